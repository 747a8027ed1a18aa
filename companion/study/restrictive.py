"""`companion study restrictive`: the minimax Kalman filter and the restrictive filter R1 on the same flights.

The experiment of Poddubny, section 3: a ship's INS with a log in unknown currents, 16 states, 600 samples in
six hours, perfect alignment. The truth of a run is the input that drives the currents; everything else is
drawn from the model that both filters use. In the paper the input is always on the bounds; the other truths
show how the result depends on that.
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from rich.table import Table

from companion.analysis.progress import show_step
from companion.estimate import kalman, restrictive
from companion.nav.error_model import Example, paper_example
from companion.study.plot_options import PLOT_FOLDER
from companion.tables import number_table, print_tables
from companion.units import Floats

SAMPLES = 600
NEAR = 0.9  # inputs above this share of the bound count as near it
Generator = np.random.Generator


def constant(rng: Generator, runs: int, C: Floats, dt: float) -> Floats:
    """Return both currents on the upper bound for the whole run.

    The paper does not state which bounds. With equal signs the gain is greater in velocity north than east
    (1.8 and 1.5 times); with opposite signs it is the reverse.
    """
    return np.broadcast_to(C, (runs, SAMPLES, len(C)))


def telegraph(rng: Generator, runs: int, C: Floats, dt: float) -> Floats:
    """Return inputs that switch between the bounds, once an hour on average."""
    switches = rng.random((runs, SAMPLES, len(C))) < dt
    switches[:, 0] = rng.random((runs, len(C))) < 0.5
    return C * np.where(np.cumsum(switches, 1) % 2, 1.0, -1.0)


def slow(rng: Generator, runs: int, C: Floats, dt: float) -> Floats:
    """Return sines of period 2 to 6 h, amplitude 0.2 to 0.6 of the bound, random phase."""
    shape = (runs, 1, len(C))
    period, height = rng.uniform(2, 6, shape), rng.uniform(0.2, 0.6, shape)
    phase = rng.uniform(0, 1, shape)
    hours = dt * np.arange(SAMPLES)[:, None]
    return C * height * np.sin(2 * np.pi * (hours / period + phase))


def white(rng: Generator, runs: int, C: Floats, dt: float) -> Floats:
    """Return Gaussian white noise of variance C^2, for which the minimax filter is optimal."""
    return C * rng.standard_normal((runs, SAMPLES, len(C)))


class TruthModel(NamedTuple):
    """A row of the table: the inputs that drive the currents, and the model variant."""

    title: str
    inputs: Callable[[Generator, int, Floats, float], Floats]
    exact: bool = True
    sigma_E: float = 1e-5


TRUTHS = {
    "constant": TruthModel("constant on the bound", constant),
    "telegraph": TruthModel("telegraph, one switch an hour", telegraph),
    "slow": TruthModel("slow, inside the bounds", slow),
    "white": TruthModel("Gaussian white, variance C^2", white),
    "euler": TruthModel("constant, Euler's step, sigma_E 3e-6", constant, exact=False, sigma_E=3e-6),
}


#: Key of a row, title of its table, and format of its numbers.
TABLES = (
    ("ratio", "rms error, minimax / restrictive (above 1: restrictive better)", ".2f"),
    ("rms_minimax", "rms error of the minimax filter, km, h, rad", ".2e"),
    ("rms_restrictive", "rms error of the restrictive filter", ".2e"),
    ("rms_free", "rms error of the INS without correction", ".2e"),
    ("nees_minimax", "mean error^2 / variance, minimax (1: consistent)", ".1f"),
    ("nees_restrictive", "mean error^2 / variance, restrictive", ".1f"),
)


class Flights(NamedTuple):
    """Truth x (T, runs, n), inputs u (T, runs, m), measurements z (T, runs, p); the first axis is time."""

    x: Floats
    u: Floats
    z: Floats


def simulate_flights(model: Example, truth: TruthModel, runs: int, rng: Generator) -> Flights:
    """Simulate the flights: W and N from the model, U from the truth."""
    u = np.moveaxis(truth.inputs(rng, runs, model.C, model.dt), 1, 0)
    noise = rng.multivariate_normal(np.zeros(len(model.x0)), model.Q, (SAMPLES, runs), method="eigh")
    x = np.broadcast_to(model.x0, (runs, len(model.x0)))
    states = np.empty((SAMPLES, *x.shape))
    for t in range(SAMPLES):
        states[t] = x = x @ model.A.T + u[t] @ model.B.T + noise[t]
    sigma = np.sqrt(np.diag(model.R))
    return Flights(states, u, states @ model.H.T + sigma * rng.standard_normal((SAMPLES, runs, len(sigma))))


class FilterResult(NamedTuple):
    """Result of a filter: estimates (T, runs, n), inputs (T, runs, m) or None, NEES by state (n,)."""

    x: Floats
    u: Floats | None
    nees: Floats
    nees_all: float


def minimax(model: Example, flights: Flights) -> FilterResult:
    """Run the Kalman filter with the greatest noise within the bounds."""
    Q = kalman.minimax_noise(model.B, model.C, model.Q)
    return _run(model, flights, model.P0, lambda x, P, z: kalman.step(x, P, z, model.A, Q, model.H, model.R))


def r1(model: Example, flights: Flights) -> FilterResult:
    """Run the restrictive filter; every flight has its own covariance."""
    P0 = np.broadcast_to(model.P0, (flights.x.shape[1], *model.P0.shape))
    terms = model.A, model.B, model.Q, model.H, model.R, model.C
    return _run(model, flights, P0, lambda x, P, z: restrictive.step(x, P, z, *terms))


def _run(
    model: Example, flights: Flights, P: Floats, step: Callable[[Floats, Floats, Floats], Any]
) -> FilterResult:
    """Run a filter; the NEES is from after the first hour, when all variances have grown."""
    x = np.broadcast_to(model.x0, flights.x.shape[1:])
    estimates, inputs, by_state, whole = [], [], [], []
    for t, z in enumerate(flights.z):
        now = step(x, P, z)
        x, P = now.x, now.P
        estimates.append(x)
        inputs.append(getattr(now, "u", None))
        if t >= SAMPLES // 6 and t % 10 == 0:
            error = x - flights.x[t]
            by_state.append((error**2 / np.diagonal(P, axis1=-2, axis2=-1)).mean(0))
            whole.append(kalman.nees(error, P).mean() / error.shape[-1])
    u = None if inputs[0] is None else np.array(inputs)
    return FilterResult(np.array(estimates), u, np.mean(by_state, 0), float(np.mean(whole)))


class Comparison(NamedTuple):
    """Flights by a model, and the results of both filters."""

    model: Example
    flights: Flights
    minimax: FilterResult
    restrictive: FilterResult


def study(name: str, runs: int, seed: int) -> tuple[dict[str, Any], Comparison]:
    """Compute one row: rms errors over all runs and six hours, ratio, inputs on the bound, consistency."""
    truth = TRUTHS[name]
    model = paper_example(exact=truth.exact, sigma_E=truth.sigma_E)
    rng = np.random.default_rng([seed, list(TRUTHS).index(name)])
    flights = simulate_flights(model, truth, runs, rng)
    found = Comparison(model, flights, minimax(model, flights), r1(model, flights))
    rms = [np.sqrt(np.mean((f.x - flights.x) ** 2, axis=(0, 1))) for f in (found.minimax, found.restrictive)]
    assert found.restrictive.u is not None
    share = np.abs(found.restrictive.u) / model.C
    row = {
        "truth": name,
        "title": truth.title,
        "runs": runs,
        "states": list(model.states),
        "rms_minimax": rms[0].tolist(),
        "rms_restrictive": rms[1].tolist(),
        "ratio": (rms[0] / rms[1]).tolist(),
        "rms_free": np.sqrt(np.mean(flights.x**2, axis=(0, 1))).tolist(),
        "on_bound": float((share >= 1.0).mean()),
        "near_bound": float((share >= NEAR).mean()),
        "nees_minimax": found.minimax.nees.tolist(),
        "nees_restrictive": found.restrictive.nees.tolist(),
        "nees_minimax_per_dimension": found.minimax.nees_all,
        "nees_restrictive_per_dimension": found.restrictive.nees_all,
    }
    return row, found


def build_table(rows: list[dict[str, Any]], key: str, title: str, number: str) -> Table:
    """Build a table with a row per state and a column per truth; it fits 80 columns."""
    table = number_table(title, "state", *(row["truth"] for row in rows))
    for i, state in enumerate(rows[0]["states"]):
        table.add_row(state, *(format(row[key][i], number) for row in rows))
    return table


def axis_label(state: str) -> str:
    """Name of a state with its unit in the paper's system: km, h, rad."""
    units = {"dx": "km", "dy": "km", "dV": "km/h", "P": "rad", "E": "rad/h", "V": "km/h", "G": "km/h$^2$"}
    units["A"] = units["G"]
    return f"{state}, {units.get(state[:2]) or units[state[0]]}"


def draw(folder: Path, name: str, found: Comparison) -> None:
    """Draw figures 1-10 of the paper for the first run: measurements, inputs, estimates, errors."""
    from matplotlib.figure import Figure

    model, flights, u = found.model, found.flights, found.restrictive.u
    assert u is not None
    states, hours = [axis_label(state) for state in model.states], model.dt * np.arange(len(flights.z))
    groups = [range(i, min(i + 4, len(states))) for i in range(0, len(states), 4)]

    def save(number: int, panels: list[tuple[str, dict[str, Floats]]]) -> None:
        figure = Figure(figsize=(8, 2 * len(panels)), layout="constrained")
        for axes, (label, curves) in zip(np.atleast_1d(figure.subplots(len(panels), 1)), panels, strict=True):
            for legend, values in curves.items():
                axes.plot(hours[: len(values)], values, label=legend, linewidth=0.8)
            axes.set_ylabel(label)
            axes.legend(fontsize="x-small", loc="upper right")
        axes.set_xlabel("time, h")
        figure.savefig(folder / f"{name}_{number:02d}.png", dpi=110)

    save(1, [(f"Z{i + 1}, km/h", {"measured": flights.z[:, 0, i]}) for i in range(flights.z.shape[-1])])
    save(
        2,
        [
            (f"U{i + 1}, km/h", {"true": flights.u[:, 0, i], "restrictive": u[:, 0, i]})
            for i in range(flights.u.shape[-1])
        ],
    )
    x, k, r = (f[:, 0] for f in (flights.x, found.minimax.x, found.restrictive.x))
    for number, group in enumerate(groups):
        curves = [(states[i], {"true": x[:, i], "restrictive": r[:, i], "minimax": k[:, i]}) for i in group]
        errors = [
            (f"|error| of {states[i]}", {"restrictive": abs(r - x)[:, i], "minimax": abs(k - x)[:, i]})
            for i in group
        ]
        save(3 + number, curves)
        save(7 + number, errors)


@click.command("restrictive")
@click.option(
    "--runs", default=200, show_default=True, type=click.IntRange(2, 10_000), help="Flights per truth."
)
@click.option(
    "--truth",
    "names",
    multiple=True,
    type=click.Choice(list(TRUTHS)),
    help="Truth, may be repeated; default: all.",
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the random numbers."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
@click.option("--plot", type=PLOT_FOLDER, help="Folder for figures 1-10.")
def command(names: tuple[str, ...], runs: int, seed: int, as_json: bool, plot: Path | None) -> None:
    """Compare the minimax and the restrictive filter.

    The simulated flights have 16 states and last six hours, in unknown currents.
    """
    rows = []
    with show_step("fly") as step:
        for name in names or tuple(TRUTHS):
            step(f"fly: {name}")
            row, found = study(name, runs, seed)
            rows.append(row)
            if plot:
                draw(plot, name, found)
    if as_json:
        click.echo(json.dumps(rows))
        return
    print_tables(*(build_table(rows, *table) for table in TABLES))
    for row in rows:
        click.echo(
            f"{row['title']}: U on the bound in {row['on_bound']:.0%} of steps, "
            f"{row['near_bound']:.0%} within 10 %; "
            f"NEES per dimension {row['nees_minimax_per_dimension']:.2f} minimax, "
            f"{row['nees_restrictive_per_dimension']:.2f} restrictive"
        )
