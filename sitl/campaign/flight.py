"""One flight of a campaign: scenario, fault and seed in; a row of numbers out.

Sensor faults are applied to records, which are passed directly to the navigator, without messages and link:
ten minutes take about two seconds. Faults of the link and of the autopilot are applied to bytes in the whole
loopback. The fault starts after five minutes, in which the filters converge; three minutes follow for
recovery. A fault of the beacon is one of all beacons.

Workers, files and tables belong to `sitl.campaign.command`. A fault counts as

    detected    before its end a measurement of an affected source was rejected, a reset was recorded, an
                event reported the source as suspect or excluded, a late link or a clock jump, the solutions
                stopped using the source, or trust decreased;
    excluded    the source was reported as excluded, or the solutions stopped using it (also because it sends
                nothing);
    misleading  the error exceeded the protection level for at least a second without a flag: trust neither
                "degraded" nor "untrusted".
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec.structs import replace

from companion.analysis.error_statistics import root_mean_square
from companion.config import Config, InertialConfig
from companion.navigator import Navigator
from companion.records import Event, Imu, Mode, Rejection, Reset, Solution, Source, Stamped, Trust
from companion.storage.flight_log import Writer
from companion.units import SECOND_NS, Floats
from sitl import loopback
from sitl.autopilot import UNIX_AT_START_NS
from sitl.beacon import Beacon
from sitl.faults import RECORD_FAULTS, Fault, FullDisk
from sitl.flight import FlightPlan, Leg
from sitl.scenarios import EAST_BEACON, TAKE_OFF, WIND, Scenario, SensorRates
from sitl.world import SENSORS, World

FAULT_S, OVER_S = 300.0, 540.0
TURN_S = 430.0
FAULT_EVENTS = ("the link is late", "the clock of autopilot")  # events that report a fault contain one
SUSPICION, EXCLUSION = " is suspect:", " is excluded:"  # after the name of the source, in events
SETTLED_S = 60.0  # alarms count from here on
_LEGS = (
    *TAKE_OFF,
    Leg(360, 40, 38, 400),
    Leg(180, 95, 34, 400),
    Leg(120, 50, 42, 400),
)
_PLAN = FlightPlan(_LEGS, winds=(WIND,))
NORTH_BEACON = Beacon(2, 60.45, 30.0)
_RATES = SensorRates(imu=1.0, truth=1.0)
_STOCK_RATES = SensorRates(imu=10.0, truth=1.0)
_BEACON = Source.AZIMUTH | Source.RANGE

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario("one-beacon", _PLAN, beacons=(EAST_BEACON,), rates=_RATES),
        Scenario("two-beacons", _PLAN, beacons=(EAST_BEACON, NORTH_BEACON), rates=_RATES),
        Scenario("no-beacon", _PLAN, rates=_RATES),
        Scenario("tactical", _PLAN, grade="tactical", beacons=(EAST_BEACON,), rates=_RATES),
        Scenario("mems", _PLAN, grade="mems", beacons=(EAST_BEACON,), rates=_RATES),
        # without an INS of its own: airspeed, attitude and fixes
        Scenario("air-data", _PLAN, beacons=(EAST_BEACON,), rates=_RATES),
        # a stock autopilot: all of its sensors
        Scenario("stock", _PLAN, grade="mems", beacons=(EAST_BEACON,), rates=_STOCK_RATES),
    )
}
OWN_CHANNEL = {
    "air-data": InertialConfig(source="air_data"),
    "stock": InertialConfig(),
}
"""Configuration of scenarios without an INS of their own; the others fly by default."""


class FaultCase(NamedTuple):
    """Fault, source it concerns (prefix of rejections, bits of `Solution.sources`), and further faults."""

    fault: Fault | None
    concerns: str = ""
    bits: Source = Source(0)
    also: tuple[Fault, ...] = ()


def _case(name: str, size: float | None = None, end_s: float = OVER_S, start_s: float = FAULT_S) -> FaultCase:
    concerns, bits = {
        "gnss": ("gnss", Source.GNSS),
        "beacon": ("rsbn", _BEACON),
        "airspeed": ("air", Source.AIR_DATA),
        "pitot": ("air", Source.AIR_DATA),
        "heading": ("air", Source.AIR_DATA),
        "wind": ("air", Source.AIR_DATA),
        "ins": ("inertial", Source(0)),
    }.get(name.split("-")[0], ("", Source.GNSS))
    return FaultCase(Fault(name, start_s, end_s, size), concerns, bits)


FAULT_CASES: dict[str, FaultCase] = {
    "none": FaultCase(None),
    "gnss-jump": _case("gnss-jump"),
    "gnss-jump-50": _case("gnss-jump", 50.0),
    "gnss-spoof-0.5": _case("gnss-spoof", 0.5),
    "gnss-spoof-2": _case("gnss-spoof", 2.0),
    "gnss-spoof-5": _case("gnss-spoof", 5.0),
    "gnss-accelerate": _case("gnss-accelerate"),
    "gnss-first-450": _case("gnss-jump", 450.0, start_s=0.0),
    "gnss-return-450": _case("gnss-return", 450.0),
    "gnss-latency-0.1": _case("gnss-latency", 0.1, math.inf, 0.0),
    "gnss-latency-0.2": _case("gnss-latency", 0.2, math.inf, 0.0),
    "gnss-latency-0.3": _case("gnss-latency", 0.3, math.inf, 0.0),
    "gnss-lever-arm": _case("gnss-lever-arm", 5.0, math.inf, 0.0),
    "gnss-jam": _case("gnss-jam"),
    "gnss-frozen": _case("gnss-frozen"),
    "gnss-stale": _case("gnss-stale"),
    "gnss-late": _case("gnss-late"),
    "beacon-bias": _case("beacon-bias"),
    "beacon-bias-50": _case("beacon-bias", 50.0),
    "beacon-bias-200": _case("beacon-bias", 200.0),
    "beacon-bias-300": _case("beacon-bias", 300.0),
    "beacon-position": _case("beacon-position"),
    "beacon-place": _case("beacon-position", 3000.0, math.inf, 0.0),
    "beacon-anywhere": _case("beacon-anywhere", None, math.inf, 0.0),
    "beacon-anywhere-first": FaultCase(
        Fault("beacon-anywhere", 0.0), "rsbn", _BEACON, (Fault("gnss-jam", 0.0, 30.0),)
    ),
    "beacon-north": _case("beacon-north"),
    "beacon-north-1": _case("beacon-north", math.radians(1.0)),
    "beacon-north-5": _case("beacon-north", math.radians(5.0)),
    "beacon-multipath": _case("beacon-multipath"),
    "beacon-drop-out": _case("beacon-drop-out"),
    "beacon-late": _case("beacon-late"),
    "beacon-frozen": _case("beacon-frozen"),
    "ins-frozen": _case("ins-frozen", end_s=FAULT_S + 60.0),
    "ins-reset": _case("ins-reset"),
    "ins-drift": _case("ins-drift"),
    "airspeed-icing": _case("airspeed-icing"),
    "pitot-low": _case("pitot-stuck", 8.0),
    "pitot-high": _case("pitot-stuck", 60.0),
    "pitot-zero": _case("pitot-stuck", 0.0),
    "pitot-scale": _case("pitot-scale", 1.5),
    "heading-off": _case("heading-off"),
    "airspeed-frozen": _case("airspeed-frozen"),
    "wind-shear": _case("wind-shear"),
    "ins-nan": _case("ins-nan", end_s=FAULT_S + 10.0),
    "link-loss": _case("link-loss", end_s=FAULT_S + 60.0),
    "bit-errors": _case("bit-errors", 1e-3),
    "duplicates": _case("duplicates"),
    "reordering": _case("reordering"),
    "garbage": _case("garbage"),
    "slow-consumer": _case("slow-consumer"),
    "disk-full": _case("disk-full"),
    "link-late": _case("link-late", end_s=FAULT_S + 60.0),
    "reboot": _case("reboot"),
    "reboot-turning": FaultCase(Fault("reboot", TURN_S, OVER_S), bits=Source.GNSS),
    "clock-jump": _case("clock-jump"),
    "second-autopilot": _case("second-autopilot"),
    "origin-change": _case("origin-change"),
}


class FlightOrder(NamedTuple):
    """Flight to be flown: names of scenario and fault, and the seed of all noise."""

    scenario: str
    fault: str
    seed: int

    @property
    def key(self) -> str:
        """Unique name of the flight."""
        return f"{self.scenario}/{self.fault}/{self.seed}"


class FlightResult(NamedTuple):
    """Result of a flight. Times from the start of the fault (s), horizontal errors (m); None: did not happen.

    `normal_m` is the largest error with normal trust after the start of the fault, `beyond_s` the time with a
    flagged error above the protection level. `alarms` counts exclusions in the `quiet_s` seconds before the
    fault, `wrong` exclusions of other sources after its start; `rms_error` and `rms_bound` are over the
    predicting instants; `raised` is the exception that ended the flight.
    """

    key: str
    scenario: str
    fault: str
    seed: int
    flown_s: float
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


def scenario_of(order: FlightOrder) -> Scenario:
    """Return the scenario of an order. Raises ValueError for an unknown name."""
    if order.scenario not in SCENARIOS or order.fault not in FAULT_CASES:
        raise ValueError(
            f"flight {order.key}: unknown scenario or fault; scenarios are {', '.join(SCENARIOS)}; "
            f"faults are {', '.join(FAULT_CASES)}"
        )
    base, kind = SCENARIOS[order.scenario], FAULT_CASES[order.fault]
    faults = (kind.fault, *kind.also) if kind.fault else kind.also
    return dataclasses.replace(base, faults=faults, seed=order.seed)


def config_of(scenario: str) -> Config:
    """Return the configuration that a scenario is flown with."""
    inertial = OWN_CHANNEL.get(scenario)
    if inertial is None:
        return loopback.simulator_config(Config())
    return loopback.simulator_config(Config(inertial=inertial), own_ins=False)


def is_sensor_fault(kind: str) -> bool:
    """Whether a fault is a sensor fault, flown without messages."""
    fault = FAULT_CASES[kind].fault
    return fault is None or (fault.name in RECORD_FAULTS and fault.name != "ins-nan")


def is_applicable(scenario: str, kind: str) -> bool:
    """Whether the scenario has the source of the fault: a beacon, an INS, or air data as the channel."""
    concerned = kind.split("-")[0]
    if concerned == "beacon":
        return bool(SCENARIOS[scenario].beacons)
    if concerned in ("airspeed", "pitot", "heading", "wind"):
        return scenario in OWN_CHANNEL
    return concerned != "ins" or scenario not in OWN_CHANNEL


def fly_order(order: FlightOrder) -> FlightResult:
    """Fly an order; an exception is returned as a result."""
    try:
        scenario = scenario_of(order)
        config = config_of(order.scenario)
        fly = fly_records if is_sensor_fault(order.fault) else fly_bytes
        world, outputs = fly(scenario, config)
        return score_flight(order, world, outputs)
    except Exception as error:  # the campaign continues and lists it
        return FlightResult(order.key, *order, 0.0, raised=f"{type(error).__name__}: {error}")


def sensors_of(config: Config) -> tuple[type[Stamped], ...]:
    """Return the kinds of records that the configuration uses.

    The IMU is first: it moves the trajectory to an instant before the others are compared with it.
    """
    return SENSORS if config.has_own_ins or not config.uses("imu") else (Imu, *SENSORS)


def fly_records(scenario: Scenario, config: Config) -> tuple[World, list[Stamped]]:
    """Fly without messages: pass every record to the navigator at its arrival. Times are flight time."""
    world, navigator = World(scenario), Navigator(config)
    outputs: list[Stamped] = []
    for record in world.records(sensors_of(config)):
        outputs += navigator.handle(record)
        navigator.settle()
    return world, outputs


def fly_bytes(scenario: Scenario, config: Config) -> tuple[World, list[Stamped]]:
    """Fly over the simulated link; return the companion's outputs in flight time."""
    flown = (
        _fly_logged(scenario, config) if _disk_faults(scenario) else loopback.fly_scenario(scenario, config)
    )
    kinds = Solution, Rejection, Reset, Event
    outputs = [r for r in flown.records if isinstance(r, kinds)]
    return flown.autopilot.world, [replace(r, t_ns=r.t_ns - loopback.START_NS) for r in outputs]


def _disk_faults(scenario: Scenario) -> list[Fault]:
    return [fault for fault in scenario.faults if fault.name == "disk-full"]


def _fly_logged(scenario: Scenario, config: Config) -> loopback.LoopbackFlight:
    """Fly with a log whose disk is temporarily full. Raises OSError if messages were lost."""
    disks: list[FullDisk] = []

    def disk(path: Path) -> FullDisk:
        disks.append(FullDisk(path))
        return disks[-1]

    def progress(flown_s: float) -> None:
        disks[0].full = any(fault.covers(round(flown_s * SECOND_NS)) for fault in _disk_faults(scenario))

    with tempfile.TemporaryDirectory() as folder:
        log = Writer(
            Path(folder) / "flight.mcap",
            metadata={},
            start_unix_ns=UNIX_AT_START_NS,
            start_ns=loopback.START_NS,
            block=True,
            disk=disk,
        )
        flown = loopback.fly_scenario(scenario, config, log, progress)
        disks[0].full = False
        if not log.close() or log.dropped:
            raise OSError(f"the log lost {log.dropped} messages: {log.trouble or 'full for too long'}")
    return flown


def score_flight(order: FlightOrder, world: World, outputs: Sequence[Stamped]) -> FlightResult:
    """Compute the result of a flight from the companion's `outputs` and the truth."""
    solutions = [r for r in outputs if isinstance(r, Solution) and r.mode is not Mode.INITIALISING]
    if not solutions:
        return FlightResult(order.key, *order, world.scenario.duration_s, raised="no solution at all")
    kind = FAULT_CASES[order.fault]
    t, error = world.horizontal_errors(solutions)
    dt = np.clip(np.diff(t, append=t[-1]), 0.0, 1.0)
    levels = np.array([math.inf if s.protection is None else s.protection for s in solutions])
    trust = np.array([Trust.UNTRUSTED if s.trust is None else s.trust for s in solutions])
    start = kind.fault.start_s if kind.fault else math.inf
    end = kind.fault.end_s if kind.fault else math.inf
    on = (t >= start) & (t < end)
    exclusions = [r for r in outputs if isinstance(r, Event) and EXCLUSION in r.text]
    ours = [r.t_ns * 1e-9 for r in exclusions if _concerns(r, kind.concerns)]
    dropped = [x for x in (*ours, *_losses_of(solutions, t, kind.bits)) if start <= x < end]
    excluded = min(dropped, default=None)
    reported = [r.t_ns * 1e-9 for r in outputs if _reports_fault(r, kind.concerns)]
    worse = t[on & (trust > trust[max(int(on.argmax()) - 1, 0)])].tolist() if on.any() else []
    detected = min((x for x in (*reported, *dropped, *worse) if start <= x < end), default=None)
    of_gnss = "velocity of gnss" if kind.concerns == "gnss" else ""  # its velocity is no other source
    wrong = [r for r in exclusions if not _concerns(r, kind.concerns) and not _concerns(r, of_gnss)]
    before = (t >= start) & (t <= (end if excluded is None else excluded))
    settled, beyond = t >= SETTLED_S, error > levels
    flagged = (trust == Trust.DEGRADED) | (trust == Trust.UNTRUSTED)
    predicting = np.array([s.mode is Mode.PREDICTING and s.bound_n is not None for s in solutions])
    bounds = np.array([math.hypot(*(s.bound_n or (0.0, 0.0))) for s in solutions])

    def seconds(mask: npt.NDArray[np.bool_]) -> float:
        return round(float(dt[mask].sum()), 2)

    def largest(mask: npt.NDArray[np.bool_]) -> float:
        return round(float(error[mask].max(initial=0.0)), 2)

    return FlightResult(
        order.key,
        *order,
        flown_s=world.scenario.duration_s,
        solutions=len(solutions),
        detected_s=None if detected is None else round(detected - start, 3),
        excluded_s=None if excluded is None else round(excluded - start, 3),
        before_m=largest(before),
        largest_m=largest(settled),
        last_m=round(float(error[-1]), 2),
        normal_m=largest((t >= start) & (trust == Trust.NORMAL)),
        misleading_s=seconds(beyond & ~flagged & settled),
        beyond_s=seconds(beyond & flagged & settled),
        alarms=sum(SETTLED_S <= r.t_ns * 1e-9 < start for r in exclusions),
        wrong=sum(r.t_ns * 1e-9 >= start for r in wrong),
        quiet_s=seconds(settled & (t < start)),
        rms_error=_rms(error[predicting]),
        rms_bound=_rms(bounds[predicting]),
    )


def _losses_of(solutions: Sequence[Solution], t: Floats, bits: Source) -> Iterator[float]:
    """Yield the times (s) at which one of `bits` is no longer set in the sources of the solutions."""
    before = 0
    for solution, at in zip(solutions, t.tolist(), strict=True):
        if before & ~solution.sources & bits:
            yield at
        before = solution.sources


def _concerns(event: Event, concerns: str) -> bool:
    return bool(concerns) and event.text.startswith(concerns)


def _reports_fault(record: Any, concerns: str) -> bool:
    if isinstance(record, Rejection):
        return bool(concerns) and record.source.startswith(concerns)
    if isinstance(record, Event):
        names = any(word in record.text for word in (SUSPICION, EXCLUSION)) and _concerns(record, concerns)
        return names or any(text in record.text for text in FAULT_EVENTS)
    return isinstance(record, Reset)


def _rms(values: Floats) -> float | None:
    return round(root_mean_square(values), 3) if len(values) else None
