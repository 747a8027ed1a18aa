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
