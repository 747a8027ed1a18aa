"""`companion study schemes`: feedforward, feedback and mixtures of the two, on a planar INS.

Position, velocity and heading of a vehicle in the plane, one gyro and two accelerometers with constant
biases, a position fix of 2 m every second for 300 s. After Vavilova, Golovan, Parusnikov: with small
errors every mixture gives the same solution; with coarse sensors the feedforward linearisation fails. The
schemes differ by the square of the errors, which the last table shows: doubling all errors makes the
distance four times as large.
"""

from __future__ import annotations

import json
import math
from typing import NamedTuple

import click
import numpy as np

from companion.estimate.schemes import FeedbackFractions, Plant, SchemeState, step
from companion.tables import number_table, print_tables
from companion.units import Floats

DT, SPEED = 0.1, 20.0
SAMPLES, FIX_EVERY = 3000, 10
FIX_M = 2.0
SCALES = (0.02, 0.04, 0.08)
SCHEMES = {
    "feedforward": FeedbackFractions(0.0, 0.0),
    "0.3": FeedbackFractions(0.3, 0.3),
    "0.7": FeedbackFractions(0.7, 0.7),
    "state only": FeedbackFractions(1.0, 0.0),
    "sensors only": FeedbackFractions(0.0, 1.0),
    "feedback": FeedbackFractions(1.0, 1.0),
}


class Sensors(NamedTuple):
    """Sigma of the constant biases: gyro (rad/s), accelerometers (m/s^2)."""

    title: str
    gyro: float
    accelerometer: float


FINE = Sensors("0.1 deg/s, 0.05 m/s^2", math.radians(0.1), 0.05)
COARSE = Sensors("0.5 deg/s, 0.2 m/s^2", math.radians(0.5), 0.2)


def turned(heading: float, f: Floats) -> Floats:
    """Turn a vector (2,) from body axes by the heading."""
    c, s = math.cos(heading), math.sin(heading)
    return np.array([c * f[0] - s * f[1], s * f[0] + c * f[1]])


def mechanise(X: Floats, u: Floats) -> Floats:
    """Return position, velocity, heading (5,) one step later, by gyro and accelerometers u (3,)."""
    a, v = turned(X[4], u[1:]), X[2:4]
    return np.concatenate([X[:2] + DT * v + DT**2 / 2 * a, v + DT * a, [X[4] + DT * u[0]]])


def transition(X: Floats, u: Floats) -> Floats:
    """Return the Jacobian (8, 8) of the errors: of the state, and of the sensors."""
    a = turned(X[4], u[1:])
    pull = np.column_stack(
        [[-a[1], a[0]], turned(X[4], np.array([1.0, 0.0])), turned(X[4], np.array([0.0, 1.0]))]
    )
    A = np.eye(8)
    A[0, 2] = A[1, 3] = A[4, 5] = DT
    A[:2, [4, 6, 7]] = DT**2 / 2 * pull
    A[2:4, [4, 6, 7]] = DT * pull
    return A


def fly(sensors: Sensors, fractions: FeedbackFractions, seed: int, scale: float = 1.0) -> Floats:
    """Return the position errors (300, 2) m at the fixes; every error is multiplied by `scale`."""
    rng = np.random.default_rng(seed)
    noise = scale * np.array([1e-3, 0.02, 0.02])
    Q = np.diag(np.concatenate([[0, 0], (DT * noise[1:]) ** 2, [(DT * noise[0]) ** 2], [0, 0, 0]]))
    H = np.zeros((2, 8))
    H[0, 0] = H[1, 1] = -1.0
    plant = Plant(mechanise, transition, lambda X: X[:2], lambda X: H, Q, (FIX_M * scale) ** 2 * np.eye(2))
    biases = np.array([sensors.gyro, sensors.accelerometer, sensors.accelerometer])
    sigma = scale * np.concatenate([[2.0, 2.0, 0.2, 0.2, 0.02], biases])
    X = np.array([0.0, 0.0, SPEED, 0.0, 0.0])
    state = SchemeState(X + sigma[:5] * rng.standard_normal(5), np.zeros(8), np.diag(sigma**2), np.zeros(3))
    biases = scale * biases * rng.choice([-1, 1], 3)
    errors = []
    for k in range(1, SAMPLES + 1):
        w = 0.05 + 0.1 * math.sin(2.0 * math.pi * k * DT / 60.0)
        u = np.array([w, 0.5 * math.sin(2.0 * math.pi * k * DT / 30.0), SPEED * w])
        X = mechanise(X, u)
        fix = X[:2] + FIX_M * scale * rng.standard_normal(2) if k % FIX_EVERY == 0 else None
        state = step(state, u + biases + noise * rng.standard_normal(3), fix, plant, fractions)
        if fix is not None:
            errors.append(state.corrected[:2] - X[:2])
    return np.array(errors)


def rms(sensors: Sensors, fractions: FeedbackFractions, seeds: int) -> float:
    """Return the r.m.s. position error over some flights, m."""
    squares = [np.mean(np.sum(fly(sensors, fractions, s) ** 2, axis=1)) for s in range(seeds)]
    return math.sqrt(float(np.mean(squares)))


def distance(fractions: FeedbackFractions, scale: float) -> float:
    """Return the greatest distance of a scheme's position from feedforward, m."""
    apart = fly(FINE, fractions, 1, scale) - fly(FINE, SCHEMES["feedforward"], 1, scale)
    return float(np.abs(apart).max())


@click.command("schemes")
@click.option(
    "--seeds", type=click.IntRange(1, 10_000), default=2, show_default=True, help="Flights per cell."
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(seeds: int, as_json: bool) -> None:
    """Compare correction schemes of an INS by their errors.

    Shows the law of their difference.
    """
    errors = {name: [rms(s, f, seeds) for s in (FINE, COARSE)] for name, f in SCHEMES.items()}
    apart = {name: [distance(f, s) for s in SCALES] for name, f in SCHEMES.items() if name != "feedforward"}
    if as_json:
        click.echo(json.dumps({"rms_m": errors, "scales": SCALES, "distance_m": apart}))
        return
    title = f"position error, m r.m.s., {seeds} flights"
    table = number_table(title, "share fed back", FINE.title, COARSE.title)
    for name, row in errors.items():
        table.add_row(name, *(f"{value:.2f}" for value in row))
    title = "greatest distance from feedforward, m: the square of the errors"
    law = number_table(title, "share fed back", *(f"errors x {scale:g}" for scale in SCALES))
    for name, row in apart.items():
        law.add_row(name, *(f"{value:.3g}" for value in row))
    print_tables(table, law)
