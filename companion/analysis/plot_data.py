"""What a plot is, before it is drawn: lines and dots with names, as data, thinned so that every peak stays.

`draw` makes it visible, on a page or on paper. It knows nothing of flights.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np

from companion.analysis import error_statistics
from companion.analysis.flight_arrays import Floats

MOST = 3000  # points of a line: about the pixels of a screen, twice
Style = Literal["line", "dots"]

#: A colour for each role, for the first log and for the second. Chosen to be told apart by colour-blind eyes.
COLOURS = {
    "reference": ("#374151", "#9ca3af"),
    error_statistics.CORRECTED: ("#2563eb", "#db2777"),
    error_statistics.INS: ("#9333ea", "#c084fc"),
    error_statistics.GNSS: ("#f59e0b", "#a16207"),
    error_statistics.RSBN: ("#10b981", "#065f46"),
    "bound": ("#dc2626", "#7c2d12"),
    "refused": ("#111827", "#6b7280"),
    "second": ("#0891b2", "#155e75"),
}


class Line(NamedTuple):
    """Points (x, y), joined or not; NaN lifts the pen."""

    name: str
    x: Floats
    y: Floats
    colour: str
    style: Style = "line"
    dash: bool = False
    width: float = 1.6


class Figure(NamedTuple):
    """A plot: `key` names it in the page and as a file, `note` says how to read it.

    `spans` are shaded stretches of x with a name. `equal` asks for the same scale on both axes, `zero` for y
    from 0; `view` is what is seen at first: x from, to, y from, to. `level` is a y to compare with; `rows`
    name y = 1, 2 ...
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
LETTERS = "AB"  # what two flights compared are called


def thinned(x: Floats, y: Floats, most: int = MOST) -> tuple[Floats, Floats]:
    """The line with at most about `most` points: of each stretch of it the lowest and the highest stay."""
    n = len(x)
    if n <= most:
        return x, y
    width = math.ceil(2 * n / most)
    whole = n // width * width
    stretches = y[:whole].reshape(-1, width)
    empty = ~np.isfinite(stretches)
    low = np.where(empty, np.inf, stretches).argmin(axis=1)
    high = np.where(empty, -np.inf, stretches).argmax(axis=1)
    start = np.arange(0, whole, width)
    keep = np.unique(np.concatenate([start + low, start + high, [0, n - 1]]))
    return x[keep], y[keep]


def strided(a: Floats, most: int = MOST) -> Floats:
    """At most `most` of them, evenly."""
    return a[:: max(1, math.ceil(len(a) / most))]
