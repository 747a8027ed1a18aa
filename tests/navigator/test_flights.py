"""Whole simulated flights: a healthy GNSS is never excluded, a false one is, and the claims are honest."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace

from companion.config import Config, load
from companion.estimate.bank import Bank
from companion.nav.geometry import displace
from companion.navigator import Navigator
from companion.navigator.changes import FALSE_AIRSPEED, USE_AIRSPEED
from companion.navigator.fixes import BEACON_REACH_M
from companion.navigator.own_error_model import LATENCY
from companion.output.gate import withholding_reason
from companion.output.source_table import BELIEVED
from companion.records import (
    PARALLEL,
    AirData,
    Event,
    Gnss,
    GnssIntegrity,
    Imu,
    LocalPosition,
    Rejection,
    RsbnFix,
    Solution,
    Source,
    Trust,
    Vehicle,
)
from companion.units import Floats
from sitl.beacon import Beacon
from sitl.flight import FlightPlan, Leg, WindChange
from sitl.scenarios import Scenario, SensorRates
from sitl.world import SENSORS, World

pytestmark = pytest.mark.flight

NS = 1_000_000_000
FIVE_MINUTES = (
    Leg(5, 40, 0, 0),
    Leg(55, 40, 38, 40),
    Leg(60, 40, 38, 40),
    Leg(60, 130, 34, 40),
    Leg(60, 220, 38, 40),
    Leg(60, 310, 38, 40),
)
INS = load(flags={"inertial.independent": True}, environment={})
OWN = load(flags={"output.profile": "ardupilot"}, environment={})
CHANNELS: dict[str, tuple[Config, tuple[type, ...]]] = {
    "ins": (INS, SENSORS),
    "imu": (OWN, (*SENSORS, Imu)),
    "air": (OWN, SENSORS),
}
SETTLED_S = 60.0
Change = Callable[[Any], Any]


FAR = Beacon(1, 60.05, 31.07)


class Flown(NamedTuple):
    """Solutions with their times (s), errors north and east (m), events and rejections."""

    solutions: list[Solution]
    t: Floats
    error_n: Floats
    velocity_error_n: Floats
    events: list[Event]
    rejections: list[Rejection]

    @property
    def error(self) -> Floats:
        return np.hypot(*self.error_n.T)

    @property
    def protection(self) -> Floats:
        return np.array([s.protection for s in self.solutions])

    def of(self, name: str, start: float = 0.0, end: float = math.inf) -> Floats:
        """Field of the solutions between two times."""
        rows = [getattr(s, name) for s, t in zip(self.solutions, self.t, strict=True) if start <= t < end]
        return np.array(rows)

    def nees(self, at: float) -> float:
        """Normalised squared error of the position at a time."""
        k = int(np.searchsorted(self.t, at))
        var_n, cov, _, var_e = self.solutions[k].covariance[:4]
        e = self.error_n[k]
        return float(e @ np.linalg.solve([[var_n, cov], [cov, var_e]], e))


def fly(
    channel: str,
    change: Change = lambda record: record,
    legs: tuple[Leg, ...] = FIVE_MINUTES,
    config: Config | None = None,
    gnss_until: float = math.inf,
    rsbn: tuple[tuple[float, float], ...] = (),
    seed: int = 1,
    winds: tuple[WindChange, ...] = (WindChange(0, 4, 5),),
    beacon: Beacon = FAR,
    others: tuple[Beacon, ...] = (),
    navigator: Navigator | None = None,
    **scenario: Any,
) -> Flown:
    """Fly a scenario with every record changed, or dropped where None comes back."""
    chosen, kinds = CHANNELS[channel]
    outages = ((gnss_until, 1e9),) if gnss_until < math.inf else ()
    world = World(
        Scenario(
            "test",
            FlightPlan(legs, winds=winds),
            beacons=(beacon, *others),
            rates=SensorRates(imu=20.0, truth=1.0, gnss=2.0),
            gnss_outages=outages,
            rsbn_outages=rsbn,
            seed=seed,
            **scenario,
        )
    )
    navigator, outputs = navigator or Navigator(config or chosen), list[Any]()
    for record in world.records(kinds):
        changed = change(record)
        outputs += [] if changed is None else navigator.handle(changed)
    solutions = [out for out in outputs if isinstance(out, Solution)]
    t = np.array([s.t_ns for s in solutions]) / NS
    truth = world.flight.at(t)
    place = np.array([(s.lat, s.lon) for s in solutions])
    radius = 6.378e6
    north, east = (place[:, 0] - truth.lat) * radius, (place[:, 1] - truth.lon) * radius * np.cos(truth.lat)
    velocity = np.array([s.v_n for s in solutions])[:, :2] - truth.v_n[:, :2]
    events = [out for out in outputs if isinstance(out, Event)]
    rejections = [out for out in outputs if isinstance(out, Rejection)]
    return Flown(solutions, t, np.stack([north, east], axis=1), velocity, events, rejections)


def after(start: float, kind: type, **fields: Callable[[Any], Any]) -> Change:
    """Change the fields of one kind of record from `start` (s) on."""

    def change(record: Any) -> Any:
        if not isinstance(record, kind) or record.t_ns < start * NS:
            return record
        return replace(record, **{name: of(getattr(record, name)) for name, of in fields.items()})

    return change


# ---------------------------------------------------------------------------------------------------------
# First, do no harm
# ---------------------------------------------------------------------------------------------------------


def noisy(speed: float) -> Callable[[float], float]:
    """A sensor that is stuck still has noise in its last digits."""
    count = iter(range(10**9))
    return lambda _: speed + 0.01 * (next(count) % 7)


def late(seconds: float, kind: type = Gnss) -> Change:
    """GNSS, or a beacon, that is older than its time of validity says."""

    def change(record: Any) -> Any:
        if not isinstance(record, kind):
            return record
        shifted = record.t_ns + round(seconds * NS)
        return replace(record, t_ns=shifted, rx_ns=shifted)

    return change


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.long)])
def test_by_air_data_fixes_without_a_velocity_are_not_made_worse(seed: int) -> None:
    """GPS_RAW_INT whose vel is unknown; the take-off run, without air data, is no measurement of latency."""
    fixes = list[Gnss]()

    def position_alone(record: Any) -> Any:
        if isinstance(record, Gnss):
            record = replace(record, v_n=None)
            fixes.append(record)
        return record

    flown = fly("air", position_alone, rsbn=((0.0, 1e9),), seed=seed)
    place, radius = np.array([(s.lat, s.lon) for s in flown.solutions]), 6.378e6
    scale = np.stack([np.full(len(place), radius), radius * np.cos(place[:, 0])], axis=1)
    truth = place - flown.error_n / scale
    t = np.array([fix.t_ns for fix in fixes]) / NS
    is_later = (t > SETTLED_S) & (t < flown.t[-1])
    at = np.stack([np.interp(t, flown.t, column) for column in truth.T], axis=1)
    off = (np.array([(fix.lat, fix.lon) for fix in fixes]) - at) * scale[0]
    own = math.sqrt((off[is_later] ** 2).sum(axis=1).mean())
    ours = math.sqrt((flown.error[flown.t > SETTLED_S] ** 2).mean())
    assert 1.0 < own < 4.0
    assert ours < 1.25 * own


FINE = load(
    flags={
        "inertial.independent": True,
        **{
            f"inertial.{name}": value / 10.0
            for name, value in (
                ("gyro_drift_deg_h", INS.inertial.gyro_drift_deg_h),
                ("accelerometer_bias_ug", INS.inertial.accelerometer_bias_ug),
                ("angle_random_walk_deg_sqrt_h", INS.inertial.angle_random_walk_deg_sqrt_h),
                ("velocity_noise_m_s_sqrt_s", INS.inertial.velocity_noise_m_s_sqrt_s),
                ("tilt_arcsec", INS.inertial.tilt_arcsec),
                ("heading_arcmin", INS.inertial.heading_arcmin),
            )
        },
    },
    environment={},
)
ONE_WRONG: dict[str, Callable[[], Change]] = {
    "nothing": lambda: lambda record: record,
    "pitot low": lambda: after(120.0, AirData, airspeed=noisy(20.0)),
    "pitot high": lambda: after(120.0, AirData, airspeed=noisy(60.0)),
    "pitot zero": lambda: after(120.0, AirData, airspeed=noisy(0.0)),
    "range": lambda: after(120.0, RsbnFix, slant_range=lambda d: d + 200.0),
    "azimuth": lambda: after(120.0, RsbnFix, azimuth=lambda a: (a + math.radians(1.0)) % math.tau),
    "velocity": lambda: after(120.0, Gnss, v_n=lambda v: (v[0] + 0.4, v[1] - 0.3, v[2])),
    "late 0.3 s": lambda: late(0.3),
    "stated too fine": lambda: lambda record: record,
}
CASES = [
    ("air", "pitot low"),
    ("imu", "nothing"),
    ("imu", "range"),
    ("ins", "velocity"),
    ("ins", "stated too fine"),
    *(
        pytest.param(*case, marks=pytest.mark.long)
        for case in (
            ("ins", "nothing"),
            ("ins", "range"),
            ("imu", "azimuth"),
            ("imu", "pitot high"),
            ("imu", "pitot low"),
            ("imu", "pitot zero"),
            ("air", "pitot high"),
            ("air", "pitot zero"),
            ("ins", "azimuth"),
            ("ins", "late 0.3 s"),
            ("imu", "late 0.3 s"),
        )
    ),
]


@pytest.mark.parametrize(("channel", "wrong"), CASES)
def test_a_healthy_gnss_is_never_excluded(channel: str, wrong: str) -> None:
    flown = fly(channel, ONE_WRONG[wrong](), config=FINE if wrong == "stated too fine" else None)
    used = flown.of("sources", 30.0) & Source.GNSS
    assert used.all()
    assert flown.of("gnss_false", 30.0).max() < 0.5
    assert not any(event.text.startswith("gnss is") for event in flown.events)
    late_m = 38.0 * 0.3 if wrong == "late 0.3 s" else 0.0
    if channel != "air":  # there a false airspeed moves the nominal trajectory until the next fix
        assert flown.error[flown.t > SETTLED_S].max() < 10.0 + late_m
    assert np.all(flown.error <= flown.protection)


NEAR = Beacon(2, FAR.lat_deg + 0.045, FAR.lon_deg)
AWAY = Beacon(2, FAR.lat_deg + 0.2, FAR.lon_deg)


def misplaced(other: Beacon) -> Change:
    """FAR is stated where `other` is, which is stated where FAR is."""
    stated = {FAR.number: other, other.number: FAR}

    def change(record: Any) -> Any:
        if not isinstance(record, RsbnFix):
            return record
        return replace(record, lat=math.radians(stated[record.beacon].lat_deg))

    return change


@pytest.mark.parametrize(
    "channel", ["air", *(pytest.param(name, marks=pytest.mark.long) for name in ("imu", "ins"))]
)
def test_beacons_whose_places_are_exchanged_leave_a_healthy_gnss_beyond_doubt(channel: str) -> None:
    """Two, 5 km apart. With one false beacon at a time GNSS was excluded at the fifth answer, 5 km off."""
    flown = fly(channel, misplaced(NEAR), legs=FIVE_MINUTES[:3], others=(NEAR,))
    assert flown.of("gnss_false").max() < 0.5
    assert flown.error[flown.t > SETTLED_S].max() < 10.0


@pytest.mark.parametrize(
    ("channel", "other", "exchanged"),
    [
        ("air", NEAR, True),
        ("air", AWAY, False),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                ("air", NEAR, False),
                ("air", AWAY, True),
                ("imu", NEAR, True),
                ("imu", NEAR, False),
                ("imu", AWAY, True),
                ("imu", AWAY, False),
                ("ins", NEAR, True),
                ("ins", NEAR, False),
                ("ins", AWAY, True),
                ("ins", AWAY, False),
            )
        ),
    ],
)
def test_gnss_is_followed_where_beacons_at_wrong_places_answered_before_its_first_fix(
    channel: str, other: Beacon, exchanged: bool
) -> None:
    """One 22 km off kept GNSS out of use for good; two that were exchanged 5 km apart excluded it."""
    wrong = misplaced(other)
    flown = fly(
        channel,
        lambda record: None if isinstance(record, Gnss) and record.t_ns < 20 * NS else wrong(record),
        legs=FIVE_MINUTES[:3],
        others=(other,) if exchanged else (),
    )
    assert flown.of("gnss_false", 20.0).max() < 0.5
    assert flown.error[flown.t > SETTLED_S].max() < 10.0
    for solution, off in zip(flown.solutions, flown.error, strict=True):
        if solution.t_ns > 20.5 * NS and off > BEACON_REACH_M:
            assert solution.contradicted
            assert solution.protection > off


@pytest.mark.parametrize("jammed", [False, True])
def test_a_position_of_one_beacon_is_contradicted_while_a_first_gnss_22_km_off_is_received(
    jammed: bool,
) -> None:
    """And no longer; not while the receiver reports jamming, but GNSS is not believed then either."""
    navigator = Navigator(OWN)

    def change(record: Any) -> Any:
        if not isinstance(record, Gnss):
            return record
        if not 20 * NS <= record.t_ns < 28 * NS:
            return None
        navigator.handle(GnssIntegrity(record.t_ns, record.rx_ns, record.receiver, 2 * jammed, 0))
        return replace(record, lat=record.lat + math.radians(0.2))

    flown = fly("air", change, legs=FIVE_MINUTES[:3], navigator=navigator)
    assert set(flown.of("contradicted", 20.5, 28.0)) == {not jammed}
    assert not flown.of("contradicted", 32.0).any()
    assert set(flown.of("gnss_false", 20.5, 28.0) >= BELIEVED) == {True}
    assert set(flown.of("protection", 20.5, 28.0) > 22e3) == {True}
    assert flown.error.max() < 1000.0
    assert all(withholding_reason(s) is None for s in flown.solutions)


def test_a_first_gnss_22_km_off_withholds_no_position_that_coasts() -> None:
    """Out of sight of two beacons: it counted in the protection level, which made the position untrusted."""

    def change(record: Any) -> Any:
        if not isinstance(record, Gnss):
            return record
        is_received = 74 * NS <= record.t_ns < 78 * NS
        return replace(record, lat=record.lat + math.radians(0.2)) if is_received else None

    flown = fly("air", change, legs=FIVE_MINUTES[:3], rsbn=((60.0, 1e9),), others=(Beacon(2, 60.45, 30.0),))
    assert flown.of("contradicted", 74.5, 78.0).all()
    assert all(withholding_reason(s) is None for s in flown.solutions if s.t_ns < 85 * NS)
    assert flown.error[flown.t < 85.0].max() < 500.0


def test_two_beacons_that_agree_are_not_left_for_a_first_fix_of_gnss_22_km_away() -> None:
    north = Beacon(2, 60.45, 30.0)

    def captured(record: Any) -> Any:
        if not isinstance(record, Gnss):
            return record
        return None if record.t_ns < 20 * NS else replace(record, lat=record.lat + math.radians(0.2))

    flown = fly("air", captured, legs=FIVE_MINUTES[:3], others=(north,))
    assert flown.error[flown.t > SETTLED_S].max() < 300.0
    assert np.all(flown.error <= flown.protection)


@pytest.mark.parametrize(
    ("channel", "azimuth_s", "range_s"),
    [
        ("air", 100.0, 160.0),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (("air", 160.0, 100.0), ("imu", 100.0, 160.0))
        ),
    ],
)
def test_a_beacon_whose_azimuth_and_range_become_wrong_one_after_the_other_leaves_gnss_beyond_doubt(
    channel: str, azimuth_s: float, range_s: float
) -> None:
    """A state could hold one of them false: at the second GNSS was excluded, 278 m off by air data."""
    azimuth = after(azimuth_s, RsbnFix, azimuth=lambda a: (a + math.radians(1.0)) % math.tau)
    slant_range = after(range_s, RsbnFix, slant_range=lambda d: d - 200.0)
    flown = fly(channel, lambda record: slant_range(azimuth(record)))
    assert flown.of("gnss_false", 30.0).max() < 0.5
    assert flown.error[flown.t > SETTLED_S].max() < 10.0
    excluded = {event.text.split(" is excluded")[0] for event in flown.events if "is excluded" in event.text}
    assert excluded == {"rsbn 1 azimuth", "rsbn 1 range"}


@pytest.mark.parametrize("channel", ["air", pytest.param("imu", marks=pytest.mark.long)])
def test_two_beacons_that_become_wrong_in_different_ways_are_both_excluded(channel: str) -> None:
    north = Beacon(2, 60.45, 30.0)

    def wrong(record: Any) -> Any:
        if not isinstance(record, RsbnFix) or record.t_ns < 90 * NS:
            return record
        if record.beacon == north.number:
            return replace(record, slant_range=record.slant_range + 200.0)
        return replace(record, azimuth=record.azimuth + math.radians(1.0))

    flown = fly(channel, wrong, legs=FIVE_MINUTES[:4], others=(north,))
    excluded = {event.text.split(" is excluded")[0] for event in flown.events if "is excluded" in event.text}
    assert excluded == {"rsbn 1 azimuth", "rsbn 2 range"}
    assert flown.of("gnss_false", SETTLED_S).max() < 0.5
    assert flown.error[flown.t > SETTLED_S].max() < 10.0


@pytest.mark.parametrize("channel", ["imu", pytest.param("ins", marks=pytest.mark.long)])
def test_late_answers_of_a_beacon_beside_the_runway_move_nothing(channel: str) -> None:
    """At 1 km its azimuth is good to 2 m: answers 0.5 s late moved the position by 18 m, beside an INS those
    0.3 s late excluded GNSS.
    """
    near = Beacon(1, 60.0027, 30.0162, alt=100.0)
    flown = fly(channel, late(0.4, RsbnFix), legs=FIVE_MINUTES[:4], beacon=near, grade="mems")
    assert not any(event.text.startswith("gnss is") for event in flown.events)
    within = (flown.t > SETTLED_S) & (flown.t < 175.0)  # the last answer is of after the flight
    assert flown.error[within].max() < 6.0
    assert np.all(flown.error[within] <= flown.protection[within])


def test_a_beacon_whose_place_is_stated_far_off_changes_nothing() -> None:
    """It fits no hypothesis. The level was that of a GNSS false from its first fix on: 7 km, nothing sent."""
    legs = FIVE_MINUTES[:3]
    moved = after(0.0, RsbnFix, lat=lambda lat: lat + 50e3 / 6.4e6)
    wrong = fly("imu", moved, legs=legs, gnss_until=80.0)
    none = fly("imu", legs=legs, gnss_until=80.0, rsbn=((0.0, 1e9),))
    dark = none.t > 80.0
    assert np.abs(wrong.error_n - none.error_n).max() < 1.0
    assert wrong.protection[dark].max() == pytest.approx(none.protection[dark].max(), rel=0.05)
    assert sum(rejection.source.startswith("rsbn 1") for rejection in wrong.rejections) > 200
    assert [event.text for event in wrong.events if event.text.startswith("rsbn 1")] == [
        "rsbn 1 is not used: no answer fits its stated place; check its number and its place"
    ]


@pytest.mark.parametrize(
    ("channel", "jump_m", "seed"), [("air", 600.0, 1), ("air", 520.0, 3), ("imu", 520.0, 1)]
)
def test_a_jump_of_gnss_that_stays_makes_nothing_else_false(channel: str, jump_m: float, seed: int) -> None:
    """It is followed once it has lasted as long as the flight before. A row with a false velocity or airspeed
    beside had become wide enough before that: either was excluded for a minute, or for good.
    """
    jumps_s = 83.0

    def jumped(record: Any) -> Any:
        if isinstance(record, RsbnFix) or record.t_ns > 2 * (jumps_s + 5.0) * NS:
            return None
        if not isinstance(record, Gnss) or record.t_ns < jumps_s * NS:
            return record
        place = displace(record.lat, record.lon, record.alt_msl, jump_m, 0.0, 0.0)
        return replace(record, lat=place.lat, lon=place.lon)

    flown = fly(channel, jumped, legs=FIVE_MINUTES[:4], seed=seed)
    assert not [event.text for event in flown.events if "suspect" in event.text or "excluded" in event.text]
    assert {rejection.source for rejection in flown.rejections} == {"gnss 0"}
    assert np.hypot(*(flown.error_n[-1] - (jump_m, 0.0))) < 10.0


@pytest.mark.parametrize("height", [80.0, pytest.param(-80.0, marks=pytest.mark.long)])
def test_wind_that_grew_with_height_is_known_as_well_as_claimed(height: float) -> None:
    """GNSS is lost 50 s after lift-off. The wind of the first metres was believed too much: 450 m off, 2.5
    times the sigma. After a launch from a hill airspeed was not used.
    """
    legs = (Leg(10, 40, 0, 0), Leg(40, 40, 38, 0), Leg(60, 110, 38, height), Leg(60, 40, 38, height))
    flown = fly("imu", legs=legs, gnss_until=100.0, rsbn=((0.0, 1e9),))
    sigma = np.array([math.sqrt(s.covariance[0] + s.covariance[3]) for s in flown.solutions])
    dark = flown.t > 100.0
    assert np.all(flown.error[dark] < 1.5 * sigma[dark])
    assert np.all(flown.of("sources", 101.0) & Source.AIR_DATA)
    assert flown.error[-1] < 200.0


def test_a_local_position_that_drifts_ever_faster_is_not_believed_against_gnss() -> None:
    """As that of an estimator without GNSS: 0.12 m/s^2 from 60 s on, 29 m/s and 3.5 km in the end."""

    def drifting(record: Any) -> Any:
        since = record.t_ns / NS - 60.0
        if not isinstance(record, LocalPosition) or since < 0.0:
            return record
        (x, y, z), (vn, ve, vd) = record.x_n, record.v_n
        x_n = x + 0.06 * since**2, y, z
        return replace(record, x_n=x_n, v_n=(vn + 0.12 * since, ve, vd))

    flown = fly("imu", drifting, config=Config())  # nothing is fed: its velocity is used
    assert (flown.of("sources", 30.0) & Source.GNSS).all()
    assert flown.of("gnss_false", 30.0).max() < 0.1
    assert flown.error[flown.t > SETTLED_S].max() < 10.0


@pytest.mark.parametrize("seed", [1, 3])
def test_straight_flight_after_a_silence_does_not_measure_the_latency_of_gnss(seed: int) -> None:
    """As when the autopilot reboots: the beacon comes first, with the velocity of before, the IMU last."""
    first = {RsbnFix: 68.0, Gnss: 68.15, Imu: 68.5, AirData: 68.5}
    navigator, sigma = Navigator(OWN), dict[str, float]()
    scenario = Scenario(
        "straight",
        FlightPlan((Leg(100, 40, 38, 0),)),
        grade="mems",
        beacons=(FAR,),
        rates=SensorRates(imu=10.0),
        seed=seed,
    )
    for record in World(scenario).records((*SENSORS, Imu)):
        t = record.t_ns / NS
        if not 60.0 < t < first.get(type(record), 68.0):
            navigator.handle(record)
        if navigator.state.bank is not None:
            sigma["before" if t <= 60.0 else "after"] = spread(navigator.state.bank, LATENCY)
    assert sigma["after"] > 0.99 * sigma["before"]  # 0.5 to 0.9 of it, and 6 m along the track, before


def spread(bank: Bank, state: int) -> float:
    """One sigma of a state over all hypotheses."""
    x = bank.x[:, state]
    return math.sqrt(bank.weights @ (bank.P[:, state, state] + (x - bank.weights @ x) ** 2))


@pytest.mark.parametrize(("gnss_until", "needed"), [(math.inf, False), (90.0, True), (150.0, True)])
def test_without_gnss_a_false_airspeed_must_be_taken_out_of_use(gnss_until: float, needed: bool) -> None:
    """The autopilot compares it with GPS only, and dives for the speed that a stuck pitot lacks.

    With a healthy GNSS it is not always excluded, see the next test. One that was excluded while GNSS was
    healthy is as false once GNSS is lost.
    """
    stuck = after(120.0, AirData, airspeed=noisy(8.0))
    flown = fly(
        "imu", stuck, gnss_until=gnss_until, legs=FIVE_MINUTES[:4], seed=1 if gnss_until < 100.0 else 3
    )
    texts = [event.text for event in flown.events]
    assert any(text.startswith("airspeed is excluded") for text in texts)
    assert sum(text.startswith(FALSE_AIRSPEED) for text in texts) == needed
    assert "airspeed is used again" not in texts
    assert all(len(FALSE_AIRSPEED + name) <= 50 for name in USE_AIRSPEED.values())  # one STATUSTEXT


@pytest.mark.parametrize("seed", [2, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 3, 4))])
def test_a_stuck_pitot_is_excluded_beside_a_healthy_gnss(seed: int) -> None:
    """In a wide turn, 2 deg/s: as no onset was born as it stuck, a wind redrawn every few seconds was it."""
    stuck = after(120.0, AirData, airspeed=noisy(8.0))
    flown = fly("imu", stuck, legs=FIVE_MINUTES[:4], seed=seed)
    assert any(event.text.startswith("airspeed is excluded") for event in flown.events)


@pytest.mark.long
@pytest.mark.parametrize("channel", ["imu", "ins", "air"])
def test_a_false_velocity_of_gnss_is_excluded_and_its_position_stays_in_use(channel: str) -> None:
    """Off by 2.2 m/s from 120 s to 210 s."""
    begin, end = 120.0, 210.0

    def wrong(record: Any) -> Any:
        if not isinstance(record, Gnss) or record.v_n is None or not begin <= record.t_ns / NS < end:
            return record
        north, east, down = record.v_n
        return replace(record, v_n=(north + 2.0, east - 1.0, down))

    flown = fly(channel, wrong, (*FIVE_MINUTES, Leg(60, 310, 38, 40)))
    texts = [event.text for event in flown.events]
    excluded = next(k for k, text in enumerate(texts) if text.startswith("velocity of gnss is excluded"))
    assert "velocity of gnss is used again" in texts[excluded:]
    rejected = [r for r in flown.rejections if r.source == "velocity of gnss 0" and "excluded" in r.reason]
    assert len(rejected) > 100
    assert not [r for r in flown.rejections if r.source == "gnss 0" and "excluded" in r.reason]
    assert (flown.of("sources", 30.0) & Source.GNSS).all()
    assert flown.of("gnss_false", 30.0).max() < 0.5
    assert np.all(flown.error <= flown.protection)
    assert flown.error[flown.t > SETTLED_S].max() < 10.0


@pytest.mark.long
def test_a_false_velocity_of_gnss_that_stops_leaves_no_suspicion() -> None:
    """Nothing could clear it: the positions go on, and both explanations agree with them."""

    def stops(record: Any) -> Any:
        if not isinstance(record, Gnss) or record.v_n is None or record.t_ns < 120 * NS:
            return record
        north, east, down = record.v_n
        return replace(record, v_n=(north + 2.0, east - 1.0, down) if record.t_ns < 210 * NS else None)

    flown = fly("ins", stops)
    assert any(event.text.startswith("velocity of gnss is excluded") for event in flown.events)
    assert (flown.of("trust", 180.0, 210.0) == Trust.DEGRADED).all()
    assert (flown.of("trust", 240.0) == Trust.NORMAL).all()


@pytest.mark.parametrize(
    "channel, shaken", [pytest.param("ins", 0.0, marks=pytest.mark.long), ("imu", 0.0), ("imu", 4.0)]
)
def test_a_spoofed_gnss_is_excluded_with_a_beacon_and_comes_back(channel: str, shaken: float) -> None:
    """Drawn off by 2 m/s from 120 s to 210 s, velocity alike; also where the IMU shakes (m/s^2)."""
    begin, end = 120.0, 210.0

    def spoofed(record: Any) -> Any:
        if isinstance(record, Imu):
            shake = shaken * math.sin(math.tau * 3.3 * record.t_ns / NS)
            return replace(record, f_b=(record.f_b[0], record.f_b[1] + shake, record.f_b[2]))
        since = record.t_ns / NS - begin
        if not isinstance(record, Gnss) or not 0.0 <= since < end - begin:
            return record
        assert record.v_n is not None
        lon = record.lon + 2.0 * since / (6.378e6 * math.cos(record.lat))
        return replace(record, lon=lon, v_n=(record.v_n[0], record.v_n[1] + 2.0, record.v_n[2]))

    legs = (*FIVE_MINUTES, Leg(120, 310, 38, 40))
    flown = fly(channel, spoofed, legs)
    reported = [(e.t_ns / NS, e.text) for e in flown.events if e.text.startswith("gnss is")]
    excluded = next(t for t, text in reported if "excluded" in text)
    back = next(t for t, text in reported if "used again" in text and t > excluded)
    assert begin < excluded < end
    assert end <= back < end + 120.0
    held = flown.of("sources", excluded + 6.0, end) & Source.GNSS
    assert not held.any()
    assert (flown.of("sources", back + 5.0) & Source.GNSS).all()
    assert flown.of("witness", begin, end).all()
    assert np.all(flown.error <= flown.protection)
    assert flown.error[flown.t > SETTLED_S].max() < 2.0 * (end - begin) / 2.0
    assert flown.error[flown.t > back + 20.0].max() < 10.0


STATED_M_S = 0.5  # where the velocity of the simulated receiver is good to 0.1 m/s


@pytest.mark.parametrize("seed", [1, 2])
def test_a_velocity_that_is_better_than_stated_shows_a_spoofer_at_once(seed: int) -> None:
    """Drawn off east by 2 m/s. With the sigma that is stated it was not excluded within 85 s."""
    begin, end = 120.0, 180.0

    def spoofed(record: Any) -> Any:
        if not isinstance(record, Gnss) or record.v_n is None:
            return record
        since = record.t_ns / NS - begin
        off = 2.0 if 0.0 <= since < end - begin else 0.0
        return replace(
            record,
            lon=record.lon + off * since / (6.378e6 * math.cos(record.lat)),
            v_n=(record.v_n[0], record.v_n[1] + off, record.v_n[2]),
            sigma_velocity=STATED_M_S,
        )

    flown = fly("imu", spoofed, FIVE_MINUTES[:4], seed=seed)
    excluded = next(e.t_ns / NS for e in flown.events if e.text.startswith("gnss is excluded"))
    assert begin < excluded < begin + 10.0
    assert flown.error[flown.t > SETTLED_S].max() < 40.0


LASTING_S = {"as noisy as stated": 0.0, "wrong for 5 s": 5.0, "wrong for 20 s": 20.0}


@pytest.mark.parametrize("worse", LASTING_S)
def test_a_velocity_that_becomes_as_bad_as_stated_does_not_make_gnss_suspect(worse: str) -> None:
    rng, lasting, error, last = np.random.default_rng(1), LASTING_S[worse], np.zeros(2), 0.0

    def changed(record: Any) -> Any:
        nonlocal error, last
        if not isinstance(record, Gnss) or record.v_n is None:
            return record
        t = record.t_ns / NS
        kept = math.exp(-(t - last) / lasting) if lasting else 0.0
        last = t
        if t > 120.0:
            error = kept * error + STATED_M_S * math.sqrt(1.0 - kept**2) * rng.standard_normal(2)
        north, east, down = record.v_n
        return replace(record, v_n=(north + error[0], east + error[1], down), sigma_velocity=STATED_M_S)

    flown = fly("imu", changed)
    assert not any(event.text.startswith("gnss is") for event in flown.events)
    assert flown.error[flown.t > SETTLED_S].max() < 10.0
    assert np.mean([flown.nees(t) for t in range(60, 290, 10)]) < 3.0


@pytest.mark.parametrize(
    "flying, speed, stands", [(False, 0.0, True), (True, 0.0, False), (None, 0.0, False), (False, 8.0, False)]
)
def test_what_is_parked_stands_where_gnss_showed_it_to(
    flying: bool | None, speed: float, stands: bool
) -> None:
    """Parked by its autopilot, on a ship of 8 m/s too: the IMU is as still."""
    navigator = Navigator(OWN)
    navigator.handle(Vehicle(1, 1, flying=flying, fixed_wing=True))
    legs = (Leg(150, 40, speed, 0),)
    flown = fly("imu", legs=legs, gnss_until=60.0, rsbn=((0.0, 1e9),), navigator=navigator)
    sigma = np.sqrt([c[0] for c in flown.of("covariance", 145.0)])
    if stands:
        assert np.ptp(flown.error[flown.t > 61.0]) < 0.5
        assert sigma.max() < 5.0
    else:
        assert sigma.min() > 100.0
        assert np.hypot(*flown.velocity_error_n[-1]) < 1.0


@pytest.mark.parametrize("channel", ["ins", "imu", "air"])
def test_a_gnss_that_stops_is_no_step_of_the_output(channel: str) -> None:
    """What the output moves beyond its velocity, from one solution to the next, is no more than before."""
    stop = 150.0
    flown = fly(channel, gnss_until=stop, rsbn=((0.0, 1e9),), legs=FIVE_MINUTES[:4])
    step = np.hypot(*np.diff(flown.error_n, axis=0).T)
    with_gnss = step[(flown.t[1:] > SETTLED_S) & (flown.t[1:] < stop)]
    at_loss = step[(flown.t[1:] >= stop) & (flown.t[1:] < stop + 5.0)]
    assert at_loss.max() <= max(1.5 * with_gnss.max(), 0.5)
    assert flown.of("protection", stop, stop + 1.0)[0] < 3.0 * flown.of("protection", stop - 5.0, stop).max()
    assert np.all(flown.error <= flown.protection)


# ---------------------------------------------------------------------------------------------------------
# Honest claims
# ---------------------------------------------------------------------------------------------------------

SHORT = (Leg(5, 40, 0, 0), Leg(55, 40, 38, 40), Leg(30, 40, 38, 40), Leg(60, 130, 34, 40))


@pytest.mark.long
@pytest.mark.parametrize("channel", ["imu", "ins", "air"])
def test_the_claims_are_consistent(channel: str) -> None:
    """Normalised squared errors over seeds, with GNSS and 20 s after its loss without any fix."""
    seeds, at = range(8), (100.0, 135.0)
    values: dict[float, list[float]] = {t: [] for t in at}
    for seed in seeds:
        flown = fly(channel, legs=SHORT, gnss_until=115.0, rsbn=((0.0, 1e9),), seed=seed)
        for t in at:
            values[t].append(flown.nees(t))
        assert np.all(flown.error <= flown.protection)
    for t in at:
        # 16 degrees of freedom: more than 34.3 with a probability of 0.005 each
        assert sum(values[t]) < 34.3, (t, values[t])


# ---------------------------------------------------------------------------------------------------------
# What must not matter
# ---------------------------------------------------------------------------------------------------------


def test_without_an_airspeed_sensor_the_number_of_vfr_hud_moves_nothing() -> None:
    """It is the autopilot's own estimate then."""
    wild = np.random.default_rng(1)

    def unsensed(record: Any) -> Any:
        return replace(record, sensed=False) if isinstance(record, AirData) else record

    def lying(record: Any) -> Any:
        if isinstance(record, AirData):
            return replace(record, sensed=False, airspeed=float(wild.uniform(0.0, 99.0)))
        return record

    plain = fly("imu", unsensed, legs=SHORT, gnss_until=100.0)
    other = fly("imu", lying, legs=SHORT, gnss_until=100.0)
    assert len(plain.solutions) > 100
    assert plain.solutions == other.solutions


def test_feedback_and_feedforward_give_equal_positions() -> None:
    """In the same flight the corrected positions agree whether the nominal is brought back or not."""
    feedback, feedforward = (
        load(flags={"output.profile": "ardupilot", "estimator.scheme": scheme}, environment={})
        for scheme in ("feedback", "feedforward")
    )
    a, b = (fly("imu", legs=SHORT, config=c, gnss_until=120.0) for c in (feedback, feedforward))
    np.testing.assert_array_equal(a.t, b.t)
    apart = np.hypot(*(a.error_n - b.error_n).T)
    two_centimetres = 0.02  # the rows are linearised about nominal trajectories that are metres apart
    assert apart.max() < two_centimetres


def test_the_velocity_by_air_data_is_as_good_as_claimed_in_gusts() -> None:
    """With the gusts of the simulator stated: the defaults are those of recorded flights, and larger."""
    gusts = {"inertial.source": "air_data", "air_data.gust_m_s": 0.6, "air_data.gust_s": 0.5}
    config = load(flags=gusts, environment={})
    flown = fly("air", seed=2, rsbn=((0.0, 1e9),), legs=FIVE_MINUTES[:4], config=config)
    late = flown.t > 80.0
    claimed = flown.of("sigma_velocity")[late]
    error = np.abs(flown.velocity_error_n[late]).max(axis=1)
    assert len(error) > 100
    assert np.mean(error > 3.0 * claimed) < 0.01
    assert np.median(claimed) < 2.0 * np.sqrt(np.mean(error**2))  # nor is too much claimed


# ---------------------------------------------------------------------------------------------------------
# Filters beside the bank
# ---------------------------------------------------------------------------------------------------------

PARALLEL_FILTERS = {"estimator.parallel": list(PARALLEL)}
WITH_AIRSPEED = {"inertial.independent": True, "inertial.correctors": ["airspeed"]}
BY_AIR = {"inertial.source": "air_data", "output.profile": "ardupilot"}


@pytest.mark.parametrize(
    ("channel", "flags"), [pytest.param("ins", WITH_AIRSPEED, marks=pytest.mark.long), ("air", BY_AIR)]
)
def test_filters_beside_the_bank_follow_the_flight_and_change_nothing_that_is_sent(
    channel: str, flags: dict[str, Any]
) -> None:
    """GNSS until 100 s, then the beacon; the error of each filter is within what it claims."""

    def sent(solutions: list[Solution]) -> list[object]:
        return [replace(s, parallel=(), disagreement=None) for s in solutions]

    alone, both = (
        fly(channel, config=load(flags=each, environment={}), gnss_until=100.0, legs=FIVE_MINUTES[:4])
        for each in (flags, {**flags, **PARALLEL_FILTERS})
    )
    assert sent(both.solutions) == sent(alone.solutions)
    assert not any(s.parallel for s in alone.solutions)
    for k, name in enumerate(PARALLEL):
        inside = []
        for s, t, error_n in zip(both.solutions, both.t, both.error_n, strict=True):
            if t > SETTLED_S:
                p = s.parallel[k]
                var_n, _, var_e = p.covariance
                assert p.estimator == name
                inside.append(math.dist(error_n + s.error_n, p.error_n) < 3.0 * math.sqrt(var_n + var_e))
        assert np.mean(inside) > 0.95
