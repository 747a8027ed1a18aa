"""`companion study horizon`: permissible flight time without fixes.

For position fixes of a given sigma over a given window: the guaranteed r.m.s. bound of the INS errors as a
function of the time since the last fix, with the claimed and the worst-case error of least squares. The model
is the Schuler channel (see `estimate.schuler`); no fix is missing and the drift of the INS is constant.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from companion.estimate.minimax import closed_form
from companion.estimate.minimax_lp import Design, Infeasible, Minimax
from companion.estimate.schuler import (
    ARCSECOND,
    DEG_PER_HOUR,
    MEAN_EARTH,
    STATE,
    force_response,
    schuler_row,
    transition,
)
from companion.option_types import FloatRange
from companion.study.plot_options import PLOT_FILE
from companion.tables import number_table, print_tables
from companion.units import G0, Floats

GRADES_DEG_H = {"navigation": 0.01, "tactical": 1.0, "industrial": 10.0}
LONGEST_MIN = 24 * 60
FORCE_STEP_S = 10.0
MAX_FIXES = 1_000_000  # in the window
MAX_AHEAD_MIN, MAX_TARGET, MAX_DRIFT_DEG_H = 100_000, 1e12, 1e6
ALONE = tuple(tuple(float(i == k) for i in range(4)) for k in range(4))  # targets of one state
WINDOWS = (1.0, 0.5, 0.25)  # of the window, in the plot


class Ahead(NamedTuple):
    """Bounds at one time since the last fix, in the units of the output."""

    ahead_min: float
    position_m: float
    velocity_mps: float
    tilt_arcsec: float
    drift_deg_h: float
    ls_claimed_m: float  # position, least squares, uncorrelated errors
    ls_worst_m: float  # position, least squares, worst correlation
    closed_form_m: float | None  # position, closed form: measured always, no force, no knowledge of the drift
    gap: float  # relative, within which the position bound is proved to be the least


class Horizon:
    """Bounds after a window of position fixes, the last one at its end.

    `drift` [rad/s] is the constant drift of the INS, r.m.s.; `force` [m/s^2] an unknown specific force,
    r.m.s. at each moment, of any correlation; `velocity` [m/s] the r.m.s. error of a velocity measured with
    each fix.
    """

    def __init__(
        self,
        sigma: float,
        window: float,
        every: float = 1.0,
        drift: float | None = None,
        velocity: float | None = None,
        force: float = 0.0,
    ) -> None:
        if not (window > 0.0 and every > 0.0 and math.isfinite(window / every)):
            raise ValueError(
                f"a window of {window} s with a fix every {every} s contains none; give positive seconds"
            )
        count = round(window / every) + 1
        if count > MAX_FIXES:
            raise ValueError(
                f"a window of {window:g} s with a fix every {every:g} s has {count:g} fixes, at most"
                f" {MAX_FIXES}: give a shorter window or a longer interval"
            )
        tau = np.linspace(-0.5, 0.5, count) * (window * MEAN_EARTH.rate)
        rows, sigmas = schuler_row("gamma", -tau), np.full(count, sigma / MEAN_EARTH.radius)
        if velocity is not None:  # the velocity of each fix is measured too
            more = schuler_row("mu", -tau)
            rows = np.vstack([rows, more])
            sigmas = np.append(sigmas, np.full(count, velocity / (MEAN_EARTH.radius * MEAN_EARTH.rate)))
        if drift is not None:  # prior knowledge of the constant, 0 +- drift, is one more measurement
            rows, sigmas = np.vstack([rows, [0.0, 0.0, 0.0, 1.0]]), np.append(sigmas, drift / MEAN_EARTH.rate)
        self._half, self._force = 0.5 * window, force
        self._sigma = sigma
        self._plain = drift is None and velocity is None and force == 0.0
        t = tau / MEAN_EARTH.rate
        step = min(FORCE_STEP_S, every)
        self._edges = np.linspace(t[0], t[-1], math.ceil(window / step) + 1)
        effect = np.zeros((len(rows), len(self._edges) - 1 if force else 0))
        if force:
            start, end = self._edges[:-1], self._edges[1:]
            effect[:count] = (
                force_response("gamma", t[:, None], start, end, 0.5 * window, MEAN_EARTH) / MEAN_EARTH.radius
            )
            if velocity is not None:
                speed = MEAN_EARTH.radius * MEAN_EARTH.rate
                response = force_response("mu", t[:, None], start, end, 0.5 * window, MEAN_EARTH)
                effect[count : 2 * count] = response / speed
        self._design = Design.of(rows, sigmas, effect, np.full(effect.shape[1], force))
        self._starts: list[Minimax | None] = [None] * 4

    def position(self, ahead: float) -> float:
        """Return the bound of the position [m] at a time ahead [s] after the last fix."""
        return self._bound(0, ahead)

    def at(self, ahead: float) -> Ahead:
        """Return all bounds at a time ahead [s] after the last fix."""
        position, tilt, velocity, drift = (self._bound(k, ahead) for k in range(4))
        target, radius = self._transition(ahead)[0], MEAN_EARTH.radius
        ls = self._design.least_squares(target)
        worst = radius * ls.worst + self._beyond(ALONE[0], ahead)
        plain = closed_form(2.0 * self._half, ahead, self._sigma, MEAN_EARTH) if self._plain else None
        best = self._starts[0]
        assert best is not None
        return Ahead(
            ahead / 60.0,
            position,
            velocity,
            tilt / ARCSECOND,
            drift / DEG_PER_HOUR,
            radius * ls.claimed,
            worst,
            float(plain.bounds[0]) if plain else None,
            best.gap,
        )

    def combination(self, ahead: float, target: Sequence[float]) -> float:
        """Return the bound of a' x, with x position (m), tilt (rad), velocity (m/s), drift (rad/s),
        at a time ahead [s]: `target` is a (4,).
        """
        a = np.array(target) * MEAN_EARTH.units
        best = self._design.minimax(a @ self._transition(ahead))
        return best.bound + self._beyond(target, ahead)

    def longest(self, limit: float) -> float:
        """Return the time [s] for which the position bound stays within limit [m]; inf beyond a day."""
        for minute in range(LONGEST_MIN + 1):
            if self.position(60.0 * minute) > limit:
                break
        else:
            return math.inf
        return next(
            (60.0 * minute - s for s in range(1, 61) if self.position(60.0 * minute - s) <= limit), 0.0
        )

    def _transition(self, ahead: float) -> Floats:
        # from the state in the middle, about which the rows are best conditioned
        return transition((self._half + ahead) * MEAN_EARTH.rate)

    def _beyond(self, target: Sequence[float], ahead: float) -> float:
        """Worst error of a combination of the states, SI, by the force after the last fix."""
        if not self._force or ahead <= 0.0:
            return 0.0
        edges = np.linspace(self._half, self._half + ahead, math.ceil(ahead / FORCE_STEP_S) + 1)
        end = np.array([self._half + ahead])
        response = np.zeros(len(edges) - 1)
        for name, a in zip(STATE, target, strict=True):
            if a:
                response += a * force_response(name, end, edges[:-1], edges[1:], self._half, MEAN_EARTH)
        return self._force * float(np.abs(response).sum())

    def _bound(self, k: int, ahead: float) -> float:
        best = self._design.minimax(self._transition(ahead)[k], self._starts[k])
        self._starts[k] = best
        return MEAN_EARTH.units[k] * best.bound + self._beyond(ALONE[k], ahead)


def _minutes(context: click.Context, parameter: click.Parameter, text: str) -> list[float]:
    try:
        given = [float(word) for word in text.split(",")]
    except ValueError:
        raise click.BadParameter(f"{text!r} is neither a number nor a list like 5,10,20") from None
    if not all(0.0 <= minute <= MAX_AHEAD_MIN for minute in given):
        raise click.BadParameter(f"{text!r}: give minutes from 0 to {MAX_AHEAD_MIN}")
    return given if len(given) > 1 else np.linspace(0.0, given[0], 13).tolist()


def _target(context: click.Context, parameter: click.Parameter, text: str | None) -> list[float] | None:
    if text is None:
        return None
    try:
        found = [float(word) for word in text.split(",")]
    except ValueError:
        found = []
    greatest = max(map(abs, found), default=0.0)
    if (
        len(found) != 4
        or not all(map(math.isfinite, found))
        or not 1.0 / MAX_TARGET <= greatest <= MAX_TARGET
    ):
        raise click.BadParameter(
            f"{text!r}: give four numbers A,B,C,D, the greatest from {1.0 / MAX_TARGET:g} to {MAX_TARGET:g}"
        )
    return found


def _drift(context: click.Context, parameter: click.Parameter, text: str | None) -> float | None:
    """Return the drift in deg/h from a grade or a number."""
    if text is None or text in GRADES_DEG_H:
        return GRADES_DEG_H[text] if text else None
    try:
        drift = float(text)
    except ValueError:
        drift = math.nan
    if not 0.0 < drift <= MAX_DRIFT_DEG_H:
        raise click.BadParameter(
            f"{text!r} is neither a grade ({', '.join(GRADES_DEG_H)}) nor a drift in deg/h above 0, at most"
            f" {MAX_DRIFT_DEG_H:g}"
        )
    return drift


@click.command("horizon")
@click.option(
    "--sigma-m",
    type=FloatRange(1e-3, 1e6),
    default=30.0,
    show_default=True,
    help="R.m.s. of one position fix [m].",
)
@click.option(
    "--window-min",
    type=FloatRange(0.0, min_open=True),
    default=15.0,
    show_default=True,
    help="Duration of the window of fixes [min].",
)
@click.option(
    "--every-s",
    type=FloatRange(0.0, min_open=True),
    default=1.0,
    show_default=True,
    help="Interval of the fixes [s].",
)
@click.option(
    "--ahead-min",
    default="60",
    show_default=True,
    callback=_minutes,
    help="Times after the last fix [min]: a list 5,10,20, or the last one.",
)
@click.option(
    "--ins", "drift_deg_h", callback=_drift, help="Grade (navigation, tactical, industrial) or drift [deg/h]."
)
@click.option(
    "--disturbance-ug",
    default=0.0,
    show_default=True,
    type=FloatRange(0.0, 1e6),
    help="R.m.s. specific force that the channel does not model [micro-g].",
)
@click.option(
    "--velocity-mps",
    type=FloatRange(1e-6, 1e6),
    help="A velocity is measured with each fix, of this r.m.s. error [m/s].",
)
@click.option(
    "--target",
    callback=_target,
    metavar="A,B,C,D",
    help="Also print the bound of A position + B tilt + C velocity + D drift [m, rad, m/s, rad/s].",
)
@click.option(
    "--limit-m",
    type=FloatRange(0.0, min_open=True),
    help="Also print how long the position bound stays below this [m].",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--plot", type=PLOT_FILE, help="Also write a plot to this file.")
def command(
    sigma_m: float,
    window_min: float,
    every_s: float,
    ahead_min: list[float],
    drift_deg_h: float | None,
    disturbance_ug: float,
    velocity_mps: float | None,
    target: list[float] | None,
    limit_m: float | None,
    as_json: bool,
    plot: Path | None,
) -> None:
    """Print the guaranteed bounds by time since the last fix."""
    try:
        drift = None if drift_deg_h is None else drift_deg_h * DEG_PER_HOUR
        force = disturbance_ug * 1e-6 * G0
        horizon = Horizon(sigma_m, 60.0 * window_min, every_s, drift, velocity_mps, force=force)
        table = [horizon.at(60.0 * minute) for minute in ahead_min]
    except Infeasible as error:
        raise click.UsageError(f"the window has too few fixes: {error}") from None
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    longest = None if limit_m is None else horizon.longest(limit_m)
    bounds = [] if target is None else [horizon.combination(60.0 * minute, target) for minute in ahead_min]
    if as_json:
        answer: dict[str, Any] = {
            "sigma_m": sigma_m,
            "window_min": window_min,
            "every_s": every_s,
            "ins_drift_deg_h": drift_deg_h,
            "disturbance_ug": disturbance_ug,
        }
        if longest is not None:
            answer |= {"limit_m": limit_m, "longest_min": longest / 60.0 if math.isfinite(longest) else None}
        if target is not None:
            answer |= {"target": target, "target_bound": bounds}
        click.echo(json.dumps({**answer, "table": [row._asdict() for row in table]}))
    else:
        _print(table, f"{sigma_m:g} m fixes every {every_s:g} s for {window_min:g} min", drift_deg_h)
        if target is not None:
            named, stated = ",".join(f"{a:g}" for a in target), ", ".join(f"{b:.5g}" for b in bounds)
            click.echo(f"Bound of {named} (A,B,C,D) at these times: {stated}")
        if longest is not None:
            duration = f"{longest / 60.0:.1f} min" if math.isfinite(longest) else "more than a day"
            click.echo(f"The position bound stays below {limit_m:g} m for {duration} without fixes.")
    if plot is not None:
        windows = [
            Horizon(sigma_m, 60.0 * window_min * k, every_s, drift, velocity_mps, force=force)
            for k in WINDOWS
        ]
        _plot(windows, [f"{window_min * k:.3g} min" for k in WINDOWS], ahead_min, plot)


def _print(table: Sequence[Ahead], title: str, drift_deg_h: float | None) -> None:
    if drift_deg_h is not None:
        title += f", INS drift {drift_deg_h:g} deg/h r.m.s."
    shown = number_table(
        title,
        *("ahead\nmin", "position\nm", "velocity\nm/s", "tilt\narcsec", "drift\ndeg/h"),
        *("least\nsquares\nclaim, m", "least\nsquares\nworst, m", "closed\nform, m", "gap"),
        texts=0,
        caption="bounds on the r.m.s. error under any correlation of the fixes' errors",
    )
    for row in table:
        *bounds, plain, gap = row
        shown.add_row(
            *(f"{number:.5g}" for number in bounds),
            "-" if plain is None else f"{plain:.5g}",
            f"{abs(gap):.0e}",
        )
    print_tables(shown)


def _plot(windows: Sequence[Horizon], names: Sequence[str], ahead_min: Sequence[float], file: Path) -> None:
    """Plot the bounds of the four quantities over the time ahead, for several windows of fixes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 7.5), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    minutes = np.linspace(min(ahead_min), max(ahead_min), 61).tolist()
    for k, (horizon, name) in enumerate(zip(windows, names, strict=True)):
        rows = [horizon.at(60.0 * minute) for minute in minutes]
        for axes, quantity in zip(
            panels, ("position_m", "velocity_mps", "tilt_arcsec", "drift_deg_h"), strict=True
        ):
            axes.plot(minutes, [getattr(row, quantity) for row in rows], label=f"fixes for {name}")
        if k == 0:
            panels[0].plot(minutes, [row.ls_worst_m for row in rows], "k--", label="least squares: worst")
            panels[0].plot(minutes, [row.ls_claimed_m for row in rows], "k:", label="least squares: claimed")
    for axes, quantity in zip(
        panels, ("position, m", "velocity, m/s", "tilt, arcsec", "drift, deg/h"), strict=True
    ):
        axes.set(xlabel="time since the last fix, min", ylabel=f"guaranteed bound: {quantity}", yscale="log")
        axes.grid(visible=True, which="both", alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=5)
    figure.savefig(file)
