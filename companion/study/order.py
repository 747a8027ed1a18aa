"""`companion study order`: selection of the number of terms of an unknown function, for four bases.

For a simulated signal, with known true error, a table of samples, or a column of any log: the criterion for
every order, the order selected, and whether the basis spans the signal. `--track` smooths a long column in
windows, `--figures` draws the figures 6.5.1 to 6.5.4 of Brandin. See `estimate.polynomial`.
"""

import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from click.core import ParameterSource

from companion.analysis.error_statistics import root_mean_square
from companion.analysis.replay_inputs import input_errors_as_log_errors, is_own_log, open_inputs
from companion.estimate.polynomial import (
    FAMILIES,
    Family,
    Order,
    Track,
    orthonormal_basis,
    select_order,
    smooth_track,
)
from companion.importers.sources import LOG_SUFFIXES
from companion.option_types import FloatRange
from companion.records import Gnss, Stamped
from companion.storage import flight_log
from companion.study.plot_options import PLOT_FILE
from companion.tables import number_table, print_tables
from companion.units import Floats

OF_A_FIX = ("lat", "lon", "alt_msl", "v_n", "alt")  # fields of Gnss that are nothing without one
SPAN_S = 10.0
SIGMA = 0.2


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


def read(file: Path, sigma: float | None) -> Samples:
    """Read samples from a CSV file: t, z and, if there is a third column, sigma; else 0.2 by default."""
    if is_own_log(file) or file.suffix.lower() in LOG_SUFFIXES:
        raise ValueError(f"{file} is a log: give --topic and --field of the samples in it")
    if not file.stat().st_size:
        raise ValueError(f"{file} is empty: give rows of numbers t,z or t,z,sigma")
    try:
        table = np.loadtxt(file, delimiter=",", ndmin=2, encoding="utf-8")
    except (ValueError, OSError) as error:
        no_text = isinstance(error, UnicodeDecodeError)
        why = "not a text file in UTF-8" if no_text else str(error).rstrip(".")
        raise ValueError(
            f"{file}: {why}: give rows of numbers t,z or t,z,sigma, without a line of column names"
        ) from None
    if table.shape[1] not in (2, 3):
        raise ValueError(f"{file}: has {table.shape[1]} columns; give t,z or t,z,sigma")
    if table.shape[1] == 3 and sigma is not None:
        raise ValueError(f"--sigma {sigma:g} has no effect: {file} has a third column, sigma: leave one out")
    known = table[:, 2] if table.shape[1] == 3 else np.full(len(table), SIGMA if sigma is None else sigma)
    return Samples(table[:, 0], table[:, 1], known)


def read_log(log: Path, topic: str, field: str, sigma: float | None) -> Samples:
    """Read one field of the messages of one topic of a log, ours or another recorder's.

    `topic` is that of our logs or the name of a record, /in/Gnss or Gnss; `field` is a name, with an index
    for a vector: alt_msl, v_n.0. Without `sigma` it is estimated by `noise_of`.
    """
    values = []
    names: set[str] = set()
    with input_errors_as_log_errors():
        for where, record in _messages(log):
            names.add(where)
            if topic in (where, type(record).__name__):
                value = _field(record, field)
                if isinstance(record, Gnss) and not record.has_3d_fix and field.split(".")[0] in OF_A_FIX:
                    continue
                if value is not None and math.isfinite(value):
                    values.append((record.t_ns, value))
    if not values:
        known = f"it has {', '.join(sorted(names))}" if topic not in names else "all its values are missing"
        raise ValueError(f"{log}: no values of {field} in {topic}: {known}")
    t_ns, first = np.unique(np.array([t for t, _ in values], dtype=np.int64), return_index=True)
    z = np.array([value for _, value in values])[first]
    if len(z) < 8:
        raise ValueError(f"{log}: {len(z)} values of {field} in {topic}: at least 8 are needed")
    t: Floats = (t_ns - t_ns[0]) * 1e-9
    return Samples(t, z, np.full(len(z), noise_of(z) if sigma is None else sigma))


def noise_of(z: Floats) -> float:
    """Estimate the white noise of even samples of a smooth function from their third differences."""
    noise = math.sqrt(float(np.mean(np.diff(z, 3) ** 2)) / 20.0)
    return noise or 1e-9 * max(1.0, float(np.abs(z).max()))


def _messages(log: Path) -> Iterator[tuple[str, Stamped]]:
    if is_own_log(log):
        for entry in flight_log.read(log):
            if isinstance(entry.value, Stamped):
                yield entry.topic, entry.value
        return
    for record in open_inputs(log).records:
        yield flight_log.topic_of_input(record), record


def _field(record: Stamped, field: str) -> float | None:
    value: Any = record
    for name in field.split("."):
        try:
            value = value[int(name)] if name.isdigit() else getattr(value, name)
        except (AttributeError, IndexError, TypeError):
            fields = ", ".join(type(record).__struct_fields__)
            raise ValueError(
                f"{type(record).__name__} has no field {field!r}: it has {fields}; a component is v_n.0"
            ) from None
        if value is None:
            return None
    if not isinstance(value, int | float):
        raise ValueError(f"{field!r} of {type(record).__name__} is no number: give a component, {field}.0")
    return float(value)


def study(samples: Samples, bases: Sequence[Family], r_max: int) -> list[BasisResult]:
    """Evaluate every basis on the same samples."""
    rows = []
    for basis in bases:
        found = select_order(samples.t, samples.z, samples.sigma, basis, r_max)
        error = None
        if samples.truth is not None:
            error = root_mean_square(found.at(samples.t).x - samples.truth)
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
@click.option(
    "--r-max", type=click.IntRange(1, 100), default=12, show_default=True, help="Greatest number of terms."
)
@click.option(
    "--samples",
    "count",
    type=click.IntRange(2, 100_000),
    default=101,
    show_default=True,
    help="Number of samples of the simulated signal.",
)
@click.option(
    "--sigma",
    type=FloatRange(1e-100, 1e100),
    help="R.m.s. noise; default: 0.2 if FILE has no third column, estimated for a log.",
)
@click.option("--topic", help="Topic or record of a log, for example /in/Gnss or Gnss.")
@click.option("--field", help="Field of its messages, for example alt_msl or v_n.0.")
@click.option("--track", is_flag=True, help="Smooth the samples in windows of the basis (default: legendre).")
@click.option("--figures", type=PLOT_FILE, help="Draw the figures 6.5.1 to 6.5.4 of Brandin to this file.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the noise.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--plot", type=PLOT_FILE, help="Also write a plot to this file.")
def command(
    file: Path | None,
    signal: str,
    bases: tuple[Family, ...],
    r_max: int,
    count: int,
    sigma: float | None,
    topic: str | None,
    field: str | None,
    track: bool,
    figures: Path | None,
    seed: int,
    as_json: bool,
    plot: Path | None,
) -> None:
    """Select the number of terms of an unknown function.

    The samples are read from FILE: a CSV with t,z or t,z,sigma without a line of column names, or with
    --topic and --field any log that `replay` reads. Without FILE they are simulated.
    """
    if (topic is None) != (field is None) or (topic and not file):
        raise click.UsageError("a column of a log needs FILE, --topic and --field")
    if file and figures is None:
        for option, name in (("--signal", "signal"), ("--samples", "count"), ("--seed", "seed")):
            context = click.get_current_context()
            if context.get_parameter_source(name) is not ParameterSource.DEFAULT:
                raise click.UsageError(
                    f"{option} {context.params[name]} has no effect on the samples of {file}:"
                    f" leave out {option}, or leave out FILE to simulate samples"
                )
    try:
        if file and topic and field:
            samples = read_log(file, topic, field, sigma)
        else:
            samples = read(file, sigma) if file else synthetic(signal, count, sigma or SIGMA, seed)
        if figures is not None:
            draw_figures(synthetic(signal, count, sigma or SIGMA, seed), r_max, figures)
        if track:
            if len(bases) > 1:
                raise ValueError(f"--track smooths by one basis, {len(bases)} are given: leave one --basis")
            _smooth(samples, bases[0] if bases else "legendre", r_max, as_json, plot)
            return
        rows = study(samples, bases or FAMILIES, r_max)  # type: ignore[arg-type]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    title = str(file) if file else f"{signal}, {count} samples, seed {seed}"
    if topic:
        title += f", {topic} {field}, noise {samples.sigma[0]:.3g}"
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
    caption = "estimated squared error (6.5.7); * marks the minimum"
    shown = number_table(title, "terms", *(row.basis for row in rows), texts=0, caption=caption)
    for k in range(len(rows[0].found.criterion)):
        cells = (f"{row.found.criterion[k]:.4g}{'*' if k + 1 == row.found.order else ' '}" for row in rows)
        shown.add_row(str(k + 1), *cells, end_section=k + 1 == len(rows[0].found.criterion))
    shown.add_row("order", *(str(row.found.order) for row in rows))
    shown.add_row("order, short form", *(str(row.short) for row in rows))
    shown.add_row("RSS/(N - r_max)", *(f"{row.found.consistency:.3g}" for row in rows))
    shown.add_row("spans", *("yes" if row.found.spans else "no" for row in rows))
    if rows[0].error is not None:
        shown.add_row("true r.m.s. error", *(f"{row.error:.3g}" for row in rows))
    print_tables(shown)


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


def _smooth(samples: Samples, basis: Family, r_max: int, as_json: bool, plot: Path | None) -> None:
    """Smooth a long column in windows; print the result, plot it."""
    found = smooth_track(samples.t, samples.z, samples.sigma, basis, r_max)
    residual = root_mean_square(samples.z - found.x)
    if as_json:
        columns = {"t": samples.t, "z": samples.z, "x": found.x, "sigma": found.sigma}
        plain: dict[str, Any] = {name: column.tolist() for name, column in columns.items()}
        click.echo(json.dumps({"windows": found.windows, "consistency": found.consistency, **plain}))
    else:
        click.echo(
            f"{len(samples.t)} samples in {found.windows} windows of at most {r_max} {basis} functions:"
            f" residual {residual:.4g} r.m.s., RSS/(N - r_max) {found.consistency:.3g} at a noise of"
            f" {root_mean_square(samples.sigma):.3g}"
        )
    if plot is not None:
        _plot_track(samples, found, plot)


def _plot_track(samples: Samples, found: Track, file: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.5), layout="constrained")
    axes = figure.add_subplot()
    x, sigma = found.x, found.sigma
    axes.plot(samples.t, samples.z, ".", color="0.7", markersize=2, label="samples")
    axes.plot(samples.t, x, label=f"smoothed, {found.windows} windows")
    axes.fill_between(samples.t, x - 2.0 * sigma, x + 2.0 * sigma, alpha=0.3, label="two sigma")
    axes.set(xlabel="time, s")
    axes.legend()
    axes.grid(visible=True, alpha=0.3)
    figure.savefig(file)


def errors_by_order(samples: Samples, r_max: int) -> tuple[Floats, Floats]:
    """Return the r.m.s. methodical and random error (r_max,) of the fit with 1 to r_max Legendre terms."""
    assert samples.truth is not None
    Psi = orthonormal_basis(samples.t, samples.sigma, "legendre", r_max)(samples.t) / samples.sigma[:, None]
    truth, methodical, random = samples.truth / samples.sigma, [], []
    for r in range(1, r_max + 1):
        P = Psi[:, :r] @ np.linalg.pinv(Psi[:, :r])
        methodical.append(np.mean(((truth - P @ truth) * samples.sigma) ** 2))
        random.append(np.mean(np.diag(P) * samples.sigma**2))
    return np.sqrt(methodical), np.sqrt(random)


def draw_figures(samples: Samples, r_max: int, file: Path) -> None:
    """Draw 6.5.1 to 6.5.3, the families of functions, and 6.5.4, the errors by their number."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 7.5), layout="constrained")
    t, T = np.linspace(0.0, 1.0, 401), 1.0
    power, sine, legendre, errors = figure.subplots(2, 2).ravel()
    for m in range(5):
        power.plot(t, t**m, label=f"m = {m}")
        sine.plot(t, np.sin(np.pi * m * t / T), label=f"m = {m}")
        shape = np.polynomial.legendre.Legendre.basis(m)(2.0 * t / T - 1.0)
        legendre.plot(t, math.sqrt((2 * m + 1) / T) * shape, label=f"m = {m}")
    power.set(title="6.5.1 power: t^m", xlabel="t / T")
    sine.set(title="6.5.2 trigonometric: sin(pi m t / T)", xlabel="t / T")
    legendre.set(title="6.5.3 Legendre, orthonormal", xlabel="t / T")
    methodical, random = errors_by_order(samples, r_max)
    terms = np.arange(1, r_max + 1)
    errors.semilogy(terms, np.maximum(methodical, 1e-4), label="methodical")
    errors.semilogy(terms, random, label="random")
    errors.semilogy(terms, np.hypot(methodical, random), "k", label="total")
    errors.set(
        title="6.5.4 errors by the number of terms", xlabel="terms", ylabel="r.m.s. error", ylim=(1e-3, None)
    )
    for axes in (power, sine, legendre, errors):
        axes.grid(visible=True, alpha=0.3)
        axes.legend(fontsize="small")
    figure.savefig(file)
