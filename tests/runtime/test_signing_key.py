"""Signed links live whatever the system's clock shows: it is followed only while somebody vouches for it."""

import time
from pathlib import Path

import pytest

from companion.link import dialect, frame
from companion.link.signing import Refusal, Signing
from companion.runtime.signing_key import SET_AFTER_NS, Keys, synchronized_time

SECOND, DAY = 10**9, 86_400 * 10**9
#: What the autopilot's GPS says, UNIX nanoseconds.
TRUE_NS = SET_AFTER_NS + 800 * DAY
KEY = bytes(32)


def said(signing: Signing, system: int, now_ns: int) -> frame.Frame:
    """A heartbeat signed at `now_ns`, as it is heard."""
    message = dialect.new("HEARTBEAT", type=1, autopilot=3)
    (heard,) = frame.Reader().receive(
        frame.encode(message, 0, system, 1, lambda data: signing.sign(data, 0, now_ns))
    )
    assert isinstance(heard, frame.Frame)
    return heard


@pytest.mark.parametrize("behind_ns", [TRUE_NS, 500 * DAY, DAY, -DAY])
def test_a_clock_that_is_not_synchronised_refuses_nobody_and_is_heard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, behind_ns: int
) -> None:
    """Of 1970, of the day systemd was built, of the last shutdown, set by hand to tomorrow."""
    autopilot = Signing(KEY)
    autopilot.follow(TRUE_NS, 0)
    monkeypatch.setattr(time, "time_ns", lambda: TRUE_NS - behind_ns)
    absent = str(tmp_path / "synchronized")
    keys = Keys(Signing(KEY), tmp_path / "stamp", lambda: synchronized_time("linux", absent))
    for now_ns in range(SECOND, 600 * SECOND, SECOND):
        keys.follow()
        assert keys.signing.judge(said(autopilot, 1, now_ns), now_ns) is None
        assert autopilot.judge(said(keys.signing, 2, now_ns), now_ns) is None


def test_a_clock_that_is_synchronised_in_flight_is_followed_and_runs_on_when_it_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synchronized = tmp_path / "synchronized"
    monkeypatch.setattr(time, "time_ns", lambda: TRUE_NS)
    monkeypatch.setattr(time, "monotonic_ns", lambda: 0)
    keys = Keys(Signing(KEY), tmp_path / "stamp", lambda: synchronized_time("linux", str(synchronized)))
    assert keys.signing.time(0) == 0
    synchronized.touch()
    keys.follow()
    followed = Signing(KEY)
    followed.follow(TRUE_NS, 0)
    assert keys.signing.time(0) == followed.time(0) > 0
    synchronized.unlink()
    keys.follow()
    assert keys.signing.time(DAY) == followed.time(DAY)
    future = Signing(KEY)  # a recording of a station whose clock once stood wrong
    future.follow(TRUE_NS + DAY, 0)
    assert keys.signing.judge(said(future, 1, 0), 0) is Refusal.FUTURE


def test_where_nobody_can_vouch_a_clock_that_was_never_set_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: 3600 * SECOND)
    assert synchronized_time("darwin", str(tmp_path)) is None
    monkeypatch.setattr(time, "time_ns", lambda: TRUE_NS)
    assert synchronized_time("darwin", str(tmp_path / "absent")) == TRUE_NS
