"""Measurement rows of the correctors: H in Z = INS - corrector = H X + N.

Poddubny (1.19), (1.20), (1.22), (1.23), with x north, y east, z down. A row is a mapping from state name to
coefficient; `observation_matrix` puts rows on the states of a model. It does not know noise covariances,
gating or time.

The error of the ground velocity is dVN, dVE in the aircraft's model; in the paper's, whose dVE is the rate of
dy, it is `paper_velocity`.
"""

from collections.abc import Sequence
from math import cos, sin, tan

import numpy as np

from companion.nav.earth import SPHERE, Sphere
from companion.units import Floats

Row = dict[str, float]


def paper_velocity(lat: float, v_north: float, v_east: float, sphere: Sphere = SPHERE) -> tuple[Row, Row]:
    """Express the true velocity error in the paper's states: dVE + phi' tan(phi) dy - lam' sin(phi) dx.

    Parameters
    ----------
    lat : float
        Latitude, rad.
    v_north, v_east : float
        Ground velocity, in the unit of `sphere`.
    sphere : Sphere
        Spherical earth.

    Returns
    -------
    tuple of Row
        North and east.

    References
    ----------
    Poddubny (1.19).
    """
    lat_rate, lon_rate = v_north / sphere.R, v_east / (sphere.R * cos(lat))
    return {"dVN": 1.0}, {"dVE": 1.0, "dx": -lon_rate * sin(lat), "dy": lat_rate * tan(lat)}


def observation_matrix(states: Sequence[str], *row: Row) -> Floats:
    """Put rows on the states of a model.

    Parameters
    ----------
    states : sequence of str
        The n states of the model, in order.
    *row : Row
        k rows.

    Returns
    -------
    (k, n)
        H.

    Raises
    ------
    ValueError
        For a state that the model does not have.
    """
    index = {s: i for i, s in enumerate(states)}
    H = np.zeros((len(row), len(index)))
    for i, r in enumerate(row):
        for name, coefficient in r.items():
            if name not in index:
                raise ValueError(
                    f"a corrector measures {name}, not a state of the model: add its disturbance"
                )
            H[i, index[name]] = coefficient
    return H


def airspeed(K: float, V_air: float) -> tuple[Row, Row]:
    """Build the rows of the air velocity along and across the hull, INS minus air data, physical wind sign.

    The across row needs a sideslip vane or the assumption of zero sideslip.

    Parameters
    ----------
    K : float
        Heading, rad.
    V_air : float
        True airspeed.

    Returns
    -------
    tuple of Row
        Along and across.
    """
    return _log(K, V_air, {"dVN": 1.0, "wN": 1.0}, {"dVE": 1.0, "wE": 1.0})


def relative_log(K: float, V: float, velocity: tuple[Row, Row]) -> tuple[Row, Row]:
    """Build the rows of a log against the water; the current enters with minus.

    Parameters
    ----------
    K : float
        Heading, rad.
    V : float
        Speed through the water.
    velocity : tuple of Row
        Error of the ground velocity, north and east.

    Returns
    -------
    tuple of Row
        Along and across.

    References
    ----------
    Poddubny (1.19), (1.20).
    """
    north, east = velocity
    return _log(K, V, {**north, "VcX": -1.0}, {**east, "VcY": -1.0})


def _log(K: float, V: float, north: Row, east: Row) -> tuple[Row, Row]:
    """Turn the error of a velocity into the hull, whose computed heading is off by PZ."""
    along = _add(_scale(cos(K), north), _scale(sin(K), east))
    across = _add(_scale(-sin(K), north), _scale(cos(K), east))
    return along, {**across, "PZ": -V}


def line_of_position(N: float, M: float, drift: str) -> Row:
    """Build the row of a radio line of position, N dx + M dy + its slow drift.

    Parameters
    ----------
    N, M : float
        Gradient of the measurement, north and east.
    drift : str
        Name of the drift state.

    Returns
    -------
    Row
        The row.

    References
    ----------
    Poddubny (1.23).
    """
    return {"dx": N, "dy": M, drift: 1.0}


def star(h: float, q: float, lat: float) -> tuple[Row, Row]:
    """Build the rows of a star's altitude and azimuth against the platform.

    DEPARTS FROM (1.22): azimuth contains -PZ - tan(h) (cos(q) PX + sin(q) PY), there + PZ alone.

    Parameters
    ----------
    h : float
        Altitude of the star, rad.
    q : float
        Azimuth, from north clockwise, rad.
    lat : float
        Latitude, rad.

    Returns
    -------
    tuple of Row
        Altitude and azimuth.

    References
    ----------
    Poddubny (1.22).
    """
    R = SPHERE.R
    altitude = {"dx": cos(q) / R, "dy": sin(q) / R, "PX": sin(q), "PY": -cos(q)}
    azimuth = {
        "dx": tan(h) * sin(q) / R,
        "dy": (tan(lat) - tan(h) * cos(q)) / R,
        "PX": -tan(h) * cos(q),
        "PY": -tan(h) * sin(q),
        "PZ": -1.0,
    }
    return altitude, azimuth


def second_ins() -> tuple[Row, Row]:
    """Build the rows of the position of a second INS, whose states end with 2: first minus second.

    Returns
    -------
    tuple of Row
        North and east.
    """
    return {"dx": 1.0, "dx2": -1.0}, {"dy": 1.0, "dy2": -1.0}


def _scale(k: float, row: Row) -> Row:
    return {name: k * c for name, c in row.items()}


def _add(a: Row, b: Row) -> Row:
    return {name: a.get(name, 0.0) + b.get(name, 0.0) for name in (*a, *(n for n in b if n not in a))}
