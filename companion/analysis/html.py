"""HTML report of one flight or several, in a single file that opens offline.

Templates escape every text; figures are embedded as JSON with `<`, `>` and `&` escaped, so that no text of a
log can end an element or begin one.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from importlib.resources import files
from typing import Any, NamedTuple

from companion import __version__
from companion.analysis import error_statistics
from companion.analysis.assessment import Assessment, deviation
from companion.analysis.drawing import to_page
from companion.analysis.flight_arrays import TimelineEntry
from companion.analysis.flight_events import phase_title, reason_title, source_title, topic_name
from companion.analysis.plot_data import Figure
from companion.analysis.summary import (
    BY_BEACONS,
    WITH_GNSS,
    WITHOUT,
    count_held,
    describe_outage,
    describe_worst,
    format_duration,
    format_length,
    format_share,
    format_time,
    rms_by_source,
    summarize_flight,
    worst_of,
)
from companion.analysis.verdict import Verdict, judge_flight
from companion.importers.gnss_latency import describe_latency
from companion.records import Severity
from companion.storage.run_metadata import CONFIGURATION

#: Chapters in order: title and its figures. The one without a title is "Errors", or "Distances" where there
#: is no truth.
CHAPTERS = (
    ("Map", ("map",)),
    ("", ("error", "bound")),
    ("Sources", ("sources",)),
    ("Events", ()),
    ("Consistency", ("consistency",)),
    ("Inertial channel", ("inertial_north", "inertial_east", "ahead")),
    ("Messages and clock", ("rates", "latency", "timesync")),
    ("Configuration", ()),
)
BOOTED_NS = 10**18  # earlier than 2001: the clock counts from power-up
EVENTS = 400  # maximum number of events shown
NO_NUMBER = "–"


class ReportBlock(NamedTuple):
    """A section of the report: one flight, or several compared, with names and figures."""

    names: Sequence[str]
    flights: Sequence[Assessment]
    figures: Sequence[Figure]


class Cell(NamedTuple):
    """Text of a table with the level of its colour."""

    text: str
    level: str


class Table(NamedTuple):
    """A table: head, rows of texts or cells; on narrow screens the kind "cards" shows each row as a card."""

    head: Sequence[str]
    rows: Sequence[Sequence[str | Cell]]
    kind: str = ""
    note: str = ""
    title: str = ""


class Text(NamedTuple):
    """A folded text, such as a configuration."""

    title: str
    text: str


class Summary(NamedTuple):
    """Top of the report for one flight."""

    name: str
    verdict: Verdict
    tiles: Sequence[tuple[str, str]]
    facts: Sequence[str]
    when: str


class Chapter(NamedTuple):
    """A chapter of the page: id, title, figures with their ids, tables, folded texts."""

    anchor: str
    title: str
    figures: Sequence[tuple[str, Figure]]
    tables: Sequence[Table]
    texts: Sequence[Text]


def render_report(title: str, blocks: Sequence[ReportBlock]) -> str:
    """Return the HTML: the verdicts first, then the chapters of each block.

    Raises ModuleNotFoundError if jinja2 is missing.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    page = Environment(
        loader=PackageLoader("companion.analysis", "web"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    keys = [f"flight{k}_" for k in range(1, len(blocks) + 1)] if len(blocks) > 1 else [""]
    drawn = {
        key + figure.key: to_page(figure) for key, block in zip(keys, blocks) for figure in block.figures
    }
    several = sum(len(block.flights) for block in blocks) > 1
    text: str = page.get_template("report.html.j2").render(
        title=title,
        version=__version__,
        asset=lambda name: Markup(files("companion.analysis").joinpath("web", name).read_text("utf-8")),
        reboots=len(blocks) - 1,
        summaries=[
            _summary(a, name if several else "")
            for block in blocks
            for a, name in zip(block.flights, block.names, strict=True)
        ],
        comparisons=[comparison_table(block) for block in blocks if len(block.flights) > 1],
        blocks=[
            (block.names[0] if len(blocks) > 1 else "", _chapters(key, block))
            for key, block in zip(keys, blocks)
        ],
        figures=drawn,
    )
    return text


def _summary(a: Assessment, name: str) -> Summary:
    when = "Date unknown"
    if a.flight.unix_ns > BOOTED_NS:
        when = datetime.fromtimestamp(a.flight.unix_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    version = a.flight.metadata.get("companion", {}).get("version")
    flown = f", navigator of companion {version}" if version else ""
    return Summary(
        name,
        judge_flight(a),
        _tiles(a),
        summarize_flight(a),
        f"{when}{flown}. Times are minutes:seconds since its first message.",
    )


def _tiles(a: Assessment) -> list[tuple[str, str]]:
    worst = worst_of(a)
    return [
        ("duration", format_duration(a.flight.seconds)),
        ("longest without GNSS", describe_outage(a)),
        (describe_worst(a), format_length(worst.estimate)),
        ("farthest GNSS fix", format_length(worst.gnss)),
        (
            "bound held in phases",
            count_held(a) if any(row.bound is not None for row in a.rows) else NO_NUMBER,
        ),
    ]


def comparison_table(block: ReportBlock) -> Table:
    """Return a row for each flight of a block: verdict, duration, outage, errors."""
    rows: list[Sequence[str | Cell]] = []
    for a, name in zip(block.flights, block.names, strict=True):
        verdict = judge_flight(a)
        reference = NO_NUMBER if a.reference is None else a.reference.what
        rms = rms_by_source(a)
        rows.append(
            (
                name,
                Cell(verdict.word, verdict.level),
                format_duration(a.flight.seconds),
                describe_outage(a),
                *(format_length(rms.get(how, math.nan)) for how in (WITH_GNSS, BY_BEACONS, WITHOUT)),
                format_length(worst_of(a).estimate),
                reference,
            )
        )
    head = (
        "log",
        "verdict",
        "lasts",
        "GNSS lost for",
        f"r.m.s. {WITH_GNSS}",
        BY_BEACONS,
        WITHOUT,
        "greatest",
        "against",
    )
    same = len({a.reference.what if a.reference else "" for a in block.flights}) == 1
    note = "" if same else "The logs have different references; compare with care."
    return Table(head, rows, "cards", note, "Comparison")


def _chapters(key: str, block: ReportBlock) -> list[Chapter]:
    """Return the chapters of one block; `key` is the prefix of its element ids."""
    drawn = {figure.key: figure for figure in block.figures}
    errors = f"{deviation(*block.flights).title()}s"
    tables = {
        errors: _phases,
        "Consistency": _consistency,
        "Sources": _rejections,
        "Messages and clock": _messages,
        "Events": _events,
    }
    chapters = []
    for name_of, keys in CHAPTERS:
        title = name_of or errors
        figures = [(key + k, drawn[k]) for k in keys if k in drawn]
        found: list[Table] = []
        texts: list[Text] = []
        for a, name in zip(block.flights, block.names, strict=True):
            heading = name if len(block.flights) > 1 else ""
            if title in tables:
                found += [t._replace(title=heading) for t in tables[title](a) if t.rows or t.note]
            elif title == "Configuration":
                texts += _configuration(a, f"{heading}: " if heading else "")
        if title == "Configuration" and len(block.flights) > 1:
            found.append(_differences(block.flights, block.names))
        if figures or found or texts:
            chapters.append(Chapter(key + title.lower().replace(" ", "-"), title, figures, found, texts))
    return chapters


# -- tables ----------------------------------------------------------------------------------------------


def _phases(a: Assessment) -> list[Table]:
    if not a.rows:
        return [Table((), (), note="There is no estimate.")]
    if not a.errors:
        return [Table((), (), note="There is nothing to compare the estimate with.")]
    sources = [source for source in error_statistics.SOURCES if source in a.errors]
    titles = {
        error_statistics.CORRECTED: "estimate",
        error_statistics.INS: "inertial alone",
        error_statistics.RSBN: "beacon",
        error_statistics.GNSS: "GNSS",
    }
    names = [titles.get(source, source) for source in sources]
    head = ["phase", "from", "lasts", *names, "bound", f"{deviation(a)} / bound", "held", "within", "twice"]
    rows: list[list[str | Cell]] = []
    for row, phase in zip(a.rows, a.phases, strict=True):
        cells: list[str | Cell] = [
            phase_title(row.phase),
            format_time(phase.start_ns * 1e-9),
            format_duration(row.seconds),
        ]
        for source in sources:
            known = source in row.rms
            cells.append(_both(row.rms[source], row.p95[source]) if known else NO_NUMBER)
        bound = NO_NUMBER if row.bound is None else format_length(row.bound)
        cells.append(bound if row.bound is None or row.useful else "no useful bound")
        cells.append(NO_NUMBER if row.share is None else f"{row.share:.2f}")
        held = Cell("yes", "good") if row.held else Cell("no", "fault")
        cells.append(NO_NUMBER if row.held is None else held)
        cells += [NO_NUMBER if k is None else format_share(k) for k in (row.inside, row.inside_twice)]
        rows.append(cells)
    what = deviation(a)
    about = (
        ""
        if a.reference is None
        else f"Horizontal {what}s from {a.reference.what}: r.m.s. / 95th percentile. "
    )
    note = (
        f"{about}The bound held if every {what} of the phase was within the bound of its moment. Within, "
        f"twice: share of moments with the {what} within the bound and twice the bound. No useful bound: "
        "above ten times the sigma that the estimate claims, or above 5 km."
    )
    return [Table(head, rows, "cards", note)]


def _both(rms: float, p95: float) -> str:
    """Format two lengths; the unit is written once if both have the same."""
    first, second = format_length(rms), format_length(p95)
    same = first.split()[-1] == second.split()[-1]
    return f"{first.split()[0] if same else first} / {second}"


_CONSISTENCY = {
    "NEES": "error of the estimate against the truth",
    "lines of position": "residuals of fixes from more of them than are needed",
}


def _consistency(a: Assessment) -> list[Table]:
    if not a.normalized_errors:
        return [Table((), (), note="The log has no data to compare with covariances.")]
    rows = [(m.what, f"{len(m.t)}", f"{m.mean:.2f}", format_share(m.inside)) for m in a.normalized_errors]
    shown = "".join(f"{m.what}: {_CONSISTENCY[m.what]}. " for m in a.normalized_errors)
    note = f"{shown}A consistent filter has a mean of about 1 and 95 % within."
    return [Table(("what", "number", "mean / degrees of freedom", "within 95 %"), rows, note=note)]


def _rejections(a: Assessment) -> list[Table]:
    if not a.groups:
        return [Table((), (), note="No measurement was rejected.")]
    counts: dict[tuple[str, str], list[float]] = {}
    for group in a.groups:
        known = counts.setdefault((group.source, group.reason), [0, 0, group.start, group.end])
        known[0] += group.number
        known[1] += 1
        known[3] = group.end
    rows = [
        (
            source_title(source),
            reason_title(reason),
            f"{n:.0f}",
            f"{events:.0f}",
            format_time(first),
            format_time(last),
        )
        for (source, reason), (n, events, first, last) in counts.items()
    ]
    return [Table(("rejected", "reason", "number", "events", "first", "last"), rows, "cards")]


def _messages(a: Assessment) -> list[Table]:
    rows = [
        (
            topic_name(r.topic),
            f"{r.number}",
            f"{r.hz:.2f}" if r.number > 1 else NO_NUMBER,
            f"{r.gap:.2f}" if r.number > 1 else NO_NUMBER,
            format_time(r.gap_at),
            f"{1e3 * r.latency:.0f} / {1e3 * r.latency_95:.0f}" if r.latency == r.latency else NO_NUMBER,
        )
        for r in a.rates
    ]
    links = [
        (
            link,
            *(f"{t[column][-1]:.0f}" for column in ("received", "lost", "bad", "dropped")),
        )
        for link, t in a.flight.links.items()
    ]
    latencies = [describe_latency(found) + "." for found in a.flight.latencies]
    note = " ".join(
        ["Gap: the longest time between two arrivals. Age: median / 95th percentile on arrival.", *latencies]
    )
    return [
        Table(("message", "number", "Hz", "gap, s", "at", "age, ms"), rows, "small", note),
        Table(("link", "frames received", "lost", "bad", "dropped"), links, "small"),
    ]


def _events(a: Assessment) -> list[Table]:
    rows = [(format_time(line.t), _severity(line), line.text) for line in a.timeline[:EVENTS]]
    more = len(a.timeline) - len(rows)
    note = f"{more} more events are in the log." if more else ""
    return [Table(("at", "what", "text"), rows, "events", note)]


def _severity(line: TimelineEntry) -> Cell:
    """Return what a line of the timeline is: an event by its severity, in the colour of it."""
    name = Severity(line.severity).name.lower() if line.kind == "event" else line.kind
    warns, fails = line.severity <= Severity.WARNING, line.severity <= Severity.ERROR
    return Cell(name, "fault" if fails else "caution" if warns else "")


def _configuration(a: Assessment, heading: str) -> list[Text]:
    texts = []
    for name, values in a.flight.metadata.items():
        text = values.get("toml") if name == CONFIGURATION else None
        text = "\n".join(f"{key} = {value}" for key, value in values.items()) if text is None else text
        texts.append(Text(heading + name, text))
    return texts or [Text(f"{heading}the log does not contain its configuration", "")]


def _differences(flights: Sequence[Assessment], names: Sequence[str]) -> Table:
    """Return a table of the keys in which configurations differ."""
    texts = [a.flight.metadata.get(CONFIGURATION, {}).get("toml", "") for a in flights]
    settings = [_settings(text) for text in texts]
    keys: Iterable[str] = dict.fromkeys(key for one in settings for key in one)
    rows = [
        (key, *(one.get(key, NO_NUMBER) for one in settings))
        for key in keys
        if len({one.get(key) for one in settings}) > 1
    ]
    note = "" if rows else "All flights had the same configuration."
    return Table(("key", *names), rows, note=note, title="Differences")


def _settings(toml: str) -> dict[str, Any]:
    found, section = {}, ""
    for line in toml.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif " = " in line:
            key, value = line.split(" = ", 1)
            found[f"{section}.{key}"] = value
    return found
