"""Origin of the autopilot's local frame, inferred from simultaneous local and global positions. Pure.

Both positions come from one estimator and describe one point, so the difference is the origin. The error is
the rounding of GLOBAL_POSITION_INT (1 cm) and the motion between the two that its velocity does not describe:
0.2 m r.m.s. on a copter that sends both at 1-2 Hz. Used only where no message states the origin.
"""

from __future__ import annotations

import numpy as np

from companion.nav.geometry import Geodetic, local_to_geodetic, wrap_angle
from companion.records import GlobalPosition, LocalOrigin, LocalPosition, Projection

LIVE_WINDOW_NS = 50_000_000  # in flight both are requested at 10 Hz or more
LOG_WINDOW_NS = 150_000_000  # recordings may hold both at 1-2 Hz only


def infer_origin(
    local: LocalPosition, known: GlobalPosition, projection: Projection, window_ns: int
) -> LocalOrigin | None:
    """Return the origin of `local`, given that `known` is the same point a moment apart.

    Parameters
    ----------
    local, known : positions of the same estimator; `local` is extrapolated with its velocity.
    projection : flat-earth projection of the autopilot that sent them.
    window_ns : limit on the difference of their times; None is returned beyond it.
    """
    apart_ns = known.t_ns - local.t_ns
    if abs(apart_ns) > window_ns:
        return None
    x_n = np.array(local.x_n) + apart_ns * 1e-9 * np.array(local.v_n)
    point = origin = Geodetic(known.lat, known.lon, known.alt_msl)
    for _ in range(4):  # fixed-point iteration; converges by the ratio distance / earth radius
        back = local_to_geodetic(projection, origin, x_n)
        origin = Geodetic(
            origin.lat + point.lat - back.lat,
            wrap_angle(origin.lon + point.lon - back.lon),
            origin.alt + point.alt - back.alt,
        )
    rx_ns = max(local.rx_ns, known.rx_ns)
    return LocalOrigin(known.t_ns, rx_ns, origin.lat, origin.lon, origin.alt, projection)
