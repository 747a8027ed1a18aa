"""The height error of the inertial channel against GNSS: it drifts, and it grows with a climb.

The height is a barometer's in the end. Weather, warming up and airflow move it by 0.2 m a root second: so
96 % of the heights of GNSS in 18 recorded flights are within two sigma of one predicted for three minutes. On
a day 20 K off the standard a metre of it is 8 % off: so the error is followed together with its share of a
climb, which is estimated within a few hundred metres of climb. A climb without GNSS then costs what is not
known of that share, no more.
"""

from __future__ import annotations

from typing import NamedTuple

from companion.navigator.inertial_track import Point
from companion.records import Gnss, Vector3

DRIFT = 0.04  # m^2/s
SHARE = 0.08  # one sigma of the error of a climb, as its share
SHARE_WALK = 1.3e-7  # 1/m: in 3 km of climb the share changes by 2 %
LEAST_M = 5.0  # one sigma of a height of GNSS, at least
PATIENCE_NS = 10_000_000_000  # what goes on contradicting for so long is believed, at least
#: Between two readings no height changes by more: noise, manoeuvres, and a climb or a dive.
STEP_M, CLIMB_M_S = 20.0, 200.0
WEATHER_M = 100.0  # one sigma of a pressure altitude at sea level: 12 hPa
#: A height that no pressure follows climbs or sinks by so much (m/s), one sigma, for so long (s).
HELD_M_S, HELD_S = 10.0, 30.0
NEARER_SIGMA = 3.0  # so much nearer to the standard atmosphere a height of GNSS is the likelier one


class Level(NamedTuple):
    """Height error (m) where the channel was at height `alt` (m) at `t_ns`, and its share of a climb; their
    covariance (m^2, m, 1). `refused_ns` is since when fixes contradict it, `patience_ns` for how long these
    are not believed; `since_ns` is since when the others are, `last` time and height of the last of them.
    """

    error: float = 0.0
    share: float = 0.0
    covariance: Vector3 = (400.0, 0.0, SHARE**2)
    t_ns: int | None = None
    alt: float = 0.0
    refused_ns: int | None = None
    patience_ns: int = PATIENCE_NS
    since_ns: int | None = None
    last: tuple[int, float] = (0, 0.0)


def greatest_change(dt: float) -> float:
    """The greatest change (m) of an aircraft's height, as a sensor reads it, in `dt` seconds."""
    return STEP_M + CLIMB_M_S * dt


def stepped(level: Level, up: float) -> Level:
    """The error after the channel's height stepped by `up` (m), which was no climb."""
    return level._replace(error=level.error + up, alt=level.alt + up)


def at(level: Level, ins: Point, held_s: float = 0.0) -> Level:
    """The error at the time and height of `ins`; before the first fix it is what it is everywhere.

    For `held_s` nothing has measured the height.
    """
    if level.t_ns is None:
        return level
    climb, dt = ins.position.alt - level.alt, (ins.t_ns - level.t_ns) * 1e-9
    variance, covariance, of_share = level.covariance
    variance += climb * (2.0 * covariance + climb * of_share) + DRIFT * max(dt, 0.0)
    variance += (HELD_M_S * min(held_s, HELD_S)) ** 2
    covariance += climb * of_share
    return level._replace(
        error=level.error + climb * level.share,
        covariance=(variance, covariance, of_share + SHARE_WALK * abs(climb)),
        t_ns=ins.t_ns,
        alt=ins.position.alt,
    )


def update(level: Level, record: Gnss, ins: Point, part: float, gate: float, held_s: float = 0.0) -> Level:
    """With the height of one fix, refused if its squared innovation is beyond `gate` times its variance.

    `part` is the share of one independent fix that this one is worth, its noise being correlated. If it is
    the height of GNSS that stepped, the longer of the two runs of fixes is believed, or the one that is
    nearer to the standard atmosphere by far. A height that was held for `held_s` is that of the fix.
    """
    first, since_ns = level.t_ns is None, ins.t_ns if level.since_ns is None else level.since_ns
    now = at(level, ins, held_s)._replace(t_ns=ins.t_ns, alt=ins.position.alt)
    variance, covariance, of_share = now.covariance
    noise = max(record.sigma_vertical or 0.0, LEAST_M) ** 2
    nu = ins.position.alt - record.alt_msl - now.error
    if not first and not nu * nu <= gate * (variance + noise):
        if now.refused_ns is None:
            last_ns, last_alt = now.last
            has_stepped = abs(record.alt_msl - last_alt) > greatest_change((record.t_ns - last_ns) * 1e-9)
            patience_ns = PATIENCE_NS
            if has_stepped and not _is_nearer(ins.position.alt, ins.position.alt - record.alt_msl, now.error):
                patience_ns = max(PATIENCE_NS, ins.t_ns - since_ns)
            now = now._replace(refused_ns=ins.t_ns, patience_ns=patience_ns)
        if ins.t_ns - (now.refused_ns or 0) < now.patience_ns:
            return now
        variance += nu * nu  # the claim was wrong
        since_ns = ins.t_ns
    now = now._replace(refused_ns=None, since_ns=since_ns, last=(record.t_ns, record.alt_msl))
    if held_s > 0.0:
        return now._replace(error=now.error + nu, covariance=(noise, 0.0, of_share))
    k = variance / (variance + noise / part)
    k_share = covariance / (variance + noise / part)
    left = ((1.0 - k) * variance, (1.0 - k) * covariance, of_share - k_share * covariance)
    return now._replace(error=now.error + k * nu, share=now.share + k_share * nu, covariance=left)


def _is_nearer(alt: float, error: float, than: float) -> bool:
    """Whether a pressure altitude `alt` (m) is in `error` (m) far more likely than in `than`."""
    sigma2 = WEATHER_M**2 + (SHARE * alt) ** 2
    return than * than - error * error > NEARER_SIGMA**2 * sigma2
