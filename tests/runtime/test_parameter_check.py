"""The look at the autopilot's parameters at the start of a flight: one line where something is wrong, and
never a change."""

import pytest

from companion.config import load
from companion.config.required_parameters import needed
from companion.link import frame
from companion.records import Stamped
from companion.runtime.core import Onboard
from sitl.autopilot import Autopilot
from sitl.faults import Fault
from sitl.scenarios import named
from sitl.world import World

SECOND = 1_000_000_000
STEP = SECOND // 50
REQUEST_READ, SET = 20, 23
WORLDS = {make: World(named("short", autopilot=make)) for make in ("ardupilot", "px4")}


class Kept:
    """A log of nothing."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        pass

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        pass


class Flight:
    """An autopilot and the companion joined for some seconds; what was asked, and what was told of it."""

    def __init__(self, make: str, *pairs: str, right: bool = False, seconds: float = 8.0, **scenario) -> None:
        world = WORLDS[make] if not scenario else None
        autopilot = Autopilot(named("short", autopilot=make, **scenario), world=world)
        config = load(None, None, {}, pairs)
        if right:
            autopilot.parameters.values |= {need.name: need.value for need in needed(config, make)}
        before = dict(autopilot.parameters.values)
        onboard = Onboard(config, Kept())
        self.asked: list[int] = []
        for now in range(STEP, round(seconds * SECOND), STEP):
            for data in autopilot.poll(now):
                onboard.receive("main", data, now)
            onboard.poll(now)
            for data in onboard.to_send("main", now):
                autopilot.receive(data, now)
                seen = frame.examine(data)
                assert isinstance(seen, frame.Frame)
                self.asked += [seen.msgid] if seen.msgid in (REQUEST_READ, SET) else []
        self.told = [event.text for event in onboard.take_events() if "doctor" in event.text]
        assert autopilot.parameters.values == before and SET not in self.asked


@pytest.mark.parametrize(
    ("make", "line"),
    [
        ("ardupilot", "main: VISO_TYPE is 0, needs 1 and 2 more: see companion doctor"),
        ("px4", "main: EKF2_AGP0_ID is 0, needs 1 and 1 more: see companion doctor"),
    ],
)
@pytest.mark.parametrize("custom", [False, True])
def test_what_is_wrong_is_told_in_one_line(make: str, line: str, custom: bool) -> None:
    rate = "odometry_hz=10" if make == "ardupilot" else "global_position_sensor_hz=2"
    pairs = ("output.profile=custom", f"output.{rate}") if custom else (f"output.profile={make}",)
    assert Flight(make, *pairs).told == [line]


def test_what_is_right_is_not_worth_a_line() -> None:
    flight = Flight("ardupilot", "output.profile=ardupilot", right=True)
    assert flight.told == [] and len(flight.asked) == 6


@pytest.mark.parametrize("profile", ["monitor", "px4"])  # of the latter another line tells
def test_nobody_is_asked_where_nothing_is_fed(profile: str) -> None:
    flight = Flight("ardupilot", f"output.profile={profile}")
    assert flight.told == [] and flight.asked == []


def test_after_a_reboot_it_is_looked_at_again() -> None:
    flight = Flight("ardupilot", "output.profile=ardupilot", seconds=20.0, faults=(Fault("reboot", 10.0),))
    assert len(flight.told) == 2 and len(flight.asked) == 12
