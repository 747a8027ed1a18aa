"""`companion study order`: selection of the number of terms of an unknown function, for four bases.

For a simulated signal, with known true error, or a file of samples: the criterion for every order, the order
selected, and whether the basis spans the signal. See `estimate.polynomial`.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from rich.console import Console
from rich.table import Table

from companion.estimate.polynomial import FAMILIES, Family, Order, select_order
from companion.study import plot_options
from companion.units import Floats

SPAN_S = 10.0


def cubic(t: Floats) -> Floats:
    """Return a cubic: four power terms."""
    x: Floats = 1.0 + 0.5 * t - 0.12 * t**2 + 0.008 * t**3
    return x


def oscillation(t: Floats) -> Floats:
    """Return a sum of the first and the third harmonic: Fourier functions two and six."""
    x: Floats = np.sin(2.0 * np.pi * t / SPAN_S) + 0.5 * np.sin(6.0 * np.pi * t / SPAN_S)
    return x


SIGNALS: dict[str, Callable[[Floats], Floats]] = {"cubic": cubic, "oscillation": oscillation}


class Samples(NamedTuple):
    """Samples: t (N,) s, z (N,), sigma (N,), and the truth (N,) if known."""

    t: Floats
    z: Floats
    sigma: Floats
    truth: Floats | None = None


class BasisResult(NamedTuple):
    """Result for a basis: selected order, order by the short form, true r.m.s. error if known."""

    basis: str
    found: Order
    short: int
    error: float | None


def synthetic(signal: str, count: int, sigma: float, seed: int) -> Samples:
    """Simulate the signal over ten seconds with normal noise growing from `sigma` to 1.5 `sigma`."""
    t = np.linspace(0.0, SPAN_S, count)
    noise, truth = sigma * (1.0 + 0.5 * t / SPAN_S), SIGNALS[signal](t)
    return Samples(t, truth + noise * np.random.default_rng(seed).standard_normal(count), noise, truth)


def read(file: Path, sigma: float) -> Samples:
    """Read samples from a CSV file: t, z and, if there is a third column, sigma."""
    try:
        table = np.loadtxt(file, delimiter=",", ndmin=2, encoding="utf-8")
    except (ValueError, OSError) as error:
        raise ValueError(f"{file}: is not a table of numbers t,z[,sigma] ({error})") from None
    if table.shape[1] not in (2, 3):
        raise ValueError(f"{file}: has {table.shape[1]} columns; give t,z or t,z,sigma")
    known = table[:, 2] if table.shape[1] == 3 else np.full(len(table), sigma)
    return Samples(table[:, 0], table[:, 1], known)


def study(samples: Samples, bases: Sequence[Family], r_max: int) -> list[BasisResult]:
    """Evaluate every basis on the same samples."""
    rows = []
    for basis in bases:
        found = select_order(samples.t, samples.z, samples.sigma, basis, r_max)
        error = None
        if samples.truth is not None:
            error = float(np.sqrt(np.mean((found.at(samples.t).x - samples.truth) ** 2)))
        rows.append(BasisResult(basis, found, short_form(samples, found), error))
    return rows


def short_form(samples: Samples, found: Order) -> int:
    """Return the order that minimizes -|a_r|^2 + 2 r dt, valid for a fine uniform grid of samples."""
    Psi, y = found.basis(samples.t) / samples.sigma[:, None], samples.z / samples.sigma
    dt = float(samples.t[-1] - samples.t[0]) / (len(y) - 1)
    values = []
    for r in range(1, len(found.criterion) + 1):
        a = np.linalg.lstsq(Psi[:, :r], y, rcond=None)[0]
        values.append(2.0 * r * dt - float(a @ a))
    return int(np.argmin(values)) + 1


@click.command("order")
@click.argument("file", required=False, type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option(
    "--signal", type=click.Choice(list(SIGNALS)), default="cubic", show_default=True, help="Simulated signal."
)
@click.option(
    "--basis",
    "bases",
    type=click.Choice(FAMILIES),
    multiple=True,
    help="Basis, may be repeated; default: all.",
)
@click.option("--r-max", default=12, show_default=True, help="Greatest number of terms.")
@click.option(
    "--samples", "count", default=101, show_default=True, help="Number of samples of the simulated signal."
)
@click.option("--sigma", default=0.2, show_default=True, help="R.m.s. noise, if FILE has no third column.")
@click.option("--seed", default=1, show_default=True, help="Seed of the noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option(
    "--plot",
    type=click.Path(path_type=Path),
    callback=plot_options.check_plot_file,
    help="Also write a plot to this file.",
)
def command(
    file: Path | None,
    signal: str,
    bases: tuple[Family, ...],
    r_max: int,
    count: int,
    sigma: float,
    seed: int,
    as_json: bool,
    plot: Path | None,
) -> None:
    """Select the number of terms of an unknown function.

    The samples are read from FILE (CSV with t,z or t,z,sigma), or simulated.
    """
    try:
        samples = read(file, sigma) if file else synthetic(signal, count, sigma, seed)
        rows = study(samples, bases or FAMILIES, r_max)  # type: ignore[arg-type]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    title = str(file) if file else f"{signal}, {count} samples, seed {seed}"
    if as_json:
        click.echo(json.dumps({"signal": title, "bases": [_plain(row) for row in rows]}))
    else:
        _print(rows, title)
    if plot is not None:
        _plot(samples, rows, plot)


def _plain(row: BasisResult) -> dict[str, Any]:
    found = row.found
    return {
        "basis": row.basis,
        "order": found.order,
        "criterion": found.criterion.tolist(),
        "coefficients": found.coefficients.tolist(),
        "order_short_form": row.short,
        "consistency": found.consistency,
        "spans": found.spans,
        "rms_error": row.error,
    }


def _print(rows: Sequence[BasisResult], title: str) -> None:
    shown = Table(title=title, caption="estimated squared error (6.5.7); * marks the minimum")
    shown.add_column("terms", justify="right")
    for row in rows:
        shown.add_column(row.basis, justify="right")
    for k in range(len(rows[0].found.criterion)):
        cells = (f"{row.found.criterion[k]:.4g}{'*' if k + 1 == row.found.order else ' '}" for row in rows)
        shown.add_row(str(k + 1), *cells, end_section=k + 1 == len(rows[0].found.criterion))
    shown.add_row("order", *(str(row.found.order) for row in rows))
    shown.add_row("order, short form", *(str(row.short) for row in rows))
    shown.add_row("RSS/(N - r_max)", *(f"{row.found.consistency:.3g}" for row in rows))
    shown.add_row("spans", *("yes" if row.found.spans else "no" for row in rows))
    if rows[0].error is not None:
        shown.add_row("true r.m.s. error", *(f"{row.error:.3g}" for row in rows))
    Console(width=100).print(shown)


def _plot(samples: Samples, rows: Sequence[BasisResult], file: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(samples.t, samples.z, ".", color="0.7", label="samples")
    if samples.truth is not None:
        left.plot(samples.t, samples.truth, "k", label="truth")
    fine = np.linspace(samples.t[0], samples.t[-1], 400)
    for row in rows:
        name = f"{row.basis}, {row.found.order} terms{'' if row.found.spans else ' (does not span)'}"
        (line,) = left.plot(fine, row.found.at(fine).x, label=name)
        terms = np.arange(1, len(row.found.criterion) + 1)
        right.plot(terms, row.found.criterion, ".-", color=line.get_color())
        least = float(row.found.criterion.min())
        right.plot(row.found.order, least, "o", color=line.get_color())
    scale = max(min(abs(float(row.found.criterion.min())) for row in rows), 1e-3)
    right.set_yscale("symlog", linthresh=scale)
    left.set(xlabel="time, s")
    right.set(xlabel="terms", ylabel="estimated squared error")
    left.legend()
    right.grid(visible=True, alpha=0.3)
    figure.savefig(file)
