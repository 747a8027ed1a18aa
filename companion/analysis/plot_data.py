"""Plot data: named lines and dots, thinned without losing extremes; `drawing` renders them."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from companion.analysis import error_statistics
from companion.units import Floats

MAX_POINTS = 3000  # per line: about twice the pixels of a screen
Style = Literal["line", "dots"]

#: Colours by role, for the first and the second log; distinguishable for colour-blind readers.
COLOURS = {
    "reference": ("#374151", "#9ca3af"),
    error_statistics.CORRECTED: ("#2563eb", "#db2777"),
    error_statistics.INS: ("#9333ea", "#c084fc"),
    error_statistics.GNSS: ("#f59e0b", "#a16207"),
    error_statistics.RSBN: ("#10b981", "#065f46"),
    "bound": ("#dc2626", "#7c2d12"),
    "rejected": ("#111827", "#6b7280"),
    "second": ("#0891b2", "#155e75"),
}


class Line(NamedTuple):
    """Points (x, y), joined or not; NaN is a gap."""

    name: str
    x: Floats
    y: Floats
    colour: str
    style: Style = "line"
    dash: bool = False
    width: float = 1.6


class Figure(NamedTuple):
    """A plot; `key` is its name in the page and its file name, `note` explains how to read it.

    `spans`: shaded intervals of x with a name. `equal`: same scale on both axes. `zero`: y starts at 0.
    `view`: initial view, x from, to, y from, to. `level`: horizontal reference line. `rows`: names of
    y = 1, 2, ...
    """

    key: str
    title: str
    x: str
    y: str
    lines: list[Line]
    note: str = ""
    log: bool = False
    equal: bool = False
    zero: bool = False
    spans: tuple[tuple[float, float, str], ...] = ()
    view: tuple[float, float, float, float] | None = None
    level: float | None = None
    rows: tuple[str, ...] = ()


TIME = "time, min"
LETTERS = "AB"  # names of two compared flights


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


def subsample(a: Floats, most: int = MAX_POINTS) -> Floats:
    """Return at most `most` values, evenly spaced."""
    return a[:: max(1, math.ceil(len(a) / most))]
