"""`companion study weights`: fusion of correlated readings, and what wrong coefficients cost.

Without readings it evaluates the worked example of Lukinova, Podgorna and Rogozhin: the printed result,
what their formulas give, the corrected estimator axis by axis, and the joint estimator. The sensitivity
study that the paper announces follows: each coefficient changed by some per cent, each sigma assumed
wrong, and correlations ignored. See `companion.estimate.weights` and `companion.estimate.readings`.
"""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import click
import numpy as np
from rich.table import Table

from companion.estimate.readings import (
    KINDS,
    AxisRows,
    JointFix,
    Reading,
    axis_rows,
    error_covariance,
    estimate_joint,
)
from companion.estimate.weights import estimate_covariance, optimal_gain, perturb_weight
from companion.study.plot_options import PLOT_FILE
from companion.tables import number_table, print_tables
from companion.units import Floats

Axis = Literal["x", "y"]
DEVIATIONS = (0.05, 0.1, 0.2, 0.5)  # the result is the same for both signs
FACTORS = (0.1, math.sqrt(0.1), 0.5, 2.0, math.sqrt(10.0), 10.0)  # the roots are variances x 0.1 and x 10
CORRELATIONS = (-0.9, -0.5, 0.5, 0.9)
PRINTED = (101.139, 100.0)
GREATEST = 1e50  # absolute value of a number that is given: its square is a double
_NO_ROW = 1e-18  # claimed over true variance: the range is across the axis to a billionth
_ISOTROPIC = math.sqrt(200.0)
#: Variances 500, 10, 200 km^2 as printed; that of RSBN is the one of both axes.
PAPER = (
    Reading("INS", "x", 105.0, math.sqrt(500.0)),
    Reading("INS", "y", 103.0, math.sqrt(500.0)),
    Reading("GNSS", "x", 101.0, math.sqrt(10.0)),
    Reading("GNSS", "y", 100.5, math.sqrt(10.0)),
    Reading("RSBN", "azimuth", math.radians(45.0), _ISOTROPIC / 140.0),
    Reading("RSBN", "range", 140.0, _ISOTROPIC),
)


class AxisStudy(NamedTuple):
    """One coordinate: its readings, their covariance and the best coefficients."""

    axis: Axis
    rows: AxisRows
    R: Floats
    K: Floats

    @property
    def value(self) -> float:
        """Return the estimate."""
        return float(self.K @ self.rows.z)

    @property
    def sigma(self) -> float:
        """Return the standard deviation of the estimate."""
        return math.sqrt(float(self.K @ self.R @ self.K))


class Cost(NamedTuple):
    """Actual rms error over the best one, and the claimed over the actual."""

    actual: float
    claimed: float


def study_axis(readings: Sequence[Reading], R: Floats, axis: Axis) -> AxisStudy | None:
    """Estimate one coordinate; None if nothing reads it."""
    rows = axis_rows(readings, axis)
    if not rows.sources:
        return None
    covariance = rows.T @ R @ rows.T.T
    return AxisStudy(axis, rows, covariance, optimal_gain(np.ones((len(rows.z), 1)), covariance)[0])


def exact_azimuth(readings: Sequence[Reading], R: Floats, axis: Axis) -> tuple[float, float, float] | None:
    """Return value, claimed and actual sigma of the row (7), which takes the azimuth for exact; None where
    the row does not exist."""
    rows = axis_rows(readings, axis)
    known = np.array([0.0 if reading.kind == "azimuth" else 1.0 for reading in readings])
    claimed = rows.T @ (R * np.outer(known, known)) @ rows.T.T
    true = rows.T @ R @ rows.T.T
    if (claimed.diagonal() <= _NO_ROW * true.diagonal()).any():
        return None
    K = optimal_gain(np.ones((len(rows.z), 1)), claimed)
    actual = estimate_covariance(K, true)
    return float(K[0] @ rows.z), math.sqrt(float((K @ claimed @ K.T)[0, 0])), math.sqrt(float(actual[0, 0]))


def misprinted(readings: Sequence[Reading]) -> float:
    """Return X by the printed scalar formula with R squared once more and z_P = D: 101.139."""
    I, C, P = (reading.sigma**4 for reading in (readings[0], readings[2], readings[5]))
    s = math.sin(readings[4].value)
    weights = np.array([C * P * s, I * P * s, I * C]) / (C * P * s + I * P * s + I * C)
    return float(weights @ [readings[0].value, readings[2].value, readings[5].value])


def cost_of_factor(H: Floats, R: Floats, scaled: Sequence[bool], factor: float) -> Cost:
    """Compute the cost of assuming `factor` times the true sigma for some readings."""
    S = np.where(scaled, factor, 1.0)
    return _cost(H, R, R * np.outer(S, S))


def cost_of_ignored_correlation(R: Floats, i: int, j: int, rho: float) -> Cost | None:
    """Compute the cost of assuming 0 for a true correlation `rho` of two readings of one coordinate; None
    where it cannot occur beside the others."""
    true = R.copy()
    true[i, j] = true[j, i] = rho * math.sqrt(R[i, i] * R[j, j])
    if np.linalg.eigvalsh(true)[0] <= 1e-12 * R.diagonal().min():
        return None
    assumed = true.copy()
    assumed[i, j] = assumed[j, i] = 0.0
    return _cost(np.ones((len(R), 1)), true, assumed)


def _cost(H: Floats, true: Floats, assumed: Floats) -> Cost:
    K = optimal_gain(H, assumed)
    actual = float(np.trace(estimate_covariance(K, true)))
    best = float(np.trace(estimate_covariance(optimal_gain(H, true), true)))
    return Cost(
        math.sqrt(actual / best), math.sqrt(float(np.trace(estimate_covariance(K, assumed))) / actual)
    )


class Study(NamedTuple):
    """All results for some readings."""

    readings: tuple[Reading, ...]
    R: Floats
    axes: tuple[AxisStudy, ...]
    joint: JointFix | None

    @property
    def sources(self) -> tuple[str, ...]:
        """Return the names of the sources."""
        return tuple(dict.fromkeys(reading.source for reading in self.readings))

    def problem(self) -> tuple[Floats, Floats, list[str]]:
        """Return H, R and the source of each row: of the joint problem, or of the only coordinate."""
        if self.joint is not None:
            return self.joint.H, self.R, [reading.source for reading in self.readings]
        (only,) = self.axes
        return np.ones((len(only.R), 1)), only.R, list(only.rows.sources)

    def factor_costs(self, source: str, factors: Sequence[float]) -> list[Cost]:
        """Return the cost of each wrong sigma of a source."""
        H, R, sources = self.problem()
        return [cost_of_factor(H, R, [s == source for s in sources], f) for f in factors]


def study(readings: Sequence[Reading], correlations: dict[tuple[str, str], float]) -> Study:
    """Evaluate the readings. Raises ValueError if one cannot be used or they give no position."""
    if len(readings) < 2:
        raise ValueError("weights need several readings: give at least two")
    R = error_covariance(readings, correlations)
    axes = tuple(found for axis in ("x", "y") if (found := study_axis(readings, R, axis)))
    one_axis = {reading.kind for reading in readings} in ({"x"}, {"y"})
    return Study(tuple(readings), R, axes, None if one_axis else estimate_joint(readings, R))


def plain(result: Study) -> dict[str, Any]:
    """Return the study as plain data."""
    joint = result.joint
    return {
        "readings": [
            {"name": r.name, "value": _shown(r, r.value), "sigma": _shown(r, r.sigma)}
            for r in result.readings
        ],
        "joint": joint
        and {
            "position": joint.position.tolist(),
            "covariance": joint.covariance.tolist(),
            "weights": joint.weights.tolist(),
        },
        "axes": [
            {
                "axis": a.axis,
                "value": a.value,
                "variance": a.sigma**2,
                "weights": dict(zip(a.rows.sources, a.K.tolist(), strict=True)),
                "weight_changed": {
                    name: [_weight_cost(a, i, eps) for eps in DEVIATIONS]
                    for i, name in enumerate(a.rows.sources)
                },
                "correlation_ignored": [
                    {
                        "pair": [a.rows.sources[i], a.rows.sources[j]],
                        "rho": rho,
                        "cost": found and found._asdict(),
                    }
                    for i, j in _pairs(a)
                    for rho in CORRELATIONS
                    for found in [cost_of_ignored_correlation(a.R, i, j, rho)]
                ],
            }
            for a in result.axes
        ],
        "sigma_assumed": {
            source: [c._asdict() for c in result.factor_costs(source, FACTORS)] for source in result.sources
        },
        "deviations": list(DEVIATIONS),
        "factors": list(FACTORS),
    }


def _shown(reading: Reading, value: float) -> float:
    """Return a value in the unit of the command line: azimuths in degrees."""
    return math.degrees(value) if reading.kind == "azimuth" else value


def _pairs(a: AxisStudy) -> list[tuple[int, int]]:
    n = len(a.rows.sources)
    return [(i, j) for i in range(n) for j in range(i + 1, n)]


def _weight_cost(a: AxisStudy, i: int, eps: float) -> float | None:
    """Return the rms ratio with weight i changed by eps, the others rescaled; None if it is alone."""
    try:
        K = perturb_weight(a.K, i, eps)
    except ValueError:
        return None
    return math.sqrt(float(K @ a.R @ K)) / a.sigma


def estimates_table(result: Study, example: bool) -> Table:
    """Build the table of estimates."""
    heads = "estimator", "x", "y", "sigma x", "sigma y", "true sigma x", "true sigma y"
    table = number_table("the paper's worked example" if example else "estimates", *heads)
    if example:
        table.add_row("printed", *(f"{v:.6g}" for v in PRINTED), "", "", "", "")
        table.add_row(
            "the printed formula, R squared, z_P = D", f"{misprinted(result.readings):.6f}", *[""] * 5
        )
    found: dict[str, AxisStudy] = {a.axis: a for a in result.axes}
    sources = {a: found[a].rows.sources if a in found else () for a in "xy"}
    if any(reading.kind == "azimuth" and reading.source in sources["x"] for reading in result.readings):
        seven = [exact_azimuth(result.readings, result.R, axis) for axis in ("x", "y")]
        table.add_row(
            "per axis, row (7): azimuth taken for exact",
            *(f"{each[k]:.6f}" if each else "-" for k in (0, 1, 2) for each in seven),
        )
    table.add_row(
        "per axis, (5)",
        *(f"{found[a].value:.6f}" if a in found else "-" for a in "xy"),
        *(f"{found[a].sigma:.6f}" if a in found else "-" for a in "xyxy"),
    )
    if result.joint is not None:
        sigma = np.sqrt(result.joint.covariance.diagonal())
        table.add_row("joint, (5) iterated", *(f"{v:.6f}" for v in (*result.joint.position, *sigma, *sigma)))
    return table


def coefficients_table(a: AxisStudy) -> Table:
    """Build the table of one coordinate: weights, weights changed, correlations ignored."""
    title = f"coefficients of {a.axis}: rms error over the least, {a.sigma:.6g}"
    table = number_table(title, "deviation", *a.rows.sources)
    table.add_row("none: the weight", *(f"{w:.6f}" for w in a.K), end_section=True)
    for eps in DEVIATIONS:
        costs = (_weight_cost(a, i, eps) for i in range(len(a.K)))
        table.add_row(
            f"weight ±{eps:.0%}, others rescaled", *("-" if c is None else f"{c:.5f}" for c in costs)
        )
    table.add_section()
    table.add_row("weight +1%, not rescaled: bias", *(f"{0.01 * w * abs(a.value):.5f}" for w in a.K))
    return table


def factors_table(result: Study) -> Table:
    """Build the table of wrong sigmas."""
    what = "joint estimate" if result.joint is not None else result.axes[0].axis
    title = f"sigma assumed wrong, {what}: rms error over the least (claimed over true)"
    table = number_table(title, "assumed / true sigma", *result.sources)
    columns = [result.factor_costs(source, FACTORS) for source in result.sources]
    for k, factor in enumerate(FACTORS):
        variance = {FACTORS[1]: " (variance x 0.1)", FACTORS[4]: " (variance x 10)"}.get(factor, "")
        table.add_row(
            f"{factor:.4g}{variance}", *(f"{c[k].actual:.5f} ({c[k].claimed:.3f})" for c in columns)
        )
    return table


def correlations_table(a: AxisStudy) -> Table:
    """Build the table of correlations that are assumed to be zero."""
    pairs = _pairs(a)
    title = f"correlation ignored, {a.axis}: rms error over the least (claimed over true)"
    heads = (f"{a.rows.sources[i]}, {a.rows.sources[j]}" for i, j in pairs)
    table = number_table(title, "true correlation", *heads, texts=0)
    for rho in CORRELATIONS:
        costs = (cost_of_ignored_correlation(a.R, i, j, rho) for i, j in pairs)
        table.add_row(f"{rho:+.1f}", *(f"{c.actual:.5f} ({c.claimed:.3f})" if c else "-" for c in costs))
    return table


def plot(result: Study, file: Path) -> None:
    """Plot the rms ratio over changed weights, wrong sigmas and ignored correlations."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13.0, 4.2), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    if result.axes:
        a = result.axes[0]
        eps = np.linspace(-1.0, 1.0, 81)
        for i, name in enumerate(a.rows.sources):
            left.plot(100.0 * eps, [_weight_cost(a, i, e) or math.nan for e in eps], label=name)
        rho = np.linspace(-0.95, 0.95, 77)
        for i, j in _pairs(a):
            costs = [cost_of_ignored_correlation(a.R, i, j, r) for r in rho]
            label = f"{a.rows.sources[i]}, {a.rows.sources[j]}"
            right.plot(rho, [c.actual if c else math.nan for c in costs], label=label)
        left.set(title=f"coefficient of {a.axis} changed, others rescaled")
        right.set(title=f"correlation ignored, {a.axis}")
        left.legend()
        right.legend()
    factors = np.geomspace(0.1, 10.0, 61).tolist()
    for source in result.sources:
        found = result.factor_costs(source, factors)
        (line,) = middle.loglog(factors, [c.actual for c in found], label=source)
        middle.loglog(factors, [c.actual * c.claimed for c in found], ":", color=line.get_color())
    middle.set(title="sigma assumed wrong (dotted: claimed)", xlabel="assumed / true sigma")
    middle.legend()
    left.set(xlabel="change, %", ylabel="rms error / least rms error")
    right.set(xlabel="true correlation, assumed 0")
    for axes in (left, middle, right):
        axes.grid(visible=True, which="both", alpha=0.3)
    figure.savefig(file)


def parse_reading(text: str, beacons: dict[str, tuple[float, float]]) -> Reading:
    """Parse NAME.KIND=VALUE,SIGMA; an azimuth and its sigma are in degrees.

    Raises ValueError for anything else.
    """
    name, _, numbers = text.partition("=")
    source, _, kind = name.rpartition(".")
    if not source or kind not in KINDS:
        raise ValueError(f"{text!r}: give NAME.KIND=VALUE,SIGMA with a kind of {', '.join(KINDS)}")
    value, sigma = _numbers(text, numbers)
    if 0.0 < sigma < 1.0 / GREATEST:
        raise ValueError(f"{text!r}: sigma is {sigma:g}: give one from {1.0 / GREATEST:g} to {GREATEST:g}")
    if kind == "azimuth":
        value, sigma = math.radians(value), math.radians(sigma)
    return Reading(source, kind, value, sigma, beacons.get(source, (0.0, 0.0)))


def _numbers(text: str, numbers: str) -> tuple[float, float]:
    try:
        a, b = (float(word) for word in numbers.split(","))
    except ValueError:
        raise ValueError(f"{text!r}: give two numbers after '='") from None
    if not (abs(a) <= GREATEST and abs(b) <= GREATEST):
        raise ValueError(f"{text!r}: give two finite numbers after '=', of at most {GREATEST:g}")
    return a, b


def _parse(
    readings: Sequence[str], beacons: Sequence[str], correlations: Sequence[str]
) -> tuple[list[Reading], dict[tuple[str, str], float]]:
    places: dict[str, tuple[float, float]] = {}
    for text in beacons:
        name, _, numbers = text.partition("=")
        if name in places:
            raise ValueError(f"{text!r}: the place of {name} is given twice: leave one out")
        places[name] = _numbers(text, numbers)
    found = [parse_reading(text, places) for text in readings]
    if unknown := set(places) - {reading.source for reading in found}:
        raise ValueError(f"no reading of beacon {', '.join(sorted(unknown))}")
    pairs: dict[tuple[str, str], float] = {}
    for text in correlations:
        names, _, number = text.partition("=")
        a, _, b = names.partition(",")
        if (a, b) in pairs or (b, a) in pairs:
            raise ValueError(f"{text!r}: the correlation of {a} and {b} is given twice: leave one out")
        try:
            pairs[a, b] = float(number)
        except ValueError:
            raise ValueError(f"{text!r}: give NAME.KIND,NAME.KIND=NUMBER") from None
    return found or list(PAPER), pairs


@click.command(name="weights")
@click.option(
    "--reading",
    "readings",
    multiple=True,
    metavar="NAME.KIND=VALUE,SIGMA",
    help="A reading; KIND is x (east), y (north), azimuth (deg) or range. Default: the paper's example.",
)
@click.option(
    "--beacon", "beacons", multiple=True, metavar="NAME=X,Y", help="Place of a beacon; default: 0,0."
)
@click.option(
    "--correlation",
    "correlations",
    multiple=True,
    metavar="A.KIND,B.KIND=RHO",
    help="Correlation of the errors of two readings.",
)
@click.option("--plot", "plot_file", type=PLOT_FILE, help="Also write a plot to this file.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    readings: tuple[str, ...],
    beacons: tuple[str, ...],
    correlations: tuple[str, ...],
    plot_file: Path | None,
    as_json: bool,
) -> None:
    """Fuse readings by maximum likelihood.

    Prints what wrong weights, sigmas and correlations cost. Lengths may be in any one unit; results have the
    same.
    """
    try:
        given, pairs = _parse(readings, beacons, correlations)
        result = study(given, pairs)
    except ValueError as e:
        raise click.UsageError(str(e)) from None
    if plot_file:
        plot(result, plot_file)
    if as_json:
        click.echo(json.dumps(plain(result), indent=1))
        return
    print_tables(estimates_table(result, example=not readings and not correlations))
    for a in result.axes:
        if len(a.K) > 1:
            print_tables(coefficients_table(a))
    print_tables(factors_table(result))
    for a in result.axes:
        if len(a.K) > 1:
            print_tables(correlations_table(a))
