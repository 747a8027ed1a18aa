"""Summary page of many flights: one HTML file that loads nothing; the worst flights first."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from typing import TYPE_CHECKING

from companion import __version__
from companion.analysis.html import Cell
from companion.analysis.summary import format_duration, format_length

if TYPE_CHECKING:
    from companion.analysis.fleet import FlightRow

SHOWN = 1000
POLICY = "default-src 'none'; style-src 'unsafe-inline'"
HEADS = ("flight", "verdict", "start, UTC", "lasts", "longest without GNSS")
MORE_HEADS = (
    *("largest error", "r.m.s.", "largest, inertial channel alone"),
    *("bound held in phases", "rejected", "warnings"),
)


def render_page(rows: Sequence[FlightRow]) -> str:
    """Return the page of `rows`, which are sorted with the worst first."""
    good = [row for row in rows if row.reason is None]
    bad = [row for row in rows if row.reason is not None]
    tiles = {
        "flights": str(len(good)),
        "total duration": format_duration(sum(row.duration_s for row in good)),
        "largest error": format_length(
            max((row.largest_m for row in good if row.largest_m is not None), default=math.nan)
        ),
        "logs not readable": str(len(bad)),
    }
    style = files("companion.analysis").joinpath("web", "style.css").read_text("utf-8")
    return "".join(
        (
            "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width, initial-scale=1'>",
            f"<meta http-equiv='Content-Security-Policy' content=\"{POLICY}\">",
            f"<title>Flights</title><style>{style}</style></head><body>",
            "<header><p class='kind'>Summary of flights</p><h1>Worst flights first</h1>",
            "<dl class='tiles'>",
            *(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in tiles.items()),
            "</dl><p class='when'>Errors are horizontal, relative to the truth of the log or to its smoothed "
            "track. All rows are in flights.parquet.</p></header><main>",
            _section(
                "Flights", "flights", (*HEADS, *MORE_HEADS), [_flight_cells(row) for row in good[:SHOWN]]
            ),
            _section("Not readable", "logs", ("log", "reason"), [_reason_cells(row) for row in bad[:SHOWN]]),
            f"</main><footer>companion {__version__}</footer></body></html>\n",
        )
    )


def _section(title: str, kind: str, heads: Sequence[str], rows: Sequence[Sequence[str | Cell]]) -> str:
    """Return a table of the CSS class `kind`; the cells are HTML."""
    if not rows:
        return ""
    head = "".join(f"<th>{name}</th>" for name in heads)
    body = "".join(
        "<tr>" + "".join(_td(name, cell) for name, cell in zip(heads, row, strict=True)) + "</tr>"
        for row in rows
    )
    return (
        f"<section><h2>{title}</h2><div class='scroll'><table class='cards {kind}'>"
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div></section>"
    )


def _td(name: str, cell: str | Cell) -> str:
    text, kind = (cell.text, f" class='{cell.level}'") if isinstance(cell, Cell) else (cell, "")
    return f"<td data-label='{name}'{kind}>{text}</td>"


def _flight_cells(row: FlightRow) -> list[str | Cell]:
    name = escape(row.log.rpartition("/")[2]) + (
        f", {row.flight} of {row.flights}" if row.flights > 1 else ""
    )
    title = escape(row.log)
    named = f"<span title='{title}'>{name}</span>"
    if row.report:
        named = f"<a href='{escape(row.report)}' title='{title}'>{name}</a>"
    verdict, why = escape(row.verdict or "–"), escape(row.verdict_reason or "")
    return [
        named,
        Cell(f"<span title='{why}'>{verdict}</span>", verdict.lower()),
        (row.start_utc or "–").replace("T", " ").removesuffix("+00:00"),
        format_duration(row.duration_s),
        format_duration(row.gnss_outage_s) if row.gnss_outage_s else "–",
        *(("–" if v is None else format_length(v)) for v in (row.largest_m, row.rms_m, row.ins_largest_m)),
        f"{row.phases_held} of {row.phases_bound}" if row.phases_bound else "–",
        str(row.rejections),
        str(row.warnings),
    ]


def _reason_cells(row: FlightRow) -> list[str]:
    return [escape(row.log), escape(row.reason or "")]
