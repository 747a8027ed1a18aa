"""Figures of the report: plots of one flight, or of several in the same axes.

One flight shows its sources in the colours of their roles; several flights show their estimates only, each
in the colour of its log.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import Assessment, chi2_95, deviation
from companion.analysis.flight_arrays import AHEAD
from companion.analysis.map_figure import build_map
from companion.analysis.plot_data import (
    COLOURS,
    LETTERS,
    LOGS,
    Figure,
    Line,
    Mark,
    Style,
    cut_at_gaps,
    subsample,
    thin_line,
)
from companion.records import Severity, Source
from companion.units import Floats

MARKS = 60  # events marked in a plot, the most severe first


def build_figures(flights: Sequence[Assessment]) -> list[Figure]:
    """Build every figure that has data, for one flight or several (A, B, ... in the legends)."""
    found = [build(_Axes(flights)) for build in _BUILDERS]
    return [figure for figure in found if any(len(line.x) for line in figure.lines)]


class _Axes:
    """Flights that share the axes of a figure, with the colours, spans and marks of the figure."""

    def __init__(self, flights: Sequence[Assessment]) -> None:
        self.flights = flights
        self.alone = len(flights) == 1
        self.prefixes = [""] if self.alone else [f"{letter} " for letter, _ in zip(LETTERS, flights)]

    def each(self) -> Iterator[tuple[int, Assessment, str]]:
        """Yield number, flight and the prefix of its names."""
        yield from zip(range(len(self.flights)), self.flights, self.prefixes, strict=True)

    def line(self, name: str, role: str, which: int, t: Floats, y: Floats, **more: object) -> Line:
        """Build a line over time, in order of time, with a gap where nothing came."""
        t, y = _in_order(t, y)
        x, y = thin_line(t, y)
        if more.get("style") != "dots":
            x, y = cut_at_gaps(x, t, flight_events.longest_step(t), y)
        return Line(name, x, y, self._colour(role, which), **more)  # type: ignore[arg-type]

    def bar(self, name: str, role: str, which: int, t: Floats, y: Floats) -> Line:
        """Build a bar over time: from and to where y is known and something came."""
        t, y = _in_order(t, y)
        x, y = thin_line(*_runs(*cut_at_gaps(t, t, flight_events.longest_step(t), y)))
        return Line(name, x, y, self._colour(role, which), width=8.0)

    def _colour(self, role: str, which: int) -> tuple[str, str]:
        return COLOURS[role] if self.alone else LOGS[which % len(LOGS)]

    def over_time(
        self, key: str, title: str, unit: str, lines: list[Line], note: str = "", **more: object
    ) -> Figure:
        """Build a figure with the spans and marks of the flight; several flights would overlap."""
        spans, marks = (self._spans(), self._marks()) if self.alone else ((), ())
        return Figure(key, title, unit, lines, note, spans=spans, marks=marks, **more)  # type: ignore[arg-type]

    def _spans(self) -> tuple[tuple[float, float, str], ...]:
        """Return the phases without fixes."""
        return tuple(
            (phase.start_ns * 1e-9, phase.end_ns * 1e-9, "no fixes")
            for phase in self.flights[0].phases
            if phase.name in flight_events.WITHOUT_FIXES
        )

    def _marks(self) -> tuple[Mark, ...]:
        entries = sorted(self.flights[0].timeline, key=lambda entry: entry.severity)[:MARKS]
        return tuple(Mark(e.t, e.text, e.severity <= Severity.WARNING) for e in sorted(entries))


def _in_order(t: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return times and values in order of time; of two at the same time the later one holds."""
    t = np.asarray(t, dtype=np.float64)
    if len(t) > 1 and not (np.diff(t) > 0.0).all():
        t, last = np.unique(t[::-1], return_index=True)
        y = y[::-1][last]
    return t, y


# -- errors ----------------------------------------------------------------------------------------------


def _error(axes: _Axes) -> Figure:
    shown: tuple[tuple[str, str, Style], ...] = (
        (error_statistics.RSBN, "beacon positions", "dots"),
        (error_statistics.GNSS, "GNSS", "dots"),
        (error_statistics.INS, "inertial channel alone", "line"),
        (error_statistics.CORRECTED, "estimate", "line"),
    )
    lines = []
    for which, a, prefix in axes.each():
        for source, name, style in shown if axes.alone else shown[-1:]:
            if (e := a.errors.get(source)) is not None:
                error = np.maximum(e.error, 0.01)
                lines.append(axes.line(prefix + name, source, which, e.t, error, style=style))
        if (e := a.errors.get(error_statistics.CORRECTED)) is not None and np.isfinite(e.bound).any():
            lines.append(axes.line(f"{prefix}guaranteed bound", "bound", which, e.t, e.bound, dash=True))
        if axes.alone and np.isfinite((s := a.flight.tables["Solution"])["protection"]).any():
            level = s["protection"]
            lines.append(axes.line("protection level", "second", which, s["t"], level, dash=True, width=1.1))
    references = dict.fromkeys(a.reference.what for a in axes.flights if a.reference is not None)
    return axes.over_time(
        "error",
        "Error of the position"
        if deviation(*axes.flights) == "error"
        else f"Distance from {' or '.join(references) or 'a reference'}",
        "m",
        lines,
        f"Logarithmic. {'Shaded: no fixes. ' * axes.alone}{_limits(axes)}",
        log=True,
    )


def _limits(axes: _Axes) -> str:
    """Describe what the guaranteed bound and the protection level limit."""
    if deviation(*axes.flights) == "error":
        return (
            "The r.m.s. error must stay below the guaranteed bound, every error below the protection level."
        )
    return (
        "The guaranteed bound and the protection level limit how far the estimate is from where the aircraft "
        "was; the reference may itself be off."
    )


def _ratio(axes: _Axes) -> Figure:
    what = deviation(*axes.flights)
    lines = []
    for which, a, prefix in axes.each():
        if (e := a.errors.get(error_statistics.CORRECTED)) is not None and np.isfinite(e.bound).any():
            share = np.maximum(e.error / e.bound, 1e-4)
            name = f"{prefix}{what} / bound"
            lines.append(axes.line(name, error_statistics.CORRECTED, which, e.t, share))
    return axes.over_time(
        "bound",
        f"{what.title()} divided by the guaranteed bound",
        "× bound",
        lines,
        f"Above 1 the {what} exceeded the bound. The bound limits the r.m.s. of a phase: single moments "
        "above 1 are allowed.",
        log=True,
        level=1.0,
    )


def _misfit(axes: _Axes) -> Figure:
    roles = {"NEES": error_statistics.CORRECTED, "lines of position": error_statistics.RSBN}
    lines = []
    for which, a, prefix in axes.each():
        for series in a.normalized_errors:
            style: Style = "line" if series.what == "NEES" else "dots"
            value = np.maximum(series.value / chi2_95(series.degrees_of_freedom), 1e-4)
            name = prefix + series.what
            lines.append(axes.line(name, roles[series.what], which, series.t, value, style=style))
    return axes.over_time(
        "consistency",
        "Consistency with the stated sigmas",
        "× limit",
        lines,
        "Squared deviations divided by their covariance and by the 95 % limit of chi-square. About 5 % "
        "of the values should be above 1; if none are, the sigmas are too large.",
        log=True,
        level=1.0,
    )


# -- the inertial channel --------------------------------------------------------------------------------


def _inertial(axis: str) -> Callable[[_Axes], Figure]:
    def build(axes: _Axes) -> Figure:
        true = deviation(*axes.flights) == "error"
        lines = []
        for which, a, prefix in axes.each():
            s = a.flight.tables["Solution"]
            estimated, bound = s[f"error_{axis}"], s[f"bound_{axis}"]
            alone = flight_events.without_fixes(s)
            for sign, name in ((1.0, f"{prefix}estimated ± bound"), (-1.0, "")):
                edge = np.where(alone, estimated + sign * bound, np.nan)
                if axes.alone and np.isfinite(edge).any():
                    lines.append(axes.line(name, "bound", which, s["t"], edge, dash=True, width=1.0))
            if a.offset and a.reference:
                against, actual = f"{prefix}by {a.reference.what}", a.offset[axis] + estimated
                lines.append(axes.line(against, "reference", which, s["t"], actual, width=2.2))
            lines.append(axes.line(f"{prefix}estimated", error_statistics.INS, which, s["t"], estimated))
        return axes.over_time(
            f"inertial_{axis}",
            f"{'Error' if true else 'Correction'} of the inertial channel, {axis}",
            "m",
            lines,
            "The estimated error, which is subtracted; the actual one; the bound where there were no fixes."
            if true
            else "What the estimate subtracts; the distance of the inertial channel from the reference; the "
            "bound where there were no fixes.",
            view=_near([line for line in lines if not line.dash]),
        )

    return build


def _near(lines: Sequence[Line]) -> tuple[float, float] | None:
    """Return a view that covers these lines with a margin of half their range."""
    known = [line for line in lines if np.isfinite(line.y).any()]
    if not known:
        return None
    low = min(float(np.nanmin(line.y)) for line in known)
    high = max(float(np.nanmax(line.y)) for line in known)
    room = max(1.0, 0.5 * (high - low))
    return low - room, high + room


def _ahead(axes: _Axes) -> Figure:
    roles = (error_statistics.GNSS, error_statistics.RSBN, error_statistics.CORRECTED, error_statistics.INS)
    lines = []
    for which, a, prefix in axes.each():
        s = a.flight.tables["Solution"]
        for i in range(AHEAD):
            seconds = s[f"ahead_{i}"]
            if (known := np.isfinite(seconds)).any():
                minutes = float(np.nanmedian(seconds)) / 60.0
                for column, dash, what in (("bound", False, "guaranteed"), ("claimed", True, "claimed")):
                    if axes.alone or not dash:
                        y = s[f"ahead_{column}_{i}"][known]
                        name = f"{prefix}in {minutes:g} min, {what}"
                        lines.append(axes.line(name, roles[i], which, s["t"][known], y, dash=dash))
    return axes.over_time(
        "ahead",
        "Predicted uncertainty, as reported in flight",
        "m",
        lines,
        "How uncertain the position would be some minutes later if all fixes were lost (r.m.s.): guaranteed "
        "bound, and (dashed) the value that least squares claims under white noise.",
        log=True,
    )


# -- sources and messages --------------------------------------------------------------------------------


def _sources(axes: _Axes) -> Figure:
    """Build one row per source and log: intervals of use, and each rejection."""
    lines: list[Line] = []
    rows: list[str] = []
    for which, a, prefix in axes.each():
        s = a.flight.tables["Solution"]
        used = s["sources"].astype(int)
        for role, name, on in (
            (error_statistics.GNSS, "GNSS", (used & int(Source.GNSS)) != 0),
            (error_statistics.RSBN, "beacons", (used & int(flight_events.BEACON)) != 0),
            ("bound", "no fixes", flight_events.without_fixes(s)),
        ):
            if on.any():
                rows.append(prefix + name)
                y = np.where(on, float(len(rows)), np.nan)
                lines.append(axes.bar(rows[-1], role, which, s["t"], y))
        for source in dict.fromkeys(r.source for r in a.flight.rejections):
            rows.append(f"{prefix}rejected: {flight_events.source_title(source)}")
            t = subsample(np.array([r.t for r in a.flight.rejections if r.source == source]))
            y = np.full(len(t), float(len(rows)))
            lines.append(axes.line(rows[-1], "rejected", which, t, y, style="dots"))
    note = "One row per source: bars where it was used, dots where a measurement was rejected."
    return axes.over_time("sources", "Sources used and rejected", "", lines, note, rows=tuple(rows))


def _runs(t: Floats, on: Floats) -> tuple[Floats, Floats]:
    """Keep the ends of bars, and one gap between two."""
    known = np.isfinite(on)
    change = np.flatnonzero(np.diff(known, prepend=not known[0]))
    keep: npt.NDArray[np.int64] = np.unique(np.clip([*change, *(change - 1), len(t) - 1], 0, len(t) - 1))
    return t[keep], on[keep]


_TOPICS = (
    ("/in/LocalPosition", error_statistics.INS),
    ("/in/Gnss", error_statistics.GNSS),
    ("/in/RsbnFix", error_statistics.RSBN),
    ("/out/Solution", error_statistics.CORRECTED),
)


def _latency(axes: _Axes) -> Figure:
    lines = []
    for which, a, prefix in axes.each():
        for topic, role in _TOPICS[:3]:
            if topic in a.flight.streams:
                rx, late = flight_events.message_latency(a.flight, topic)
                if not late.any():  # the recorder stored only one time
                    continue
                name = f"{prefix}{flight_events.topic_name(topic)}"
                lines.append(axes.line(name, role, which, rx, 1e3 * late, style="dots"))
    return axes.over_time("latency", "Age of measurements on arrival", "ms", lines)


def _pace(axes: _Axes) -> Figure:
    lines = []
    for which, a, prefix in axes.each():
        seconds = a.flight.seconds
        edges = np.linspace(0.0, seconds, min(max(int(seconds / 5.0), 1), 400) + 1)  # none beyond the end
        for topic, role in _TOPICS:
            if (stream := a.flight.streams.get(topic)) is not None and seconds > 0.0:
                hz = np.histogram(stream.rx, edges)[0] / np.diff(edges)
                name = f"{prefix}{flight_events.topic_name(topic)}"
                lines.append(axes.line(name, role, which, edges[:-1], hz))
    note = "Averaged over a few seconds."
    return axes.over_time("rates", "Messages per second", "Hz", lines, note, zero=True)


def _clock(axes: _Axes) -> Figure:
    lines = []
    for which, a, prefix in axes.each():
        for link, table in a.flight.links.items():
            known = np.isfinite(table["offset"])
            if known.any():
                t, offset = table["t"][known], table["offset"][known]
                drift = (offset - offset[0]) * 1e3
                name = f"{prefix}{link}: clock difference since the start"
                lines.append(axes.line(name, error_statistics.CORRECTED, which, t, drift))
            trip = np.isfinite(table["round_trip"])
            if trip.any():
                t, ms = table["t"][trip], table["round_trip"][trip] * 1e3
                lines.append(axes.line(f"{prefix}{link}: round trip", "second", which, t, ms))
    return axes.over_time("timesync", "Clock against the autopilot", "ms", lines)


_BUILDERS: tuple[Callable[[_Axes], Figure], ...] = (
    lambda axes: build_map(axes.flights, axes.prefixes),
    _error,
    _sources,
    _ratio,
    _misfit,
    _inertial("north"),
    _inertial("east"),
    _ahead,
    _pace,
    _latency,
    _clock,
)
