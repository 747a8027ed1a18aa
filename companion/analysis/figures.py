"""What a report draws: the plots of one flight, or of two in the same axes, over time and the map (`track`).

Times are minutes since the flight's start, lengths metres.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from companion.analysis import error_statistics, flight_events
from companion.analysis.assessment import Assessment, chi2_95
from companion.analysis.flight_arrays import AHEAD, Floats
from companion.analysis.map_figure import track
from companion.analysis.plot_data import COLOURS, LETTERS, TIME, Figure, Line, Style, strided, thinned


def figures(flights: Sequence[Assessment]) -> list[Figure]:
    """Every plot there is something to draw in, for one flight or two, which the legends call A and B."""
    prefixes = [f"{letter} " for letter in LETTERS] if len(flights) > 1 else [""]
    found = (build(flights, prefixes) for build in _BUILDERS)
    return [figure for figure in found if any(len(line.x) for line in figure.lines)]


def _line(name: str, role: str, which: int, t: Floats, y: Floats, **more: object) -> Line:
    x, y = thinned(np.asarray(t / 60.0, dtype=np.float64), y)
    return Line(name, x, y, COLOURS[role][which], **more)  # type: ignore[arg-type]


def _seconds(e: error_statistics.Errors) -> Floats:
    return np.asarray(e.t_ns * 1e-9, dtype=np.float64)


def _spans(flights: Sequence[Assessment]) -> tuple[tuple[float, float, str], ...]:
    """The phases without fixes, of one flight alone: two would hide each other."""
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
        "Logarithmic. Shaded: no fixes. The estimate's error must stay, r.m.s., under the dashed bound.",
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
        "Above 1 the error was beyond the bound. The bound is on the r.m.s.: a moment above it is allowed, "
        "a phase is not.",
        log=True,
        spans=_spans(flights),
        level=1.0,
    )


def _misfit(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    roles = {"NEES": error_statistics.CORRECTED, "fix residuals": error_statistics.RSBN}
    lines = []
    for which, (a, prefix) in enumerate(zip(flights, prefixes, strict=True)):
        for misfit in a.misfits:
            role = roles.get(misfit.what, error_statistics.GNSS)
            style: Style = "line" if misfit.what == "NEES" else "dots"
            value = np.maximum(misfit.value / chi2_95(misfit.freedom), 1e-4)
            lines.append(_line(prefix + misfit.what, role, which, misfit.t, value, style=style))
    return Figure(
        "consistency",
        "Do errors fit their covariances?",
        TIME,
        "value / 95 % limit",
        lines,
        "Squares of errors by their covariance, over the 95 % quantile of chi-square: in a sound filter "
        "one in twenty is above 1, not many more and not none at all.",
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
            lone = s["sources"].astype(int) <= 1
            for sign, name in ((1.0, f"{prefix}estimate ± bound"), (-1.0, "")):
                edge = np.where(lone, estimated + sign * bound, np.nan)
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
            "What is taken off the inertial channel, beside what it was; the bound while it is predicted.",
            spans=_spans(flights),
            view=_near([line for line in lines if not line.dash]),
        )

    return build


def _near(lines: Sequence[Line]) -> tuple[float, float, float, float] | None:
    """A view of these lines with half as much again above and below, whatever else there is."""
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
        "The error ahead, as told in flight",
        TIME,
        "r.m.s., m",
        lines,
        "What the inertial error may be some minutes from each moment: guaranteed, and (dashed) as least "
        "squares claims it under white noise.",
        log=True,
        spans=_spans(flights),
    )


# -- sources and messages --------------------------------------------------------------------------------


def _sources(flights: Sequence[Assessment], prefixes: Sequence[str]) -> Figure:
    """A row a source and log: when it was used, and each refusal."""
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
        for source in dict.fromkeys(r.source for r in a.flight.refused):
            rows.append(f"{prefix}refused: {source}")
            t = strided(np.array([r.t for r in a.flight.refused if r.source == source])) / 60.0
            y = np.full(len(t), float(len(rows)))
            lines.append(Line(rows[-1], t, y, COLOURS["refused"][which], "dots"))
    note = "A row for each source: bars where it was used, dots where it was refused."
    return Figure("sources", "Sources used and refused", TIME, "", lines, note, rows=tuple(rows))


def _runs(name: str, role: str, which: int, t: Floats, on: Floats) -> Line:
    """A bar: only where it begins and ends needs points."""
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
                rx, late = flight_events.latency(a.flight, topic)
                if not late.any():  # its recorder kept one time
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
        "rates", "Message rates", TIME, "Hz", lines, "Messages a second, over a few seconds each.", zero=True
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
    track,
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
