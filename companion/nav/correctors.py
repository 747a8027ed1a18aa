"""Measurement rows of the correctors: H in Z = INS - corrector = H X + N.

Poddubny (1.19)-(1.23), with x north, y east, z down. A row is a mapping from state name to coefficient;
`observation_matrix` puts rows on the states of a model. It does not know noise covariances, gating or time.

The error of the ground velocity is a separate argument, since the two models define dVE differently:
`TRUE_VELOCITY` for the aircraft's (dVN, dVE are errors of the velocity itself), `paper_velocity` for the
paper's (its dVE is the rate of dy). All velocity correctors are built on one of them.
"""

from collections.abc import Sequence
from math import cos, sin, tan
from typing import NamedTuple

import numpy as np

from companion.nav.earth import SPHERE, Sphere
from companion.units import Floats

Row = dict[str, float]


class VelocityError(NamedTuple):
    """Error of the computed ground velocity as rows.

    Attributes
    ----------
    north, east : Row
        Coefficients of the states in its components.
    """

    north: Row
    east: Row


TRUE_VELOCITY = VelocityError({"dVN": 1.0}, {"dVE": 1.0})


def paper_velocity(lat: float, v_north: float, v_east: float, sphere: Sphere = SPHERE) -> VelocityError:
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
    VelocityError
        Rows of north and east error.

    References
    ----------
    Poddubny (1.19).
    """
    lat_rate, lon_rate = v_north / sphere.R, v_east / (sphere.R * cos(lat))
    return VelocityError({"dVN": 1.0}, {"dVE": 1.0, "dx": -lon_rate * sin(lat), "dy": lat_rate * tan(lat)})


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


def airspeed(K: float, V_air: float, velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """Build the rows of the air velocity along and across the hull, INS minus air data, physical wind sign.

    The across row needs a sideslip vane or the assumption of zero sideslip.

    Parameters
    ----------
    K : float
        Heading, rad.
    V_air : float
        True airspeed.
    velocity : VelocityError
        Error of the ground velocity in the model's states.

    Returns
    -------
    tuple of Row
        Along and across.
    """
    return _log(K, V_air, velocity, {"wN": 1.0}, {"wE": 1.0})


def relative_log(K: float, V: float, velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """Build the rows of a log against the water; the current enters with minus.

    Parameters
    ----------
    K : float
        Heading, rad.
    V : float
        Speed through the water.
    velocity : VelocityError
        Error of the ground velocity in the model's states.

    Returns
    -------
    tuple of Row
        Along and across.

    References
    ----------
    Poddubny (1.19), (1.20).
    """
    return _log(K, V, velocity, {"VcX": -1.0}, {"VcY": -1.0})


def absolute_log(K: float, V: float, velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """Build the rows of a log against the ground, Doppler radar or optical flow.

    Parameters
    ----------
    K : float
        Heading, rad.
    V : float
        Speed over ground.
    velocity : VelocityError
        Error of the ground velocity in the model's states.

    Returns
    -------
    tuple of Row
        Along and across.

    References
    ----------
    Poddubny (1.19) without current.
    """
    return _log(K, V, velocity, {}, {})


def _log(K: float, V: float, velocity: VelocityError, flow_n: Row, flow_e: Row) -> tuple[Row, Row]:
    north, east = _add(velocity.north, flow_n), _add(velocity.east, flow_e)
    along = _add(_scale(cos(K), north), _scale(sin(K), east))
    across = _add(_add(_scale(-sin(K), north), _scale(cos(K), east)), {"PZ": -V})
    return along, across


def gnss_position() -> tuple[Row, Row]:
    """Build the rows of a GNSS position, INS minus GNSS in metres (`geometry.separation`).

    Returns
    -------
    tuple of Row
        North and east.
    """
    return {"dx": 1.0}, {"dy": 1.0}


def gnss_velocity(velocity: VelocityError = TRUE_VELOCITY) -> tuple[Row, Row]:
    """Build the rows of a GNSS velocity, INS minus GNSS.

    Parameters
    ----------
    velocity : VelocityError
        Error of the ground velocity in the model's states.

    Returns
    -------
    tuple of Row
        North and east.
    """
    return velocity.north, velocity.east


def line_of_position(N: float, M: float, drift: str | None = None) -> Row:
    """Build the row of a radio line of position, N dx + M dy + its slow drift.

    Parameters
    ----------
    N, M : float
        Gradient of the measurement, north and east.
    drift : str, optional
        Name of the drift state, if there is one.

    Returns
    -------
    Row
        The row.

    References
    ----------
    Poddubny (1.23).
    """
    return {"dx": N, "dy": M} | ({drift: 1.0} if drift else {})


def rsbn_range(bearing: float, elevation: float, drift: str | None = None) -> Row:
    """Build the row of a slant range to a beacon, computed minus measured.

    Parameters
    ----------
    bearing : float
        Direction of the line from the beacon, at the aircraft, rad (the azimuth at the beacon plus the
        convergence of the meridians).
    elevation : float
        Elevation of the aircraft above the beacon's horizontal, rad.
    drift : str, optional
        Name of the drift state, if there is one.

    Returns
    -------
    Row
        The row.
    """
    return line_of_position(cos(bearing) * cos(elevation), sin(bearing) * cos(elevation), drift)


def rsbn_azimuth(bearing: float, distance: float, drift: str | None = None) -> Row:
    """Build the row of an azimuth at a beacon, computed minus measured, rad.

    Parameters
    ----------
    bearing : float
        As in `rsbn_range`, rad.
    distance : float
        Horizontal distance to the beacon.
    drift : str, optional
        Name of the drift state, if there is one.

    Returns
    -------
    Row
        The row.

    Raises
    ------
    ValueError
        If the distance is not positive.
    """
    if not distance > 0.0:
        raise ValueError(
            f"horizontal distance to the beacon is {distance}: give a positive one, "
            "overhead the azimuth is undefined"
        )
    return line_of_position(-sin(bearing) / distance, cos(bearing) / distance, drift)


def star(h: float, q: float, lat: float, sphere: Sphere = SPHERE) -> tuple[Row, Row]:
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
    sphere : Sphere
        Spherical earth.

    Returns
    -------
    tuple of Row
        Altitude and azimuth.

    References
    ----------
    Poddubny (1.22).
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
    """Build the rows of a free gyro: a star with errors dg westward along the parallel, dd in declination.

    Parameters
    ----------
    h, q : float
        Altitude and azimuth, rad, as in `star`.
    P : float
        Parallactic angle, rad: at the star, from the pole to the zenith, counted westward.
    lat : float
        Latitude, rad.
    sphere : Sphere
        Spherical earth.

    Returns
    -------
    tuple of Row
        Altitude and azimuth.

    References
    ----------
    Poddubny (1.21), (1.22).
    """
    altitude, azimuth = star(h, q, lat, sphere)
    return (
        altitude | {"dg": sin(P), "dd": cos(P)},
        azimuth | {"dg": cos(P) / cos(h), "dd": -sin(P) / cos(h)},
    )


def second_ins(
    suffix: str = "2", compared: Sequence[str] = ("dx", "dy", "dVN", "dVE", "PX", "PY", "PZ")
) -> list[Row]:
    """Build the rows of a second INS: first minus second, outputs and platform angles.

    Parameters
    ----------
    suffix : str
        Suffix of the second system's states.
    compared : sequence of str
        States that are compared.

    Returns
    -------
    list of Row
        One row for each state.
    """
    return [{s: 1.0, s + suffix: -1.0} for s in compared]


def _scale(k: float, row: Row) -> Row:
    return {name: k * c for name, c in row.items()}


def _add(a: Row, b: Row) -> Row:
    return {name: a.get(name, 0.0) + b.get(name, 0.0) for name in (*a, *(n for n in b if n not in a))}
