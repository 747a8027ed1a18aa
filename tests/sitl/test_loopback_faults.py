"""Faults of autopilot and link through the whole loopback.

Each flight lasts four minutes of virtual time, straight until 160 s and then through a turn; its log is read
back from the disk. Requirements, with either inertial channel:

    stated accuracy     the error is within three times the stated accuracy (sigma, or the guaranteed bound if
                        greater)
    no jump             between two solutions the position follows the velocity, to within three times the
                        accuracy stated before
    events              every event is in the log, in order
"""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest

from companion.config import load
from companion.nav.geometry import Geodetic, displace, local_to_geodetic, separation
from companion.records import Event, LinkState, Reboot, Reset, Solution, Stamped, TimeStep
from companion.runtime.core import CompanionCore
from companion.storage import flight_log
from companion.storage.retention import create_log
from companion.units import SECOND_NS
from sitl.autopilot import UNIX_AT_START_NS, SimulatedAutopilot
from sitl.faults import Fault
from sitl.flight import FlightPlan, Leg, WindChange
from sitl.loopback import (
    LINK,
    START_NS,
    CollectingLog,
    fly_connected,
    fly_scenario,
    simulated_for,
    simulator_config,
    truth_function,
)
from sitl.scenarios import Scenario, SensorRates, get_scenario

pytestmark = pytest.mark.flight

PLAN = FlightPlan(
    (Leg(10, 40, 0, 0), Leg(90, 40, 38, 100), Leg(60, 40, 38, 100), Leg(80, 100, 36, 100)),
    winds=(WindChange(0, 4, 5),),
)
BEACONS = get_scenario("short").beacons
OUTAGE_S = 100.0  # after take-off and the wind change during the climb
OUTAGE = ((OUTAGE_S, math.inf),)
#: By which channel a fault is flown on every change; by the other too in `make all-flights`.
LOCAL_FIRST = ("local_position", pytest.param("air_data", marks=pytest.mark.long))
AIR_FIRST = (pytest.param("local_position", marks=pytest.mark.long), "air_data")


class LoggedFlight:
    """Log and truth of one flight."""

    def __init__(self, folder: Path, channel: str, **changes) -> None:
        scenario = Scenario("faults", **{"plan": PLAN, "rates": SensorRates(imu=1.0), **changes})
        config = simulator_config(
            load(flags={"rates.imu_hz": 0.0, "inertial.source": channel}, environment={})
        )
        log = create_log(
            folder, metadata={}, start_unix_ns=UNIX_AT_START_NS, start_ns=START_NS, min_free=0, block=True
        )
        with log:
            flown = fly_scenario(scenario, config, log)
        assert log.trouble is None
        self.autopilot, self.truth = flown.autopilot, truth_function(flown.autopilot)
        self.logged = [entry.value for entry in flight_log.read(log.path)]
        self.solutions = [value for value in self.logged if isinstance(value, Solution)]

    def event_lines(self) -> list[str]:
        """Events and resets in the order of the log, each with its flight time in seconds."""
        lines = []
        for value in self.logged:
            if isinstance(value, Event | Reset):
                text = value.text if isinstance(value, Event) else f"{value.what}: {value.reason}"
                lines.append(f"{(value.rx_ns - START_NS) * 1e-9:.1f} {text}")
        return lines

    def assert_events(self, *patterns: str) -> None:
        """Each of `patterns` is logged, in this order."""
        lines = iter(self.event_lines())
        for pattern in patterns:
            assert any(re.search(pattern, line) for line in lines), (pattern, self.event_lines())

    def assert_accuracy(self) -> None:
        """The error of every solution is within three times its stated accuracy."""
        for s in self.solutions:
            north, east, _ = separation(place(s), self.truth(s.t_ns))
            assert math.hypot(north, east) <= 3.0 * stated_accuracy(s), s

    def assert_no_jump(self, longest_gap_s: float = 0.5) -> None:
        """No position jump, and no gap longer than `longest_gap_s`."""
        for before, after in itertools.pairwise(self.solutions):
            dt = (after.t_ns - before.t_ns) * 1e-9
            assert dt <= longest_gap_s, after
            north, east, _ = separation(place(after), place(before))
            step = [
                moved - 0.5 * dt * (v + w)
                for moved, v, w in zip((north, east), before.v_n[:2], after.v_n[:2], strict=True)
            ]
            accuracy = math.hypot(stated_accuracy(before), stated_accuracy(after))  # independent by a restart
            assert math.hypot(*step) <= 3.0 * accuracy, (before, after)


def place(solution: Solution) -> Geodetic:
    return Geodetic(solution.lat, solution.lon, solution.alt_msl)


def stated_accuracy(solution: Solution) -> float:
    """One sigma, or the guaranteed bound if greater."""
    sigma = math.sqrt(solution.covariance[0]), math.sqrt(solution.covariance[3])
    return math.hypot(*map(max, sigma, solution.bound_n or (0.0, 0.0)))


@pytest.mark.parametrize("channel", AIR_FIRST)
@pytest.mark.parametrize("beacons", [pytest.param((), marks=pytest.mark.long), BEACONS])
def test_ten_gnss_outages(tmp_path: Path, channel: str, beacons) -> None:
    outages = tuple((OUTAGE_S + 13.0 * i, OUTAGE_S + 13.0 * i + 7.0) for i in range(10))
    flown = LoggedFlight(tmp_path, channel, gnss_outages=outages, beacons=beacons)
    flown.assert_accuracy()
    flown.assert_no_jump()
    lost = r"fixed: azimuth and range fixes" if beacons else r"predicting: no fixes; protection level"
    back = r"fixed: gnss and azimuth and range fixes" if beacons else r"fixed: gnss fixes"
    flown.assert_events(*itertools.chain.from_iterable([lost, back] for _ in outages))
    assert sum(bool(re.search(lost, line)) for line in flown.event_lines()) == len(outages)


def test_gnss_is_accepted_after_an_outage_with_wind_change(tmp_path: Path) -> None:
    """Dead reckoning has the error of the wind change, far more than its random walk explains."""
    climb = FlightPlan(
        (Leg(10, 40, 0, 0), Leg(50, 40, 38, 0), Leg(120, 40, 38, 120)),
        winds=(WindChange(0, 4, 5),),  # reached during the climb, from 75 to 90 s
    )
    flown = LoggedFlight(tmp_path, "air_data", plan=climb, gnss_outages=((82.0, 94.0),))
    flown.assert_events(r"^84\.\d navigation predicting", r"^94\.\d navigation fixed: gnss")
    for s in flown.solutions:
        if (s.t_ns - START_NS) * 1e-9 > 96.0:
            north, east, _ = separation(place(s), flown.truth(s.t_ns))
            assert math.hypot(north, east) <= 3.0 * stated_accuracy(s), s


@pytest.mark.parametrize("channel", LOCAL_FIRST)
def test_autopilot_reboot_during_gnss_outage(tmp_path: Path, channel: str) -> None:
    flown = LoggedFlight(
        tmp_path, channel, beacons=BEACONS, gnss_outages=OUTAGE, faults=(Fault("reboot", 120.0, size=8.0),)
    )
    flown.assert_accuracy()
    flown.assert_no_jump(longest_gap_s=8.0 + 2.0)  # until the first beacon answer
    reset = "navigator" if channel == "local_position" else "sensors"
    flown.assert_events(
        "silent for 5 s", "autopilot 1 connected", "1 rebooted", f"{reset}: autopilot 1 rebooted"
    )
    assert sum(isinstance(value, Reboot) for value in flown.logged) == 1
    assert (flown.solutions[-1].t_ns - START_NS) * 1e-9 > PLAN.duration_s - 1.0


def test_no_solution_after_a_reboot_without_fixes_by_the_autopilot_channel(
    tmp_path: Path,
) -> None:
    flown = LoggedFlight(
        tmp_path, "local_position", gnss_outages=OUTAGE, faults=(Fault("reboot", 120.0, size=8.0),)
    )
    flown.assert_accuracy()
    assert (flown.solutions[-1].t_ns - START_NS) * 1e-9 < 120.0


def test_estimated_wind_survives_a_reboot(tmp_path: Path) -> None:
    """For air-data dead reckoning the reboot is only a gap in the airspeed."""
    flown = LoggedFlight(
        tmp_path, "air_data", gnss_outages=OUTAGE, faults=(Fault("reboot", 120.0, size=8.0),)
    )
    flown.assert_accuracy()
    flown.assert_no_jump(longest_gap_s=8.0 + 1.0)
    flown.assert_events("sensors: autopilot 1 rebooted")
    last = flown.solutions[-1]
    north, east, _ = separation(place(last), flown.truth(last.t_ns))
    assert math.hypot(north, east) < 0.5 * 6.4 * 140.0  # half of the error without a wind estimate


@pytest.mark.parametrize("channel", AIR_FIRST)
@pytest.mark.parametrize("outages", [pytest.param((), marks=pytest.mark.long), OUTAGE])
def test_link_loss_of_thirty_seconds(tmp_path: Path, channel: str, outages) -> None:
    flown = LoggedFlight(tmp_path, channel, gnss_outages=outages, faults=(Fault("link-loss", 115.0, 145.0),))
    flown.assert_accuracy()
    flown.assert_no_jump(longest_gap_s=31.01)  # the loss, a second to resume, and the jitter of the link
    flown.assert_events("silent for 5 s", r"14[56]\.\d sitl: autopilot 1 connected")
    down = [s for s in flown.logged if isinstance(s, LinkState) and not s.connected]
    assert 20 <= len(down) <= 30  # one per second after the link counts as lost


@pytest.mark.parametrize("channel", LOCAL_FIRST)
@pytest.mark.parametrize("outages", [pytest.param((), marks=pytest.mark.long), OUTAGE])
def test_local_origin_moves_by_a_kilometre(tmp_path: Path, channel: str, outages) -> None:
    """And back; the new origin is sent two seconds after the first local positions that refer to it."""
    there, back = 118.0, 198.0
    flown = LoggedFlight(
        tmp_path, channel, gnss_outages=outages, faults=(Fault("origin-change", there, back, 1000.0),)
    )
    flown.assert_accuracy()
    flown.assert_no_jump()
    if channel == "air_data":
        return  # local positions are not used
    flown.assert_events("jumped by", "local origin changed", "jumped by", "jumped by", "local origin changed")
    old = flown.autopilot.world.origin
    new = displace(*old, 1000.0 * math.sqrt(0.5), 1000.0 * math.sqrt(0.5), 0.0)
    silent, last = 0.0, START_NS
    for at_ns, odometry in flown.autopilot.outputs:
        if odometry.get_type() != "ODOMETRY":
            continue
        t, silent, last = (at_ns - START_NS) * 1e-9, max(silent, (at_ns - last) * 1e-9), at_ns
        event_lines = np.array([odometry.x, odometry.y, odometry.z])
        origin = new if there < t < back else old
        north, east, _ = separation(local_to_geodetic("ardupilot", origin, event_lines), flown.truth(at_ns))
        assert math.hypot(north, east) < 300.0, t  # the wrong origin would add a kilometre
    if not outages:  # without GNSS the output is also withheld by ArduPilot's accuracy limit
        assert 2.0 < silent < 8.0


@pytest.mark.parametrize("outages", [pytest.param((), marks=pytest.mark.long), OUTAGE])
def test_autopilot_filter_reset_of_forty_metres(tmp_path: Path, outages) -> None:
    flown = LoggedFlight(
        tmp_path, "local_position", gnss_outages=outages, faults=(Fault("ins-reset", 120.0, 180.0, 40.0),)
    )
    flown.assert_accuracy()
    flown.assert_no_jump()
    flown.assert_events(r"120\.\d inertial channel: jumped by 40", r"180\.\d inertial channel: jumped by 40")


@pytest.mark.long
def test_air_data_channel_ignores_local_position_resets(tmp_path: Path) -> None:
    fault = Fault("ins-reset", 120.0, 180.0, 40.0)
    calm, shaken = (
        LoggedFlight(tmp_path, "air_data", gnss_outages=OUTAGE, faults=faults) for faults in ((), (fault,))
    )
    assert [place(s) for s in shaken.solutions] == [place(s) for s in calm.solutions]


class Everything(CollectingLog):
    """All records."""

    def record(self, record: Stamped, channel: str | None = None) -> None:
        self.records.append(record)


class StandsStill:
    """A simulated autopilot on a busy computer: its world and its clock stand still for `lasting_s`."""

    def __init__(self, autopilot: SimulatedAutopilot, begin_ns: int, lasting_s: float) -> None:
        self.autopilot, self.begin_ns, self.lasting_ns = autopilot, begin_ns, round(1e9 * lasting_s)
        self.end_ns = autopilot.end_ns + self.lasting_ns

    def world_ns(self, now_ns: int) -> int:
        return min(now_ns, max(self.begin_ns, now_ns - self.lasting_ns))

    def poll(self, now_ns: int) -> list[bytes]:
        return self.autopilot.poll(self.world_ns(now_ns))

    def receive(self, data: bytes, now_ns: int) -> None:
        self.autopilot.receive(data, self.world_ns(now_ns))

    def deadline(self) -> int:
        due = self.autopilot.deadline()
        return due if due <= self.begin_ns else due + self.lasting_ns


@pytest.mark.parametrize("own_ins", [True, False])
@pytest.mark.parametrize("lasting_s", [0.3, 0.7, 3.0])
def test_simulator_that_stands_still_leaves_a_healthy_gnss_beyond_doubt(
    own_ins: bool, lasting_s: float
) -> None:
    """What it did not fly is not known, so the position is doubted instead, until the next fix."""
    config = simulator_config(load(environment={}), own_ins)
    scenario = simulated_for(Scenario("slow", PLAN, beacons=BEACONS), config)
    log = Everything(None)
    slow = StandsStill(SimulatedAutopilot(scenario, START_NS), START_NS + 100 * SECOND_NS, lasting_s)
    fly_connected(slow, CompanionCore(config, log, (LINK,)), START_NS)
    steps = [r for r in log.records if isinstance(r, TimeStep)]
    assert sum(step.step_s for step in steps) == pytest.approx(lasting_s, abs=0.05)
    texts = [r.text for r in log.records if isinstance(r, Event)]
    assert not [text for text in texts if "suspect" in text or "excluded" in text]
    truth, late = truth_function(slow.autopilot), 0
    for s in (r for r in log.records if isinstance(r, Solution)):
        if s.t_ns > steps[-1].t_ns + SECOND_NS:
            north, east, _ = separation(place(s), truth(slow.world_ns(s.t_ns)))
            assert math.hypot(north, east) <= 3.0 * stated_accuracy(s), s
            late += 1
    assert late > 500


class SpedUp:
    """A simulated autopilot whose world and clock run `rate` times as fast as ours."""

    def __init__(self, autopilot: SimulatedAutopilot, rate: float) -> None:
        self.autopilot, self.rate = autopilot, rate
        self.end_ns = START_NS + round((autopilot.end_ns - START_NS) / rate)

    def world_ns(self, now_ns: int) -> int:
        return START_NS + int((now_ns - START_NS) * self.rate)

    def poll(self, now_ns: int) -> list[bytes]:
        return self.autopilot.poll(self.world_ns(now_ns))

    def receive(self, data: bytes, now_ns: int) -> None:
        self.autopilot.receive(data, self.world_ns(now_ns))

    def deadline(self) -> int:
        return START_NS + math.ceil((self.autopilot.deadline() - START_NS) / self.rate) + 1


def test_nothing_of_a_simulation_that_is_sped_up_is_used_and_that_is_reported() -> None:
    """Its velocities fit no clock of ours: with them a healthy GNSS was excluded after 8 s."""
    config = simulator_config(load(environment={}), own_ins=False)
    scenario = simulated_for(Scenario("fast", PLAN, beacons=BEACONS), config)
    log = Everything(None)
    fast = SpedUp(SimulatedAutopilot(scenario, START_NS), 3.0)
    fly_connected(fast, CompanionCore(config, log, (LINK,)), START_NS)
    events = [r for r in log.records if isinstance(r, Event)]
    (at,) = (e.t_ns for e in events if "runs 3 times as fast as ours: nothing of it is used" in e.text)
    assert at < START_NS + 8 * SECOND_NS
    later = [e.text for e in events if e.t_ns > at]
    assert later == ["no solution for 2 s: no data from the inertial channel"]
    assert not [r for r in log.records if isinstance(r, Solution) and r.t_ns > at + 2 * SECOND_NS]
    assert not [e for e in events if "excluded" in e.text or "source set 2" in e.text]
