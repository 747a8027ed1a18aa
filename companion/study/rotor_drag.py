"""`companion study rotor-drag`: the drag of a multirotor's rotors, from a recorded flight with GNSS.

    companion study rotor-drag flight.bin

Least squares of the force of the drag, -drag (v - wind) + accelerometer bias, over means of one second in
flight: v is GNSS's, the wind is constant for `WIND_S` at a time, the bias turns with the aircraft. Without
changes of speed or course the drag cannot be separated from the wind.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np

from companion.analysis.replay_inputs import input_errors_as_log_errors, open_inputs
from companion.config import Config, load
from companion.config.options import configuration_options
from companion.navigator import strapdown_channel
from companion.navigator.strapdown_channel import Strap
from companion.option_types import INPUT_PATH
from companion.records import Attitude, Gnss, Imu, Stamped
from companion.storage.reader import LogError
from companion.study.outages import Fixes
from companion.tables import number_table, print_tables
from companion.units import SECOND_NS, Floats

WIND_S = 120.0
LASTING_S = 10.0  # gusts: residuals are independent after it
LEAST = 60  # seconds in flight
UPRIGHT = 0.5  # cosine of the tilt: here an attitude that is wrong at times only adds noise
FIXES_S = 2.0  # no velocity is interpolated across a longer gap
COARSEST = 0.25  # of the drag: the navigator's own uncertainty


class Seconds(NamedTuple):
    """Means of one second in flight: time (n,) s; `strapdown_channel.drag_force` (n, 2) m/s^2 and velocity
    (n, 2) m/s, north and east; nose (n, 2), its direction.
    """

    t: Floats
    force: Floats
    v: Floats
    nose: Floats


class RotorDrag(NamedTuple):
    """Drag and its sigma (1/s), seconds used, what is left of the velocity in the mean of a second (m/s)."""

    drag_per_s: float
    sigma: float
    seconds: int
    left_m_s: float


def seconds_in_flight(records: Sequence[Stamped], config: Config) -> Seconds:
    """Average over each second of a multirotor's flight in which IMU, attitude and GNSS velocity came."""
    receiver, imu = config.gnss.receiver, config.strapdown.imu
    fixes = Fixes([r for r in records if not (isinstance(r, Gnss) and r.receiver != receiver)])
    strap, rows = Strap(), dict[int, list[tuple[float, ...]]]()
    for record in records if fixes.is_multirotor else ():
        if isinstance(record, Attitude):
            strap = strapdown_channel.sense(strap, record)
        elif isinstance(record, Imu) and record.source == imu:
            strap = strapdown_channel.receive(strap, record)
            if strap.why or strap.C_nb is None or not fixes.is_aloft(record.t_ns):
                continue
            if (force := strapdown_channel.drag_force(strap, UPRIGHT)) is not None:
                row = (*force, float(strap.C_nb[0, 0]), float(strap.C_nb[1, 0]))
                rows.setdefault(record.t_ns // SECOND_NS, []).append(row)
    middles = {second: second * SECOND_NS + SECOND_NS // 2 for second in rows}
    known = [second for second, middle in middles.items() if fixes.covers(middle, FIXES_S)]
    t_ns = np.array([middles[second] for second in known])
    v = [np.interp(t_ns, fixes.v_t_ns, each) for each in (fixes.v_n, fixes.v_e)] if len(fixes.v_n) else []
    if not known or not v:
        return Seconds(np.zeros(0), *(np.zeros((0, 2)) for _ in range(3)))
    means = np.array([np.mean(rows[second], axis=0) for second in known])
    return Seconds((t_ns - t_ns[0]) / SECOND_NS, means[:, :2], np.column_stack(v), means[:, 2:])


def fit(s: Seconds) -> RotorDrag:
    """Fit the drag, a wind for each `WIND_S` and the accelerometers' bias."""
    parts = (s.t // WIND_S)[:, None] == np.unique(s.t // WIND_S)
    c, d = s.nose.T / np.hypot(*s.nose.T)
    north = np.column_stack((-s.v[:, 0], parts, 0.0 * parts, c, -d))
    east = np.column_stack((-s.v[:, 1], 0.0 * parts, parts, d, c))
    A, b = np.vstack((north, east)), np.concatenate(s.force.T)
    x, *_ = np.linalg.lstsq(A, b, rcond=None)
    left = float(np.std(b - A @ x))
    sigma = left * float(np.sqrt(LASTING_S * np.linalg.pinv(A.T @ A)[0, 0]))
    drag = float(x[0])
    return RotorDrag(drag, sigma, len(s.t), left / abs(drag) if drag else np.inf)


@click.command("rotor-drag")
@click.argument("log", type=INPUT_PATH)
@configuration_options
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(log: Path, file: Path | None, preset: str | None, pairs: tuple[str, ...], as_json: bool) -> None:
    """Measure a multirotor's drag in a recorded flight.

    LOG is any log that `companion replay` reads, of a flight with GNSS and changes of speed or course. The
    result is air_data.rotor_drag_per_s.
    """
    config = load(file, {}, pairs=pairs, preset=preset)
    with input_errors_as_log_errors():
        s = seconds_in_flight(list(open_inputs(log, config).records), config)
    if len(s.t) < LEAST:
        raise LogError(
            f"{log}: {len(s.t)} s of a multirotor's flight with IMU, attitude and velocity of GNSS, {LEAST} s"
            " are needed: choose a longer flight, or a log with these at 5, 2 and 1 Hz"
        )
    found = fit(s)
    if as_json:
        click.echo(json.dumps(found._asdict()))
    else:
        heads = "drag, 1/s", "sigma", "of seconds", "left in a second, m/s"
        table = number_table("drag of the rotors", *heads, texts=0)
        row = f"{found.drag_per_s:.3f}", f"{found.sigma:.3f}", f"{found.seconds}", f"{found.left_m_s:.2f}"
        table.add_row(*row)
        print_tables(table)
    if not found.sigma <= COARSEST * found.drag_per_s:
        raise LogError(
            f"{log}: the drag is not known to {COARSEST:.0%}: choose a flight with more changes of speed and"
            " course"
        )
