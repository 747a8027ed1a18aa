"""Drawing of figures: `to_plotly` for the HTML page, `write_figures` for PDF and PNG (matplotlib)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from companion.analysis.plot_data import Figure, Line
from companion.units import Floats

INK, GRID, SHADE = "#374151", "#e5e7eb", "#fee2e2"
_FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, sans-serif"


def to_plotly(figure: Figure) -> dict[str, Any]:
    """Convert a figure to plotly's JSON, `data` and `layout`; its width follows the page."""
    x: dict[str, Any] = {"title": {"text": figure.x}, "zeroline": False, "gridcolor": GRID}
    y: dict[str, Any] = {
        "title": {"text": figure.y},
        "zeroline": False,
        "gridcolor": GRID,
        "automargin": True,
    }
    if figure.log:
        y |= {"type": "log", "dtick": 1, "tickformat": "~g"}
    if figure.zero:
        y |= {"rangemode": "tozero"}
    if figure.equal:
        y |= {"scaleanchor": "x", "scaleratio": 1}
    if figure.view is not None:
        x["range"], y["range"] = list(figure.view[:2]), list(figure.view[2:])
    if figure.rows:
        y |= {"tickvals": list(range(1, len(figure.rows) + 1)), "ticktext": list(figure.rows), "title": None}
        y |= {"range": [len(figure.rows) + 0.6, 0.4]}
    shapes: list[dict[str, Any]] = [
        {"type": "rect", "xref": "x", "yref": "paper", "x0": x0, "x1": x1, "y0": 0, "y1": 1}
        | {"fillcolor": SHADE, "opacity": 0.5, "line": {"width": 0}, "layer": "below"}
        for x0, x1, _ in figure.spans
    ]
    if figure.level is not None:
        at = figure.level
        shapes.append(
            {"type": "line", "xref": "paper", "x0": 0, "x1": 1, "y0": at, "y1": at}
            | {"line": {"color": INK, "width": 1, "dash": "dot"}}
        )
    layout = {
        "font": {"family": _FONT, "size": 12, "color": INK},
        "margin": {"l": 56, "r": 12, "t": 8, "b": 44},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#ffffff",
        "legend": {"orientation": "h", "y": 1.02, "yanchor": "bottom", "x": 0},
        "showlegend": not figure.rows,
        "hovermode": "closest",
        "xaxis": x,
        "yaxis": y,
        "shapes": shapes,
    }
    return {"data": [_trace(line) for line in figure.lines], "layout": layout}


def _trace(line: Line) -> dict[str, Any]:
    trace: dict[str, Any] = {"x": _plain(line.x), "y": _plain(line.y), "type": "scatter", "name": line.name}
    if line.style == "dots":
        trace |= {"mode": "markers", "marker": {"size": 4, "color": line.colour, "opacity": 0.7}}
    else:
        dash = "dash" if line.dash else "solid"
        trace |= {"mode": "lines", "line": {"color": line.colour, "width": line.width, "dash": dash}}
    if not line.name:
        trace |= {"showlegend": False, "hoverinfo": "skip"}
    return trace


def _plain(a: Floats) -> list[float | None]:
    """Return the values with six digits, NaN as None (a gap in the line)."""
    return [float(f"{v:.6g}") if math.isfinite(v) else None for v in a.tolist()]


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
        sheet = Sheet(figsize=(7.0, 7.0 if figure.equal else 3.6), dpi=160, layout="constrained")
        FigureCanvasAgg(sheet)
        _paint(figure, sheet.subplots())
        sheets.append(sheet)
    if pdf is not None:
        with PdfPages(pdf) as pages:
            for sheet in sheets:
                pages.savefig(sheet)
        written.append(pdf)
    if png is not None:
        png.mkdir(parents=True, exist_ok=True)
        for figure, sheet in zip(figures, sheets, strict=True):
            written.append(png / f"{figure.key}.png")
            sheet.savefig(written[-1])
    return written


def _paint(figure: Figure, axes: Any) -> None:
    """Draw one figure in matplotlib axes, like `to_plotly`."""
    axes.set_title(figure.title, loc="left", fontsize=10)
    axes.set_xlabel(figure.x)
    axes.set_ylabel("" if figure.rows else figure.y)
    axes.grid(color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    if figure.log:
        axes.set_yscale("log")
    if figure.equal:
        axes.set_aspect("equal", adjustable="box")
    for x0, x1, _ in figure.spans:
        axes.axvspan(x0, x1, color=SHADE, alpha=0.5, linewidth=0)
    if figure.level is not None:
        axes.axhline(figure.level, color=INK, linewidth=0.8, linestyle=":")
    for line in figure.lines:
        label = line.name or "_nolegend_"
        x, y = np.asarray(line.x), np.asarray(line.y)
        if line.style == "dots":
            axes.plot(x, y, ".", color=line.colour, markersize=2.5, alpha=0.7, label=label)
        else:
            style = "--" if line.dash else "-"
            axes.plot(x, y, style, color=line.colour, linewidth=0.7 * line.width, label=label)
    if figure.zero:
        axes.set_ylim(bottom=0.0)
    if figure.view is not None:
        axes.set_xlim(*figure.view[:2])
        axes.set_ylim(*figure.view[2:])
    if figure.rows:
        axes.set_yticks(range(1, len(figure.rows) + 1), figure.rows)
        axes.set_ylim(len(figure.rows) + 0.6, 0.4)
    else:
        axes.legend(fontsize=7, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.15))
