"""Navigator state between two records, immutable, and the settings derived once from the configuration."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from msgspec import Struct, structs

from companion.config import Config
from companion.estimate import bank as banks
from companion.estimate.bank import Bank
from companion.estimate.kalman import Gaussian
from companion.nav.geometry import Geodetic, displace
from companion.navigator import height_error
from companion.navigator.air_data_channel import CLIMB_NS
from companion.navigator.channel import Nominal
from companion.navigator.height_error import Level
from companion.navigator.hypotheses import GNSS, SOURCES, TURNED_M_S, Hypotheses, Model, Situation
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.own_channel import OwnChannel, Reckoned, Sensors
from companion.navigator.parallel_filters import Parallel
from companion.navigator.scatter import Scatter
from companion.navigator.trust import Held
from companion.records import Gnss, LocalOrigin, LocalPosition, Output, RsbnFix, Source, Vector2
from companion.units import SECOND_NS

FIXES = Source.GNSS | Source.AZIMUTH | Source.RANGE
JAMMED_NS = 10 * SECOND_NS  # the receiver's word lasts so long
SUSPECT, EXCLUDED = 1, 2
NEAR_S = 0.5  # the bank is at most so far behind: in between the error moves by its velocity


class Settings(NamedTuple):
    """The configuration with what follows from it."""

    config: Config
    model: Model

    @classmethod
    def of(cls, config: Config) -> Settings:
        """Derive everything once."""
        return cls(config, Model(config))


class Beacon(NamedTuple):
    """A beacon that is followed: identity, place, when it answered last; whether all of that was believed."""

    identity: int
    place: tuple[float, float, float]
    last_ns: int
    believed: bool = False


class Contradiction(NamedTuple):
    """A first GNSS that contradicts a position of one beacon: since when, when last, by how much (m)."""

    since_ns: int
    last_ns: int
    apart_m: float


class Pending(NamedTuple):
    """A fix whose radio-only solution has still to be made: it teaches the guaranteed predictor."""

    record: Gnss | RsbnFix
    point: Point  # origin of the observations' plane
    centre: Vector2  # error of the nominal trajectory that was taken off there (m)
    used: Source


class VelocityError(NamedTuple):
    """Mean of the estimated error of the nominal velocity over the last minute, m/s, at `t_ns`."""

    t_ns: int
    north: float
    east: float


class Newborn(NamedTuple):
    """What the bank `parent` is after the births that are due, before its rows are reduced or after."""

    parent: Bank
    bank: Bank
    is_reduced: bool


class State(Struct, frozen=True):
    """All that the navigator remembers; to replace a field of a Struct costs a fifth of a NamedTuple's."""

    guarantee: Guarantee = Guarantee()
    origin: LocalOrigin | None = None
    local: LocalPosition | None = None
    waiting_ns: int | None = None  # since when a channel cannot begin
    sensors: Sensors = Sensors()
    nominal: Nominal | None = None
    reckoned: Reckoned | None = None  # by airspeed alone, in the own channel: the guaranteed bound is of it
    ins: Point | None = None  # the last sample of an INS; the nominal point may be carried on beyond it
    bank: Bank | None = None
    newborn: Newborn | None = None
    turned: Vector2 = (0.0, 0.0)  # change of velocity by the IMU within seconds, north and east (m/s)
    leading: tuple[Bank, Gaussian] | None = None  # moments of the leading family, and of which bank
    protection: tuple[int, float, float, float] | None = None  # when computed; radius, position error (m)
    fixed: bool = False  # whether a fix was ever used
    restarts: int = 0  # how often the position was given up
    beacons: tuple[Beacon, ...] = ()
    unfit: tuple[tuple[int, int], ...] = ()  # beacons none of whose answers fits: identity, answers so far
    jammed_ns: int | None = None  # when the receiver last reported jamming or spoofing
    false: tuple[float, ...] = ()  # probability that each source is false
    certain_ns: tuple[int, ...] = ()  # since when each is false beyond doubt, 0 where it is not
    reported: tuple[int, ...] = ()  # what was last reported of each source: 0 used, 1 suspect, 2 excluded
    level: Level = Level()
    moved: Vector2 = (0.0, 0.0)  # sum of the jumps of the nominal trajectory, north and east (m)
    scatter: Mapping[str, Scatter] = MappingProxyType({})  # of the measurements, by name
    velocity_scatter: Scatter | None = None  # of the velocity of GNSS
    parallel: Parallel | None = None  # filters beside the bank
    gnss_taken: Gnss | None = None  # the last one judged by the bank
    gnss_before: Gnss | None = None  # the one before it
    gnss_fix: tuple[Gnss, Point] | None = None  # the last one believed
    pending: Pending | None = None
    half: Pending | None = None  # an azimuth or a range that alone was no fix
    velocity_error: VelocityError | None = None
    gnss_first_ns: int | None = None  # of the first 3D fix
    started_ns: int | None = None  # when the position was started
    contradiction: Contradiction | None = None
    refused_ns: int | None = None  # since when no hypothesis takes a fix of GNSS
    gnss_ns: int | None = None  # when fixes were last believed
    rsbn_ns: int | None = None
    azimuth_ns: int | None = None  # when an azimuth was last believed, None if the last one was not
    range_ns: int | None = None
    held: Held | None = None
    next_ns: int = 0


Step = tuple[State, list[Output]]


def afresh(state: State) -> State:
    """What is left of a state where the estimate begins again."""
    return State(
        next_ns=state.next_ns,
        origin=state.origin,
        sensors=state.sensors,
        level=state.level,
        restarts=state.restarts + 1,
    )


def with_sensors(state: State, **changes: Any) -> State:
    """With these fields of `sensors` replaced."""
    return structs.replace(state, sensors=structs.replace(state.sensors, **changes))


def hypotheses(state: State, settings: Settings) -> Hypotheses:
    """The hypotheses of the situation."""
    interval, s = state.nominal.interval if state.nominal else None, state.sensors
    now = Situation(
        len(state.beacons),
        by_air=interval is not None and interval.by == "air",
        witness=has_witness(state, settings),
        is_received=gnss_is_received(state, settings),
        has_turned=math.hypot(*state.turned) > TURNED_M_S,
        along_nose=not s.multirotor and not s.hovering,
        is_aloft=not s.landed or s.ground.flying,
    )
    return settings.model.hypotheses(now)


def gnss_is_received(state: State, settings: Settings) -> bool:
    """Whether a fix was used within `gnss.timeout_s`."""
    bank = state.bank
    return bank is not None and bool(bank.t - bank.seen[GNSS] <= settings.config.gnss.timeout_s)


def gnss_is_believed(state: State, settings: Settings) -> bool:
    """Whether GNSS is not even suspect."""
    return not state.false or state.false[GNSS] < hypotheses(state, settings).settings.suspect


def is_jammed(state: State) -> bool:
    """Whether the receiver reported jamming or spoofing within the last seconds."""
    now = state.nominal.t_ns if state.nominal else 0
    return state.jammed_ns is not None and now - state.jammed_ns < JAMMED_NS


def is_contradicted(state: State, t_ns: int, settings: Settings) -> Contradiction | None:
    """The contradiction of a first GNSS that is still received; None if there is none."""
    found, timeout_ns = state.contradiction, round(1e9 * settings.config.gnss.timeout_s)
    is_over = found is None or state.gnss_taken is not None or t_ns - found.last_ns > timeout_ns
    return None if is_over else found


def gnss_climb(state: State, t_ns: int) -> float:
    """Rate of the height of GNSS between its last two fixes, m/s; 0 where these are not recent."""
    now, before = state.gnss_taken, state.gnss_before
    if now is None or before is None or now.receiver != before.receiver:
        return 0.0
    if not 0 < now.t_ns - before.t_ns <= CLIMB_NS or abs(t_ns - now.t_ns) > CLIMB_NS:
        return 0.0
    return (now.alt_msl - before.alt_msl) / ((now.t_ns - before.t_ns) * 1e-9)


def has_witness(state: State, settings: Settings) -> bool:
    """Whether a beacon was received within its timeout, or the receiver reports jamming or spoofing.

    A beacon is none beside a steady airspeed alone, which is off by the whole change of the speed: what it
    contradicts is not GNSS.
    """
    if state.bank is None:
        return False
    if is_jammed(state):
        return True
    interval = state.nominal.interval if state.nominal else None
    if interval is not None and interval.by == "air" and interval.airspeed == "steady":
        return False
    now = state.nominal.t_ns if state.nominal else 0
    timeout = round(1e9 * settings.config.rsbn.timeout_s)
    return any(now - beacon.last_ns < timeout for beacon in state.beacons)


def own(settings: Settings) -> OwnChannel:
    """The own channel, where its samples are handled."""
    assert isinstance(settings.model.channel, OwnChannel)
    return settings.model.channel


def held_s(state: State, t_ns: int) -> float:
    """How long neither a pressure nor a fix has measured the height, s; 0 while pressures come."""
    static_ns = state.sensors.air.static_ns
    if state.nominal is None or state.nominal.interval is None or t_ns - static_ns <= CLIMB_NS:
        return 0.0
    return max(t_ns - max(static_ns, state.level.t_ns or 0), 0) * 1e-9


def levelled(point: Point, state: State) -> Point:
    """The nominal point at the height corrected by GNSS."""
    lat, lon, alt = point.position
    return Point(point.t_ns, Geodetic(lat, lon, alt - height_error.at(state.level, point).error), point.v_n)


def corrected(point: Point, state: State, settings: Settings) -> tuple[Point, Vector2]:
    """The nominal point less its estimated error, and that error, north and east (m)."""
    north, east = estimate(state, settings).x[:2].tolist()
    point = levelled(point, state)
    place = displace(*point.position, -north, -east, 0.0)
    return point._replace(position=place._replace(alt=point.position.alt)), (north, east)


def estimate(state: State, settings: Settings) -> Gaussian:
    """Moments of the leading explanation."""
    assert state.bank is not None
    if state.leading is not None and state.leading[0] is state.bank:
        return state.leading[1]
    return banks.estimate(state.bank, hypotheses(state, settings).layout)


def source_name(i: int, state: State) -> str:
    """Name of source number `i`, with the beacon's identity."""
    if i < len(SOURCES):
        return SOURCES[i]
    k, part = divmod(i - len(SOURCES), 2)
    return f"rsbn {state.beacons[k].identity} {('azimuth', 'range')[part]}"


def sources(state: State, t_ns: int, settings: Settings) -> Source:
    """What the position rests on now: fixes younger than their timeouts, over the channel."""
    config, found = settings.config, Source.INERTIAL
    interval = state.nominal.interval if state.nominal else None
    if interval is not None and (interval.by == "air" or t_ns - state.sensors.measured_ns < 2_000_000_000):
        found |= Source.AIR_DATA
    if state.gnss_ns is not None and (t_ns - state.gnss_ns) * 1e-9 <= config.gnss.timeout_s:
        found |= Source.GNSS
    for part, last_ns in ((Source.AZIMUTH, state.azimuth_ns), (Source.RANGE, state.range_ns)):
        if last_ns is not None and (t_ns - last_ns) * 1e-9 <= config.rsbn.timeout_s:
            found |= part
    return found
