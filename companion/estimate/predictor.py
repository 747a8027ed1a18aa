"""Rolling minimax prediction of one INS channel: which fixes are kept, and what they promise ahead.

A `Window` holds the trusted fixes of one channel, the longest stretch within a limit in seconds and in
number: short windows are physically poor (40 s of positions, four minutes ahead: 8703 sigma). It is an
immutable value; pushing gives a new one. Nor should it pass an hour: beyond, the optimum rests on a single
fix one Schuler period old, which a real INS does not honour (on recorded flight 0.32 m/s instead of 0.16 m/s
five minutes ahead, 90 against 60 minutes of velocities). `predict` gives position, velocity, tilt and drift
error of the INS at one instant, each with the r.m.s. bound that holds under any correlation of the fixes'
errors, and beside it what least squares would claim were they uncorrelated, and would suffer were they not.

Rows are taken about the middle of the window, where they are as well conditioned as powers of time, and the
target is carried there; so one factoring serves all targets and instants. It does not know whether a fix
deserves trust, nor what is north: signs of tilt and drift for each axis are in `schuler`.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Self, cast

import numpy as np
import numpy.typing as npt

from companion.estimate.minimax_lp import Design, Infeasible
from companion.estimate.schuler import MEAN_EARTH, Scale, schuler_row, transition

Floats = npt.NDArray[np.float64]
Quantity = Literal["position", "velocity"]
Target = Literal["position", "velocity", "tilt", "drift"]
Key = tuple[int, bool]  # a fix, told by its time and whether it is a velocity

TARGETS: tuple[Target, ...] = (
    "position",
    "tilt",
    "velocity",
    "drift",
)  # in the order gamma, phi, mu, vartheta
MEASURED: dict[Quantity, bool] = {"position": False, "velocity": True}
NANO = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Measured INS errors of one channel, oldest first; no array is ever written to."""

    span: float = 3600.0  # [s] older fixes are let go
    capacity: int = 1000  # more are thinned evenly; the ends of each quantity stay
    t_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    velocity: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    value: Floats = field(default_factory=lambda: np.empty(0))  # [m] or [m/s], INS minus fix
    sigma: Floats = field(default_factory=lambda: np.empty(0))  # [m] or [m/s]
    disturbance: float = 0.0  # [m/s^2] r.m.s. of specific force that (2.1) does not know of
    drifting: bool = False  # nothing restores a velocity error: air-data dead reckoning in a wind

    def __post_init__(self) -> None:
        if not (math.isfinite(self.span) and self.span > 0.0):
            raise ValueError(f"Window.span is {self.span}; give a positive number of seconds")
        if self.capacity < 8:
            raise ValueError(f"Window.capacity is {self.capacity}; give at least 8, four of each quantity")

    @classmethod
    def of(
        cls,
        t_ns: npt.ArrayLike,
        quantity: Quantity,
        value: npt.ArrayLike,
        sigma: npt.ArrayLike,
        span: float = 3600.0,
        capacity: int = 1000,
    ) -> Self:
        """Return a window of one quantity: t_ns (n,) integers, value (n,), sigma (n,) or one for all."""
        window = cls(span, capacity)
        times, values = np.asarray(t_ns, np.int64), np.asarray(value, np.float64)
        if times.ndim != 1 or times.shape != values.shape:
            raise ValueError(f"t_ns has shape {times.shape}, value {values.shape}; give (n,) of both")
        sigmas = np.broadcast_to(np.asarray(sigma, np.float64), times.shape)
        if (late := np.diff(times) <= 0).any():
            k = int(late.argmax())
            raise ValueError(f"t_ns[{k + 1}] does not follow t_ns[{k}]; sort the fixes, drop repeated ones")
        if (bad := ~(np.isfinite(values) & np.isfinite(sigmas) & (sigmas > 0.0))).any():
            k = int(bad.argmax())
            raise ValueError(
                f"fix {k}: value {values[k]}, sigma {sigmas[k]}; leave out what is no measurement"
            )
        keep = times >= times[-1] - round(span / NANO) if len(times) else slice(0)
        window = window._with(
            times[keep], np.full(len(times), MEASURED[quantity])[keep], values[keep], sigmas[keep]
        )
        while len(window) > capacity:
            window = window._thinned()
        return window

    def __len__(self) -> int:
        return len(self.t_ns)

    def push(self, t_ns: int, quantity: Quantity, value: float, sigma: float) -> Self:
        """Return the window with one more fix; ValueError if it is late, repeated or not a number."""
        if quantity not in MEASURED:
            raise ValueError(f"quantity is {quantity!r}; give 'position' or 'velocity'")
        if not (math.isfinite(value) and math.isfinite(sigma) and sigma > 0.0):
            raise ValueError(
                f"fix {len(self)}: value {value}, sigma {sigma}; leave out what is no measurement"
            )
        velocity = MEASURED[quantity]
        if len(self) and t_ns < self.t_ns[-1]:
            raise ValueError(
                f"fix {len(self)} is at {t_ns} ns, before the last at {self.t_ns[-1]}; push in order"
            )
        if (self.velocity[self.t_ns.searchsorted(t_ns) :] == velocity).any():
            raise ValueError(
                f"fix {len(self)} repeats the {quantity} at {t_ns} ns; combine the two beforehand"
            )
        first = int(self.t_ns.searchsorted(t_ns - round(self.span / NANO)))
        grown = self._with(
            np.append(self.t_ns[first:], np.int64(t_ns)),
            np.append(self.velocity[first:], velocity),
            np.append(self.value[first:], value),
            np.append(self.sigma[first:], sigma),
        )
        return grown if len(grown) <= self.capacity else grown._thinned()

    def _with(
        self, t_ns: npt.NDArray[np.int64], velocity: npt.NDArray[np.bool_], value: Floats, sigma: Floats
    ) -> Self:
        for array in (t_ns, velocity, value, sigma):
            array.setflags(write=False)
        kept = (t_ns, velocity, value, sigma)
        return type(self)(self.span, self.capacity, *kept, self.disturbance, self.drifting)

    def _thinned(self) -> Self:
        """Drop the fix that leaves the least hole between its neighbours of the same quantity."""
        drop, least = -1, math.inf
        for velocity in (False, True):
            same = np.flatnonzero(self.velocity == velocity)
            if len(same) > 2:
                hole = self.t_ns[same[2:]] - self.t_ns[same[:-2]]
                k = int(hole.argmin())
                if hole[k] < least:
                    drop, least = int(same[k + 1]), float(hole[k])
        kept = np.arange(len(self)) != drop
        return self._with(self.t_ns[kept], self.velocity[kept], self.value[kept], self.sigma[kept])


class Forecast(NamedTuple):
    """One INS error at one instant, SI: m, rad, m/s, rad/s. Not feasible: nan, and infinite bounds."""

    feasible: bool
    estimate: float = math.nan
    bound: float = math.inf  # r.m.s., under any correlation of the fixes' errors
    gap: float = math.inf  # how far, relatively, the bound is proved to be from the least possible
    ls_estimate: float = math.nan
    ls_claimed: float = math.inf  # one sigma of least squares if the errors were uncorrelated
    ls_worst: float = math.inf  # r.m.s. of least squares under the worst correlation
    active: tuple[Key, ...] = ()  # the fixes the bound stands on


class Prediction(NamedTuple):
    """The INS errors of one channel at t_ns; None for what was not asked."""

    t_ns: int
    feasible: bool  # of all that was asked
    reason: str  # why not, or empty
    position: Forecast | None = None
    tilt: Forecast | None = None
    velocity: Forecast | None = None
    drift: Forecast | None = None


def predict(
    window: Window,
    t_ns: int,
    targets: Sequence[Target] = ("position", "velocity"),
    start: Prediction | None = None,
    scale: Scale = MEAN_EARTH,
) -> Prediction:
    """Return the INS errors at t_ns, usually ahead of the window; `start` is the previous prediction.

    Never raises on what a flight may bring: too few fixes give `feasible=False` and the reason.
    """
    return predict_ahead(window, [t_ns], targets, start, scale)[0]


def predict_ahead(
    window: Window,
    t_ns: Sequence[int],
    targets: Sequence[Target] = ("position", "velocity"),
    start: Prediction | None = None,
    scale: Scale = MEAN_EARTH,
) -> list[Prediction]:
    """Return predictions for several instants, each started from the one before."""
    for target in targets:
        if target not in TARGETS:
            raise ValueError(f"target {target!r} is unknown; give some of {', '.join(TARGETS)}")
    if not len(window):
        lost = dict.fromkeys(targets, Forecast(False))
        return [Prediction(int(t), False, "no fixes in the window", **lost) for t in t_ns]
    middle = (int(window.t_ns[0]) + int(window.t_ns[-1])) // 2
    factored: tuple[Design, Floats] | None = None
    predictions = []
    for t in t_ns:
        if factored is None or window.disturbance:
            factored = _design(window, middle, int(t), scale)
        design, whitened = factored
        alpha = (int(t) - middle) * NANO * scale.rate
        carried = _drift(alpha) if window.drifting else transition(alpha)
        forecasts, reasons = {}, []
        for target in targets:
            k = TARGETS.index(target)
            before = cast("Forecast | None", getattr(start, target)) if start else None
            try:
                forecasts[target] = _forecast(window, design, whitened, carried[k], scale.units[k], before)
            except Infeasible:
                forecasts[target] = Forecast(False)
                reasons.append(target)
        rank, fixes = len(design.q), len(window)
        why = (
            f"{', '.join(reasons)} not observable: {fixes} fixes determine {rank} of 4 unknowns"
            if reasons
            else ""
        )
        start = Prediction(int(t), not reasons, why, **forecasts)
        predictions.append(start)
    return predictions


def _design(window: Window, middle: int, t_ns: int, scale: Scale) -> tuple[Design, Floats]:
    """Return the dimensionless rows about the middle of the window, factored, and the measurements in sigmas.

    An unknown specific force between a fix and t_ns moves what the fix says of the state at t_ns. Its effect,
    at most the disturbance times the integral of the channel's response, is one more error of that fix of
    unknown correlation, and so adds to its sigma: an old fix counts for less, and the bound stays a bound.
    """
    before = (middle - window.t_ns) * (NANO * scale.rate)
    position, _, velocity, _ = scale.units
    rows = np.empty((len(window), 4))
    if window.drifting:
        rows = np.array([_drift(-s)[2 if v else 0] for s, v in zip(before, window.velocity, strict=True)])
    else:
        rows[~window.velocity] = schuler_row("gamma", before[~window.velocity])
        rows[window.velocity] = schuler_row("mu", before[window.velocity])
    sigma = window.sigma
    if window.disturbance:
        age = np.abs(t_ns - window.t_ns) * (NANO * scale.rate)
        swept = (0.5 * age**2, age) if window.drifting else (_swept(age, 0.0), _swept(age, 0.5 * math.pi))
        of_position = window.disturbance / scale.rate**2 * swept[0]
        of_velocity = window.disturbance / scale.rate * swept[1]
        sigma = sigma + np.where(window.velocity, of_velocity, of_position)
    return Design.of(rows, sigma / np.where(window.velocity, velocity, position)), window.value / sigma


def _drift(alpha: float) -> Floats:
    """Return the (4, 4) matrix that takes gamma a dimensionless time alpha ahead on mu alone, mu constant."""
    ahead = np.zeros((4, 4))
    ahead[0, 0] = ahead[2, 2] = 1.0
    ahead[0, 2] = alpha
    return ahead


def _swept(x: Floats, phase: float) -> Floats:
    """Return the integral of |sin(u + phase)| from 0 to x."""

    def to(y: Floats) -> Floats:
        turns = np.floor(y / math.pi)
        return 2.0 * turns + 1.0 - np.cos(y - math.pi * turns)

    return to(x + phase) - to(np.full_like(x, phase))


def _forecast(
    window: Window, design: Design, whitened: Floats, a: Floats, unit: float, before: Forecast | None
) -> Forecast:
    best = design.minimax(a, _rows(window, before.active) if before and before.active else None)
    ls = design.least_squares(a)
    used = list(best.active)
    active = tuple(zip(window.t_ns[used].tolist(), window.velocity[used].tolist(), strict=True))
    return Forecast(
        feasible=True,
        estimate=unit * float((best.weights[used] * design.sigmas[used]) @ whitened[used]),
        bound=unit * best.bound,
        gap=best.gap,
        ls_estimate=unit * float((ls.weights * design.sigmas) @ whitened),
        ls_claimed=unit * ls.claimed,
        ls_worst=unit * ls.worst,
        active=active,
    )


def _rows(window: Window, active: Sequence[Key]) -> list[int]:
    """Return where in the window the fixes of an earlier solution are now, or those nearest to them."""
    rows = []
    for t_ns, velocity in active:
        same = np.flatnonzero(window.velocity == velocity)
        if len(same):
            rows.append(int(same[np.abs(window.t_ns[same] - t_ns).argmin()]))
    return rows
