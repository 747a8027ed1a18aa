"""Navigation: the earth, positions, and linear error models.

    earth            constants and radii of WGS84; the sphere of the error equations
    geometry         geodetic, ECEF and local positions, lines of sight, rotations, flat earths
    error_model      error equations of an INS, the paper's and the complete ones
    bounded_channel  errors of a channel as unknown but bounded, by grade
    disturbances     slow disturbances, stochastic or bounded, that extend the error state
    correctors       measurement rows of airspeed, logs, lines of position, stars, a second INS
    discretization   continuous system to one step, exact or Euler

Geodetic positions are radians and metres above WGS84. `_n` is NED, `_b` the body, `_e` ECEF; `C_nb` rotates
from b to n. Errors are computed minus true. numpy and scipy only, no I/O and no time.
"""

from companion.nav import correctors, disturbances, earth
from companion.nav.correctors import observation_matrix
from companion.nav.discretization import Discrete, discretise, euler
from companion.nav.disturbances import Disturbance, Model, compose
from companion.nav.earth import SPHERE, Radii, Sphere, radii
from companion.nav.error_model import (
    INS_STATES,
    Example,
    aircraft_matrix,
    aircraft_model,
    paper_example,
    paper_model,
)
from companion.nav.geometry import (
    Geodetic,
    LineOfSight,
    Projection,
    displace,
    enu_axes,
    from_ecef,
    from_enu,
    geodetic_to_local,
    local_to_geodetic,
    radio_horizon,
    rotation_matrix,
    separation,
    slant_range_azimuth,
    to_ecef,
    to_enu,
    wrap_angle,
)

__all__ = [
    "INS_STATES",
    "SPHERE",
    "Discrete",
    "Disturbance",
    "Example",
    "Geodetic",
    "LineOfSight",
    "Model",
    "Projection",
    "Radii",
    "Sphere",
    "aircraft_matrix",
    "aircraft_model",
    "compose",
    "correctors",
    "discretise",
    "displace",
    "disturbances",
    "earth",
    "enu_axes",
    "euler",
    "from_ecef",
    "from_enu",
    "geodetic_to_local",
    "local_to_geodetic",
    "observation_matrix",
    "paper_example",
    "paper_model",
    "radii",
    "radio_horizon",
    "rotation_matrix",
    "separation",
    "slant_range_azimuth",
    "to_ecef",
    "to_enu",
    "wrap_angle",
]
