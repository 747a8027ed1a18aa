"""`companion study schuler`: prediction of recorded velocity errors of a real INS, and test of its bound.

Input is a CSV with columns utc_s_of_day, ins_minus_gps_ve_mps, ins_minus_gps_vn_mps (comment lines with #,
may be .gz), such as the five Schuler periods of a navigation-grade Honeywell Laseref on the NSF/NCAR
Gulfstream V (DEEPWAVE, W. Cooper, UCAR). In sliding windows over the flight the velocity error is estimated,
then predicted: by the Kalman filter of the model, by the minimax and the restricted estimate of the same
window, and, as simple rules, by least squares on the Schuler channel, a straight line, and the last error
held.

What is stated. The unit is of navigation grade (0.01 deg/h, 50 ug), in flight for hours: an oscillation of 2
m/s. Its motion is not recorded, so the model has no turns: heading error x force and body-fixed errors are
part of the unknown force. Earth's rotation couples the channels and is modelled at the latitude. The sigma
is that of a 30 s mean of the measured velocity, of any correlation. It was fixed in advance; as the "truth"
is such a measurement too, the shares are conservative.
"""

import json
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import numpy.typing as npt

from companion.analysis.error_statistics import root_mean_square
from companion.analysis.progress import show_step
from companion.estimate.minimax_lp import Design
from companion.estimate.predictor import Start, Step, Window, anchor
from companion.estimate.schuler import ARCSECOND, DEG_PER_HOUR, MEAN_EARTH, schuler_row, transition
from companion.nav.bounded_channel import BoundedIns, Motion, UnitErrors
from companion.option_types import FloatList, FloatRange
from companion.tables import number_table, print_tables
from companion.units import G0, SECOND_NS, Floats

STATED_SIGMA = 0.10  # [m/s]
MAX_S, MAX_M_S = 1e9, 1e6  # of the numbers in a recording
LATITUDE_DEG = -44.0  # DEEPWAVE flew over New Zealand
UNIT = UnitErrors(
    gyro=0.01 * DEG_PER_HOUR,
    gyro_s=5.0 * 3600.0,
    tilt_walk=math.radians(0.002) / 60.0,
    accelerometer=50e-6 * G0,
    accelerometer_s=3600.0,
    velocity_walk=1e-3,
    velocity=2.0,
    tilt=60.0 * ARCSECOND,  # 2 m/s of Schuler's oscillation
    heading=math.radians(0.05),
)
CORRELATION_S = 60.0
NODE_S = 30.0
VELOCITY = np.eye(15)[2:4]
STEP_S = 300.0  # interval between the starts of windows
SLACK_S = 5.0  # maximum time between a prediction and the measurement it is compared with


class Recording(NamedTuple):
    """Velocity errors INS minus GPS."""

    t_ns: npt.NDArray[np.int64]  # (n,) from the start
    channels: dict[str, Floats]  # east, north: (n,) [m/s]


class Outcome(NamedTuple):
    """Result for one channel, window and horizon; m/s except n and shares."""

    channel: str
    window_min: float
    ahead_min: float
    n: int  # predictions
    bound: float  # of the restricted estimate, r.m.s.
    inside: float  # share of its errors within the bound
    optimum: float  # bound of the minimax estimate, r.m.s.
    expected: float  # error of the Kalman filter, as it claims
    kalman_rms: float
    restricted_rms: float
    minimax_rms: float
    ls_rms: float  # least squares on the Schuler channel, without a force
    line_rms: float
    hold_rms: float


def load(file: Path, every_s: float = 10.0) -> Recording:
    """Read a recording and keep about one sample per every_s; times are unwrapped at midnight.

    Raises ValueError, one sentence, if the file is not a recording.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # empty files are reported below
            table = np.loadtxt(file, delimiter=",", skiprows=3, ndmin=2)
    except (ValueError, OSError) as error:  # not a number, not text, not gzip
        raise ValueError(f"{file} is not a recording of velocity errors: {error}") from None
    if len(table) < 2 or table.shape[1] < 3:
        raise ValueError(
            f"{file} is not a recording of velocity errors: after three header lines it needs lines of"
            " seconds, east, north"
        )
    for number, (t_s, east, north) in enumerate(table[:, :3].tolist(), start=1):
        if not (0.0 <= t_s <= MAX_S and abs(east) <= MAX_M_S and abs(north) <= MAX_M_S):
            raise ValueError(
                f"{file} is not a recording of velocity errors: row {number} is {t_s:g},{east:g},{north:g}:"
                f" seconds must be from 0 to {MAX_S:g}, errors from {-MAX_M_S:g} to {MAX_M_S:g} m/s:"
                " leave the row out"
            )
    seconds = np.unwrap(table[:, 0], period=86_400.0)
    seconds -= seconds[0]
    _, first = np.unique(np.floor(seconds / every_s), return_index=True)
    t_ns = np.round(seconds[first] * SECOND_NS).astype(np.int64)
    return Recording(t_ns, {"east": table[first, 1], "north": table[first, 2]})


def run(
    recording: Recording, window_s: float, ahead_s: list[float], sigma: float, lat_deg: float = LATITUDE_DEG
) -> list[Outcome]:
    """Predict both channels after every window of window_s [s] for each horizon in ahead_s [s]."""
    errors = _errors(recording, window_s, ahead_s, sigma, math.radians(lat_deg))
    outcomes = []
    for (channel, ahead), rows in errors.items():
        e = np.array(rows)
        if not len(e):
            continue
        bound, optimum, expected = (root_mean_square(e[:, k]) for k in range(3))
        inside = float((np.abs(e[:, 4]) <= e[:, 0]).mean())
        rms = [root_mean_square(e[:, k]) for k in range(3, 9)]
        sizes = (window_s / 60.0, ahead / 60.0, len(e), bound, inside, optimum, expected)
        outcomes.append(Outcome(channel, *sizes, *rms))
    return outcomes


def _errors(
    recording: Recording, window_s: float, ahead_s: list[float], sigma: float, lat: float
) -> dict[tuple[str, float], list[tuple[float, ...]]]:
    """Return by channel and horizon: bound, optimum, expected; errors of the six predictions."""
    law = BoundedIns(UNIT, CORRELATION_S)
    still = Motion(lat, (0.0, 0.0), (0.0, 0.0), NODE_S)
    Phi, B, Q = law.step(still)
    step = Step(NODE_S, Phi, B)
    t = recording.t_ns / SECOND_NS
    both = np.stack([recording.channels["north"], recording.channels["east"]], axis=1)
    errors: dict[tuple[str, float], list[tuple[float, ...]]] = {
        (channel, ahead): [] for channel in ("east", "north") for ahead in ahead_s
    }
    starts: dict[tuple[int, float], Start] = {}
    for span in _windows(recording.t_ns, window_s):
        times, values = t[span], both[span]
        later = {ahead: int(np.abs(t - (times[-1] + ahead)).argmin()) for ahead in ahead_s}
        later = {ahead: k for ahead, k in later.items() if abs(t[k] - times[-1] - ahead) <= SLACK_S}
        if not later:
            continue
        window = Window.begin(times[0] - 0.5 * NODE_S, law)
        for _ in range(round((times[-1] - times[0]) / NODE_S)):
            window = window.extend(window.t_s[-1] + NODE_S, Phi, B, Q)
            near = (times >= window.t_s[-2]) & (times < window.t_s[-1])
            if near.any():
                rows = VELOCITY @ window.C[-1]
                mean = values[near].mean(axis=0)
                window = window.with_fix(
                    float(times[near].mean()), rows, mean, np.full(2, sigma), 2.0 * window_s
                )
        anchored = anchor(window, law)
        widening = anchored.grouped.widening
        seconds = times - times[-1]
        fit = np.polyfit(seconds, values, 1)
        for ahead, k in later.items():
            steps = [step] * round((t[k] - window.t_s[-1]) / NODE_S)
            for axis, target in enumerate(anchored.targets(window, (2, 3), steps)):
                found = anchored.solve(target, starts.get((axis, ahead)))
                starts[axis, ahead] = found.start
                plain = Design.of(schuler_row("mu", -seconds * MEAN_EARTH.rate), 1.0)
                ls = plain.least_squares(transition(ahead * MEAN_EARTH.rate)[2]).weights @ values[:, axis]
                line = fit[1, axis] + fit[0, axis] * (t[k] - times[-1])
                guesses = (found.kalman.value, found.restricted.value, found.minimax.value, ls, line)
                error = np.array([*guesses, values[-1, axis]]) - both[k, axis]
                bounds = widening * found.restricted.bound, widening * found.minimax.bound
                channel = ("north", "east")[axis]
                errors[channel, ahead].append((*bounds, found.kalman.expected, *error.tolist()))
    return errors


def _windows(t_ns: npt.NDArray[np.int64], window_s: float) -> Iterator[slice]:
    for start in np.arange(0.0, t_ns[-1] / SECOND_NS - window_s, STEP_S):
        first, end = t_ns.searchsorted(np.array([start, start + window_s]) * SECOND_NS)
        if end - first >= 4:
            yield slice(int(first), int(end))


@click.command("schuler")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--window-min",
    "windows_min",
    type=FloatList(0.0, min_open=True),
    default="20,30,60",
    show_default=True,
    help="Windows of the estimation [min].",
)
@click.option(
    "--ahead-min",
    "aheads_min",
    type=FloatList(0.0),
    default="5,10,20,40",
    show_default=True,
    help="Horizons [min].",
)
@click.option(
    "--sigma-mps",
    type=FloatRange(1e-6, 1e6),
    default=STATED_SIGMA,
    show_default=True,
    help="Stated sigma [m/s].",
)
@click.option(
    "--lat-deg",
    type=FloatRange(-85.0, 85.0),
    default=LATITUDE_DEG,
    show_default=True,
    help="Latitude of the flight [deg].",
)
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    file: Path,
    windows_min: tuple[float, ...],
    aheads_min: tuple[float, ...],
    sigma_mps: float,
    lat_deg: float,
    as_json: bool,
) -> None:
    """Predict recorded INS velocity errors.

    Compares them with their bound and with simpler predictions.
    """
    try:
        recording = load(file)
        ahead = [60.0 * minutes for minutes in aheads_min]
        with show_step("predict"):
            outcomes = [
                outcome
                for minutes in windows_min
                for outcome in run(recording, 60.0 * minutes, ahead, sigma_mps, lat_deg)
            ]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    if not outcomes:
        windows, aheads = (" or ".join(f"{m:g}" for m in minutes) for minutes in (windows_min, aheads_min))
        raise click.UsageError(
            f"nothing to predict: in {file}, {recording.t_ns[-1] / SECOND_NS / 60.0:.3g} min long, no window"
            f" of {windows} min has four samples and a measurement {aheads} min later: change --window-min or"
            " --ahead-min"
        )
    if as_json:
        click.echo(json.dumps([outcome._asdict() for outcome in outcomes]))
        return
    shown = number_table(
        f"{file.name}: velocity error predicted, m/s",
        *("channel", "window\nmin", "ahead\nmin", "n", "bound", "inside", "least\nbound", "Kalman\nclaims"),
        *(f"{name}\nrms" for name in ("Kalman", "restricted", "minimax", "LS", "line", "hold")),
        texts=0,
        caption="bound: guaranteed r.m.s. of the restricted estimate; inside: share of its errors within it",
    )
    for outcome in outcomes:
        shown.add_row(outcome.channel, *(f"{number:.3g}" for number in outcome[1:]))
    print_tables(shown)
