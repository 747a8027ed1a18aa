"""What goes wrong between an autopilot and us, through the whole loopback: no jump, all of it logged.

Each flight is four minutes of bytes in virtual time, straight on to 160 s and through a turn, and its log is
read back from the disk. The same is asked of every one, by either inertial channel:

    the stated accuracy holds     the error is within three of it (sigma, or the guaranteed bound if greater)
    no jump                       from one solution to the next the position goes on by the velocity, but for
                                  three of the accuracy stated before: so much may new data correct
    every event is in the log     in its order
"""

import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest

from companion.config import load
from companion.nav.geometry import Geodetic, displace, local_to_geodetic, separation
from companion.records import Event, LinkState, Reboot, Reset, Solution
from companion.storage import flight_log
from companion.storage.retention import open_log
from sitl.autopilot import UNIX_AT_START_NS
from sitl.faults import Fault
from sitl.flight import Leg, Plan, Wind
from sitl.loopback import START_NS, fly, simulated, truth_of
from sitl.scenarios import Rates, Scenario, named

PLAN = Plan(
    (Leg(10, 40, 0, 0), Leg(90, 40, 38, 100), Leg(60, 40, 38, 100), Leg(80, 100, 36, 100)),
    winds=(Wind(0, 4, 5),),
)
BEACONS = named("short").beacons
OFF = 100.0  # the take-off is over, and with it the change of the wind on the way up
LOST = ((OFF, math.inf),)
CHANNELS = ("local_position", "air_data")


class Flown:
    """One flight's log, and the truth."""

    def __init__(self, folder: Path, channel: str, **changes) -> None:
        scenario = Scenario("faults", **{"plan": PLAN, "rates": Rates(imu=1.0), **changes})
        config = simulated(load(flags={"rates.imu_hz": 0.0, "inertial.source": channel}, environment={}))
        log = open_log(
            folder, metadata={}, start_unix_ns=UNIX_AT_START_NS, start_ns=START_NS, min_free=0, block=True
        )
        with log:
            flown = fly(scenario, config, log)
        assert log.trouble is None
        self.autopilot, self.truth = flown.autopilot, truth_of(flown.autopilot)
        self.logged = [entry.value for entry in flight_log.read(log.path)]
        self.solutions = [value for value in self.logged if isinstance(value, Solution)]

    def told(self) -> list[str]:
        """Events and resets, in the log's order, each with its second of flight."""
        lines = []
        for value in self.logged:
            if isinstance(value, Event | Reset):
                text = value.text if isinstance(value, Event) else f"{value.what}: {value.reason}"
                lines.append(f"{(value.rx_ns - START_NS) * 1e-9:.1f} {text}")
        return lines

    def tells(self, *patterns: str) -> None:
        """Each of `patterns` is told, in this order."""
        lines = iter(self.told())
        for pattern in patterns:
            assert any(re.search(pattern, line) for line in lines), (pattern, self.told())

    def holds(self) -> None:
        """The accuracy stated with each solution is kept three times over."""
        for s in self.solutions:
            north, east, _ = separation(place(s), self.truth(s.t_ns))
            assert math.hypot(north, east) <= 3.0 * stated(s), s

    def does_not_jump(self, longest_gap_s: float = 0.5) -> None:
        """Nor does it stop for longer."""
        for before, after in itertools.pairwise(self.solutions):
            dt = (after.t_ns - before.t_ns) * 1e-9
            assert dt <= longest_gap_s, after
            north, east, _ = separation(place(after), place(before))
            step = [
                moved - 0.5 * dt * (v + w)
                for moved, v, w in zip((north, east), before.v_n[:2], after.v_n[:2], strict=True)
            ]
            assert math.hypot(*step) <= 3.0 * stated(before), (before, after)


def place(solution: Solution) -> Geodetic:
    return Geodetic(solution.lat, solution.lon, solution.alt_msl)


def stated(solution: Solution) -> float:
    """One sigma, or the guaranteed bound where it is greater."""
    sigma = math.sqrt(solution.covariance[0]), math.sqrt(solution.covariance[3])
    return math.hypot(*map(max, sigma, solution.bound_n or (0.0, 0.0)))


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("beacons", [(), BEACONS])
def test_gnss_is_lost_and_comes_back_ten_times(tmp_path: Path, channel: str, beacons) -> None:
    outages = tuple((OFF + 13.0 * i, OFF + 13.0 * i + 7.0) for i in range(10))
    flown = Flown(tmp_path, channel, gnss_outages=outages, beacons=beacons)
    flown.holds()
    flown.does_not_jump()
    lost = r"fixed: azimuth and range fixes" if beacons else r"predicting: no fixes; the guaranteed bound is"
    back = r"fixed: gnss and azimuth and range fixes" if beacons else r"fixed: gnss fixes"
    flown.tells(*itertools.chain.from_iterable([lost, back] for _ in outages))
    assert sum(bool(re.search(lost, line)) for line in flown.told()) == len(outages)


def test_gnss_is_believed_when_it_comes_back_to_a_wind_that_has_changed(tmp_path: Path) -> None:
    """Dead reckoning is off by what the wind gained meanwhile, far beyond a random walk of it."""
    climb = Plan(
        (Leg(10, 40, 0, 0), Leg(50, 40, 38, 0), Leg(120, 40, 38, 120)),
        winds=(Wind(0, 4, 5),),  # aloft alone: it is met from 75 to 90 s
    )
    flown = Flown(tmp_path, "air_data", plan=climb, gnss_outages=((82.0, 94.0),))
    flown.tells(r"^84\.\d navigation predicting", r"^94\.\d navigation fixed: gnss")
    for s in flown.solutions:
        if (s.t_ns - START_NS) * 1e-9 > 96.0:
            north, east, _ = separation(place(s), flown.truth(s.t_ns))
            assert math.hypot(north, east) <= 3.0 * stated(s), s


@pytest.mark.parametrize("channel", CHANNELS)
def test_the_autopilot_reboots_while_gnss_is_lost(tmp_path: Path, channel: str) -> None:
    flown = Flown(
        tmp_path, channel, beacons=BEACONS, gnss_outages=LOST, faults=(Fault("reboot", 120.0, size=8.0),)
    )
    flown.holds()
    flown.does_not_jump(longest_gap_s=8.0 + 2.0)  # the first answer of the beacon after it
    reset = "navigator" if channel == "local_position" else "air data"
    flown.tells("silent for 5 s", "autopilot 1 heard", "1 rebooted", f"{reset}: autopilot 1 rebooted")
    assert sum(isinstance(value, Reboot) for value in flown.logged) == 1
    assert (flown.solutions[-1].t_ns - START_NS) * 1e-9 > PLAN.duration_s - 1.0


def test_after_a_reboot_without_any_fix_nothing_is_claimed_of_another_inertial_channel(
    tmp_path: Path,
) -> None:
    flown = Flown(tmp_path, "local_position", gnss_outages=LOST, faults=(Fault("reboot", 120.0, size=8.0),))
    flown.holds()
    assert (flown.solutions[-1].t_ns - START_NS) * 1e-9 < 120.0


def test_the_wind_that_was_learnt_outlives_a_reboot(tmp_path: Path) -> None:
    """Air-data dead reckoning is our own: the autopilot's reboot is a silence in its airspeed."""
    flown = Flown(tmp_path, "air_data", gnss_outages=LOST, faults=(Fault("reboot", 120.0, size=8.0),))
    flown.holds()
    flown.does_not_jump(longest_gap_s=8.0 + 1.0)
    flown.tells("air data: autopilot 1 rebooted", "no airspeed with attitude for 8")
    last = flown.solutions[-1]
    north, east, _ = separation(place(last), flown.truth(last.t_ns))
    assert math.hypot(north, east) < 0.5 * 6.4 * 140.0  # half of what not to know the wind would cost


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("outages", [(), LOST])
def test_the_link_is_gone_for_thirty_seconds(tmp_path: Path, channel: str, outages) -> None:
    flown = Flown(tmp_path, channel, gnss_outages=outages, faults=(Fault("link-loss", 115.0, 145.0),))
    flown.holds()
    flown.does_not_jump(longest_gap_s=31.0)
    flown.tells("silent for 5 s", r"14[56]\.\d sitl: autopilot 1 heard")
    if channel == "air_data":
        flown.tells("no airspeed with attitude for 30")
    down = [s for s in flown.logged if isinstance(s, LinkState) and not s.connected]
    assert 20 <= len(down) <= 30  # one a second, from the moment it counts as lost


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("outages", [(), LOST])
def test_the_origin_of_the_local_position_moves_by_a_kilometre(tmp_path: Path, channel: str, outages) -> None:
    """And back; the new one is told two seconds after the first local positions that are counted from it."""
    there, back = 118.0, 198.0
    flown = Flown(
        tmp_path, channel, gnss_outages=outages, faults=(Fault("origin-change", there, back, 1000.0),)
    )
    flown.holds()
    flown.does_not_jump()
    if channel == "air_data":
        return  # it does not listen to local positions
    flown.tells("jumped by", "local origin changed", "jumped by", "jumped by", "local origin changed")
    old = flown.autopilot.world.origin
    new = displace(*old, 1000.0 * math.sqrt(0.5), 1000.0 * math.sqrt(0.5), 0.0)
    silent, last = 0.0, START_NS
    for at_ns, odometry in flown.autopilot.outputs:
        if odometry.get_type() != "ODOMETRY":
            continue
        t, silent, last = (at_ns - START_NS) * 1e-9, max(silent, (at_ns - last) * 1e-9), at_ns
        told = np.array([odometry.x, odometry.y, odometry.z])
        origin = new if there < t < back else old
        north, east, _ = separation(local_to_geodetic("ardupilot", origin, told), flown.truth(at_ns))
        assert math.hypot(north, east) < 300.0, t  # what is counted from the wrong one is a kilometre off
    if not outages:  # without GNSS an accuracy worse than ArduPilot can be told withholds it for longer
        assert 2.0 < silent < 8.0


@pytest.mark.parametrize("outages", [(), LOST])
def test_the_autopilot_s_filter_resets_its_local_position_by_forty_metres(tmp_path: Path, outages) -> None:
    flown = Flown(
        tmp_path, "local_position", gnss_outages=outages, faults=(Fault("ins-reset", 120.0, 180.0, 40.0),)
    )
    flown.holds()
    flown.does_not_jump()
    flown.tells(r"120\.\d inertial channel: it jumped by 40", r"180\.\d inertial channel: it jumped by 40")


def test_air_data_never_hears_of_a_reset_of_the_local_position(tmp_path: Path) -> None:
    fault = Fault("ins-reset", 120.0, 180.0, 40.0)
    calm, shaken = (
        Flown(tmp_path, "air_data", gnss_outages=LOST, faults=faults) for faults in ((), (fault,))
    )
    assert [place(s) for s in shaken.solutions] == [place(s) for s in calm.solutions]
