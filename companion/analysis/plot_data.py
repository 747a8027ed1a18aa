"""Plot data: named lines, dots and places, thinned without losing extremes.

`drawing` renders them for the pages (report and live view) and for PDF and PNG. Times are seconds since the
start of the flight; lengths are metres.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from companion.analysis import error_statistics
from companion.units import Floats

MAX_POINTS = 1600  # per line: more than the pixels of a screen that a plot covers
Style = Literal["line", "dots"]

#: Colours by role, on light and on dark paper; distinguishable for colour-blind readers.
COLOURS: dict[str, tuple[str, str]] = {
    "reference": ("#57606a", "#9aa4af"),
    error_statistics.CORRECTED: ("#0969da", "#58a6ff"),
    error_statistics.INS: ("#8250df", "#bc8cff"),
    error_statistics.GNSS: ("#bc4c00", "#f0883e"),
    error_statistics.RSBN: ("#1a7f37", "#3fb950"),
    "bound": ("#d1242f", "#ff7b72"),
    "rejected": ("#24292f", "#d0d7de"),
    "second": ("#1b7c83", "#39c5cf"),
}
#: Colours of the logs where several are compared.
LOGS: tuple[tuple[str, str], ...] = (
    ("#0969da", "#58a6ff"),
    ("#bc4c00", "#f0883e"),
    ("#1a7f37", "#3fb950"),
    ("#bf3989", "#f778ba"),
    ("#8250df", "#bc8cff"),
    ("#1b7c83", "#39c5cf"),
    ("#953800", "#ffa657"),
    ("#57606a", "#9aa4af"),
)


class Line(NamedTuple):
    """Points (x, y), joined or not; NaN is a gap. `t` (s) are their times where x is no time."""

    name: str
    x: Floats
    y: Floats
    colour: tuple[str, str]
    style: Style = "line"
    dash: bool = False
    width: float = 1.6
    t: Floats | None = None


class Mark(NamedTuple):
    """An event on a time axis: time (s), text, and whether it is a warning."""

    t: float
    text: str
    warning: bool


class PlacedName(NamedTuple):
    """A named point of a map, metres east and north."""

    name: str
    x: float
    y: float


class Figure(NamedTuple):
    """A plot; `key` is its name in the page and its file name, `note` explains how to read it.

    `unit`: of y, shown at the axis and in every reading. `spans`: shaded intervals of time with a name.
    `marks`: events. `zero`: y starts at 0. `view`: initial view of y, from and to. `level`: horizontal
    reference line. `rows`: names of y = 1, 2, ...
    A map has x east and y north in the same scale: `origin` is latitude and longitude of (0, 0) in degrees,
    `frame` its initial view, x from, to, y from, to, and `places` are named points.
    """

    key: str
    title: str
    unit: str
    lines: list[Line]
    note: str = ""
    log: bool = False
    zero: bool = False
    spans: tuple[tuple[float, float, str], ...] = ()
    marks: tuple[Mark, ...] = ()
    view: tuple[float, float] | None = None
    level: float | None = None
    rows: tuple[str, ...] = ()
    origin: tuple[float, float] | None = None
    frame: tuple[float, float, float, float] | None = None
    places: tuple[PlacedName, ...] = ()


LETTERS = "ABCDEFGHIJKLMNOPQRSTUVWXYZ"  # names of compared flights


def thin_line(x: Floats, y: Floats, most: int = MAX_POINTS) -> tuple[Floats, Floats]:
    """Thin a line to about `most` points, keeping the minimum and the maximum of each interval."""
    n = len(x)
    if n <= most:
        return x, y
    width = math.ceil(2 * n / most)
    whole = n // width * width
    intervals = y[:whole].reshape(-1, width)
    empty = ~np.isfinite(intervals)
    low = np.where(empty, np.inf, intervals).argmin(axis=1)
    high = np.where(empty, -np.inf, intervals).argmax(axis=1)
    start = np.arange(0, whole, width)
    keep = np.unique(np.concatenate([start + low, start + high, [0, n - 1]]))
    return x[keep], y[keep]


def cut_at_gaps(kept: Floats, times: Floats, longest: float, *columns: Floats) -> tuple[Floats, ...]:
    """Return the `kept` of `times` and the columns of these, with NaN in the steps longer than `longest` (s).

    A line is not drawn there.
    """
    long = np.flatnonzero(np.diff(times) > longest)
    middles = 0.5 * (times[long] + times[long + 1])
    at = np.searchsorted(kept, middles)
    return np.insert(kept, at, middles), *(np.insert(column, at, np.nan) for column in columns)


def subsample(a: Floats) -> Floats:
    """Return at most `MAX_POINTS` values, evenly spaced."""
    return a[:: max(1, math.ceil(len(a) / MAX_POINTS))]
