"""Parameter check: one event if the autopilot's parameters are wrong, and never a change."""

from collections.abc import Mapping
from functools import lru_cache

import pytest

from companion.config import load
from companion.config.required_parameters import required_parameters
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.runtime.core import CompanionCore
from companion.storage.deferred_log import NoLog
from sitl.autopilot import SimulatedAutopilot
from sitl.faults import Fault
from sitl.scenarios import get_scenario
from sitl.world import World
from tests.frames import parsed

SECOND = 1_000_000_000
STEP = SECOND // 50
REQUEST_READ, SET = 20, 23
LATER = 45 * SECOND  # when a ground station sets parameters
DARK = ((20.0, 60.0),)
FED = "output.profile=ardupilot", "inertial.independent=true"


@lru_cache(maxsize=2)
def world_of(make) -> World:
    return World(get_scenario("short", autopilot=make))


def parameter_set(name: str, value: float) -> bytes:
    """Return a PARAM_SET of a ground station."""
    fields = {"param_id": name, "param_value": value, "param_type": mavlink.MAV_PARAM_TYPE_INT8}
    return frame.encode(dialect.new("PARAM_SET", target_system=1, target_component=1, **fields), 0, 255, 190)


def source_set(data: bytes) -> list[float]:
    """Return the EKF source set that a frame requests, if it does."""
    message = dialect.decode(parsed(data))
    is_switch = getattr(message, "command", None) == mavlink.MAV_CMD_SET_EKF_SOURCE_SET
    return [message.param1] if is_switch else []


class Flight:
    """An autopilot and a companion connected for some seconds; the requests and the reports."""

    def __init__(
        self,
        make: str,
        *pairs: str,
        right: bool = False,
        seconds: float = 8.0,
        is_deaf: bool = False,
        values: Mapping[str, float] | None = None,
        later: Mapping[str, float] | None = None,
        **scenario,
    ) -> None:
        world = world_of(make) if not scenario else None
        autopilot = SimulatedAutopilot(get_scenario("short", autopilot=make, **scenario), world=world)
        config = load(None, None, {}, pairs)
        if right:
            autopilot.parameters.values |= {
                need.name: need.value for need in required_parameters(config, make)
            }
        autopilot.parameters.values |= values or {}
        before = dict(autopilot.parameters.values)
        core = CompanionCore(config, NoLog())
        self.requests: list[int] = []
        self.sets: list[float] = []
        for now in range(STEP, round(seconds * SECOND), STEP):
            if now == LATER and later is not None:
                for name, value in later.items():
                    autopilot.receive(parameter_set(name, value), now)
                before |= later
            for data in autopilot.poll(now):
                core.receive("main", data, now)
            core.poll(now)
            for data in core.to_send("main", now):
                if not is_deaf:
                    autopilot.receive(data, now)
                self.requests += {parsed(data).msgid} & {REQUEST_READ, SET}
                self.sets += source_set(data)
        events = core.take_events()
        self.reports = [event.text for event in events if "doctor" in event.text]
        assert autopilot.parameters.values == before and SET not in self.requests


@pytest.mark.parametrize(
    ("make", "line"),
    [
        ("ardupilot", "main: VISO_TYPE is 0, needs 1 and 2 more: run companion doctor"),
        ("px4", "main: EKF2_AGP0_ID is 0, needs 1 and 1 more: run companion doctor"),
    ],
)
@pytest.mark.parametrize("custom", [False, True])
def test_wrong_parameters_are_reported_in_one_event(make: str, line: str, custom: bool) -> None:
    rate = "odometry_hz=10" if make == "ardupilot" else "global_position_sensor_hz=2"
    pairs = ("output.profile=custom", f"output.{rate}") if custom else (f"output.profile={make}",)
    assert Flight(make, *pairs).reports == [line]


def test_autopilot_that_answers_nothing_lacks_no_parameter() -> None:
    (report,) = Flight("ardupilot", "output.profile=ardupilot", is_deaf=True).reports
    assert report == "main: VISO_TYPE cannot be read (no answer), needs 1 and 5 more: run companion doctor"


def test_correct_parameters_are_not_reported() -> None:
    flight = Flight("ardupilot", "output.profile=ardupilot", right=True)
    assert flight.reports == [] and len(flight.requests) == 6


@pytest.mark.parametrize("profile", ["monitor", "px4"])  # px4: reported by the output as the wrong make
def test_no_parameter_is_read_without_output(profile: str) -> None:
    flight = Flight("ardupilot", f"output.profile={profile}")
    assert flight.reports == [] and flight.requests == []


def test_parameters_are_checked_again_after_a_reboot() -> None:
    flight = Flight("ardupilot", "output.profile=ardupilot", seconds=20.0, faults=(Fault("reboot", 10.0),))
    assert len(flight.reports) == 2 and len(flight.requests) == 12


@pytest.mark.parametrize("later", [None, {"EK3_SRC2_POSXY": 6, "VISO_TYPE": 1}])
def test_an_autopilot_that_cannot_take_our_position_is_left_on_gnss(later) -> None:
    """VISO_TYPE takes effect after a reboot only."""
    flight = Flight("ardupilot", *FED, seconds=60.0, later=later, gnss_outages=DARK)
    assert flight.sets == [1]
    assert flight.reports[1:] == ["EKF source set 2 needed, but VISO_TYPE is 0: run companion doctor"]


def test_a_parameter_that_is_put_right_in_flight_counts() -> None:
    values, later = {"VISO_TYPE": 1}, {"EK3_SRC2_POSXY": 6}
    flight = Flight("ardupilot", *FED, seconds=60.0, values=values, later=later, gnss_outages=DARK)
    assert flight.sets == [1, 2]


def test_an_autopilot_that_is_prepared_is_asked_for_set_2() -> None:
    flight = Flight("ardupilot", *FED, right=True, seconds=60.0, gnss_outages=DARK)
    assert flight.sets == [1, 2] and flight.reports == []
