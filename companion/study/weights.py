"""`companion study weights`: loss of accuracy with suboptimal fusion weights.

For measurements of one coordinate with given variances: each weight wrong by some per cent (the others
rescaled), each variance assumed too large or too small, and the bias of weights whose sum is not one. See
`companion.estimate.weights`.
"""

import json
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from companion.estimate.weights import estimate_axis, perturb_weight, rms_ratio, rms_ratio_assuming
from companion.study import plot_options

DEVIATIONS = (0.05, 0.1, 0.2, 0.5)  # the result is the same for both signs
FACTORS = (0.1, 0.5, 2.0, 10.0)


def study(variances: list[float], names: list[str], distance: float) -> dict[str, Any]:
    """Compute the study as plain data; `distance` is the coordinate at which the bias is evaluated."""
    if len(variances) != len(names):
        raise ValueError(f"{len(names)} names for {len(variances)} variances: give the same number of both")
    if len(variances) < 2:
        raise ValueError("weights need several measurements: give at least two variances")
    best = estimate_axis(np.zeros(len(variances)), variances)
    sensors = []
    for i, name in enumerate(names):
        with_wrong_weight = [rms_ratio(perturb_weight(best.weights, i, eps), variances) for eps in DEVIATIONS]
        with_wrong_variance = [
            rms_ratio_assuming([v * f if j == i else v for j, v in enumerate(variances)], variances)
            for f in FACTORS
        ]
        sensors.append(
            {
                "name": name,
                "variance": variances[i],
                "weight": float(best.weights[i]),
                "rms_ratio_weight_changed": with_wrong_weight,
                "rms_ratio_variance_assumed": with_wrong_variance,
                "bias_one_per_cent": 0.01 * float(best.weights[i]) * distance,
            }
        )
    return {
        "variance": best.variance,
        "distance": distance,
        "deviations": list(DEVIATIONS),
        "factors": list(FACTORS),
        "sensors": sensors,
    }


def table(result: dict[str, Any]) -> Table:
    """Build the table, a column per sensor: rms errors relative to the optimum."""
    sensors = result["sensors"]
    shown = Table(title=f"rms error relative to the optimum, {result['variance'] ** 0.5:.4g}")
    shown.add_column("deviation")
    for s in sensors:
        shown.add_column(s["name"], justify="right")
    shown.add_row("none: the weight", *(f"{s['weight']:.6f}" for s in sensors), end_section=True)
    for k, eps in enumerate(result["deviations"]):
        shown.add_row(
            f"weight ±{eps:.0%}, others rescaled",
            *(f"{s['rms_ratio_weight_changed'][k]:.5f}" for s in sensors),
        )
    shown.add_section()
    for k, f in enumerate(result["factors"]):
        shown.add_row(
            f"variance assumed {f:g} x", *(f"{s['rms_ratio_variance_assumed'][k]:.5f}" for s in sensors)
        )
    shown.add_section()
    shown.add_row(
        f"weight +1%, not rescaled: bias at {result['distance']:g}",
        *(f"{s['bias_one_per_cent']:.5f}" for s in sensors),
    )
    return shown


def plot(variances: list[float], names: list[str], file: Path) -> None:
    """Plot the rms ratio of each sensor over the deviation of its weight, and over its assumed variance."""
    from matplotlib.figure import Figure

    best = estimate_axis(np.zeros(len(variances)), variances).weights
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    eps, factors = np.linspace(-1.0, 1.0, 81), np.geomspace(0.01, 100.0, 81)
    for i, name in enumerate(names):
        left.plot(100 * eps, [rms_ratio(perturb_weight(best, i, e), variances) for e in eps], label=name)
        assumed = [[v * f if j == i else v for j, v in enumerate(variances)] for f in factors]
        right.semilogx(factors, [rms_ratio_assuming(a, variances) for a in assumed], label=name)
    left.set(xlabel="weight changed by, %", ylabel="rms / best rms", yscale="log")
    right.set(xlabel="assumed variance / true variance", yscale="log")
    for axes in (left, right):
        axes.grid(True, alpha=0.3)
        axes.legend()
    figure.savefig(file)


@click.command(name="weights")
@click.option("--variances", default="500,10,200", show_default=True, help="Variances, comma separated.")
@click.option("--names", default="INS,GNSS,RSBN", show_default=True, help="Names, comma separated.")
@click.option(
    "--distance", default=100.0, show_default=True, help="Coordinate at which the bias is evaluated."
)
@click.option(
    "--plot",
    "plot_file",
    type=click.Path(path_type=Path),
    callback=plot_options.check_plot_file,
    help="Also write a plot to this file.",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(variances: str, names: str, distance: float, plot_file: Path | None, as_json: bool) -> None:
    """Print the loss of accuracy when fusion weights deviate from the optimum."""
    try:
        values, labels = [float(v) for v in variances.split(",")], names.split(",")
        result = study(values, labels, distance)
        if plot_file:
            plot(values, labels, plot_file)
    except ValueError as e:
        raise click.UsageError(str(e)) from None
    if as_json:
        click.echo(json.dumps(result, indent=1))
    else:
        Console().print(table(result))
