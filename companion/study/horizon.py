"""`companion study horizon`: permissible flight time without fixes.

For position fixes of a given sigma over a given window: the guaranteed r.m.s. bound of the INS errors as a
function of the time since the last fix, with the claimed and the worst-case error of least squares. The model
is the Schuler channel (see `estimate.schuler`); no fix is missing and the drift of the INS is constant.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from companion.estimate.minimax_lp import Design, Infeasible
from companion.estimate.schuler import ARCSECOND, DEG_PER_HOUR, MEAN_EARTH, Scale, schuler_row, transition
from companion.study import plot_options

GRADES_DEG_H = {"navigation": 0.01, "tactical": 1.0, "industrial": 10.0}
LONGEST_MIN = 24 * 60


class Ahead(NamedTuple):
    """Bounds at one time since the last fix, in the units of the output."""

    ahead_min: float
    position_m: float
    velocity_mps: float
    tilt_arcsec: float
    drift_deg_h: float
    ls_claimed_m: float  # position, least squares, uncorrelated errors
    ls_worst_m: float  # position, least squares, worst correlation


class Horizon:
    """Bounds after a window of position fixes; `drift` [rad/s] is the constant drift of the INS, r.m.s."""

    def __init__(
        self,
        sigma: float,
        window: float,
        every: float = 1.0,
        drift: float | None = None,
        scale: Scale = MEAN_EARTH,
    ) -> None:
        if not (window > 0.0 and every > 0.0 and math.isfinite(window / every)):
            raise ValueError(
                f"a window of {window} s with a fix every {every} s contains none; give positive seconds"
            )
        count = round(window / every) + 1
        tau = np.linspace(-0.5, 0.5, count) * (window * scale.rate)
        rows, sigmas = schuler_row("gamma", -tau), np.full(count, sigma / scale.radius)
        if drift is not None:  # prior knowledge of the constant, 0 +- drift, is one more measurement
            rows, sigmas = np.vstack([rows, [0.0, 0.0, 0.0, 1.0]]), np.append(sigmas, drift / scale.rate)
        self._design, self._scale, self._half = Design.of(rows, sigmas), scale, 0.5 * window
        self._starts: list[tuple[int, ...]] = [()] * 4

    def position(self, ahead: float) -> float:
        """Return the bound of the position [m] at a time ahead [s] after the last fix."""
        return self._bound(0, ahead)

    def at(self, ahead: float) -> Ahead:
        """Return all bounds at a time ahead [s] after the last fix."""
        position, tilt, velocity, drift = (self._bound(k, ahead) for k in range(4))
        ls = self._design.least_squares(self._target(0, ahead))
        radius = self._scale.radius
        return Ahead(
            ahead / 60.0,
            position,
            velocity,
            tilt / ARCSECOND,
            drift / DEG_PER_HOUR,
            radius * ls.claimed,
            radius * ls.worst,
        )

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

    def _target(self, k: int, ahead: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
        row: np.ndarray[tuple[int], np.dtype[np.float64]] = transition(
            (self._half + ahead) * self._scale.rate
        )[k]
        return row

    def _bound(self, k: int, ahead: float) -> float:
        best = self._design.minimax(self._target(k, ahead), self._starts[k])
        self._starts[k] = best.active
        return self._scale.units[k] * best.bound


def _minutes(context: click.Context, parameter: click.Parameter, text: str) -> list[float]:
    try:
        given = [float(word) for word in text.split(",")]
    except ValueError:
        raise click.BadParameter(f"{text!r} is neither a number nor a list like 5,10,20") from None
    if not all(math.isfinite(minute) and minute >= 0.0 for minute in given):
        raise click.BadParameter(f"{text!r}: give minutes of 0 or more")
    return given if len(given) > 1 else np.linspace(0.0, given[0], 13).tolist()


def _positive(context: click.Context, parameter: click.Parameter, value: float | None) -> float | None:
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise click.BadParameter(f"{value:g} is not a valid distance: give metres above 0")
    return value


def _drift(context: click.Context, parameter: click.Parameter, text: str | None) -> float | None:
    """Return the drift in deg/h from a grade or a number."""
    if text is None or text in GRADES_DEG_H:
        return GRADES_DEG_H[text] if text else None
    try:
        drift = float(text)
    except ValueError:
        drift = math.nan
    if not (math.isfinite(drift) and drift > 0.0):
        raise click.BadParameter(
            f"{text!r} is neither a grade ({', '.join(GRADES_DEG_H)}) nor a drift in deg/h above 0"
        )
    return drift


@click.command("horizon")
@click.option(
    "--sigma-m",
    default=30.0,
    show_default=True,
    callback=_positive,
    help="R.m.s. of one position fix [m].",
)
@click.option("--window-min", default=15.0, show_default=True, help="Duration of the window of fixes [min].")
@click.option("--every-s", default=1.0, show_default=True, help="Interval of the fixes [s].")
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
    "--limit-m",
    type=float,
    callback=_positive,
    help="Also print how long the position bound stays below this [m].",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    callback=plot_options.check_plot_file,
    help="Also write a plot to this file.",
)
def command(
    sigma_m: float,
    window_min: float,
    every_s: float,
    ahead_min: list[float],
    drift_deg_h: float | None,
    limit_m: float | None,
    as_json: bool,
    plot: Path | None,
) -> None:
    """Print the guaranteed bounds as a function of the time since the last fix."""
    try:
        drift = None if drift_deg_h is None else drift_deg_h * DEG_PER_HOUR
        horizon = Horizon(sigma_m, 60.0 * window_min, every_s, drift)
        table = [horizon.at(60.0 * minute) for minute in ahead_min]
    except Infeasible as error:
        raise click.UsageError(f"the window has too few fixes: {error}") from None
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    longest = None if limit_m is None else horizon.longest(limit_m)
    if as_json:
        answer = {
            "sigma_m": sigma_m,
            "window_min": window_min,
            "every_s": every_s,
            "ins_drift_deg_h": drift_deg_h,
        }
        if longest is not None:
            answer |= {"limit_m": limit_m, "longest_min": longest / 60.0 if math.isfinite(longest) else None}
        click.echo(json.dumps({**answer, "table": [row._asdict() for row in table]}))
    else:
        _print(table, f"{sigma_m:g} m fixes every {every_s:g} s for {window_min:g} min", drift_deg_h)
        if longest is not None:
            duration = f"{longest / 60.0:.1f} min" if math.isfinite(longest) else "more than a day"
            click.echo(f"The position bound stays below {limit_m:g} m for {duration} without fixes.")
    if plot is not None:
        _plot(table, plot)


def _print(table: Sequence[Ahead], title: str, drift_deg_h: float | None) -> None:
    if drift_deg_h is not None:
        title += f", INS drift {drift_deg_h:g} deg/h r.m.s."
    shown = Table(
        title=title, caption="bounds on the r.m.s. error under any correlation of the fixes' errors"
    )
    for head in ("ahead\nmin", "position\nm", "velocity\nm/s", "tilt\narcsec", "drift\ndeg/h"):
        shown.add_column(head, justify="right")
    shown.add_column("least squares\nclaims, m", justify="right")
    shown.add_column("least squares\nworst, m", justify="right")
    for row in table:
        shown.add_row(*(f"{number:.5g}" for number in row))
    Console(width=100).print(shown)


def _plot(table: Sequence[Ahead], file: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    minutes = [row.ahead_min for row in table]
    axes.plot(minutes, [row.position_m for row in table], "k", label="minimax: guaranteed")
    axes.plot(minutes, [row.ls_worst_m for row in table], "r--", label="least squares: worst")
    axes.plot(minutes, [row.ls_claimed_m for row in table], "r:", label="least squares: claimed")
    axes.set(xlabel="time since the last fix, min", ylabel="position error, m (r.m.s.)", yscale="log")
    axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(file)
