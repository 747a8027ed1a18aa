"""What each corrector sees of the INS errors: rows of H in Z = INS - corrector = H X + N.

Poddubny (1.19)-(1.23), with x north, y east, z down. A row is a mapping from state name to coefficient;
`rows` puts rows on the states of a model. Knows nothing of noise covariances, gating or time.

The error of the ground velocity is written apart, since the two models mean different things by dVE:
`TRUE_VELOCITY` for the aircraft's (dVN, dVE are errors of the velocity itself), `paper_velocity` for the
paper's (its dVE is the rate of dy). All velocity correctors are built on one of them.
"""

from collections.abc import Sequence
from math import cos, sin, tan
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.nav.earth import SPHERE, Sphere

Matrix = npt.NDArray[np.float64]
Row = dict[str, float]


class VelocityError(NamedTuple):
    """North and east error of the computed ground velocity, as rows."""

    north: Row
    east: Row


TRUE_VELOCITY = VelocityError({"dVN": 1.0}, {"dVE": 1.0})


def paper_velocity(lat: float, v_north: float, v_east: float, sphere: Sphere = SPHERE) -> VelocityError:
    """True velocity error in the paper's states: dVE + phi' tan(phi) dy - lam' sin(phi) dx, as in (1.19)."""
    lat_rate, lon_rate = v_north / sphere.R, v_east / (sphere.R * cos(lat))
    return VelocityError({"dVN": 1.0}, {"dVE": 1.0, "dx": -lon_rate * sin(lat), "dy": lat_rate * tan(lat)})


def rows(states: Sequence[str], *row: Row) -> Matrix:
    """H (k, n): the given rows on the `states` of a model. ValueError for a state the model has not."""
    index = {s: i for i, s in enumerate(states)}
    H = np.zeros((len(row), len(index)))
    for i, r in enumerate(row):
        for name, coefficient in r.items():
            if name not in index:
                raise ValueError(f"a corrector sees {name}, which the model has not: add its disturbance")
            H[i, index[name]] = coefficient
    return H


def airspeed(K: float, V_air: float, velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """Air velocity along and across the hull (INS minus air data), wind with its physical sign.

    K heading, V_air true airspeed. The across row needs a sideslip vane or the assumption of none.
    """
    return _log(K, V_air, velocity, {"wN": 1.0}, {"wE": 1.0})


def relative_log(K: float, V: float, velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """A log against the water, (1.19), (1.20), at speed V through it; the current enters with minus."""
    return _log(K, V, velocity, {"VcX": -1.0}, {"VcY": -1.0})


def absolute_log(K: float, V: float, velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """A log against the ground, Doppler radar, optical flow: (1.19) without current; V over ground."""
    return _log(K, V, velocity, {}, {})


def _log(K: float, V: float, velocity: VelocityError, flow_n: Row, flow_e: Row) -> tuple[Row, Row]:
    north, east = _add(velocity.north, flow_n), _add(velocity.east, flow_e)
    along = _add(_scale(cos(K), north), _scale(sin(K), east))
    across = _add(_add(_scale(-sin(K), north), _scale(cos(K), east)), {"PZ": -V})
    return along, across


def gnss_position() -> tuple[Row, Row]:
    """North and east, INS minus GNSS in metres (`geometry.separation`)."""
    return {"dx": 1.0}, {"dy": 1.0}


def gnss_velocity(velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """North and east, INS minus GNSS."""
    return velocity.north, velocity.east


def line_of_position(N: float, M: float, drift: str | None = None) -> Row:
    """A radio line of position (1.23): N dx + M dy + its slow drift, if that is a state."""
    return {"dx": N, "dy": M} | ({drift: 1.0} if drift else {})


def rsbn_range(bearing: float, elevation: float, drift: str | None = None) -> Row:
    """Slant range to a beacon, computed minus measured.

    `bearing` of the line from the beacon on, at the aircraft (the azimuth at the beacon plus the
    convergence of the meridians, rad); `elevation` of the aircraft above the beacon's horizontal, rad.
    """
    return line_of_position(cos(bearing) * cos(elevation), sin(bearing) * cos(elevation), drift)


def rsbn_azimuth(bearing: float, distance: float, drift: str | None = None) -> Row:
    """Azimuth at a beacon, computed minus measured, rad; `bearing` as above, horizontal `distance`."""
    if not distance > 0.0:
        raise ValueError(
            f"horizontal distance to the beacon is {distance}: overhead an azimuth tells nothing"
        )
    return line_of_position(-sin(bearing) / distance, cos(bearing) / distance, drift)


def star(h: float, q: float, lat: float, sphere: Sphere = SPHERE) -> tuple[Row, Row]:
    """Altitude h and azimuth q (from north clockwise) of a star against the platform, (1.22).

    DEPARTS FROM (1.22): azimuth contains -PZ - tan(h) (cos(q) PX + sin(q) PY), there + PZ alone.
    """
    R = sphere.R
    altitude = {"dx": cos(q) / R, "dy": sin(q) / R, "PX": sin(q), "PY": -cos(q)}
    azimuth = {
        "dx": tan(h) * sin(q) / R,
        "dy": (tan(lat) - tan(h) * cos(q)) / R,
        "PX": -tan(h) * cos(q),
        "PY": -tan(h) * sin(q),
        "PZ": -1.0,
    }
    return altitude, azimuth


def free_gyro(h: float, q: float, P: float, lat: float, sphere: Sphere = SPHERE) -> tuple[Row, Row]:
    """A star whose place has errors of its own: dg along the parallel westward, dd in declination (1.22).

    P is the parallactic angle: at the star, from the pole to the zenith, counted westward.
    """
    altitude, azimuth = star(h, q, lat, sphere)
    return (
        altitude | {"dg": sin(P), "dd": cos(P)},
        azimuth | {"dg": cos(P) / cos(h), "dd": -sin(P) / cos(h)},
    )


def second_ins(
    suffix: str = "2", seen: Sequence[str] = ("dx", "dy", "dVN", "dVE", "PX", "PY", "PZ")
) -> list[Row]:
    """First INS minus second: differences of like outputs, and angles between like axes of the platforms."""
    return [{s: 1.0, s + suffix: -1.0} for s in seen]


def _scale(k: float, row: Row) -> Row:
    return {name: k * c for name, c in row.items()}


def _add(a: Row, b: Row) -> Row:
    return {name: a.get(name, 0.0) + b.get(name, 0.0) for name in (*a, *(n for n in b if n not in a))}
