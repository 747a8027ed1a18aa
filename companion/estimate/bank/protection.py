"""Protection level: the radius that a sum of Gaussians in the plane exceeds with a given probability.

References
----------
Joerger, Pervan 2013: protection levels from a sum over fault hypotheses.
"""

from __future__ import annotations

import math

import numpy as np

from companion.units import Floats

NODES = np.linspace(-6.75, 6.75, 46)  # trapezoid in units of sigma: 1.5e-11 is beyond
_w = np.exp(-0.5 * NODES**2)
NODE_WEIGHTS = _w / _w.sum()
del _w
MARGIN = 1.03
"""Factor on the quadrature of the tail: covers its error, so that the level is never too small."""
# ln erfc by interpolation, within 2e-5; scipy.special takes 13 MB of a flying process and 0.2 s of its start
_X = np.arange(-4.0, 26.0, 1.0 / 128.0)
_LOG_ERFC = np.log([math.erfc(x) for x in _X])


def exceedance(r: float, d: Floats, C: Floats) -> Floats:
    """Return P(|d + e| > r), e ~ N(0, C), for each row.

    Integrates the tail along one principal axis, in closed form, over the other by the trapezoidal rule.

    Parameters
    ----------
    r : radius.
    d, C : (R, 2), (R, 2, 2) means and covariances.

    Returns
    -------
    (R,) probabilities.
    """
    return _tail(r, *_principal(d, C))


def _principal(d: Floats, C: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Sigmas a >= b along the principal axes and |means| along them, each (R,)."""
    p, q, s = C[:, 0, 0], C[:, 1, 1], C[:, 0, 1]
    mean, half = 0.5 * (p + q), np.hypot(0.5 * (p - q), s)
    angle = 0.5 * np.arctan2(2.0 * s, p - q)
    c, sn = np.cos(angle), np.sin(angle)
    a = np.sqrt(np.maximum(mean + half, 1e-12))
    b = np.sqrt(np.maximum(mean - half, 1e-12))
    return a, b, np.abs(c * d[:, 0] + sn * d[:, 1]), np.abs(-sn * d[:, 0] + c * d[:, 1])


def _tail(r: float, a: Floats, b: Floats, ma: Floats, mb: Floats) -> Floats:
    # the closed form has a kink where the other axis leaves the circle: that must be far from the mean
    near = (r - mb) * a < (r - ma) * b
    a, b = np.where(near, b, a), np.where(near, a, b)
    ma, mb = np.where(near, mb, ma), np.where(near, ma, mb)
    v = mb[:, None] + b[:, None] * NODES
    h = np.sqrt(np.maximum(r * r - v * v, 0.0))
    scale = 1.0 / (a * math.sqrt(2.0))
    u, k = ma * scale, scale[:, None]
    inner = 0.5 * (_erfc(h * k - u[:, None]) + _erfc(h * k + u[:, None]))
    out: Floats = np.minimum(np.where(v * v >= r * r, 1.0, inner) @ NODE_WEIGHTS, 1.0)
    return out


def _erfc(x: Floats) -> Floats:
    out: Floats = np.exp(np.interp(x, _X, _LOG_ERFC))
    return out


def _normal_quantile(p: Floats) -> Floats:
    """The x that a normal variable exceeds with probability p."""
    out: Floats = math.sqrt(2.0) * np.interp(-np.log(2.0 * p), -_LOG_ERFC, _X)
    return out


def level(w: Floats, d: Floats, C: Floats, risk: float) -> float:
    """Return the least r with sum_i w_i P(|d_i + e_i| > r) <= risk, never less and at most 3 % more.

    Where the tail is flat (a row weighs about as much as the risk), 3 % more than the level at risk / 1.04.

    Parameters
    ----------
    w : (R,) weights.
    d, C : (R, 2), (R, 2, 2) means and covariances.
    risk : probability.

    Returns
    -------
    float : radius.
    """
    a, b, ma, mb = _principal(d, C)
    m = np.hypot(ma, mb)
    # a one-dimensional tail bounds each row from below, a circle of the major sigma from above
    log_need = np.log(risk / np.maximum(w, 1e-300))
    upper = m + a * np.sqrt(np.maximum(-2.0 * (log_need - math.log(len(w))), 0.0))
    upper = np.where(w * len(w) > risk, upper, 0.0)
    # rows that stay below the floor contribute at most 1 % of the risk together: counted by the margin
    idle = m + a * np.sqrt(np.maximum(-2.0 * (log_need - math.log(100.0 * len(w))), 0.0))
    high = float(upper.max())
    if high == 0.0:
        return 0.0
    heavy = w > 2.0 * risk
    alone = ma + a * _normal_quantile(risk / np.where(heavy, w, 2.0 * risk))
    low = float(np.maximum(m, alone)[heavy].max(initial=0.0))
    use = (idle > low) & (w * len(w) * 100.0 > risk)
    w, a, b, ma, mb = w[use], a[use], b[use], ma[use], mb[use]
    target = math.sqrt(-2.0 * math.log(risk / MARGIN))

    def excess(r: float) -> float:
        """In sigmas of one normal tail: nearly linear in r."""
        tail = float(w @ _tail(r, a, b, ma, mb))
        return target - math.sqrt(-2.0 * math.log(min(max(tail, 1e-300), 1.0)))

    f_low, f_high = excess(low), excess(high)
    if f_low <= 0.0:
        return low
    # Illinois variant of regula falsi, aimed 0.1 % beyond the root: two radii enclose it within 0.4 %
    before = f_low
    for _ in range(30):
        if high - low < 0.004 * high or f_high > 0.0:
            break
        r = (low * f_high - high * f_low) / (f_high - f_low) + math.copysign(0.001 * high, before)
        r = min(max(r, low + 0.002 * high), high - 0.002 * high)
        f = excess(r)
        again = 0.5 if f * before > 0.0 else 1.0
        if f > 0.0:
            low, f_low, f_high = r, f, again * f_high
        else:
            high, f_high, f_low = r, f, again * f_low
        before = f
    return high
