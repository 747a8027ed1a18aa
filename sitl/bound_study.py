"""`companion study bound`: the guaranteed bound against simulated flights, by ensembles.

For each grade, vehicle, path and latitude an ensemble of INS errors is simulated along one flight, by the
simulator's own equations (`sitl.sensors.error_rates`), not by the model of the bound. A window of fixes is
followed by a time without. Errors of the fixes are white, one constant for the whole flight, or of the sign
that is worst for the estimate; each has the stated r.m.s. The r.m.s. error of the ensemble is compared with
the bound: of the Kalman filter's estimate, of the minimax one, and of the restricted one.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
from rich.table import Table

from companion.analysis.progress import show_items
from companion.estimate.predictor import KAPPA, Step, Window, anchor
from companion.nav.bounded_channel import BoundedIns, Motion, UnitErrors
from companion.nav.earth import OMEGA
from companion.option_types import FloatRange
from companion.study.plot_options import PLOT_FILE
from companion.tables import print_tables
from companion.units import Floats
from sitl.flight import Trajectory, rotation
from sitl.sensors import DEG_H, GRADES, UG, G, Generator, InertialGrade, R, error_rates

STEP_S = 0.5  # of the simulated INS errors
BIN_S = 10.0
SIGMA_M = 2.0
FIX_ERRORS = ("white", "constant", "worst")
VEHICLES = {"uav": (38.0, 4.0), "jet": (240.0, 1.0)}  # speed, m/s; turn rate, deg/s
PATHS = ("straight", "turns", "orbit")
LATITUDES = (0.0, 45.0, 80.0)
AHEAD_MIN = (1.0, 5.0, 10.0, 20.0)
ESTIMATES = ("kalman", "restricted", "minimax")


class Ensemble(NamedTuple):
    """Outcome of one ensemble at one horizon: expected and guaranteed error, and r.m.s. error found, m."""

    grade: str
    vehicle: str
    path: str
    lat_deg: float
    ahead_min: float
    fix_errors: str
    estimate: str
    flights: int
    expected: float
    bound: float
    rms: float

    @property
    def ratio(self) -> float:
        """R.m.s. error over bound."""
        return self.rms / self.bound


def unit_errors(grade: InertialGrade) -> UnitErrors:
    """State the errors of a simulated grade; levelling leaves the tilt that cancels the accelerometer."""
    tilt = math.hypot(math.radians(grade.tilt_arcsec / 3600.0), grade.accelerometer_bias_ug * UG / G)
    return UnitErrors(
        gyro=grade.gyro_bias_deg_h * DEG_H,
        gyro_s=grade.correlation_s,
        tilt_walk=math.radians(grade.angle_random_walk_deg_sqrt_h) / 60.0,
        accelerometer=grade.accelerometer_bias_ug * UG,
        accelerometer_s=grade.correlation_s,
        velocity_walk=grade.velocity_random_walk_ug_sqrt_hz * UG,
        velocity=grade.velocity_m_s,
        tilt=tilt,
        heading=math.radians(grade.heading_deg),
    )


def fly(vehicle: str, path: str, lat_deg: float, duration_s: float) -> Trajectory:
    """Fly level at constant speed: straight, quarter turns every three minutes, or circles."""
    speed, turn = VEHICLES[vehicle]
    t = np.arange(0.0, duration_s + STEP_S, STEP_S)
    rate = np.full(len(t), math.radians(turn) * (path == "orbit"))
    if path == "turns":
        lasting = 90.0 / turn
        rate = np.where(t % 180.0 < lasting, math.radians(turn) * np.where(t % 720.0 < 360.0, 1.0, -1.0), 0.0)
        rate = np.convolve(np.pad(rate, 10, mode="edge"), np.ones(21) / 21.0, mode="valid")
    heading = math.radians(60.0) + np.cumsum(rate) * STEP_S
    v_n = speed * np.stack([np.cos(heading), np.sin(heading), np.zeros(len(t))], axis=1)
    lat = math.radians(lat_deg) + np.cumsum(v_n[:, 0]) * STEP_S / R * np.sign(60.0 - lat_deg)
    if lat_deg > 60.0:  # away from the pole
        v_n[:, 0] *= -1.0
        heading = np.unwrap(np.arctan2(v_n[:, 1], v_n[:, 0]))
    lon = np.cumsum(v_n[:, 1] / np.cos(lat)) * STEP_S / R
    f_n = np.gradient(v_n, STEP_S, axis=0)
    coriolis = 2.0 * OMEGA * np.sin(lat) + v_n[:, 1] * np.tan(lat) / R
    f_n += np.stack([coriolis * v_n[:, 1], -coriolis * v_n[:, 0], np.full(len(t), -G)], axis=1)
    side = -np.sin(heading) * f_n[:, 0] + np.cos(heading) * f_n[:, 1]
    attitude = np.stack([np.arctan2(side, -f_n[:, 2]), np.zeros(len(t)), heading], axis=1)
    f_b = np.einsum("nji,nj->ni", rotation(attitude), f_n)
    zero = np.zeros(len(t))
    return Trajectory(t, lat, lon, zero, v_n, attitude, f_b, np.zeros((len(t), 3)), v_n * 0.0, zero + speed)


def simulate_errors(flight: Trajectory, grade: InertialGrade, count: int, rng: Generator) -> Floats:
    """Simulate position errors (count, n, 2) of `count` units along one flight."""
    from scipy.signal import lfilter  # 0.4 s

    n, dt = len(flight.t), STEP_S
    C_nb = rotation(flight.attitude)
    phi = math.exp(-dt / grade.correlation_s)

    def bias(sigma: float) -> Floats:
        white = rng.standard_normal((n, 3, count))
        white[1:] *= math.sqrt(1.0 - phi * phi)
        wander = lfilter([1.0], [1.0, -phi], white, axis=0)
        body = sigma * math.sqrt(0.5) * (wander + rng.standard_normal((3, count)))
        out: Floats = C_nb @ body
        return out

    drive = np.zeros((n, 7, count))
    accelerometer = bias(grade.accelerometer_bias_ug * UG)
    white = 1.0 / math.sqrt(dt)
    arw = math.radians(grade.angle_random_walk_deg_sqrt_h) / 60.0
    drive[:, 2:4] = accelerometer[:, :2]
    drive[:, 2:4] += grade.velocity_random_walk_ug_sqrt_hz * UG * white * rng.standard_normal((n, 2, count))
    drive[:, 4:] = bias(grade.gyro_bias_deg_h * DEG_H) + arw * white * rng.standard_normal((n, 3, count))
    x = np.zeros((7, count))
    x[2:4] = grade.velocity_m_s * rng.standard_normal((2, count))
    x[4:6] = np.stack([-accelerometer[0, 1], accelerometer[0, 0]]) / G
    x[4:6] += math.radians(grade.tilt_arcsec / 3600.0) * rng.standard_normal((2, count))
    x[6] = math.radians(grade.heading_deg) * rng.standard_normal(count)
    a = error_rates(flight)
    m = 0.5 * dt * (a[1:] + a[:-1])
    m2 = m @ m
    transition = np.eye(7) + m + 0.5 * m2 + m2 @ m / 6.0
    pushed = (np.eye(7) + 0.5 * m) @ (0.5 * dt * (drive[1:] + drive[:-1]))
    found = np.empty((n, 2, count))
    found[0] = x[:2]
    for k in range(n - 1):
        x = transition[k] @ x + pushed[k]
        found[k + 1] = x[:2]
    return found.transpose(2, 0, 1)


def window_along(flight: Trajectory, law: BoundedIns, window_s: float) -> tuple[Window, list[Step]]:
    """Build the window of fixes, one a bin, along the nominal flight, and the steps after the last one."""
    per_second = round(1.0 / STEP_S)
    t, lat, v = (np.asarray(a)[::per_second] for a in (flight.t, flight.lat, flight.v_n))
    window, steps = Window.begin(0.0, law), list[Step]()
    bin_n = round(BIN_S)
    position = np.eye(law.n)[:2]
    zero, sigma = np.zeros(2), np.full(2, SIGMA_M)
    for k in range(bin_n, len(t), bin_n):
        Phi, B, Q = np.eye(law.n), np.zeros((law.n, 2)), np.zeros((law.n, law.n))
        middle = Phi
        for i in range(k - bin_n, k):
            (vn0, ve0, _), (vn1, ve1, _) = v[i].tolist(), v[i + 1].tolist()
            one, b, q = law.step(Motion(float(lat[i]), (vn0, ve0), (vn1, ve1), 1.0))
            Phi, B, Q = one @ Phi, one @ B + b, one @ Q @ one.T + q
            if i == k - bin_n // 2 - 1:
                middle = Phi
        if t[k] <= window_s:
            rows = position @ middle @ window.C[-1]
            window = window.extend(float(t[k]), Phi, B, Q)
            window = window.with_fix(float(t[k]) - 0.5 * BIN_S, rows, zero, sigma, 2.0 * window_s)
        else:
            steps.append(Step(BIN_S, Phi, B))
    return window, steps


def run(
    grade: InertialGrade, vehicle: str, path: str, lat_deg: float, window_s: float, count: int, rng: Generator
) -> list[Ensemble]:
    """Fly one ensemble."""
    flight = fly(vehicle, path, lat_deg, window_s + 60.0 * AHEAD_MIN[-1])
    law = BoundedIns(unit_errors(grade))
    window, steps = window_along(flight, law, window_s)
    anchored = anchor(window, law)
    truth = simulate_errors(flight, grade, count, rng)
    per_bin = round(BIN_S / STEP_S)
    fixes = truth[:, per_bin // 2 : round(window_s / STEP_S) : per_bin]
    fixes = fixes.reshape(count, -1)  # north, east of each bin: the order of the rows
    white = SIGMA_M * rng.standard_normal(fixes.shape)
    constant = SIGMA_M * np.tile(rng.standard_normal((count, 2)), fixes.shape[1] // 2)
    found = []
    for ahead in AHEAD_MIN:
        k = round(60.0 * ahead / BIN_S)
        targets = anchored.targets(window, (0, 1), steps[:k])
        reached = truth[:, round((window_s + 60.0 * ahead) / STEP_S)]
        solved = [anchored.solve(target) for target in targets]
        by_name = {name: [getattr(one, name) for one in solved] for name in ESTIMATES}
        for name, pair in by_name.items():
            errors: dict[str, list[Floats]] = {kind: [] for kind in FIX_ERRORS}
            for axis, estimate in enumerate(pair):
                channel = fixes @ estimate.weights - reached[:, axis]
                worst = np.sign(channel) * SIGMA_M * float(np.abs(estimate.weights).sum())
                errors["white"].append(channel + white @ estimate.weights)
                errors["constant"].append(channel + constant @ estimate.weights)
                errors["worst"].append(channel + worst)
            for kind, (north, east) in errors.items():
                found.append(
                    Ensemble(
                        grade.name,
                        vehicle,
                        path,
                        lat_deg,
                        ahead_min=ahead,
                        fix_errors=kind,
                        estimate=name,
                        flights=count,
                        expected=math.hypot(*(e.expected for e in pair)),
                        bound=math.hypot(*(e.bound for e in pair)),
                        rms=float(np.sqrt(np.mean(north**2 + east**2))),
                    )
                )
    return found


class CurvePoint(NamedTuple):
    """Restricted estimate of one limit: worst error over the least, expected and guaranteed error, m."""

    kappa: float
    expected: float
    bound: float


def curve(grade: InertialGrade, window_s: float) -> list[CurvePoint]:
    """Trade expected against guaranteed error north, straight, 10 min ahead: minimax first, Kalman last."""
    flight = fly("uav", "straight", 45.0, window_s + 600.0)
    law = BoundedIns(unit_errors(grade))
    window, steps = window_along(flight, law, window_s)
    anchored = anchor(window, law)
    target = anchored.targets(window, (0,), steps)[0]
    coarse = anchored.coarse(target)
    best, _ = anchored.grouped.minimax(coarse)
    kalman = anchored.grouped.bayes(coarse)
    most = kalman.bound / best.bound
    found = []
    for kappa in np.geomspace(1.0, most, 12)[1:-1]:
        one, _ = anchored.grouped.restricted(coarse, best, float(kappa), tolerance=1e-3)
        found.append(CurvePoint(float(kappa), one.expected, one.bound))
    first = CurvePoint(1.0, best.expected, best.bound)
    return [first, *found, CurvePoint(most, kalman.expected, kalman.bound)]


@click.command("bound")
@click.option(
    "--window-min",
    type=FloatRange(1.0, 60.0),
    default=25.0,
    show_default=True,
    help="Duration of the window of fixes [min].",
)
@click.option(
    "--flights",
    type=click.IntRange(2, 1000),
    default=19,
    show_default=True,
    help="Flights in each of the 54 ensembles.",
)
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the errors.")
@click.option("--grade", type=click.Choice(tuple(GRADES)), help="Only this grade.")
@click.option("--json", "as_json", is_flag=True, help="Print every ensemble as JSON.")
@click.option(
    "--curve",
    "curve_file",
    type=PLOT_FILE,
    help="Only plot expected against guaranteed error, Kalman to minimax, 10 min ahead, to this file.",
)
def command(
    window_min: float, flights: int, seed: int, grade: str | None, as_json: bool, curve_file: Path | None
) -> None:
    """Compare the guaranteed bound with simulated errors."""
    grades = [GRADES[grade]] if grade else list(GRADES.values())
    if curve_file is not None:
        _plot(curve(grades[0], 60.0 * window_min), curve_file, grades[0].name)
        return
    cases = list(itertools.product(grades, VEHICLES, PATHS, LATITUDES))
    rng, found = np.random.default_rng(seed), list[Ensemble]()
    for one, vehicle, path, lat in show_items(cases, "flying"):
        found += run(one, vehicle, path, lat, 60.0 * window_min, flights, rng)
    if as_json:
        click.echo(json.dumps([{**e._asdict(), "ratio": e.ratio} for e in found]))
        return
    number = len(cases) * flights
    _print(found, f"{window_min:g} min of {SIGMA_M:g} m fixes; {number} flights in ensembles of {flights}")


def _print(found: Sequence[Ensemble], title: str) -> None:
    table = Table(
        title=title,
        caption="medians over paths, vehicles and latitudes, m; worst: the greatest r.m.s. error over bound",
    )
    for head in ("grade", "ahead\nmin", "estimate", "fixes'\nerrors", "expected", "r.m.s.", "bound"):
        table.add_column(head, justify="left" if head in ("grade", "estimate") else "right")
    table.add_column("bound /\nr.m.s.", justify="right")
    table.add_column("worst", justify="right")
    key = attrgetter("grade", "ahead_min", "estimate", "fix_errors")
    rows = {k: [e for e in found if key(e) == k] for k in dict.fromkeys(map(key, found))}
    for (grade, ahead, estimate, errors), group in rows.items():
        sizes = ([e.expected, e.rms, e.bound, 1.0 / e.ratio] for e in group)
        numbers = np.median(np.array(list(sizes)), axis=0).tolist()
        worst = max(e.ratio for e in group)
        texts = (f"{number:.3g}" for number in (*numbers, worst))
        table.add_row(grade, f"{ahead:g}", estimate, errors, *texts)
    print_tables(table)


def _plot(points: Sequence[CurvePoint], file: Path, grade: str) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 5.0), layout="constrained")
    axes = figure.add_subplot()
    expected, bound = [p.expected for p in points], [p.bound for p in points]
    axes.plot(expected, bound, "k.-")
    for label, k, place in (("minimax", 0, (-8, 8)), ("Kalman", -1, (8, 4))):
        side = "right" if k == 0 else "left"
        axes.annotate(label, (expected[k], bound[k]), xytext=place, textcoords="offset points", ha=side)
    axes.axhline(KAPPA * bound[0], color="0.6", ls="--", lw=0.8)
    axes.annotate(
        f"{KAPPA:g} times the least",
        (max(expected), KAPPA * bound[0]),
        xytext=(0, 4),
        textcoords="offset points",
        ha="right",
        color="0.4",
    )
    axes.set(
        title=f"{grade} grade, 10 min ahead",
        xlabel="expected error, m r.m.s.",
        ylabel="guaranteed error, m r.m.s.",
    )
    axes.margins(0.1)
    axes.grid(visible=True, alpha=0.3)
    figure.savefig(file)
