"""Schuler channel: the dynamics of one horizontal INS error, and its scale in SI units.

Matasov, Martirosyan (2.1), in dimensionless time tau = omega0 t, omega0 = sqrt(g / R):

    gamma' = mu     phi' = mu - vartheta     mu' = -phi     vartheta' = 0

    gamma      position error / R                            [m]      after `Scale.units`
    phi        tilt less the reduced accelerometer error     [rad]
    mu         velocity error / (R omega0)                   [m/s]
    vartheta   constant gyro drift / omega0                  [rad/s]

One channel is one horizontal axis, north or east, along or across the great circle: (2.1) is the same.
Errors are INS minus truth. Meaning of phi and vartheta in NED, with (P_N, P_E) MINUS the rotation of the
platform about north and east, (E_N, E_E) minus its physical drift and (A_N, A_E) the accelerometer errors:

    north   dV_N' = -g P_E + A_N,   P_E' =  dV_N / R + E_E    so   phi =  P_E - A_N / g,   drift = -E_E
    east    dV_E' =  g P_N + A_E,   P_N' = -dV_E / R + E_N    so   phi = -P_N - A_E / g,   drift =  E_N

Another axis at azimuth psi (along the course, say) mixes them like any horizontal vector: cos psi of north
plus sin psi of east for all four numbers.

It does not know the Earth's rotation, the coupling of the two axes or the heading error: over an hour or
two in level flight that is an error of a few per cent; `nav.error_model` has the whole matrix.
"""

import math
from typing import Literal, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from companion.units import Floats

Number = TypeVar("Number", float, Floats)

EARTH_RADIUS = 6_371_000.0  # [m] sphere of (2.1)
SCHULER_RATE = 1.2387e-3  # [rad/s] sqrt(g / R); 84.5 min; g = 9.81 m/s^2 would give 1.2409e-3
ARCSECOND = math.pi / 648_000  # [rad]
DEG_PER_HOUR = math.pi / 648_000  # [rad/s]; the same number: 3600 s, 3600 arcseconds

STATE = ("gamma", "phi", "mu", "vartheta")


class Scale(NamedTuple):
    """Conversion between dimensionless time and state and SI; the only place where they meet.

    Attributes
    ----------
    radius : float
        Earth radius, m.
    rate : float
        Schuler rate omega0, rad/s.
    """

    radius: float = EARTH_RADIUS
    rate: float = SCHULER_RATE

    @property
    def units(self) -> tuple[float, float, float, float]:
        """Return the multipliers of gamma, phi, mu, vartheta to m, rad, m/s, rad/s."""
        return (self.radius, 1.0, self.radius * self.rate, self.rate)


MEAN_EARTH = Scale()


def sine_excess(x: Floats) -> Floats:
    """Compute x - sin x to full relative precision; the difference itself cancels near zero.

    Parameters
    ----------
    x : array
        Angle, rad.

    Returns
    -------
    array
        x - sin x, of the same shape.
    """
    return np.where(np.abs(x) < 0.5, x * x * x * _excess_series(x * x), x - np.sin(x))


def sine_excess_scalar(x: float) -> float:
    """Compute `sine_excess` of one number, fifty times faster.

    Parameters
    ----------
    x : float
        Angle, rad.

    Returns
    -------
    float
        x - sin x.
    """
    return x * x * x * _excess_series(x * x) if abs(x) < 0.5 else x - math.sin(x)


def _excess_series(square: Number) -> Number:
    """Return (x - sin x) / x^3 from x^2 < 1/4: 1/3! (1 - x^2/(4 5) (1 - x^2/(6 7) (...)))."""
    series = 1.0 - square / 272.0
    for k in (15, 13, 11, 9, 7, 5):
        series = 1.0 - square / ((k - 1) * k) * series
    return series / 6.0


def schuler_row(quantity: Literal["gamma", "mu"], s: npt.ArrayLike) -> Floats:
    """Build the measurement row of a fix: H with H . state = the quantity a time s before that state.

    Equation (2.1) solved backwards.

    Parameters
    ----------
    quantity : {"gamma", "mu"}
        Measured quantity: position or velocity.
    s : float or (n,)
        Dimensionless time (rad of Schuler phase) from the fix to the state; negative for a fix after it.

    Returns
    -------
    (4,) or (n, 4)
        Rows on gamma, phi, mu, vartheta.

    Raises
    ------
    ValueError
        For another quantity.

    References
    ----------
    Matasov, Martirosyan (2.1).
    """
    s = np.asarray(s, dtype=np.float64)
    row = np.empty((*s.shape, 4))
    versine = 2.0 * np.sin(0.5 * s) ** 2  # 1 - cos s without cancellation
    if quantity == "gamma":
        row[..., 0] = 1.0
        row[..., 1] = -versine
        row[..., 2] = -np.sin(s)
        row[..., 3] = -sine_excess(s)
    elif quantity == "mu":
        row[..., 0] = 0.0
        row[..., 1] = np.sin(s)
        row[..., 2] = np.cos(s)
        row[..., 3] = versine
    else:
        raise ValueError(f"schuler_row: quantity is {quantity!r}; give 'gamma' (position) or 'mu' (velocity)")
    return row


def force_response(
    quantity: str,
    t_s: npt.ArrayLike,
    start_s: npt.ArrayLike,
    end_s: npt.ArrayLike,
    anchor_s: float,
    scale: Scale = MEAN_EARTH,
) -> Floats:
    """Compute the effect of a unit specific force during a step on a state at another time.

    The state at the anchor is taken as given: a force between a fix and the anchor counts against the fix,
    one between the anchor and a later time against that time. mu' = -phi + force.

    Parameters
    ----------
    quantity : {"gamma", "phi", "mu", "vartheta"}
        State.
    t_s : (n,) or (n, 1)
        Times of the state, s.
    start_s, end_s : (k,)
        Steps, s.
    anchor_s : float
        Time of the given state, s.
    scale : Scale
        Earth radius and Schuler rate.

    Returns
    -------
    array
        Effect in SI (m, rad, m/s, rad/s) of 1 m/s^2; of the shape that the times and steps broadcast to.
    """
    t = np.asarray(t_s, dtype=np.float64)
    early, late = np.minimum(t, anchor_s), np.maximum(t, anchor_s)
    a = scale.rate * (t - np.clip(np.asarray(start_s, dtype=np.float64), early, late))
    b = scale.rate * (t - np.clip(np.asarray(end_s, dtype=np.float64), early, late))
    rate = scale.rate
    # integral of sin for gamma and phi, of cos for mu; 1 / (radius rate^2) is the unit force's mu'
    unit = {"gamma": 1.0 / rate**2, "phi": 1.0 / (scale.radius * rate**2), "mu": 1.0 / rate, "vartheta": 0.0}
    middle, half = 0.5 * (a + b), 0.5 * (a - b)
    found = 2.0 * np.sin(half) * (np.cos(middle) if quantity == "mu" else np.sin(middle))
    response: Floats = unit[quantity] * np.where(t >= anchor_s, found, -found)
    return response


def transition(alpha: float) -> Floats:
    """Build the transition matrix over a dimensionless time: (2.1) solved forwards.

    Parameters
    ----------
    alpha : float
        Dimensionless time ahead, rad of Schuler phase.

    Returns
    -------
    (4, 4)
        Transition of gamma, phi, mu, vartheta.
    """
    sin, cos, versine = math.sin(alpha), math.cos(alpha), 2.0 * math.sin(0.5 * alpha) ** 2
    return np.array(
        [
            [1.0, -versine, sin, sine_excess_scalar(alpha)],
            [0.0, cos, sin, -sin],
            [0.0, -sin, cos, versine],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )
