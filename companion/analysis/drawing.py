"""Drawing of figures: `to_page` for the HTML pages, `write_figures` for PDF and PNG (matplotlib)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis.plot_data import Figure, Line
from companion.units import Floats
from companion.write_errors import make_folder, write_whole

INK, GRID, SHADE = "#374151", "#e5e7eb", "#fee2e2"
LEGEND, HANDLE = 120, 10  # characters in a row of a legend, and what stands before each name
TICKS_S = (1.0, 5.0, 10.0, 30.0, 60.0, 120.0, 300.0, 600.0, 1800.0, 3600.0)  # steps of a time axis


def to_page(figure: Figure) -> dict[str, Any]:
    """Convert a figure to the JSON that `web/view.js` draws."""
    lines = [_line(line) for line in figure.lines]
    if figure.origin is None:
        for line in lines:
            line["x"] = _apart_at_gaps(line["x"], line["y"])
    found = figure._asdict() | {"lines": lines}
    found["marks"] = [[round(mark.t, 2), mark.text, mark.warning] for mark in figure.marks]
    found["places"] = [[place.name, round(place.x, 1), round(place.y, 1)] for place in figure.places]
    del found["title"], found["note"]
    return found


def _line(line: Line) -> dict[str, Any]:
    found: dict[str, Any] = {
        "name": line.name,
        "colour": line.colour,
        "x": _rounded(line.x),
        "y": _rounded(line.y),
    }
    if line.style == "dots":
        found["dots"] = True
    if line.dash:
        found["dash"] = True
    if line.t is not None:
        found["t"] = _rounded(line.t)
    return found | {"width": line.width}


def _rounded(a: Floats) -> list[float | None]:
    """Return values to 1/100, small ones with four digits; NaN as None (a gap in the line)."""
    values = a.tolist()
    return [
        None
        if not math.isfinite(v)
        else int(v)
        if v == int(v)
        else round(v, 2)
        if abs(v) >= 10.0
        else float(f"{v:.4g}")
        for v in values
    ]


def _apart_at_gaps(x: Sequence[float], y: Sequence[float | None]) -> list[float]:
    """Return rounded times, no gap at that of a point: the page would draw nothing up to the next."""
    apart = list(x[:1])
    for t, before, after in zip(x[1:], y[:-1], y[1:], strict=True):
        last = apart[-1]
        meets = t < last or (t == last and (before is None) != (after is None))
        apart.append(round(last + 0.001, 3) if meets else t)
    return apart


def write_figures(figures: Sequence[Figure], pdf: Path | None, png: Path | None) -> list[Path]:
    """Write the figures to one `pdf`, a page each, and to the folder `png`, a file each. Return the paths.

    Raises ModuleNotFoundError if matplotlib is missing.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_pdf import PdfPages
    from matplotlib.figure import Figure as Sheet

    written = []
    sheets = []
    for figure in figures:
        sheet = Sheet(figsize=(7.0, 7.0 if figure.origin else 3.6), dpi=160, layout="constrained")
        FigureCanvasAgg(sheet)
        _paint(figure, sheet.subplots())
        sheets.append(sheet)
    if pdf is not None:
        with BytesIO() as file:
            with PdfPages(file) as pages:
                for sheet in sheets:
                    pages.savefig(sheet)
            write_whole(pdf, file.getvalue())
        written.append(pdf)
    if png is not None:
        make_folder(png)
        for figure, sheet in zip(figures, sheets, strict=True):
            written.append(png / f"{figure.key}.png")
            with BytesIO() as file:
                sheet.savefig(file, format="png")
                write_whole(written[-1], file.getvalue())
    return written


def _paint(figure: Figure, axes: Any) -> None:
    """Draw one figure in matplotlib axes, as the page draws it."""
    axes.set_title(figure.title, loc="left", fontsize=10)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    if figure.log:
        axes.set_yscale("log")
    for x0, x1, _ in figure.spans:
        axes.axvspan(x0, x1, color=SHADE, alpha=0.5, linewidth=0)
    if figure.level is not None:
        axes.axhline(figure.level, color=INK, linewidth=0.8, linestyle=":")
    for line in figure.lines:
        label, (colour, _) = line.name or "_nolegend_", line.colour
        x, y = np.asarray(line.x), np.asarray(line.y)
        if line.style == "dots":
            axes.plot(x, y, ".", color=colour, markersize=2.5, alpha=0.7, label=label)
        else:
            style = "--" if line.dash else "-"
            about = {"color": colour, "linewidth": 0.7 * line.width, "label": label}
            axes.plot(x, y, style, solid_capstyle="butt", **about)  # a bar ends at its last point
    if figure.zero:
        axes.set_ylim(bottom=0.0)
    if figure.view is not None:
        axes.set_ylim(*figure.view)
    if figure.origin:
        _paint_map(figure, axes)
    else:
        low, high = axes.get_xlim()
        step = next((s for s in TICKS_S if high - low <= 8.0 * s), 7200.0)
        axes.set_xticks(np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step)
        axes.set_xlabel("time, min:s")
        axes.xaxis.set_major_formatter(
            lambda s, _: f"{'-' if s < 0 else ''}{abs(s) // 60:.0f}:{abs(s) % 60:02.0f}"
        )
        axes.set_ylabel(figure.unit)
    if figure.rows:
        axes.set_yticks(range(1, len(figure.rows) + 1), figure.rows)
        axes.set_ylim(len(figure.rows) + 0.6, 0.4)
    elif names := axes.get_legend_handles_labels()[1]:
        columns = max(1, min(4, LEGEND // (max(map(len, names)) + HANDLE)))
        place = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.15)}
        axes.legend(fontsize=7, frameon=False, ncols=columns, **place)


def _paint_map(figure: Figure, axes: Any) -> None:
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("east, m")
    axes.set_ylabel("north, m")
    if figure.frame is not None:
        axes.set_xlim(*figure.frame[:2])
        axes.set_ylim(*figure.frame[2:])
    for place in figure.places:
        axes.plot([place.x], [place.y], "^", color=INK, markersize=5)
        axes.annotate(place.name, (place.x, place.y), fontsize=7, clip_on=True)
