"""Figures of the report: plots of one flight, or of two in the same axes.

Times are minutes since the start of the flight, lengths metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import Assessment, chi2_95
from companion.analysis.flight_arrays import AHEAD
from companion.analysis.map_figure import build_map
from companion.analysis.plot_data import COLOURS, LETTERS, TIME, Figure, Line, Style, subsample, thin_line
from companion.units import Floats


def build_figures(flights: Sequence[Assessment]) -> list[Figure]:
    """Build every figure that has data, for one flight or two (A and B in the legends)."""
    prefixes = [f"{letter} " for letter in LETTERS] if len(flights) > 1 else [""]
    found = (build(flights, prefixes) for build in _BUILDERS)
    return [figure for figure in found if any(len(line.x) for line in figure.lines)]


def _line(name: str, role: str, which: int, t: Floats, y: Floats, **more: object) -> Line:
    x, y = thin_line(np.asarray(t / 60.0, dtype=np.float64), y)
    return Line(name, x, y, COLOURS[role][which], **more)  # type: ignore[arg-type]


def _seconds(e: error_statistics.ErrorSeries) -> Floats:
    return np.asarray(e.t_ns * 1e-9, dtype=np.float64)


def _spans(flights: Sequence[Assessment]) -> tuple[tuple[float, float, str], ...]:
    """Return the phases without fixes as shaded spans; none for two flights, which would overlap."""
    if len(flights) > 1:
        return ()
    return tuple(
        (phase.start_ns / 60e9, phase.end_ns / 60e9, phase.name)
        for phase in flights[0].phases
        if phase.name in ("prediction", "untrusted")
    )


# -- errors ----------------------------------------------------------------------------------------------


def _error(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        for source in (
            error_statistics.RSBN,
            error_statistics.GNSS,
            error_statistics.INS,
            error_statistics.CORRECTED,
        ):
            if (e := a.errors.get(source)) is not None:
                dots = source in (error_statistics.GNSS, error_statistics.RSBN)
                style: Style = "dots" if dots else "line"
                error = np.maximum(e.error, 0.01)
                lines.append(_line(prefix + source, source, which, _seconds(e), error, style=style))
        if (e := a.errors.get(error_statistics.CORRECTED)) is not None:
            name = f"{prefix}guaranteed bound"
            lines.append(_line(name, "bound", which, _seconds(e), e.bound, dash=True))
    against = ", ".join(dict.fromkeys(a.reference.what for a in flights if a.reference is not None))
    return Figure(
        "error",
        f"Horizontal error against {against}",
        TIME,
        "error, m",
        lines,
        "Logarithmic. Shaded: no fixes. The r.m.s. error of the estimate must stay below the dashed bound.",
        log=True,
        spans=_spans(flights),
    )


def _ratio(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        if (e := a.errors.get(error_statistics.CORRECTED)) is not None and np.isfinite(e.bound).any():
            share = np.maximum(e.error / e.bound, 1e-4)
            name = f"{prefix}error / bound"
            lines.append(_line(name, error_statistics.CORRECTED, which, _seconds(e), share))
    return Figure(
        "bound",
        "Error as a share of the guaranteed bound",
        TIME,
        "error / bound",
        lines,
        "Above 1 the error exceeded the bound. The bound limits the r.m.s. error of a phase: single moments "
        "above 1 are allowed.",
        log=True,
        spans=_spans(flights),
        level=1.0,
    )


def _misfit(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    roles = {"NEES": error_statistics.CORRECTED, "fix residuals": error_statistics.RSBN}
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        for series in a.normalized_errors:
            role = roles.get(series.what, error_statistics.GNSS)
            style: Style = "line" if series.what == "NEES" else "dots"
            value = np.maximum(series.value / chi2_95(series.degrees_of_freedom), 1e-4)
            lines.append(_line(prefix + series.what, role, which, series.t, value, style=style))
    return Figure(
        "consistency",
        "Do errors fit their covariances?",
        TIME,
        "value / 95 % limit",
        lines,
        "Squared errors normalized by their covariance, divided by the 95 % quantile of chi-square. In a "
        "consistent filter about 5 % of the values are above 1; if none are, the sigmas are too large.",
        log=True,
        spans=_spans(flights),
        level=1.0,
    )


# -- the inertial channel --------------------------------------------------------------------------------


def _inertial(axis: str) -> Callable[[Sequence[Assessment], Sequence[str]], Figure]:
    def build(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
        lines = []
        for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
            s = a.flight.tables["Solution"]
            estimated, bound = s[f"error_{axis}"], s[f"bound_{axis}"]
            without_fixes = s["sources"].astype(int) <= 1
            for sign, name in ((1.0, f"{prefix}estimate ± bound"), (-1.0, "")):
                edge = np.where(without_fixes, estimated + sign * bound, np.nan)
                if np.isfinite(edge).any():
                    lines.append(_line(name, "bound", which, s["t"], edge, dash=True, width=1.0))
            if a.ins_error:
                against = f"{prefix}against {a.reference.what}" if a.reference else ""
                t = a.ins_error["t"]
                lines.append(_line(against, "reference", which, t, a.ins_error[axis], width=2.2))
            lines.append(_line(f"{prefix}estimated", error_statistics.INS, which, s["t"], estimated))
        return Figure(
            f"inertial_{axis}",
            f"Error of the inertial channel, {axis}",
            TIME,
            "error, m",
            lines,
            "The estimated error, which is subtracted; the actual error; the bound in phases without fixes.",
            spans=_spans(flights),
            view=_near([line for line in lines if not line.dash]),
        )

    return build


def _near(lines: Sequence[Line]) -> tuple[float, float, float, float] | None:
    """Return a view that covers these lines with a margin of half their range."""
    known = [line for line in lines if np.isfinite(line.y).any()]
    if not known:
        return None
    low = min(float(np.nanmin(line.y)) for line in known)
    high = max(float(np.nanmax(line.y)) for line in known)
    room = max(1.0, 0.5 * (high - low))
    start, end = min(float(line.x[0]) for line in known), max(float(line.x[-1]) for line in known)
    return start, end, low - room, high + room


def _ahead(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    roles = (error_statistics.GNSS, error_statistics.RSBN, error_statistics.CORRECTED, error_statistics.INS)
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        s = a.flight.tables["Solution"]
        for i in range(AHEAD):
            seconds = s[f"ahead_{i}"]
            if (known := np.isfinite(seconds)).any():
                minutes = float(np.nanmedian(seconds)) / 60.0
                for column, dash, what in (("bound", False, "guaranteed"), ("claimed", True, "claimed")):
                    y = s[f"ahead_{column}_{i}"][known]
                    name = f"{prefix}{minutes:g} min: {what}"
                    lines.append(_line(name, roles[i], which, s["t"][known], y, dash=dash))
    return Figure(
        "ahead",
        "Predicted error, as reported in flight",
        TIME,
        "r.m.s., m",
        lines,
        "The inertial error some minutes after each moment: guaranteed bound, and (dashed) the value that "
        "least squares claims under white noise.",
        log=True,
        spans=_spans(flights),
    )


# -- sources and messages --------------------------------------------------------------------------------


def _sources(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    """Build one row per source and log: intervals of use, and each rejection."""
    lines: list[Line] = []
    rows: list[str] = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        s = a.flight.tables["Solution"]
        used = s["sources"].astype(int)
        for role, name, on in (
            (error_statistics.GNSS, "GNSS", (used & 2) != 0),
            (error_statistics.RSBN, "RSBN", (used & 12) != 0),
            ("bound", "predicted", used <= 1),
        ):
            if on.any():
                rows.append(prefix + name)
                y = np.where(on, float(len(rows)), np.nan)
                lines.append(_runs(rows[-1], role, which, s["t"], y))
        for source in dict.fromkeys(r.source for r in a.flight.rejections):
            rows.append(f"{prefix}rejected: {source}")
            t = subsample(np.array([r.t for r in a.flight.rejections if r.source == source])) / 60.0
            y = np.full(len(t), float(len(rows)))
            lines.append(Line(rows[-1], t, y, COLOURS["rejected"][which], "dots"))
    note = "One row per source: bars where it was used, dots where it was rejected."
    return Figure("sources", "Sources used and rejected", TIME, "", lines, note, rows=tuple(rows))


def _runs(name: str, role: str, which: int, t: Floats, on: Floats) -> Line:
    """Build a bar; points are needed only at its ends."""
    change = np.flatnonzero(np.diff(np.isfinite(on), prepend=False))
    ends = np.concatenate([[0, len(t) - 1], change - 1, change])
    keep: npt.NDArray[np.int64] = np.unique(np.clip(ends, 0, len(t) - 1))
    return Line(name, t[keep] / 60.0, on[keep], COLOURS[role][which], width=7.0)


def _latency(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    topics = (
        ("/in/LocalPosition", error_statistics.INS),
        ("/in/Gnss", error_statistics.GNSS),
        ("/in/RsbnFix", error_statistics.RSBN),
    )
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        for topic, role in topics:
            if topic in a.flight.streams:
                rx, late = flight_events.message_latency(a.flight, topic)
                if not late.any():  # the recorder stored only one time
                    continue
                name = f"{prefix}{topic.removeprefix('/in/')}"
                lines.append(_line(name, role, which, rx, 1e3 * late, style="dots"))
    return Figure("latency", "Latency", TIME, "arrival − validity, ms", lines)


def _pace(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    topics = (
        ("/in/LocalPosition", error_statistics.INS),
        ("/in/Gnss", error_statistics.GNSS),
        ("/out/Solution", error_statistics.CORRECTED),
    )
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        edges = np.arange(0.0, a.flight.seconds + 5.0, max(5.0, a.flight.seconds / 400.0))
        for topic, role in topics:
            if (stream := a.flight.streams.get(topic)) is not None and len(edges) > 1:
                hz = np.histogram(stream.rx, edges)[0] / np.diff(edges)
                name = f"{prefix}{topic.split('/')[-1]}"
                lines.append(_line(name, role, which, np.asarray(edges[:-1], dtype=np.float64), hz))
    return Figure(
        "rates",
        "Message rates",
        TIME,
        "Hz",
        lines,
        "Messages per second, averaged over a few seconds.",
        zero=True,
    )


def _clock(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        for link, table in a.flight.links.items():
            known = np.isfinite(table["offset"])
            if known.any():
                t, offset = table["t"][known], table["offset"][known]
                drift = (offset - offset[0]) * 1e3
                lines.append(
                    _line(f"{prefix}{link}: offset − first", error_statistics.CORRECTED, which, t, drift)
                )
            trip = np.isfinite(table["round_trip"])
            if trip.any():
                t, ms = table["t"][trip], table["round_trip"][trip] * 1e3
                lines.append(_line(f"{prefix}{link}: round trip", "second", which, t, ms))
    return Figure("timesync", "Clock against the autopilot", TIME, "ms", lines)


_BUILDERS = (
    build_map,
    _error,
    _ratio,
    _misfit,
    _inertial("north"),
    _inertial("east"),
    _ahead,
    _sources,
    _pace,
    _latency,
    _clock,
)
