"""HTML report of one flight or two, in a single file that opens offline (plotly is embedded)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from typing import NamedTuple

from companion import __version__
from companion.analysis import error_statistics
from companion.analysis.assessment import Assessment
from companion.analysis.drawing import to_plotly
from companion.analysis.plot_data import Figure
from companion.analysis.summary import (
    compare_flights,
    format_duration,
    format_length,
    format_time,
    summarize_flight,
)
from companion.importers.gnss_latency import describe_latency
from companion.storage.run_metadata import CONFIGURATION

#: Chapters in order: title and its figures.
CHAPTERS = (
    ("Track", ("track",)),
    ("Errors", ("error",)),
    ("Guaranteed bound", ("bound",)),
    ("Consistency", ("consistency",)),
    ("Inertial channel and prediction", ("inertial_north", "inertial_east", "ahead")),
    ("Sources", ("sources",)),
    ("Messages and clock", ("rates", "latency", "timesync")),
    ("Events", ()),
    ("Configuration", ()),
)
BOOTED_NS = 10**18  # earlier than 2001: the clock counts from power-up
EVENTS = 400  # maximum number of events shown


class ReportBlock(NamedTuple):
    """A section of the report: one flight, or two compared flights, with names and figures."""

    names: Sequence[str]
    flights: Sequence[Assessment]
    figures: Sequence[Figure]


def render_report(title: str, blocks: Sequence[ReportBlock]) -> str:
    """Return the HTML: first the summaries, then the chapters of each block.

    Raises ModuleNotFoundError if plotly is missing.
    """
    from plotly.offline import get_plotlyjs

    here = files("companion.analysis")
    keys = [f"flight{k}_" for k in range(1, len(blocks) + 1)] if len(blocks) > 1 else [""]
    drawn = {
        key + figure.key: to_plotly(figure) for key, block in zip(keys, blocks) for figure in block.figures
    }
    data = json.dumps(drawn, separators=(",", ":"))
    data = data.replace("</", r"<\/")  # text from the log must not close the script element
    return "".join(
        (
            "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>",
            "<meta name='viewport' content='width=device-width, initial-scale=1'>",
            "<link rel='icon' href='data:,'>",
            f"<title>{escape(title)}: flight report</title>",
            f"<style>{here.joinpath('report.css').read_text('utf-8')}</style></head><body>",
            _head(title, blocks),
            *(_block(key, block, len(blocks) > 1) for key, block in zip(keys, blocks)),
            f"<footer>companion {__version__}</footer>",
            f"<script>{get_plotlyjs()}</script>",
            f"<script type='application/json' id='figures'>{data}</script>",
            f"<script>{here.joinpath('report.js').read_text('utf-8')}</script></body></html>\n",
        )
    )


def _head(title: str, blocks: Sequence[ReportBlock]) -> str:
    parts = [f"<header><p class='kind'>Flight report</p><h1>{escape(title)}</h1>"]
    if len(blocks) > 1:
        parts.append(
            f"<p class='when'>The autopilot rebooted {_times(len(blocks) - 1)}. The log contains "
            f"{len(blocks)} flights; each has its own chapters.</p>"
        )
    for block in blocks:
        if len(block.flights) == 2:
            parts.append(f"<p class='summary'>{escape(compare_flights(*block.flights))}</p>")
        for a, name in zip(block.flights, block.names, strict=True):
            named = f"<b class='log'>{escape(name)}</b>" if len(blocks) + len(block.flights) > 2 else ""
            parts.append(_summary(a, named))
    parts.append("<p class='when'>Drag across a plot to zoom; double-click to reset the view.</p>")
    return "".join(parts) + "</header>"


def _times(n: int) -> str:
    return {1: "once", 2: "twice"}.get(n, f"{n} times")


def _summary(a: Assessment, named: str) -> str:
    """Return the summary, tiles and date of one flight."""
    when = "Date unknown"
    if a.flight.unix_ns > BOOTED_NS:
        when = datetime.fromtimestamp(a.flight.unix_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    version = a.flight.metadata.get("companion", {}).get("version")
    flown = f", navigator of companion {escape(version)}" if version else ""
    warn = " bad" if any(row.held is False for row in a.rows) else ""
    return (
        f"<p class='summary{warn}'>{named}{escape(summarize_flight(a))}</p>{_tiles(a)}"
        f"<p class='when'>{when}{flown}; times are relative to its first message.</p>"
    )


def _block(key: str, block: ReportBlock, headed: bool) -> str:
    """Return the chapters of one block; `key` is the prefix of its element ids."""
    drawn = {figure.key: figure for figure in block.figures}
    tables = {
        "Errors": _phases,
        "Consistency": _consistency,
        "Sources": _rejections,
        "Messages and clock": _messages,
        "Events": _events,
        "Configuration": _configuration,
    }
    chapters = []
    for title, keys in CHAPTERS:
        inner = "".join(_figure(key, drawn[k]) for k in keys if k in drawn)
        if title in tables:
            inner += _tables_of(block, tables[title])
        if title == "Configuration" and len(block.flights) == 2:
            inner = _differences(block.flights, block.names) + inner
        if inner:
            chapters.append((title, key + title.lower().replace(" ", "-"), inner))
    return "".join(
        (
            f"<h2 class='flight'>{escape(block.names[0])}</h2>" if headed else "",
            "<nav>",
            *(f"<a href='#{anchor}'>{title}</a>" for title, anchor, _ in chapters),
            "</nav><main>",
            *(
                f"<section id='{anchor}'><h2>{title}</h2>{inner}</section>"
                for title, anchor, inner in chapters
            ),
            "</main>",
        )
    )


def _tiles(a: Assessment) -> str:
    corrected = a.errors.get(error_statistics.CORRECTED)
    worst = max((outage.end - outage.start for outage in a.outages), default=0.0)
    held = [row.held for row in a.rows if row.held is not None]
    tiles = [
        ("duration", format_duration(a.flight.seconds)),
        ("longest without GNSS", format_duration(worst) if worst else "–"),
    ]
    tiles.append(("largest error", "–" if corrected is None else format_length(float(corrected.error.max()))))
    tiles.append(("bound held in phases", f"{sum(held)} of {len(held)}" if held else "–"))
    inner = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in tiles)
    return f"<dl class='tiles'>{inner}</dl>"


def _figure(key: str, figure: Figure) -> str:
    note = f"<p class='note'>{escape(figure.note)}</p>" if figure.note else ""
    kind = "plot equal" if figure.equal else "plot rows" if figure.rows else "plot"
    caption = f"<figcaption>{escape(figure.title)}</figcaption>"
    return f"<figure>{caption}<div class='{kind}' id='plot-{key}{figure.key}'></div>{note}</figure>"


def _tables_of(block: ReportBlock, table: Callable[[Assessment], str]) -> str:
    """Return a table for each flight, headed by its name if there are two."""
    inner = [(name, table(a)) for a, name in zip(block.flights, block.names, strict=True)]
    if len(inner) == 1:
        return inner[0][1]
    return "".join(f"<h3>{escape(name)}</h3>{html}" for name, html in inner if html)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], kind: str = "") -> str:
    """Return a table; on narrow screens tables of kind "cards" show each row as a card."""
    labels = [escape(name) for name in head]
    body = ""
    for row in rows:
        pairs = zip(labels, row, strict=True)
        cells = (f"<td data-label='{label}'>{escape(cell)}</td>" for label, cell in pairs)
        body += f"<tr>{''.join(cells)}</tr>"
    titles = "".join(f"<th>{label}</th>" for label in labels)
    return (
        f"<div class='scroll'><table class='{kind}'><thead><tr>{titles}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


# -- tables ----------------------------------------------------------------------------------------------


def _phases(a: Assessment) -> str:
    if not a.rows or not a.errors:
        return (
            "<p class='note'>No errors are available: the log has neither a truth nor a track to smooth.</p>"
        )
    sources = [source for source in error_statistics.SOURCES if source in a.errors]
    head = ["phase", "from", "lasts", *sources, "bound, r.m.s.", "error / bound", "held", "within", "twice"]
    rows: list[list[str]] = []
    for row, phase in zip(a.rows, a.phases, strict=True):
        cells = [row.phase, format_time(phase.start_ns * 1e-9), format_duration(row.seconds)]
        for source in sources:
            known = source in row.rms
            cells.append(_both(row.rms[source], row.p95[source]) if known else "–")
        cells.append("–" if row.bound is None else format_length(row.bound))
        cells.append("–" if row.share is None else f"{row.share:.2f}")
        cells.append("–" if row.held is None else "yes" if row.held else "NO")
        cells += ["–" if k is None else f"{100.0 * k:.0f} %" for k in (row.inside, row.inside_twice)]
        rows.append(cells)
    about = (
        ""
        if a.reference is None
        else f"Horizontal errors against {a.reference.what}: r.m.s. / 95th percentile. "
    )
    note = (
        f"{about}The bound limits the r.m.s. error: it held if error / bound (r.m.s. of the phase) is "
        "at most 1. Within, twice: share of moments with an error within the bound and twice the bound."
    )
    return _table(head, rows, "cards") + f"<p class='note'>{escape(note)}</p>"


def _both(rms: float, p95: float) -> str:
    """Format two lengths; the unit is written once if both have the same."""
    first, second = format_length(rms), format_length(p95)
    same = first.split()[-1] == second.split()[-1]
    return f"{first.split()[0] if same else first} / {second}"


def _consistency(a: Assessment) -> str:
    if not a.normalized_errors:
        return "<p class='note'>The log has no data to compare with covariances.</p>"
    rows = [
        (m.what, f"{len(m.t)}", f"{m.mean:.2f}", f"{100.0 * m.inside:.1f} %") for m in a.normalized_errors
    ]
    table = _table(("what", "number", "mean / degrees of freedom", "within 95 %"), rows)
    note = (
        "NEES: error of the estimate against the truth. NIS: innovation of each fix. Fix residuals: those "
        "of a fix from several lines of position. A consistent filter has a mean of about 1 and 95 % within."
    )
    return f"{table}<p class='note'>{note}</p>"


def _rejections(a: Assessment) -> str:
    if not a.groups:
        return "<p class='note'>No measurement was rejected.</p>"
    counts: dict[tuple[str, str], list[float]] = {}
    for group in a.groups:
        known = counts.setdefault((group.source, group.reason), [0, 0, group.start, group.end])
        known[0] += group.number
        known[1] += 1
        known[3] = group.end
    rows = [
        (source, reason, f"{n:.0f}", f"{events:.0f}", format_time(first), format_time(last))
        for (source, reason), (n, events, first, last) in counts.items()
    ]
    return _table(("rejected", "reason", "number", "events", "first", "last"), rows, "cards")


def _messages(a: Assessment) -> str:
    rows = [
        (
            r.topic.lstrip("/"),
            f"{r.number}",
            f"{r.hz:.2f}" if r.number > 1 else "–",
            f"{r.gap:.2f}" if r.number > 1 else "–",
            format_time(r.gap_at),
            f"{1e3 * r.latency:.0f} / {1e3 * r.latency_95:.0f}" if r.latency == r.latency else "–",
        )
        for r in a.rates
    ]
    table = _table(("topic", "number", "Hz", "gap, s", "at", "latency, ms"), rows, "small")
    links = [
        (
            link,
            *(f"{t[column][-1]:.0f}" for column in ("received", "lost", "bad", "dropped")),
        )
        for link, t in a.flight.links.items()
    ]
    if links:
        table += _table(("link", "received", "lost", "bad", "dropped"), links, "small")
    latencies = [describe_latency(found) + "." for found in a.flight.latencies]
    note = " ".join(
        ["Gap: the longest time between two arrivals. Latency: median / 95th percentile.", *latencies]
    )
    return f"{table}<p class='note'>{escape(note)}</p>"


def _events(a: Assessment) -> str:
    rows = [(format_time(line.t), line.kind, line.text) for line in a.timeline[:EVENTS]]
    more = len(a.timeline) - len(rows)
    note = f"<p class='note'>{more} more events are in the log.</p>" if more else ""
    return f"<div class='long'>{_table(('at', 'what', 'text'), rows, 'events')}</div>{note}"


def _configuration(a: Assessment) -> str:
    parts = []
    for name, values in a.flight.metadata.items():
        text = values.get("toml") if name == CONFIGURATION else None
        text = "\n".join(f"{key} = {value}" for key, value in values.items()) if text is None else text
        parts.append(f"<details><summary>{escape(name)}</summary><pre>{escape(text)}</pre></details>")
    return "".join(parts) or "<p class='note'>The log does not contain its configuration.</p>"


def _differences(flights: Sequence[Assessment], names: Sequence[str]) -> str:
    """Return a table of the keys in which two configurations differ."""
    texts = [a.flight.metadata.get(CONFIGURATION, {}).get("toml", "") for a in flights]
    settings = [_settings(text) for text in texts]
    keys = [key for key in {**settings[0], **settings[1]} if settings[0].get(key) != settings[1].get(key)]
    if not keys:
        return "<p class='note'>Both flights had the same configuration.</p>"
    return _table(("key", *names), [(key, *(s.get(key, "–") for s in settings)) for key in keys])


def _settings(toml: str) -> dict[str, str]:
    found, section = {}, ""
    for line in toml.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif " = " in line:
            key, value = line.split(" = ", 1)
            found[f"{section}.{key}"] = value
    return found
