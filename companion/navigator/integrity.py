"""The integrity monitor of this navigator: its records as the monitor's measurements, its verdicts as ours.

One bank of Gaussian solutions (`estimate.filterbank`) over the error state of whatever channel is corrected,
with a constant bias of each beacon's azimuth and range as further states. Beside the error state
that leads it tells which source to leave out, and how far off the output may be.
Of the model it asks what every `ErrorModel` tells. It decides nothing about the guaranteed prediction, but
an excluded source is heard again only within that prediction's bounds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from companion.config import Config, IntegrityConfig
from companion.estimate import filterbank, integrity, monitor
from companion.estimate.filterbank import INERTIAL, Measurement
from companion.estimate.fusion import Azimuth, Range
from companion.estimate.integrity import Protection
from companion.estimate.monitor import Allotment, Exclusion, Monitor, Refusal
from companion.nav.geometry import Geodetic, separation_tuple
from companion.navigator import error_state, fix_observations, gnss_beacon_check
from companion.navigator.error_state import POSITION, VELOCITY, ErrorModel, ErrorState
from companion.navigator.gnss_beacon_check import GNSS, PLAUSIBLE, Sights
from companion.navigator.inertial_track import Point
from companion.navigator.minimax_bound import Bounded
from companion.records import Event, Gnss, Output, Rejection, Severity, Vector2, Vector3

FORKS = 2
LOOSE_M_S = 0.05  # a root second: an inertial channel that is not believed beyond a minute
LOOSER = 8.0  # times the model's own noise, for a channel whose velocity is noisier than that
MOST_STEPS = 64  # across a silence: two minutes in the error state's own steps, a longer one in longer
DECIDE_NS = 1_000_000_000
BIAS_HOUR = 0.5  # a beacon's bias walks in an hour by this share of what it may be
MOST_BEACONS = 8  # followed at once: the work grows with the cube of their number
CONTRADICT = "sources contradict one another"


class Watch(NamedTuple):
    """The monitor, the protection level of its full solution once known, and when it decides next."""

    monitor: Monitor
    protection: Protection | None = None
    exclusions: tuple[Exclusion, ...] = ()  # of the sources left out now
    due_ns: int = 0
    v_n: Vector3 | None = None  # of the channel, at the bank's time
    sights: Sights = Sights()
    beacons: tuple[int, ...] = ()  # that are followed, the last heard last


class Verdict(NamedTuple):
    """What the gate says of an excluded source: how far it is from what is guaranteed, and whether it is
    heard again.
    """

    watch: Watch
    value: float
    limit: float
    back: bool


def allotment(config: Config) -> Allotment:
    """What may go wrong, by the configuration."""
    settings = config.integrity
    return Allotment(
        settings.alarms_per_hour, rejection=config.estimator.false_rejection, settle_s=settings.settle_s
    )


def begin(t_ns: int, unit: ErrorModel) -> Watch:
    """Before the first fix: nothing but the grade of the unit."""
    bank = filterbank.begin(t_ns, np.zeros(len(unit.sigma0)), np.diag(unit.sigma0**2))
    bank = filterbank.join(filterbank.join(bank, INERTIAL), GNSS, forks=FORKS)
    return Watch(Monitor(bank))


def advance(w: Watch, ins: Point, a_n: Vector2, unit: ErrorModel, config: Config) -> Watch:
    """At the time of `ins`, the channel flying as it says with horizontal acceleration `a_n`."""
    bank = w.monitor.bank
    left = (ins.t_ns - bank.t_ns) * 1e-9
    if left <= 0.0:
        return w
    if w.v_n is not None:  # of the whole step: all of a turn's change of velocity meets the heading's error
        a_n = ((ins.v_n[0] - w.v_n[0]) / left, (ins.v_n[1] - w.v_n[1]) / left)
    system = unit.system(ins.position.lat, ins.v_n, a_n)
    steps = min(math.ceil(left / error_state.STEP_S), MOST_STEPS)
    dt = left / steps
    Phi, Q = error_state.transition(dt, system)
    moved = (unit.velocity_rows((0.0, 0.0, 0.0)) ** 2).sum(axis=0)
    loose = moved * (LOOSE_M_S**2 + LOOSER * np.diagonal(system.Q)) * dt
    walk = (
        np.array([fix_observations.bias_sigma(name, config.rsbn) ** 2 for name in bank.biases])
        * BIAS_HOUR**2
        / 3600.0
    )
    for _ in range(steps):
        bank = filterbank.carry(bank, ins.t_ns, Phi, Q, loose, walk * dt)
    return w._replace(monitor=w.monitor._replace(bank=bank), v_n=ins.v_n)


def solution(w: Watch) -> ErrorState:
    """The full solution without the biases."""
    bank = w.monitor.bank
    k = bank.x.shape[1] - len(bank.biases)
    return ErrorState(bank.t_ns, bank.x[0, :k], bank.P[0, :k, :k])


def error_at(w: Watch, ins: Point, unit: ErrorModel) -> Vector2:
    """The position error of the full solution, carried on by its velocity to a moment later."""
    t_ns, x, _ = solution(w)
    dt = (ins.t_ns - t_ns) * 1e-9
    north, east = x[POSITION].tolist()
    if not dt:
        return north, east
    v_n, v_e = (unit.velocity_rows(ins.v_n) @ x).tolist()
    return north + dt * v_n, east + dt * v_e


def excluded(w: Watch | None, source: str) -> bool:
    """Whether the source is left out."""
    return w is not None and source in w.monitor.bank.excluded


def sound_ns(w: Watch) -> int:
    """Until when what was heard is beyond suspicion, if something stands apart now."""
    return min((row.since_ns for row in w.monitor.bank.rows if not row.never), default=w.monitor.bank.t_ns)


def named(beacon: int, z: Azimuth | Range) -> str:
    """What the monitor calls a beacon's azimuth or range: each stands for itself."""
    return f"rsbn {beacon} {type(z).__name__.lower()}"


def of_gnss(record: Gnss, ins: Point, unit: ErrorModel, config: Config) -> Measurement:
    """Position and, where it is told and used, velocity; the receiver's slow drift is a state."""
    sigma = fix_observations.white_sigma(record, config.gnss)
    H, variance = error_state.gnss_rows(unit), [sigma**2] * 2
    z = [*separation_tuple(ins.position, Geodetic(record.lat, record.lon, record.alt_msl))[:2]]
    if config.gnss.use_velocity and record.v_n is not None:
        told = max(record.sigma_velocity or 0.0, config.gnss.sigma_velocity_m_s)
        z += [ins.v_n[0] - record.v_n[0], ins.v_n[1] - record.v_n[1]]
        H = np.vstack([H, unit.velocity_rows(ins.v_n)])
        variance += [told**2 + unit.velocity_noise**2] * 2
    return Measurement(GNSS, np.array(z), H, np.diag(variance))


def met(w: Watch, beacon: int) -> Watch:
    """Before an answer: of more beacons than are followed the one silent longest is forgotten, one that is
    left out only if all are.

    One that tells another place than it did goes on as the same: it is the likelier fault.
    """
    if w.beacons and w.beacons[-1] == beacon:
        return w
    known = [other for other in w.beacons if other != beacon]
    if len(known) >= MOST_BEACONS:
        excluded = {int(name.split()[1]) for name in w.monitor.bank.excluded if name.startswith("rsbn ")}
        oldest = min(known, key=lambda other: other in excluded)
        known.remove(oldest)
        w = _forgotten(w, oldest)
    return w._replace(beacons=(*known, beacon))


def _forgotten(w: Watch, beacon: int) -> Watch:
    names = tuple(f"rsbn {beacon} {part.__name__.lower()}" for part in (Azimuth, Range))
    m = w.monitor
    for name in names:
        m = monitor.forget(m, name)
    left = tuple(e for e in w.exclusions if e.source not in names)
    kept = tuple(sight for sight in w.sights.kept if sight.source not in names)
    return w._replace(monitor=m, exclusions=left, sights=w.sights._replace(kept=kept))


def of_beacon(w: Watch, name: str, z: Azimuth | Range, config: Config) -> tuple[Watch, Measurement | None]:
    """An azimuth or a range, which joins where it is new; None in the cone of silence."""
    bank = w.monitor.bank
    if name not in bank.sources:
        bank = filterbank.join(bank, name, fix_observations.bias_sigma(name, config.rsbn))
        w = w._replace(monitor=w.monitor._replace(bank=bank))
    k = bank.x.shape[1] - len(bank.biases)
    return w, filterbank.sighted(name, z, bank.x[0], k)


def calibrated(w: Watch | None, name: str, z: Azimuth | Range, config: Config) -> Azimuth | Range:
    """The measurement less its learnt bias, whose own uncertainty adds to its sigma."""
    bias, variance = 0.0, fix_observations.bias_sigma(name, config.rsbn) ** 2
    if w is not None and name in w.monitor.bank.biases:
        bank = w.monitor.bank
        i = bank.x.shape[1] - len(bank.biases) + bank.biases.index(name)
        bias, variance = float(bank.x[0, i]), float(bank.P[0, i, i])
    value, sigma = z.value - bias, math.sqrt(z.sigma**2 + variance)
    if isinstance(z, Azimuth):
        return Azimuth(z.beacon, value, sigma, z.axes)
    return Range(z.beacon, value, sigma)


def hear(w: Watch, measurement: Measurement, allotted: Allotment) -> tuple[Watch, Refusal | None]:
    """One more measurement, at the bank's time; a refusal where no solution can explain it."""
    heard, refusal = monitor.hear(w.monitor, measurement, allotted)
    return w._replace(monitor=heard), refusal


def doubted(w: Watch, measurement: Measurement) -> Watch:
    """Before a measurement that is to be believed whatever is claimed: the claims were wrong, and are widened
    until it is an ordinary one, lest it be held against its source.
    """
    bank = w.monitor.bank
    factor = max(1.0, filterbank.surprise(bank, measurement) / len(measurement.z))
    return w._replace(monitor=w.monitor._replace(bank=filterbank.widen(bank, factor)))


def decide(w: Watch, unit: ErrorModel, allotted: Allotment, config: Config) -> Watch:
    """Once a second: who is excluded, and how far off the output may be."""
    t_ns = w.monitor.bank.t_ns
    if t_ns < w.due_ns:
        return w
    watched, exclusions = monitor.watch(
        w.monitor, allotted, gnss_beacon_check.arbiter(w.sights, w.monitor, unit, config)
    )
    if INERTIAL in watched.bank.excluded:
        # nothing measures it: it is believed again once the others have calibrated it anew
        watched, _ = monitor.offer(watched, t_ns, INERTIAL, True, allotted._replace(slow_s=allotted.fork_s))
    left = tuple(e for e in (*w.exclusions, *exclusions) if e.source in watched.bank.excluded)
    w = w._replace(monitor=watched, exclusions=left, due_ns=t_ns + DECIDE_NS)
    return protected(w, allotted, config.integrity)


def protected(w: Watch, allotted: Allotment, settings: IntegrityConfig) -> Watch:
    """With the protection level of now. While nothing is heard nobody can be accused, but the level grows."""
    bank = w.monitor.bank
    level = integrity.protection(bank, allotted.false_alarm(len(bank.rows) - 1), settings.risk)
    return w._replace(protection=level)


def tell(before: Watch | None, after: Watch, rx_ns: int) -> list[Output]:
    """What became of the sources from `before` to `after`: every exclusion with its numbers."""
    known = before.exclusions if before else ()
    t_ns = after.monitor.bank.t_ns
    told = list[Output]()
    if after.monitor.unresolved and not (before and before.monitor.unresolved):
        told.append(Event(t_ns, rx_ns, Severity.WARNING, f"{CONTRADICT}, none clearly wrong"))
    for e in after.exclusions:
        if e not in known:
            age = (e.t_ns - e.since_ns) * 1e-9
            text = f"{e.source} excluded ({e.reason} {e.value:.0f}, limit {e.limit:.0f}); "
            text += f"without its last {age:.0f} s the position moves by {e.moved:.0f} m"
            told += [
                Rejection(e.t_ns, rx_ns, e.source, f"excluded: {e.reason}", e.value, e.limit),
                Event(t_ns, rx_ns, Severity.WARNING, text),
            ]
    for e in known:
        if e.source not in after.monitor.bank.excluded:
            out = (t_ns - e.t_ns) * 1e-9
            told.append(Event(t_ns, rx_ns, Severity.NOTICE, f"{e.source} heard again after {out:.0f} s"))
    return told


def offer(
    w: Watch, measurement: Measurement, bounded: Bounded | None, allotted: Allotment, config: Config
) -> Verdict:
    """An excluded source's word, against the guaranteed prediction and, while others are heard, theirs."""
    value, limit = beyond(measurement, bounded, config)
    bank = w.monitor.bank
    plausible = filterbank.surprise(bank, measurement) <= float(chdtri(len(measurement.z), PLAUSIBLE))
    admitted = value <= limit and plausible
    if measurement.source == GNSS and config.channel == "air_data":  # the channel is no witness: beacons are
        admitted = admitted and gnss_beacon_check.agrees(w.sights, w.monitor, allotted)
    heard, back = monitor.offer(w.monitor, bank.t_ns, measurement.source, admitted, allotted)
    left = tuple(e for e in w.exclusions if e.source in heard.bank.excluded)
    if back:  # what was seen of its lie is no evidence any more
        w = w._replace(
            sights=gnss_beacon_check.since_probation(w.sights, w.monitor, measurement.source, allotted)
        )
    return Verdict(w._replace(monitor=heard, exclusions=left), value, limit, back)


def beyond(measurement: Measurement, bounded: Bounded | None, config: Config) -> tuple[float, float]:
    """How far a measurement is from the guaranteed prediction, and the limit (`integrity.admits`)."""
    if bounded is None:
        return math.inf, len(measurement.z) / config.integrity.refusal
    source, z, H, R, unit = measurement
    # the position of the first two states; GNSS's velocity comes after its position
    G = np.zeros((len(z), 4))
    G[:2, :2] = H[:2, :2]
    G[2:, 2:] = np.eye(len(z), 2, -2)[2:]
    known = np.array([*bounded.error_n, *bounded.velocity_error_n])
    bounds = np.abs(G) @ np.array([*bounded.bound_n, *bounded.velocity_bound_n])
    variance = np.diagonal(R).copy()
    if unit is not None:
        variance += (unit * fix_observations.bias_sigma(source, config.rsbn)) ** 2
    else:
        variance[:2] += config.gnss.sigma_m**2
    offset, sigma = (z - G @ known).tolist(), np.sqrt(variance).tolist()
    return integrity.admits(offset, bounds.tolist(), sigma, config.integrity.refusal)


def shift(w: Watch, north: float, east: float, v_n: Vector2 | None = None, t_ns: int = 0) -> Watch:
    """After the channel jumped by (north, east) m; with `v_n` (m/s) as if it had always been faster by so
    much, (north, east) being its jump at `t_ns`.
    """
    bank = w.monitor.bank
    x = bank.x.copy()
    x[:, POSITION] += north, east
    if v_n is not None:
        x[:, POSITION] += np.array(v_n) * ((bank.t_ns - t_ns) * 1e-9)
        x[:, VELOCITY] += v_n
    faster = w.v_n and v_n and (w.v_n[0] + v_n[0], w.v_n[1] + v_n[1], w.v_n[2])
    w = w._replace(monitor=w.monitor._replace(bank=bank._replace(x=x)), v_n=faster or w.v_n)
    return w._replace(sights=gnss_beacon_check.shifted(w.sights, north, east))


def blur(w: Watch, sigma: float, sigma_v: float = 0.0) -> Watch:
    """After the channel moved by nobody knows how much: `sigma` (m) north and as much east, its velocity by
    `sigma_v` (m/s).
    """
    bank = w.monitor.bank
    P = bank.P.copy()
    P[:, POSITION, POSITION] += sigma**2 * np.eye(2)
    P[:, VELOCITY, VELOCITY] += sigma_v**2 * np.eye(2)
    return w._replace(
        monitor=w.monitor._replace(bank=bank._replace(P=P)), sights=w.sights._replace(error_n=None)
    )


def is_sound(w: Watch | None) -> bool:
    """Whether all of its numbers are numbers."""
    return w is None or filterbank.is_sound(w.monitor.bank)
