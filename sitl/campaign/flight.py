"""One flight of a campaign: a scenario, one fault, a seed in; a line of numbers out.

Two ways to fly. Faults of sensors act on records, which go straight to the navigator: no messages, no link,
ten minutes in about two seconds. Faults of the link and of the autopilot act on bytes: the whole loopback
flies. Five minutes are left before the fault for the companion to learn in, and three after it to recover.

It knows nothing of workers, files and tables (`sitl.campaign.command`). A fault counts as

    detected    a measurement of a source that it concerns was rejected, a reset told of it or a line that
                sources contradict one another, that the link is late or that the clock leapt, that source
                went out of what the solutions rest on, or trust got worse, all before the fault is over;
    excluded    that source went out of what the solutions rest on (what comes no more excludes itself);
    misleading  the error passed the protection level for a second or longer while nothing said so: trust was
                neither "degraded" nor "untrusted".
"""

from __future__ import annotations

import dataclasses
import heapq
import math
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from companion.config import Config, InertialConfig
from companion.navigator import Navigator
from companion.navigator.integrity import CONTRADICT
from companion.records import (
    AirData,
    Attitude,
    Event,
    Gnss,
    LocalOrigin,
    LocalPosition,
    Mode,
    Pressure,
    Rejection,
    Reset,
    RsbnFix,
    Solution,
    Source,
    Stamped,
    Trust,
)
from companion.storage.flight_log import Writer
from sitl import loopback
from sitl.autopilot import UNIX_AT_START_NS
from sitl.beacon import Beacon
from sitl.faults import RECORD_FAULTS, Fault, FullDisk
from sitl.flight import Array, Leg, Plan, Wind, radii
from sitl.scenarios import Rates, Scenario
from sitl.world import World

SECOND = 1_000_000_000
FAULT_S, OVER_S = 300.0, 540.0
TURN_S = 430.0
TELLING = (CONTRADICT, "the link is late", "the clock of autopilot")  # what events say that tell of a fault
EXCLUDED = "excluded:"  # how a rejection begins that tells of an exclusion
LEARNT_S = 60.0  # alarms are counted from here on
_LEGS = (
    Leg(10, 40, 0, 0),
    Leg(50, 40, 38, 0),
    Leg(360, 40, 38, 400),
    Leg(180, 95, 34, 400),
    Leg(120, 50, 42, 400),
)
_PLAN = Plan(_LEGS, winds=(Wind(0, 4, 5),))
_EAST, _NORTH = Beacon(1, 60.05, 31.07), Beacon(2, 60.45, 30.0)
_RATES = Rates(imu=1.0, truth=1.0)
_AIDED = Source.AZIMUTH | Source.RANGE

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario("one-beacon", _PLAN, beacons=(_EAST,), rates=_RATES),
        Scenario("two-beacons", _PLAN, beacons=(_EAST, _NORTH), rates=_RATES),
        Scenario("no-beacon", _PLAN, rates=_RATES),
        Scenario("tactical", _PLAN, grade="tactical", beacons=(_EAST,), rates=_RATES),
        Scenario("mems", _PLAN, grade="mems", beacons=(_EAST,), rates=_RATES),
        Scenario("air-data", _PLAN, beacons=(_EAST,), rates=_RATES),  # no INS: airspeed, attitude and fixes
    )
}

#: What an operator would write for the simulated grades: the remainders after calibration, tilt as levelled.
UNITS: dict[str, InertialConfig] = {
    "navigation": InertialConfig(),
    "tactical": InertialConfig(
        gyro_drift_deg_h=0.1,
        gyro_correlation_h=0.5,
        angle_random_walk_deg_sqrt_h=0.07,
        accelerometer_bias_ug=200.0,
        accelerometer_correlation_h=0.5,
        tilt_arcsec=60.0,
        heading_arcmin=12.0,
    ),
    "mems": InertialConfig(
        gyro_drift_deg_h=1.0,
        gyro_correlation_h=0.17,
        angle_random_walk_deg_sqrt_h=0.15,
        accelerometer_bias_ug=500.0,
        accelerometer_correlation_h=0.17,
        velocity_noise_m_s_sqrt_s=0.0012,
        tilt_arcsec=160.0,
        heading_arcmin=60.0,
    ),
}


class Kind(NamedTuple):
    """A fault of the list: its order, and what it concerns: a prefix of rejections, bits of sources."""

    fault: Fault | None
    concerns: str = ""
    bits: Source = Source(0)


def _kind(name: str, size: float | None = None, end_s: float = OVER_S) -> Kind:
    concerns, bits = {
        "gnss": ("gnss", Source.GNSS),
        "beacon": ("rsbn", _AIDED),
        "airspeed": ("air", Source.AIR_DATA),
        "wind": ("air", Source.AIR_DATA),
        "ins": ("inertial", Source(0)),
    }.get(name.split("-")[0], ("", Source.GNSS))
    return Kind(Fault(name, FAULT_S, end_s, size), concerns, bits)


KINDS: dict[str, Kind] = {
    "none": Kind(None),
    "gnss-jump": _kind("gnss-jump"),
    "gnss-jump-50": _kind("gnss-jump", 50.0),
    "gnss-spoof-0.5": _kind("gnss-spoof", 0.5),
    "gnss-spoof-2": _kind("gnss-spoof", 2.0),
    "gnss-spoof-5": _kind("gnss-spoof", 5.0),
    "gnss-jam": _kind("gnss-jam"),
    "gnss-frozen": _kind("gnss-frozen"),
    "gnss-stale": _kind("gnss-stale"),
    "gnss-late": _kind("gnss-late"),
    "beacon-bias": _kind("beacon-bias"),
    "beacon-bias-300": _kind("beacon-bias", 300.0),
    "beacon-position": _kind("beacon-position"),
    "beacon-north": _kind("beacon-north"),
    "beacon-multipath": _kind("beacon-multipath"),
    "beacon-drop-out": _kind("beacon-drop-out"),
    "beacon-late": _kind("beacon-late"),
    "beacon-frozen": _kind("beacon-frozen"),
    "ins-frozen": _kind("ins-frozen", end_s=FAULT_S + 60.0),
    "ins-reset": _kind("ins-reset"),
    "airspeed-icing": _kind("airspeed-icing"),
    "airspeed-frozen": _kind("airspeed-frozen"),
    "wind-shear": _kind("wind-shear"),
    "ins-nan": _kind("ins-nan", end_s=FAULT_S + 10.0),
    "link-loss": _kind("link-loss", end_s=FAULT_S + 60.0),
    "bit-errors": _kind("bit-errors", 1e-3),
    "duplicates": _kind("duplicates"),
    "reordering": _kind("reordering"),
    "garbage": _kind("garbage"),
    "slow-consumer": _kind("slow-consumer"),
    "disk-full": _kind("disk-full"),
    "link-late": _kind("link-late", end_s=FAULT_S + 60.0),
    "reboot": _kind("reboot"),
    "reboot-turning": Kind(Fault("reboot", TURN_S, OVER_S), bits=Source.GNSS),
    "clock-jump": _kind("clock-jump"),
    "second-autopilot": _kind("second-autopilot"),
    "origin-change": _kind("origin-change"),
}


class Order(NamedTuple):
    """A flight to be flown: names of a scenario and of a kind of fault, and the seed of all noise."""

    scenario: str
    fault: str
    seed: int

    @property
    def key(self) -> str:
        """What tells this flight from all others."""
        return f"{self.scenario}/{self.fault}/{self.seed}"


class Result(NamedTuple):
    """What came of it. Times from the fault's start (s), errors horizontal (m); None: it did not happen.

    `normal_m` is the largest error while trust was normal after the fault's start, `beyond_s` how long it
    was beyond the protection level though flagged. `alarms` are exclusions of good sources in `quiet_s`,
    before the fault, `wrong` those of sources that it does not concern after its start; `rms_error` and
    `rms_bound` are over the predicting instants; `raised` is the exception that ended the flight.
    """

    key: str
    scenario: str
    fault: str
    seed: int
    flown_s: float
    took_s: float
    solutions: int = 0
    detected_s: float | None = None
    excluded_s: float | None = None
    before_m: float = 0.0
    largest_m: float = 0.0
    last_m: float = 0.0
    normal_m: float = 0.0
    misleading_s: float = 0.0
    beyond_s: float = 0.0
    alarms: int = 0
    wrong: int = 0
    quiet_s: float = 0.0
    rms_error: float | None = None
    rms_bound: float | None = None
    raised: str | None = None


def ordered(order: Order) -> Scenario:
    """The scenario of an order. ValueError for a name that is in no table."""
    if order.scenario not in SCENARIOS or order.fault not in KINDS:
        raise ValueError(
            f"flight {order.key}: scenarios are {', '.join(SCENARIOS)}; faults are {', '.join(KINDS)}"
        )
    base, fault = SCENARIOS[order.scenario], KINDS[order.fault].fault
    return dataclasses.replace(base, faults=(fault,) if fault else (), seed=order.seed)


def by_records(kind: str) -> bool:
    """Whether a kind of fault is one of the sensors, flown without messages."""
    fault = KINDS[kind].fault
    return fault is None or (fault.name in RECORD_FAULTS and fault.name != "ins-nan")


def matters(scenario: str, kind: str) -> bool:
    """Whether the scenario has what the fault concerns: a beacon, an INS, or air data as the channel."""
    concerned = kind.split("-")[0]
    if concerned == "beacon":
        return bool(SCENARIOS[scenario].beacons)
    if concerned in ("airspeed", "wind"):
        return scenario == "air-data"
    return concerned != "ins" or scenario != "air-data"


def attempt(order: Order) -> Result:
    """Fly an order; an exception is a result too."""
    begun = time.perf_counter()
    try:
        scenario = ordered(order)
        inertial = (
            InertialConfig(source="air_data") if order.scenario == "air-data" else UNITS[scenario.grade]
        )
        config = loopback.simulated(Config(inertial=inertial))
        fly = fly_records if by_records(order.fault) else fly_bytes
        world, told = fly(scenario, config)
        result = score(order, world, told)
    except Exception as error:  # of whatever kind: the campaign goes on and the table says so
        result = Result(order.key, *order, 0.0, 0.0, raised=f"{type(error).__name__}: {error}")
    return result._replace(took_s=round(time.perf_counter() - begun, 3))


def fly_records(scenario: Scenario, config: Config) -> tuple[World, list[Stamped]]:
    """The flight without messages: every record to the navigator at its arrival. Times are the flight's."""
    world, navigator = World(scenario), Navigator(config)
    origin = world.origin
    height = origin.alt - scenario.geoid_height
    told: list[Stamped] = []
    told += navigator.handle(LocalOrigin(0, 0, origin.lat, origin.lon, height, scenario.autopilot))
    kinds = LocalPosition, Attitude, Gnss, AirData, Pressure, RsbnFix
    for record in heapq.merge(*(world.streams[kind] for kind in kinds), key=attrgetter("rx_ns")):
        told += navigator.handle(record)  # type: ignore[arg-type]
    return world, told


def fly_bytes(scenario: Scenario, config: Config) -> tuple[World, list[Stamped]]:
    """The flight over the simulated link; what the companion said, in the flight's time."""
    flown = _fly_logged(scenario, config) if _full(scenario) else loopback.fly(scenario, config)
    kinds = Solution, Rejection, Reset, Event
    told = [r for r in flown.kept if isinstance(r, kinds)]
    return flown.autopilot.world, [_at_flight_time(r) for r in told]


def _full(scenario: Scenario) -> list[Fault]:
    return [fault for fault in scenario.faults if fault.name == "disk-full"]


def _fly_logged(scenario: Scenario, config: Config) -> loopback.Flown:
    """With a log whose disk is full for a while. OSError where it is not whole in the end."""
    disks: list[FullDisk] = []

    def disk(path: Path) -> FullDisk:
        disks.append(FullDisk(path))
        return disks[-1]

    def tell(flown_s: float) -> None:
        disks[0].full = any(fault.covers(round(flown_s * SECOND)) for fault in _full(scenario))

    with tempfile.TemporaryDirectory() as folder:
        log = Writer(
            Path(folder) / "flight.mcap",
            metadata={},
            start_unix_ns=UNIX_AT_START_NS,
            start_ns=loopback.START_NS,
            block=True,
            disk=disk,
        )
        flown = loopback.fly(scenario, config, log, tell)
        disks[0].full = False
        if not log.close() or log.dropped:
            raise OSError(f"the log lost {log.dropped} messages: {log.trouble or 'full for too long'}")
    return flown


def _at_flight_time(record: Stamped) -> Stamped:
    fields = {name: getattr(record, name) for name in record.__struct_fields__}
    return type(record)(**{**fields, "t_ns": record.t_ns - loopback.START_NS})


def score(order: Order, world: World, told: Sequence[Stamped]) -> Result:
    """The numbers of a flight: what the companion `told`, against the truth."""
    solutions = [r for r in told if isinstance(r, Solution) and r.mode is not Mode.INITIALISING]
    if not solutions:
        return Result(order.key, *order, world.scenario.duration_s, 0.0, raised="no solution at all")
    kind, t = KINDS[order.fault], np.array([s.t_ns for s in solutions]) * 1e-9
    error = horizontal_errors(world, solutions, t)
    dt = np.clip(np.diff(t, append=t[-1]), 0.0, 1.0)
    levels = np.array([math.inf if s.protection is None else s.protection for s in solutions])
    trust = np.array([Trust.UNTRUSTED if s.trust is None else s.trust for s in solutions])
    start = kind.fault.start_s if kind.fault else math.inf
    end = kind.fault.end_s if kind.fault else math.inf
    on = (t >= start) & (t < end)
    lost = [x for x in _lost(solutions, t, kind.bits) if start <= x < end]
    excluded = lost[0] if lost else None
    seen = [r.t_ns * 1e-9 for r in told if _tells(r, kind.concerns)]
    worse = t[on & (trust > trust[max(int(on.argmax()) - 1, 0)])].tolist() if on.any() else []
    detected = min((x for x in (*seen, *lost, *worse) if start <= x < end), default=None)
    exclusions = [r for r in told if isinstance(r, Rejection) and r.reason.startswith(EXCLUDED)]
    wrong = [r for r in exclusions if not (kind.concerns and r.source.startswith(kind.concerns))]
    before = (t >= start) & (t <= (end if excluded is None else excluded))
    learnt, beyond = t >= LEARNT_S, error > levels
    flagged = (trust == Trust.DEGRADED) | (trust == Trust.UNTRUSTED)
    predicting = np.array([s.mode is Mode.PREDICTING and s.bound_n is not None for s in solutions])
    bounds = np.array([math.hypot(*(s.bound_n or (0.0, 0.0))) for s in solutions])

    def seconds(mask: npt.NDArray[np.bool_]) -> float:
        return round(float(dt[mask].sum()), 2)

    def largest(mask: npt.NDArray[np.bool_]) -> float:
        return round(float(error[mask].max(initial=0.0)), 2)

    return Result(
        order.key,
        *order,
        world.scenario.duration_s,
        0.0,
        len(solutions),
        None if detected is None else round(detected - start, 3),
        None if excluded is None else round(excluded - start, 3),
        largest(before),
        largest(learnt),
        round(float(error[-1]), 2),
        largest((t >= start) & (trust == Trust.NORMAL)),
        seconds(beyond & ~flagged & learnt),
        seconds(beyond & (trust == Trust.DEGRADED) & learnt),
        sum(LEARNT_S <= r.t_ns * 1e-9 < start for r in exclusions),
        sum(r.t_ns * 1e-9 >= start for r in wrong),
        seconds(learnt & (t < start)),
        _rms(error[predicting]),
        _rms(bounds[predicting]),
    )


def horizontal_errors(world: World, solutions: Iterable[Solution], t: Array) -> Array:
    """Distances (n,) m of the solutions from where the aircraft was at flight times `t` (n,) s."""
    place = np.array([(s.lat, s.lon) for s in solutions])
    truth = world.truth_at(t)
    R_N, R_E = radii(truth.lat)
    north = (place[:, 0] - truth.lat) * (R_N + truth.alt)
    east = np.remainder(place[:, 1] - truth.lon + np.pi, 2.0 * np.pi) - np.pi
    out: Array = np.hypot(north, east * (R_E + truth.alt) * np.cos(truth.lat))
    return out


def _lost(solutions: Sequence[Solution], t: Array, bits: Source) -> Iterator[float]:
    """Every moment (s) at which one of `bits` goes out of what the solutions rest on."""
    before = 0
    for solution, at in zip(solutions, t.tolist(), strict=True):
        if before & ~solution.sources & bits:
            yield at
        before = solution.sources


def _tells(record: Any, concerns: str) -> bool:
    if isinstance(record, Rejection):
        return bool(concerns) and record.source.startswith(concerns)
    return isinstance(record, Reset) or (isinstance(record, Event) and any(t in record.text for t in TELLING))


def _rms(values: Array) -> float | None:
    return round(float(np.sqrt(np.mean(values**2))), 3) if len(values) else None
