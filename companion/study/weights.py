"""`companion study weights`: how much accuracy is lost when the correction coefficients are not the best.

For readings of one coordinate with given variances: each weight wrong by some per cent (the others rescaled),
each variance assumed too large or too small, and the bias of weights that do not add up to one. The laws are
in `companion.estimate.weights`.
"""

import json
from pathlib import Path
from typing import Any

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from companion.estimate.weights import changed, per_axis, rms_ratio, rms_ratio_assuming
from companion.study import plot_options

DEVIATIONS = (0.05, 0.1, 0.2, 0.5)  # the law is even in them
FACTORS = (0.1, 0.5, 2.0, 10.0)


def study(variances: list[float], names: list[str], distance: float) -> dict[str, Any]:
    """The whole study as plain data; `distance` is the coordinate at which the bias is counted."""
    if len(variances) != len(names):
        raise ValueError(f"{len(names)} names for {len(variances)} variances: give as many")
    if len(variances) < 2:
        raise ValueError("one reading has nothing to be weighed against: give two variances at least")
    best = per_axis(np.zeros(len(variances)), variances)
    sensors = []
    for i, name in enumerate(names):
        wrong = [rms_ratio(changed(best.weights, i, eps), variances) for eps in DEVIATIONS]
        assuming = [
            rms_ratio_assuming([v * f if j == i else v for j, v in enumerate(variances)], variances)
            for f in FACTORS
        ]
        sensors.append(
            {
                "name": name,
                "variance": variances[i],
                "weight": float(best.weights[i]),
                "rms_ratio_weight_changed": wrong,
                "rms_ratio_variance_assumed": assuming,
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
    """The study as a table, a column per sensor: rms errors over the best one."""
    sensors = result["sensors"]
    sheet = Table(title=f"rms error over the best one, {result['variance'] ** 0.5:.4g}")
    sheet.add_column("what is wrong")
    for s in sensors:
        sheet.add_column(s["name"], justify="right")
    sheet.add_row("nothing: the weight", *(f"{s['weight']:.6f}" for s in sensors), end_section=True)
    for k, eps in enumerate(result["deviations"]):
        sheet.add_row(
            f"weight ±{eps:.0%}, others rescaled",
            *(f"{s['rms_ratio_weight_changed'][k]:.5f}" for s in sensors),
        )
    sheet.add_section()
    for k, f in enumerate(result["factors"]):
        sheet.add_row(
            f"variance assumed {f:g} x", *(f"{s['rms_ratio_variance_assumed'][k]:.5f}" for s in sensors)
        )
    sheet.add_section()
    sheet.add_row(
        f"weight +1%, not rescaled: bias at {result['distance']:g}",
        *(f"{s['bias_one_per_cent']:.5f}" for s in sensors),
    )
    return sheet


def plot(variances: list[float], names: list[str], file: Path) -> None:
    """Two curves per sensor: rms ratio against its weight's deviation, and against its assumed variance."""
    from matplotlib.figure import Figure

    best = per_axis(np.zeros(len(variances)), variances).weights
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    eps, factors = np.linspace(-1.0, 1.0, 81), np.geomspace(0.01, 100.0, 81)
    for i, name in enumerate(names):
        left.plot(100 * eps, [rms_ratio(changed(best, i, e), variances) for e in eps], label=name)
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
@click.option("--distance", default=100.0, show_default=True, help="Coordinate at which the bias is counted.")
@click.option(
    "--plot",
    "plot_file",
    type=click.Path(path_type=Path),
    callback=plot_options.file,
    help="Also draw the study to this file.",
)
@click.option("--json", "as_json", is_flag=True, help="Print plain data instead of a table.")
def command(variances: str, names: str, distance: float, plot_file: Path | None, as_json: bool) -> None:
    """What is lost when the fusion weights depart from the best ones."""
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
