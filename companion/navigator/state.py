"""What the navigator remembers between two records, immutable, and what follows from it at an instant."""

from __future__ import annotations

from typing import NamedTuple

from scipy.special import chdtri

from companion.config import Channel, Config
from companion.estimate.fusion import Observation
from companion.estimate.monitor import Allotment
from companion.estimate.trust import Held
from companion.nav.geometry import Geodetic
from companion.navigator import (
    error_state,
    fix_observations,
    height_error,
    inertial_track,
    integrity,
    minimax_bound,
    tilt_error_model,
    wind_error_model,
)
from companion.navigator.air_data_channel import Reckoner
from companion.navigator.error_state import ErrorModel, ErrorState
from companion.navigator.height_error import Level
from companion.navigator.inertial_track import Point, Track
from companion.navigator.integrity import Watch
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.restrictive_filter import Restrictive
from companion.navigator.strapdown_channel import Strap
from companion.navigator.wind_mixture import Jumps
from companion.records import Gnss, LocalOrigin, LocalPosition, Output, Prediction, RsbnFix, Source

FIXES = Source.GNSS | Source.AZIMUTH | Source.RANGE


class Settings(NamedTuple):
    """The configuration with what follows from it."""

    config: Config
    unit: ErrorModel
    gate: tuple[float, ...]  # chi-square limits for 0, 1, 2, 3 degrees of freedom
    allotment: Allotment
    watched: ErrorModel  # what the integrity monitor takes the channel for
    channel: Channel

    @classmethod
    def of(cls, config: Config) -> Settings:
        """Everything derived once."""
        alarm = config.estimator.false_rejection
        gate = (0.0, *(float(chdtri(k, alarm)) for k in (1, 2, 3)))
        unit: ErrorModel
        watched: ErrorModel
        if config.channel == "air_data":
            unit = wind = wind_error_model.grade(config.air_data, config.gnss)
            watched = wind_error_model.overbound(wind)
        elif config.channel == "strapdown":
            unit = watched = tilt_error_model.grade(config.strapdown, config.gnss)
        else:
            unit = watched = ins = error_state.grade(config.inertial, config.gnss)
            if not config.inertial.independent:
                watched = error_state.overbound(ins, config.air_data.wind_jump_m_s)
        return cls(config, unit, gate, integrity.allotment(config), watched, config.channel)


class Lesson(NamedTuple):
    """A fix that has still to teach: what was believed of it, for the guaranteed predictor; the inertial
    point of its time; and a beacon's measurements as they were said, for the integrity monitor. It is `proof`
    if the guaranteed prediction allows it while the Gaussian state does not: the state's claim was wrong.
    """

    record: Gnss | RsbnFix
    heard: fix_observations.Heard | None
    ins: Point
    sights: tuple[Observation, ...] = ()
    proof: bool = False


class Carry(NamedTuple):
    """All that the navigator remembers."""

    guarantee: Guarantee
    origin: LocalOrigin | None = None
    local: LocalPosition | None = None
    waiting_ns: int | None = None  # since when positions come that a channel cannot begin with
    reckoner: Reckoner = Reckoner()
    strap: Strap = Strap()
    track: Track = ()
    state: ErrorState | None = None
    jumps: Jumps | None = None  # of air-data dead reckoning: what `state` is the sum of
    restrictive: Restrictive | None = None  # of the same
    level: Level = Level()
    gnss: Gnss | None = None  # the last new one, used or not
    gnss_heard: fix_observations.Heard | None = None  # the last one believed
    innovation: float | None = None  # of the last fix, squared, by its covariance; None if of one number
    lesson: Lesson | None = None  # not yet learnt: a solution must not wait for it
    asked_ns: int | None = None  # when GNSS was last used or refused
    gnss_ns: int | None = None  # when fixes were last believed
    rsbn_ns: int | None = None
    rsbn_told: Source = Source(0)  # which of azimuth and range were, then
    watch: Watch | None = None  # over the sources; its full solution is `state`
    held: Held | None = None  # trust, and since when
    next_ns: int = 0
    next_ahead_ns: int = 0
    ahead: tuple[Prediction, ...] = ()


Step = tuple[Carry, list[Output]]


def initial(settings: Settings) -> Carry:
    """The carry before anything was heard."""
    return Carry(minimax_bound.begin(settings.config))


def is_news(record: Gnss, carry: Carry, settings: Settings) -> bool:
    """A new fix of the receiver believed in: an autopilot repeats its last one for ever."""
    believed = record.receiver == settings.config.gnss.receiver
    return believed and (carry.gnss is None or not record.repeats(carry.gnss))


def state_at(carry: Carry, ins: Point, settings: Settings) -> ErrorState:
    """The error state carried to the time of `ins`; from the grade of the unit before the first fix."""
    state = carry.state or error_state.start(ins.t_ns, settings.unit)
    acceleration = inertial_track.acceleration(carry.track)
    return error_state.predict(state, ins.t_ns, ins.position.lat, ins.v_n, acceleration, settings.unit)


def level(ins: Point, carry: Carry) -> Point:
    """The inertial point at the height that GNSS has taught."""
    lat, lon, alt = ins.position
    return Point(ins.t_ns, Geodetic(lat, lon, alt - height_error.at(carry.level, ins).error), ins.v_n)


def sources(carry: Carry, t_ns: int, settings: Settings) -> Source:
    """What the position rests on now: fixes younger than their timeouts, over the inertial channel."""
    config, sources = settings.config, Source.INERTIAL
    if settings.channel == "air_data":
        sources |= Source.AIR_DATA
    if carry.gnss_ns is not None and (t_ns - carry.gnss_ns) * 1e-9 <= config.gnss.timeout_s:
        sources |= Source.GNSS
    if carry.rsbn_ns is not None and (t_ns - carry.rsbn_ns) * 1e-9 <= config.rsbn.timeout_s:
        sources |= carry.rsbn_told
    return sources
