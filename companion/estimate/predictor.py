"""Rolling minimax prediction of one INS channel from a window of fixes.

A `Window` holds the trusted fixes of one channel, the longest stretch within a limit in seconds and in
number: short windows are physically poor (40 s of positions, four minutes ahead: 8703 sigma). It is an
immutable value; `push` returns a new one. It should not exceed an hour: beyond, the optimum relies on a
single fix one Schuler period old, which a real INS does not honour (on recorded flight 0.32 m/s instead of
0.16 m/s five minutes ahead, 90 against 60 minutes of velocities). `predict` gives position, velocity, tilt
and drift error of the INS at one instant, each with the r.m.s. bound that holds under any correlation of the
fixes' errors, and for comparison the least-squares estimate with its claimed and its worst error.

Rows are taken about the middle of the window, where they are as well conditioned as powers of time, and the
target is propagated there; so one factoring serves all targets and instants. It does not know whether a fix
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
from companion.units import Floats

Quantity = Literal["position", "velocity"]
Target = Literal["position", "velocity", "tilt", "drift"]
Key = tuple[int, bool]  # identifies a fix: its time, ns, and whether it is a velocity

TARGETS: tuple[Target, ...] = (
    "position",
    "tilt",
    "velocity",
    "drift",
)  # in the order gamma, phi, mu, vartheta
MEASURED: dict[Quantity, bool] = {"position": False, "velocity": True}
NS = 1e-9  # [s]


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Measured INS errors of one channel, oldest first; its arrays are read-only.

    Attributes
    ----------
    span : float
        Fixes older than this are dropped, s.
    capacity : int
        Above this number fixes are thinned evenly; the ends of each quantity stay.
    t_ns : (n,) int64
        Times of the fixes, ns.
    velocity : (n,) bool
        True for a velocity, False for a position.
    value : (n,)
        INS minus fix, m or m/s.
    sigma : (n,)
        R.m.s. errors of the fixes, m or m/s.
    disturbance : float
        R.m.s. of the specific force not modelled by (2.1), m/s^2.
    drifting : bool
        True where nothing restores a velocity error: air-data dead reckoning in a wind.
    """

    span: float = 3600.0
    capacity: int = 1000
    t_ns: npt.NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    velocity: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, np.bool_))
    value: Floats = field(default_factory=lambda: np.empty(0))
    sigma: Floats = field(default_factory=lambda: np.empty(0))
    disturbance: float = 0.0
    drifting: bool = False

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
        """Build a window of one quantity.

        Parameters
        ----------
        t_ns : (n,) int
            Times, ns, strictly increasing.
        quantity : {"position", "velocity"}
            What the fixes measure.
        value : (n,)
            INS minus fix, m or m/s.
        sigma : (n,) or float
            R.m.s. errors of the fixes, in the unit of the values.
        span : float
            Length limit, s.
        capacity : int
            Limit of the number of fixes.

        Returns
        -------
        Window
            The window, shortened and thinned to its limits.

        Raises
        ------
        ValueError
            On wrong shapes, times out of order, or a fix that is not usable.
        """
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
                f"fix {k}: value {values[k]}, sigma {sigmas[k]}; leave out a fix that is not a measurement"
            )
        keep = times >= times[-1] - round(span / NS) if len(times) else slice(0)
        window = window._with(
            times[keep], np.full(len(times), MEASURED[quantity])[keep], values[keep], sigmas[keep]
        )
        while len(window) > capacity:
            window = window._thinned()
        return window

    def __len__(self) -> int:
        return len(self.t_ns)

    def push(self, t_ns: int, quantity: Quantity, value: float, sigma: float) -> Self:
        """Append one fix.

        Parameters
        ----------
        t_ns : int
            Time, ns, not before the last fix.
        quantity : {"position", "velocity"}
            What the fix measures.
        value : float
            INS minus fix, m or m/s.
        sigma : float
            R.m.s. error of the fix, m or m/s.

        Returns
        -------
        Window
            A new window; older fixes are dropped or thinned by its limits.

        Raises
        ------
        ValueError
            If the fix is late, repeated or not a number.
        """
        if quantity not in MEASURED:
            raise ValueError(f"quantity is {quantity!r}; give 'position' or 'velocity'")
        if not (math.isfinite(value) and math.isfinite(sigma) and sigma > 0.0):
            raise ValueError(
                f"fix {len(self)}: value {value}, sigma {sigma}; leave out a fix that is not a measurement"
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
        first = int(self.t_ns.searchsorted(t_ns - round(self.span / NS)))
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
        arrays = (t_ns, velocity, value, sigma)
        return type(self)(self.span, self.capacity, *arrays, self.disturbance, self.drifting)

    def _thinned(self) -> Self:
        """Drop the fix that leaves the smallest gap between its neighbours of the same quantity."""
        drop, least = -1, math.inf
        for velocity in (False, True):
            same = np.flatnonzero(self.velocity == velocity)
            if len(same) > 2:
                gap = self.t_ns[same[2:]] - self.t_ns[same[:-2]]
                k = int(gap.argmin())
                if gap[k] < least:
                    drop, least = int(same[k + 1]), float(gap[k])
        others = np.arange(len(self)) != drop
        return self._with(self.t_ns[others], self.velocity[others], self.value[others], self.sigma[others])


class Forecast(NamedTuple):
    """One INS error at one instant, SI: m, rad, m/s, rad/s.

    Attributes
    ----------
    feasible : bool
        False if the fixes do not determine it; then estimates are nan and bounds infinite.
    estimate : float
        Minimax estimate.
    bound : float
        Its r.m.s. error under any correlation of the fixes' errors.
    gap : float
        Relative distance within which the bound is proved to be the least possible.
    ls_estimate : float
        Least-squares estimate.
    ls_claimed : float
        Its one sigma if the errors are uncorrelated.
    ls_worst : float
        Its r.m.s. error under the worst correlation.
    active : tuple
        Fixes that determine the bound, each (t_ns, is velocity).
    """

    feasible: bool
    estimate: float = math.nan
    bound: float = math.inf
    gap: float = math.inf
    ls_estimate: float = math.nan
    ls_claimed: float = math.inf
    ls_worst: float = math.inf
    active: tuple[Key, ...] = ()


class Prediction(NamedTuple):
    """INS errors of one channel at one instant.

    Attributes
    ----------
    t_ns : int
        Time, ns.
    feasible : bool
        True if all requested targets are.
    reason : str
        Why not, or empty.
    position, tilt, velocity, drift : Forecast or None
        None if not requested.
    """

    t_ns: int
    feasible: bool
    reason: str
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
    """Predict the INS errors at one instant, usually ahead of the window.

    Too few fixes raise nothing: they give `feasible=False` and the reason.

    Parameters
    ----------
    window : Window
        Fixes of the channel.
    t_ns : int
        Time of the prediction, ns.
    targets : sequence of {"position", "tilt", "velocity", "drift"}
        What to predict.
    start : Prediction, optional
        Previous prediction, from which the exchange starts.
    scale : Scale
        Earth radius and Schuler rate.

    Returns
    -------
    Prediction
        Estimates and bounds, SI.
    """
    return predict_ahead(window, [t_ns], targets, start, scale)[0]


def predict_ahead(
    window: Window,
    t_ns: Sequence[int],
    targets: Sequence[Target] = ("position", "velocity"),
    start: Prediction | None = None,
    scale: Scale = MEAN_EARTH,
) -> list[Prediction]:
    """Predict the INS errors at several instants, each started from the one before.

    Parameters
    ----------
    window : Window
        Fixes of the channel.
    t_ns : sequence of int
        Times of the predictions, ns.
    targets : sequence of {"position", "tilt", "velocity", "drift"}
        What to predict.
    start : Prediction, optional
        Previous prediction, from which the exchange starts.
    scale : Scale
        Earth radius and Schuler rate.

    Returns
    -------
    list of Prediction
        One for each time.

    Raises
    ------
    ValueError
        For an unknown target.
    """
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
        alpha = (int(t) - middle) * NS * scale.rate
        ahead_rows = _drift(alpha) if window.drifting else transition(alpha)
        forecasts, reasons = {}, []
        for target in targets:
            k = TARGETS.index(target)
            before = cast("Forecast | None", getattr(start, target)) if start else None
            try:
                forecasts[target] = _forecast(window, design, whitened, ahead_rows[k], scale.units[k], before)
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
    """Factor the dimensionless rows about the middle of the window; also return the measurements in sigmas.

    An unknown specific force between a fix and t_ns changes the relation of the fix to the state at t_ns. Its
    effect, at most the disturbance times the integral of the channel's response, is one more error of that
    fix of unknown correlation, and so adds to its sigma: an old fix counts for less, and the bound remains a
    bound.
    """
    since = (middle - window.t_ns) * (NS * scale.rate)
    position, _, velocity, _ = scale.units
    rows = np.empty((len(window), 4))
    if window.drifting:
        rows = np.array([_drift(-s)[2 if v else 0] for s, v in zip(since, window.velocity, strict=True)])
    else:
        rows[~window.velocity] = schuler_row("gamma", since[~window.velocity])
        rows[window.velocity] = schuler_row("mu", since[window.velocity])
    sigma = window.sigma
    if window.disturbance:
        age = np.abs(t_ns - window.t_ns) * (NS * scale.rate)
        swept = (0.5 * age**2, age) if window.drifting else (_swept(age, 0.0), _swept(age, 0.5 * math.pi))
        of_position = window.disturbance / scale.rate**2 * swept[0]
        of_velocity = window.disturbance / scale.rate * swept[1]
        sigma = sigma + np.where(window.velocity, of_velocity, of_position)
    return Design.of(rows, sigma / np.where(window.velocity, velocity, position)), window.value / sigma


def _drift(alpha: float) -> Floats:
    """Build the (4, 4) transition over a dimensionless time alpha of gamma on mu alone, mu constant."""
    ahead = np.zeros((4, 4))
    ahead[0, 0] = ahead[2, 2] = 1.0
    ahead[0, 2] = alpha
    return ahead


def _swept(x: Floats, phase: float) -> Floats:
    """Integrate |sin(u + phase)| from 0 to x."""

    def antiderivative(y: Floats) -> Floats:
        turns = np.floor(y / math.pi)
        return 2.0 * turns + 1.0 - np.cos(y - math.pi * turns)

    return antiderivative(x + phase) - antiderivative(np.full_like(x, phase))


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
    """Find the rows of the fixes of an earlier solution in the window, or those nearest to them."""
    rows = []
    for t_ns, velocity in active:
        same = np.flatnonzero(window.velocity == velocity)
        if len(same):
            rows.append(int(same[np.abs(window.t_ns[same] - t_ns).argmin()]))
    return rows
