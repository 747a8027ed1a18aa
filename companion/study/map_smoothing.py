"""`companion study map`: MAP smoothing of a two-state example by three algorithms, and by shooting.

Brandin (6.4.12) for a position and a velocity with ten measured positions: the direct solution of the
two-point boundary problem, Kalman filter and Rauch-Tung-Striebel recursion, and the filter alone.
"Shooting", which the source mentions, integrates the multipliers forwards and fails on longer problems.
See `companion.estimate.smoother`.
"""

from __future__ import annotations

import json

import click
import numpy as np
from rich.table import Table

from companion.estimate import smoother
from companion.estimate.linear_system import LinearSystem
from companion.tables import number_table, print_tables
from companion.units import Floats

PHI, GAMMA = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
D, H, R = np.array([[0.04]]), np.array([[1.0, 0.0]]), np.array([[0.25]])
M, B = np.array([0.0, 0.8]), np.array([[1.0, 0.1], [0.1, 0.5]])
Z = (1.2, 1.9, 3.4, 4.1, 4.7, 6.6, 7.1, 8.3, 8.8, 10.4)


def shooting(z: Floats) -> Floats:
    """Solve (6.4.12) by shooting: find the multiplier s_0 for which the last one is zero; states (N + 1, 2).

    Phi^-T, by which s runs forwards, grows where Phi' decays, and so do the rounding errors.
    """
    n, N = len(M), len(z)
    inverse: Floats = np.linalg.inv(PHI.T)

    def run(s_0: Floats) -> tuple[Floats, Floats]:
        x, s, states = B @ PHI.T @ s_0 + M, s_0, []
        states.append(x)
        for i in range(N):
            x = PHI @ x + GAMMA @ D @ GAMMA.T @ s
            states.append(x)
            s = inverse @ (s - H.T @ np.linalg.solve(R, np.atleast_1d(z[i]) - H @ x))
        return np.array(states), s

    _, free = run(np.zeros(n))
    response = np.column_stack([run(e)[1] - free for e in np.eye(n, dtype=np.float64)])
    return run(np.asarray(-np.linalg.solve(response, free), dtype=np.float64))[0]


def solve(z: Floats) -> dict[str, Floats]:
    """Return the states (N + 1, 2) by each algorithm."""
    N = len(z)
    readings = [np.atleast_1d(v) for v in z]
    system = LinearSystem.of([PHI] * N, [GAMMA] * N, [D] * N, [H] * N, [R] * N, readings, M, B)
    return {
        "two-point": smoother.two_point(system).x,
        "filter + RTS": smoother.rts(system).x,
        "shooting": shooting(z),
        "filter": smoother.forward_filter(system).x,
    }


def long_record(N: int) -> Floats:
    """Simulate N measurements of the example."""
    rng = np.random.default_rng(1)
    x, z = M + np.linalg.cholesky(B) @ rng.standard_normal(2), []
    for _ in range(N):
        x = PHI @ x + GAMMA[:, 0] * (0.2 * rng.standard_normal())
        z.append(x[0] + 0.5 * rng.standard_normal())
    return np.array(z)


@click.command("map")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(as_json: bool) -> None:
    """Solve the example of (6.4.12) by three algorithms.

    Shows where shooting fails.
    """
    found = solve(np.array(Z))
    lengths = (10, 60, 120)
    apart = {}
    for N in lengths:
        states = solve(long_record(N))
        apart[N] = {
            name: float(np.abs(states[name] - states["two-point"]).max())
            for name in ("filter + RTS", "shooting")
        }
    if as_json:
        click.echo(json.dumps({"x": {name: x.tolist() for name, x in found.items()}, "apart": apart}))
        return
    table = Table(title="position and velocity, ten measurements")
    table.add_column("i", justify="right")
    table.add_column("")
    for name in found:
        table.add_column(name, justify="right")
    for i in (0, 5, 10):
        for k, state in enumerate(("x", "v")):
            table.add_row(str(i), state, *(f"{x[i, k]:.12f}" for x in found.values()))
    title = "greatest distance from the direct solution, by the number of measurements"
    law = number_table(title, "algorithm", *map(str, lengths))
    for name in ("filter + RTS", "shooting"):
        law.add_row(name, *(f"{apart[N][name]:.1e}" for N in lengths))
    print_tables(table, law)
