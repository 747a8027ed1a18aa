"""GNSS beside the beacons: what they say of each other where no INS is witness.

Air data reckon by a wind that may change, and tell neither from the other. So what a beacon measures is kept
as it is seen from where GNSS says that we are, and the shape of that decides (`estimate.contradiction`). With
an INS no measurement is kept, and nobody is asked.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from companion.config import Config
from companion.estimate import filterbank, gnss_beacon_conflict, integrity, monitor
from companion.estimate.filterbank import Measurement
from companion.estimate.fusion import Azimuth, Range
from companion.estimate.gnss_beacon_conflict import Sight
from companion.estimate.monitor import Allotment, Judgement, Monitor
from companion.navigator import fix_observations
from companion.navigator.error_state import ErrorModel
from companion.navigator.inertial_track import Point
from companion.navigator.wind_error_model import WindError
from companion.records import Vector2

GNSS = "gnss"
SUSPECT_NS = 60_000_000_000  # a beacon that was refused is under suspicion for so long
BESIDE_NS = 1_000_000_000  # GNSS this close to a beacon's answer is compared with it
NOW_NS = 10_000_000_000  # for how long a comparison is one of now
PLAUSIBLE = 1e-3  # an excluded source must be this plausible to what is still heard, besides the bound


class Sights(NamedTuple):
    """The channel's error by GNSS, north and east (m), and when it said so, believed or not; and the beacons'
    measurements as they are seen from there.
    """

    gnss_ns: int = 0
    error_n: Vector2 | None = None
    kept: tuple[Sight, ...] = ()


def noted(s: Sights, t_ns: int, gnss: Measurement) -> Sights:
    """With GNSS's word, for beacons to be compared with."""
    north, east = gnss.z[:2].tolist()
    return s._replace(gnss_ns=t_ns, error_n=(north, east))


def shifted(s: Sights, north: float, east: float) -> Sights:
    """After the channel jumped by (north, east) m."""
    if s.error_n is None:
        return s
    return s._replace(error_n=(s.error_n[0] + north, s.error_n[1] + east))


def compared(s: Sights, m: Monitor, name: str, z: Azimuth | Range, ins: Point, unit: ErrorModel) -> Sights:
    """With an azimuth or a range as it is seen from where GNSS says that we are, if it says so now."""
    t_ns = m.bank.t_ns
    if not isinstance(unit, WindError) or s.error_n is None or t_ns - s.gnss_ns > BESIDE_NS:
        return s
    x = np.array(s.error_n)
    seen = filterbank.sighted(name, z, x, 2)
    if seen is None or seen.unit is None:
        return s
    north, east = seen.H[0].tolist()
    residual = float((seen.z - seen.H @ x)[0])
    drift = (unit.velocity_rows(ins.v_n) @ m.bank.x[0, : len(unit.sigma0)]).tolist()
    sight = Sight(t_ns, name, residual, (north, east), float(seen.unit[0]), (drift[0], drift[1]))
    return s._replace(kept=gnss_beacon_conflict.keep(s.kept, sight))


def arbiter(s: Sights, m: Monitor, unit: ErrorModel, config: Config) -> Callable[[], Judgement] | None:
    """Who tells whether GNSS or a beacon lies; None where the channel does, or while not both are heard."""
    bank = m.bank
    if not isinstance(unit, WindError) or GNSS in bank.excluded:
        return None
    kept = tuple(sight for sight in s.kept if sight.source not in bank.excluded)
    if not kept or bank.t_ns - kept[-1].t_ns > NOW_NS:
        return None

    def judge() -> Judgement:
        bias = {name: fix_observations.bias_sigma(name, config.rsbn) for name in bank.biases}
        rate = (config.air_data.wind_change_m_s_sqrt_s / unit.jump) ** 2
        found = gnss_beacon_conflict.weigh(kept, bias, gnss_beacon_conflict.Wind(unit.jump, rate))
        since = bank.t_ns if m.unresolved_ns is None else m.unresolved_ns
        liar = found.liar(_suspect(m, found.source), (bank.t_ns - since) * 1e-9)
        value = found.stepped if liar else found.pulled
        source = GNSS if liar == "" else liar
        return Judgement(source, value, integrity.threshold(gnss_beacon_conflict.SURE))

    return judge


def agrees(s: Sights, m: Monitor, allotted: Allotment) -> bool:
    """Whether GNSS, excluded, has been where the beacons see us for as long as it must be admitted."""
    bank = m.bank
    kept = tuple(
        sight for sight in since_probation(s, m, GNSS, allotted).kept if sight.source not in bank.excluded
    )
    if not kept:
        return True
    k = bank.x.shape[1] - len(bank.biases)
    value = gnss_beacon_conflict.apart(kept, bank.x[0, k:], bank.P[0, k:, k:], bank.biases)
    return value <= integrity.threshold(PLAUSIBLE)


def since_probation(s: Sights, m: Monitor, source: str, allotted: Allotment) -> Sights:
    """Those since which a source that is left out must be admitted; of others than GNSS all the rest."""
    since = m.bank.t_ns - round(1e9 * monitor.probation(m, source, allotted))
    kept = (sight for sight in s.kept if sight.t_ns >= since or source not in (GNSS, sight.source))
    return s._replace(kept=tuple(kept))


def _suspect(m: Monitor, source: str) -> bool:
    """Whether this source or the other one of its beacon has said what nothing explains, or is left out."""
    beacon = source.rsplit(" ", 1)[0]
    lately = {name for name, t_ns in m.refused if m.bank.t_ns - t_ns < SUSPECT_NS}
    return any(name.startswith(beacon + " ") for name in (*m.bank.excluded, *lately))
