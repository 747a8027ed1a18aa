"""A navigator that is stopped in flight, and its state given to another: the flight goes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.config import Config, load, to_toml
from companion.navigator import Navigator, kept_state
from companion.navigator.state import Settings, State
from companion.records import Event, Gnss, Output, Resumed, RsbnFix, Solution, Stamped
from tests.navigator.test_flights import CHANNELS, NS, Flown, fly
from tests.recordings import recording

OWN = load(flags={"output.profile": "ardupilot"}, environment={})
KEPT_S, STOPPED_S, AGAIN_S = 177.0, 180.0, 188.0
FALSE_S = 120.0  # from here on GNSS is false, or lost
NO_BEACON = ((0.0, 1e9),)


def flown_state(until_s: float = 30.0) -> State:
    navigator = Navigator(OWN)
    start_ns = None
    for record in recording("plane_take_off"):
        start_ns = start_ns or record.t_ns
        if record.t_ns > start_ns + until_s * NS:
            break
        navigator.handle(record)
    navigator.finish()
    return navigator.state


STATE = flown_state()
BYTES = kept_state.encode(STATE)


def resumed(data: bytes, later_s: float = 5.0, config: Config = OWN) -> tuple[Navigator, list[Output]]:
    """A navigator that was given the bytes, and its outputs."""
    assert STATE.nominal is not None
    navigator, t_ns = Navigator(OWN), STATE.nominal.t_ns + round(later_s * NS)
    return navigator, navigator.handle(Resumed(t_ns, t_ns, to_toml(config), data))


def test_what_is_kept_comes_back_bit_for_bit() -> None:
    back = kept_state.decode(BYTES, Settings.of(OWN))
    assert kept_state.encode(replace(back, bank=None)) == kept_state.encode(replace(STATE, bank=None))
    assert back.bank is not None and STATE.bank is not None
    assert len(back.bank.L) == kept_state.MOST_ROWS < len(STATE.bank.L)
    assert math.isclose(back.bank.weights.sum(), 1.0)
    likeliest = np.argsort(-STATE.bank.L, kind="stable")[: kept_state.MOST_ROWS]
    for name in ("x", "P", "grade", "fault", "event", "since", "scale", "noise"):
        np.testing.assert_array_equal(getattr(back.bank, name), getattr(STATE.bank, name)[likeliest])


@pytest.mark.parametrize(
    "data, later_s, config, why",
    [
        (BYTES, -1.0, OWN, "it is -1 s old, and the limit is 60 s"),
        (BYTES, 61.0, OWN, "it is 61 s old, and the limit is 60 s"),
        (BYTES, 5.0, load(flags={"inertial.independent": True}, environment={}), "its hypotheses do not fit"),
        (kept_state.encode(State()), 5.0, OWN, "it has no position"),
        (BYTES[:-1], 5.0, OWN, "it is damaged"),
        (b"", 5.0, OWN, "it is damaged"),
        (bytes(5), 5.0, OWN, "it is damaged"),
    ],
)
def test_a_state_that_is_not_of_use_is_refused_in_a_sentence(
    data: bytes, later_s: float, config: Config, why: str
) -> None:
    navigator, (event,) = resumed(data, later_s, config)
    assert isinstance(event, Event)
    assert event.text == f"the state of the run before is not used: {why}"
    assert navigator.state == State()


@given(st.integers(0, len(BYTES) - 1), st.integers(0, 255))
def test_damaged_bytes_are_refused(at: int, value: int) -> None:
    damaged = BYTES[:at] + bytes([value]) + BYTES[at + 1 :]
    navigator, _ = resumed(damaged)
    assert (navigator.state == State()) == (damaged != BYTES)


class Restarted:
    """A navigator that is stopped in flight and started again, from what it kept unless it forgets."""

    def __init__(self, config: Config, forgets: bool = False) -> None:
        self._config, self._forgets = config, forgets
        self._navigator = Navigator(config)
        self._kept: bytes | None = None
        self._is_second = False

    def handle(self, record: Stamped) -> list[Output]:
        t_s, outputs = record.rx_ns / NS, list[Output]()
        if self._kept is None and t_s >= KEPT_S:
            self._kept = kept_state.encode(self._navigator.state)
        if STOPPED_S <= t_s < AGAIN_S:
            return []
        if t_s >= AGAIN_S and not self._is_second:
            self._is_second, self._navigator = True, Navigator(self._config)
            if not self._forgets:
                assert self._kept is not None
                kept = Resumed(record.t_ns, record.rx_ns, to_toml(self._config), self._kept)
                outputs = self._navigator.handle(kept)
        return outputs + self._navigator.handle(record)


def restarted(channel: str, forgets: bool = False, **flight: Any) -> Flown:
    navigator: Any = Restarted(CHANNELS[channel][0], forgets)
    return fly(channel, navigator=navigator, seed=2, **flight)


def drawn_off(speed: float) -> Callable[[Any], Any]:
    """A GNSS that is drawn off to the east, its velocity too."""

    def change(record: Any) -> Any:
        seconds = record.t_ns / NS - FALSE_S
        if not isinstance(record, Gnss) or record.v_n is None or seconds < 0.0:
            return record
        north, east, down = record.v_n
        lon = record.lon + speed * seconds / (6.378e6 * math.cos(record.lat))
        return replace(record, lon=lon, v_n=(north, east + speed, down))

    return change


@pytest.mark.flight
def test_beside_a_false_gnss_it_stays_excluded() -> None:
    """A companion that began beside it believed it, and was 600 m off four minutes later."""
    flown = restarted("imu", change=drawn_off(2.0))
    assert "gnss is excluded: false with probability 1.0000" in [e.text for e in flown.events]
    assert flown.error[flown.t > AGAIN_S].max() < 60.0
    lost = restarted("imu", forgets=True, change=drawn_off(2.0))
    assert lost.error[lost.t > AGAIN_S].max() > 150.0


@pytest.mark.flight
@pytest.mark.parametrize("channel", ["imu", "air", pytest.param("ins", marks=pytest.mark.long)])
def test_without_gnss_and_beacon_the_position_goes_on(channel: str) -> None:
    """As if the companion had not been stopped, but for the eleven seconds in which nothing was measured."""
    dark: dict[str, Any] = {"gnss_until": FALSE_S, "rsbn": NO_BEACON}
    flown, whole = restarted(channel, **dark), fly(channel, seed=2, **dark)
    assert not restarted(channel, forgets=True, **dark).of("lat", AGAIN_S).size
    late = flown.t > AGAIN_S
    assert flown.t[late][0] < AGAIN_S + 1.0
    assert flown.error[-1] < whole.error[-1] + 100.0
    for t in range(190, 300, 10):
        assert flown.nees(t) < 13.8  # 0.999 of two degrees of freedom


@pytest.mark.flight
def test_a_healthy_gnss_is_believed_at_once() -> None:
    flown = restarted("imu")
    fixed = [e.t_ns / NS for e in flown.events if e.text.startswith("navigation fixed: gnss")]
    assert any(AGAIN_S <= t < AGAIN_S + 1.0 for t in fixed)
    assert flown.error[flown.t > AGAIN_S + 1.0].max() < 6.0
    assert not [e for e in flown.events if "suspect" in e.text or "excluded" in e.text]


def test_a_log_that_begins_with_a_kept_state_is_replayed_alike() -> None:
    """The state is a record of the log: what is flown from it depends on nothing else."""
    assert STATE.nominal is not None
    begin = STATE.nominal.t_ns
    later = [r for r in recording("plane_take_off") if begin + NS < r.t_ns < begin + 20 * NS]
    runs = []
    for _ in range(2):
        navigator, _ = resumed(BYTES, 1.0)
        runs.append([out for record in later for out in navigator.handle(record)])
    assert runs[0] == runs[1]
    assert sum(isinstance(out, Solution) for out in runs[0]) > 50
    assert any(isinstance(record, RsbnFix) for record in later)
