"""What can be promised of the inertial error when fixes stop: the minimax predictor kept by the navigator.

Corrections (INS minus radio fix) are averaged over short bins and pushed into one window a channel, north and
east. The mean of a bin has at most the weighted mean of its sigmas, whatever the correlation, so binning
costs the guarantee nothing and takes the white part of the noise away. A forecast is made once a second; in
between the position moves with the forecast velocity, and the bound by the velocity's bound (the triangle
inequality).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from companion.config import Config, PredictorConfig
from companion.estimate.predictor import MEASURED, Forecast, Quantity, Window, predict, predict_ahead
from companion.estimate.predictor import Prediction as Channel
from companion.records import Prediction, Vector2
from companion.units import G0

REFRESH_NS = 1_000_000_000
HOPELESS_M = 1e6  # a bound beyond this is as good as none: the window is too short for so far ahead
UNLIKE = 2.0  # a fix this many times better or worse than its bin begins a new one


class Bin(NamedTuple):
    """Weighted sums over the fixes of one bin: weight, time from start (s), value and sigma of each axis."""

    quantity: Quantity
    start_ns: int
    scale: float
    weight: float
    time: float
    value: Vector2
    sigma: Vector2


class Bounded(NamedTuple):
    """The INS error now, by minimax: position and velocity, their guaranteed r.m.s. bounds (m, m/s)."""

    error_n: Vector2
    velocity_error_n: Vector2
    bound_n: Vector2
    velocity_bound_n: Vector2


class Guarantee(NamedTuple):
    """Windows of both channels, the bins not yet full, and the last forecast."""

    north: Window
    east: Window
    bins: tuple[Bin, ...] = ()
    held: tuple[Channel, Channel] | None = None


def begin(config: Config) -> Guarantee:
    """Start without fixes. The error of dead reckoning drifts with a wind of bounded rate of change, that
    of strapdown with an unknown acceleration.
    """
    span = 60.0 * config.predictor.window_min
    if config.has_own_ins:
        window = Window(span, disturbance=config.predictor.disturbance_ug * 1e-6 * G0)
    elif config.inertial.source == "imu":
        strapdown = config.strapdown
        acceleration = math.hypot(G0 * math.radians(strapdown.tilt_deg), strapdown.accelerometer_m_s2)
        window = Window(span, disturbance=acceleration, drifting=True)
    else:
        window = Window(span, disturbance=config.air_data.wind_rate_m_s_min / 60.0, drifting=True)
    return Guarantee(window, window)


def tuned(g: Guarantee, config: Config) -> Guarantee:
    """Return the same windows of fixes under other settings."""
    fresh = begin(config).north
    north, east = (replace(w, span=fresh.span, disturbance=fresh.disturbance) for w in (g.north, g.east))
    return Guarantee(north, east, g.bins)


def add_fix(
    g: Guarantee, t_ns: int, quantity: Quantity, value: Vector2, sigma: Vector2, settings: PredictorConfig
) -> Guarantee:
    """With one more correction `value` of INS position (m) or velocity (m/s), north and east."""
    scale = sigma[0] + sigma[1]
    weight = 1.0 / scale**2
    mine = next((b for b in g.bins if b.quantity == quantity), None)
    others = tuple(b for b in g.bins if b.quantity != quantity)
    if mine is not None:
        full = (t_ns - mine.start_ns) * 1e-9 >= settings.bin_s
        if full or not 1.0 / UNLIKE < scale / mine.scale < UNLIKE:
            g = _close(g)
            mine, others = None, ()
    if mine is None:
        mine = Bin(quantity, t_ns, scale, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0))
    mine = mine._replace(
        weight=mine.weight + weight,
        time=mine.time + weight * (t_ns - mine.start_ns) * 1e-9,
        value=(mine.value[0] + weight * value[0], mine.value[1] + weight * value[1]),
        sigma=(mine.sigma[0] + weight * sigma[0], mine.sigma[1] + weight * sigma[1]),
    )
    return g._replace(bins=(*others, mine))


def bounded(g: Guarantee, t_ns: int, settings: PredictorConfig) -> tuple[Guarantee, Bounded | None]:
    """The INS error at `t_ns`; None where the fixes do not determine it (too few, too short)."""
    held = g.held
    if held is None or t_ns - held[0].t_ns >= REFRESH_NS or t_ns < held[0].t_ns:
        now = _halves(g, t_ns, settings)
        held = (
            predict(now.north, t_ns, start=held[0] if held else None),
            predict(now.east, t_ns, start=held[1] if held else None),
        )
        g = g._replace(held=held)
    if not (held[0].feasible and held[1].feasible) or max(_bound(held[0]), _bound(held[1])) > HOPELESS_M:
        return g, None
    dt = (t_ns - held[0].t_ns) * 1e-9
    north, east = _moved(held[0], dt), _moved(held[1], dt)
    error, velocity, bound, velocity_bound = zip(north, east, strict=True)
    return g, Bounded(error, velocity, bound, velocity_bound)


def ahead(g: Guarantee, t_ns: int, settings: PredictorConfig) -> tuple[Prediction, ...]:
    """Bounds for the minutes ahead of `t_ns` that are asked for, empty where there are none."""
    minutes = settings.ahead_min
    times = [t_ns + round(60e9 * m) for m in minutes]
    now = _halves(g, t_ns, settings)
    found = [
        [p.position for p in predict_ahead(window, times, ("position",))] for window in (now.north, now.east)
    ]
    return tuple(
        Prediction(60.0 * m, (n.bound, e.bound), (n.ls_claimed, e.ls_claimed), (n.ls_worst, e.ls_worst))
        for m, n, e in zip(minutes, *found, strict=True)
        if n is not None and e is not None and max(n.bound, e.bound) < HOPELESS_M
    )


def shift(g: Guarantee, north: float, east: float, v_n: Vector2 = (0.0, 0.0), t_ns: int = 0) -> Guarantee:
    """After the channel jumped by (north, east) m, so did every position error ever measured against it; with
    `v_n` (m/s) it is as if it had always moved so much faster, the jump being that at `t_ns`.
    """

    def moved(b: Bin) -> Bin:
        n, e = v_n
        if b.quantity == "velocity":
            return b._replace(value=(b.value[0] + b.weight * n, b.value[1] + b.weight * e))
        since = b.time + b.weight * (b.start_ns - t_ns) * 1e-9
        value = b.value[0] + b.weight * north + n * since, b.value[1] + b.weight * east + e * since
        return b._replace(value=value)

    window_n, window_e = _shifted(g.north, north, v_n[0], t_ns), _shifted(g.east, east, v_n[1], t_ns)
    return Guarantee(window_n, window_e, tuple(moved(b) for b in g.bins))


def forget(g: Guarantee, since_ns: int) -> Guarantee:
    """Drop the fixes after `since_ns`: their source was false."""
    return Guarantee(_until(g.north, since_ns), _until(g.east, since_ns))


def _close(g: Guarantee) -> Guarantee:
    """All bins pushed, oldest first: a window takes its fixes in the order of time, one of a kind at a time.

    Two fixes of one instant, too unlike for one bin, stand a nanosecond apart.
    """
    north, east = g.north, g.east
    for t_ns, full in sorted((b.start_ns + round(1e9 * b.time / b.weight), b) for b in g.bins):
        w, t_ns = full.weight, max(t_ns, _free_ns(north, full.quantity))
        north = north.push(t_ns, full.quantity, full.value[0] / w, full.sigma[0] / w)
        east = east.push(t_ns, full.quantity, full.value[1] / w, full.sigma[1] / w)
    return Guarantee(north, east, (), g.held)


def _free_ns(window: Window, quantity: Quantity) -> int:
    """From when on the window takes another fix of this quantity."""
    same = window.t_ns[window.velocity == MEASURED[quantity]]
    return max(int(window.t_ns[-1]), int(same[-1]) + 1 if len(same) else 0) if len(window) else 0


def _halves(g: Guarantee, t_ns: int, settings: PredictorConfig) -> Guarantee:
    """With the open bins once half full: fewer fixes would lend the estimate all their noise."""
    if all((t_ns - b.start_ns) * 1e-9 >= 0.5 * settings.bin_s for b in g.bins):
        return _close(g)
    return g


def _bound(channel: Channel) -> float:
    return channel.position.bound if channel.position else math.inf


def _moved(channel: Channel, dt: float) -> tuple[float, float, float, float]:
    position, velocity = channel.position, channel.velocity
    assert isinstance(position, Forecast)
    assert isinstance(velocity, Forecast)
    return (
        position.estimate + velocity.estimate * dt,
        velocity.estimate,
        position.bound + velocity.bound * dt,
        velocity.bound,
    )


def _until(window: Window, t_ns: int) -> Window:
    kept = int(window.t_ns.searchsorted(t_ns, "right"))
    columns = {name: getattr(window, name)[:kept] for name in ("t_ns", "velocity", "value", "sigma")}
    return replace(window, **columns)


def _shifted(window: Window, offset: float, rate: float, t_ns: int) -> Window:
    positions = window.value + offset + rate * (window.t_ns - t_ns) * 1e-9
    value = np.where(window.velocity, window.value + rate, positions)
    value.setflags(write=False)
    return replace(window, value=value)
