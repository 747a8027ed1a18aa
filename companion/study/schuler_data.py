"""`companion study schuler`: prediction of recorded velocity errors of a real INS, and test of its bound.

Input is a CSV with columns utc_s_of_day, ins_minus_gps_ve_mps, ins_minus_gps_vn_mps (comment lines with #,
may be .gz), such as the five Schuler periods of a navigation-grade Honeywell Laseref on the NSF/NCAR
Gulfstream V (DEEPWAVE, W. Cooper, UCAR). In sliding windows over the flight the velocity error is estimated,
then predicted. The minimax prediction is compared with least squares on the same model, a straight line, and
the last error held constant.

The stated sigma. The departures from (2.1) are mostly model errors: manoeuvres, drift that rotates with the
heading and, above all, the Earth's rotation, which rotates a Schuler oscillation of amplitude A between the
channels at Omega sin(lat) and is not observable in a single channel. The default is therefore fixed in
advance for any such INS: 0.12 m/s, the r.m.s. residual of the model over the first hour of this flight (its
worse channel, east), and A Omega sin(lat) t = 0.28 m/s with A = 2 m/s, lat = 45 deg, t = 45 min, the middle
of one and a half hours of window and horizon; together 0.30 m/s. `sigma_68` is the sigma for which 68 % of
the errors are inside, for comparison. As the "truth" is such a measurement too, the shares are conservative.
"""

import json
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table

from companion.estimate.predictor import Window, predict_ahead
from companion.units import SECOND_NS, Floats

STATED_SIGMA = 0.30  # [m/s]
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
    sigma: float
    bound: float  # mean
    inside: float  # share of |error| <= bound
    sigma_68: float  # sigma for which 68 % are inside
    minimax_rms: float
    ls_rms: float
    ls_inside: float  # share within one sigma as claimed by least squares
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
    seconds = np.unwrap(table[:, 0], period=86_400.0)
    seconds -= seconds[0]
    _, first = np.unique(np.floor(seconds / every_s), return_index=True)
    t_ns = np.round(seconds[first] * SECOND_NS).astype(np.int64)
    return Recording(t_ns, {"east": table[first, 1], "north": table[first, 2]})


def run(
    recording: Recording, channel: str, window_s: float, ahead_s: list[float], sigma: float
) -> list[Outcome]:
    """Predict one channel after every window of window_s [s] for each horizon in ahead_s [s]."""
    return [
        Outcome(
            channel,
            window_s / 60.0,
            ahead / 60.0,
            len(e),
            sigma,
            float(e[:, 4].mean()),
            float((np.abs(e[:, 0]) <= e[:, 4]).mean()),
            sigma * float(np.quantile(np.abs(e[:, 0]) / e[:, 4], 0.68)),
            _rms(e[:, 0]),
            _rms(e[:, 1]),
            float((np.abs(e[:, 1]) <= e[:, 5]).mean()),
            _rms(e[:, 2]),
            _rms(e[:, 3]),
        )
        for ahead, errors in _errors(recording, channel, window_s, ahead_s, sigma).items()
        if len(e := np.array(errors))
    ]


def _errors(
    recording: Recording, channel: str, window_s: float, ahead_s: list[float], sigma: float
) -> dict[float, list[tuple[float, ...]]]:
    """Return by horizon: errors of minimax, least squares, line and hold; bound; claimed sigma."""
    errors: dict[float, list[tuple[float, ...]]] = {ahead: [] for ahead in ahead_s}
    t_ns, velocity = recording.t_ns, recording.channels[channel]
    for span in _windows(t_ns, window_s):
        window = Window.of(
            t_ns[span], "velocity", velocity[span], sigma, span=window_s + 1.0, capacity=10_000
        )
        last = int(window.t_ns[-1])
        seconds = (window.t_ns - last) / SECOND_NS
        slope, level = np.polyfit(seconds, window.value, 1)
        reached = {}
        for ahead in ahead_s:
            k = int(np.abs(t_ns - (last + round(ahead * SECOND_NS))).argmin())
            if abs((t_ns[k] - last) / SECOND_NS - ahead) <= SLACK_S:
                reached[ahead] = k
        predictions = predict_ahead(window, [int(t_ns[k]) for k in reached.values()], ("velocity",))
        for (ahead, k), prediction in zip(reached.items(), predictions, strict=True):
            forecast = prediction.velocity
            if forecast is None or not forecast.feasible:
                continue
            line = level + slope * (int(t_ns[k]) - last) / SECOND_NS
            guesses = np.array([forecast.estimate, forecast.ls_estimate, line, window.value[-1]])
            errors[ahead].append((*(guesses - velocity[k]).tolist(), forecast.bound, forecast.ls_claimed))
    return errors


def _windows(t_ns: npt.NDArray[np.int64], window_s: float) -> Iterator[slice]:
    for start in np.arange(0.0, t_ns[-1] / SECOND_NS - window_s, STEP_S):
        first, end = t_ns.searchsorted(np.array([start, start + window_s]) * SECOND_NS)
        if end - first >= 4:
            yield slice(int(first), int(end))


def _rms(errors: Floats) -> float:
    return float(np.sqrt(np.mean(errors**2)))


@click.command("schuler")
@click.argument("file", type=click.Path(exists=True, dir_okay=False, path_type=Path))
@click.option(
    "--window-min", default="30,60,90,120", show_default=True, help="Windows of the estimation [min]."
)
@click.option("--ahead-min", default="5,10,20,40,60", show_default=True, help="Horizons [min].")
@click.option("--sigma-mps", default=STATED_SIGMA, show_default=True, help="Stated sigma [m/s].")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(file: Path, window_min: str, ahead_min: str, sigma_mps: float, as_json: bool) -> None:
    """Predict recorded INS velocity errors; compare them with their bound and with simpler predictions."""
    try:
        recording = load(file)
        windows = [60.0 * float(word) for word in window_min.split(",")]
        ahead = [60.0 * float(word) for word in ahead_min.split(",")]
        outcomes = [
            outcome
            for channel in recording.channels
            for window in windows
            for outcome in run(recording, channel, window, ahead, sigma_mps)
        ]
    except ValueError as error:
        raise click.UsageError(str(error)) from None
    if as_json:
        click.echo(json.dumps([outcome._asdict() for outcome in outcomes]))
        return
    shown = Table(
        title=f"{file.name}: velocity error predicted, m/s", caption="share: errors within the bound"
    )
    for head in (
        "channel",
        "window\nmin",
        "ahead\nmin",
        "n",
        "sigma",
        "bound",
        "share",
        "sigma\nfor 68%",
        "minimax\nrms",
        "LS\nrms",
        "LS share\nin claim",
        "line\nrms",
        "hold\nrms",
    ):
        shown.add_column(head, justify="right")
    for outcome in outcomes:
        shown.add_row(outcome.channel, *(f"{number:.3g}" for number in outcome[1:]))
    Console(width=120).print(shown)
