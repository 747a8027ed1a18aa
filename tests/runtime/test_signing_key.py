"""Signing key: signed links work with any system clock, which is used only while it is synchronized."""

import time
from pathlib import Path

import pytest

from companion.link import dialect, frame
from companion.link.signing import SignatureFault, Signing, load_timestamp
from companion.runtime.signing_key import SET_AFTER_NS, SigningKey, synchronized_time
from tests.frames import parsed

SECOND, DAY = 10**9, 86_400 * 10**9
#: GPS time of the autopilot, UNIX nanoseconds.
TRUE_NS = SET_AFTER_NS + 800 * DAY
KEY = bytes(32)


def signed_heartbeat(signing: Signing, system: int, now_ns: int) -> frame.Frame:
    """Return a heartbeat signed at `now_ns`, as received."""
    message = dialect.new("HEARTBEAT", type=1, autopilot=3)
    return parsed(frame.encode(message, 0, system, 1, lambda data: signing.sign(data, 0, now_ns)))


@pytest.mark.parametrize("behind_ns", [TRUE_NS, 500 * DAY, DAY, -DAY])
def test_unsynchronized_clock_neither_rejects_nor_is_rejected(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, behind_ns: int
) -> None:
    """Clock at 1970, at the build of systemd, at the last shutdown, and set to tomorrow by hand."""
    autopilot = Signing(KEY)
    autopilot.set_time(TRUE_NS, 0)
    monkeypatch.setattr(time, "time_ns", lambda: TRUE_NS - behind_ns)
    absent = str(tmp_path / "synchronized")
    key = SigningKey(Signing(KEY), tmp_path / "stamp", lambda: synchronized_time("linux", absent))
    for now_ns in range(SECOND, 600 * SECOND, SECOND):
        key.follow_system_time()
        assert key.signing.verify(signed_heartbeat(autopilot, 1, now_ns), now_ns) is None
        assert autopilot.verify(signed_heartbeat(key.signing, 2, now_ns), now_ns) is None


def test_clock_synchronized_in_flight_is_used_and_runs_on_after_loss(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synchronized = tmp_path / "synchronized"
    monkeypatch.setattr(time, "time_ns", lambda: TRUE_NS)
    monkeypatch.setattr(time, "monotonic_ns", lambda: 0)
    key = SigningKey(Signing(KEY), tmp_path / "stamp", lambda: synchronized_time("linux", str(synchronized)))
    assert key.signing.time(0) == 0
    synchronized.touch()
    key.follow_system_time()
    followed = Signing(KEY)
    followed.set_time(TRUE_NS, 0)
    assert key.signing.time(0) == followed.time(0) > 0
    synchronized.unlink()
    key.follow_system_time()
    assert key.signing.time(DAY) == followed.time(DAY)
    future = Signing(KEY)  # recorded from a station whose clock was wrong
    future.set_time(TRUE_NS + DAY, 0)
    assert key.signing.verify(signed_heartbeat(future, 1, 0), 0) is SignatureFault.FUTURE


def test_clock_that_was_never_set_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: 3600 * SECOND)
    assert synchronized_time("darwin", str(tmp_path)) is None
    monkeypatch.setattr(time, "time_ns", lambda: TRUE_NS)
    assert synchronized_time("darwin", str(tmp_path / "absent")) == TRUE_NS


def test_timestamp_that_the_disk_does_not_take_is_reported_and_tried_again(tmp_path: Path) -> None:
    """What is not stored could be replayed after a restart."""
    autopilot, folder = Signing(KEY), tmp_path / "full"
    autopilot.set_time(TRUE_NS, 0)
    key = SigningKey(Signing(KEY), folder / "stamp", lambda: None)
    received = signed_heartbeat(autopilot, 1, SECOND)
    assert key.signing.verify(received, SECOND) is None
    for _ in range(2):
        assert key.save_timestamp() == f"cannot write {folder / 'stamp'}: No such file or directory"
    folder.mkdir()
    assert key.save_timestamp() is None
    after = Signing(KEY, timestamp=load_timestamp(folder / "stamp"))
    assert after.verify(received, 2 * SECOND) is SignatureFault.OLD
