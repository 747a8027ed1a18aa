"""Scene of the live view: messages in, one page of bounded size out.

Tracks are thinned as they grow and strip charts cover the last minutes, so that an hour takes no more memory,
and no more bytes a second, than a few minutes. Every frame is complete: a page that connects late, or again,
needs nothing of before.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple

import msgspec
import numpy as np

from companion.analysis import error_statistics
from companion.analysis.drawing import to_page
from companion.analysis.flight_events import event_title, source_title
from companion.analysis.live.follow import Message
from companion.analysis.plot_data import COLOURS, Figure, Line, Mark, PlacedName
from companion.estimate import bank
from companion.nav.geometry import Geodetic, displace, separation
from companion.records import DECODERS, Event, Gnss, Mode, Reset, RsbnFix, Severity, Solution, Source
from companion.units import Floats

TRACK_POINTS = 2400
STRIP_S, STRIP_STEP_S = 600.0, 0.5
EVENTS = 200
SILENT_S = 5.0  # a source is silent after this time
STALE_S = 3.0  # no solution for so long: the view says so
NO_DATA, STOPPED = "No data", "Stopped"
CHI2_95_2 = 5.991
SUSPECT, EXCLUDED = bank.Settings().suspect, bank.Settings().excluded
#: Level and title of each `Solution.status_word`; others are a caution by their own name.
NAMED = {"normal": ("good", "Trusted"), "untrusted": ("fault", "Do not trust")}
BITS = {
    "gnss": Source.GNSS,
    "azimuth": Source.AZIMUTH,
    "range": Source.RANGE,
    "airspeed": Source.AIR_DATA,
}  # by the last word of the source's name
_SHOWN = ("Solution", "Gnss", "RsbnFix", "Event", "Reset")


class Track:
    """Points of a track, metres east and north of an origin; every second one is dropped when it is full."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float]] = []
        self._step_s = 0.5

    def add(self, t: float, east: float, north: float) -> None:
        """Append a point, NaN for a gap, unless the last one is too recent."""
        if self._rows and t - self._rows[-1][0] < self._step_s:
            return
        self._rows.append((t, east, north))
        if len(self._rows) > TRACK_POINTS:
            self._rows = self._rows[::2]
            self._step_s *= 2.0

    def line(self, name: str, colour: tuple[str, str], **more: Any) -> Line:
        """Return the track as a line of the map."""
        t, x, y = np.array(self._rows, dtype=np.float64).reshape(-1, 3).T
        return Line(name, x, y, colour, t=t, **more)


class Strip:
    """Values of the last minutes, at most two a second."""

    def __init__(self) -> None:
        self._rows: deque[tuple[float, float]] = deque(maxlen=round(STRIP_S / STRIP_STEP_S))

    def add(self, t: float, value: float | None) -> None:
        """Append a value, None for a gap."""
        if not self._rows or t - self._rows[-1][0] >= STRIP_STEP_S:
            self._rows.append((t, math.nan if value is None else value))

    def line(self, since: float, name: str, colour: tuple[str, str], **more: Any) -> Line:
        """Return the strip as a line over time: what is not older than `since` (s)."""
        rows = [row for row in self._rows if row[0] >= since]
        t, y = np.array(rows, dtype=np.float64).reshape(-1, 2).T
        return Line(name, t, y, colour, **more)


class Beacon(NamedTuple):
    """The last reply of a beacon, when it came (s) and the point that it measured (m east and north)."""

    reply: RsbnFix
    t: float
    end: tuple[float, float] | None


class Scene:
    """Everything that the page shows of one log."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.t = 0.0
        self.log_ns = 0
        self._first_ns: int | None = None
        self._origin: Geodetic | None = None
        self._solution: tuple[Solution, float] | None = None
        self._gnss: Gnss | None = None
        self._beacons: dict[int, Beacon] = {}
        self._miss = 0.0  # distance of those points from the aircraft (m)
        self._measured: dict[str, float | None] = {"gnss": None}  # when each source measured last (s)
        self._false: dict[str, float] = {}
        self._fixed, self._lost, self._received, self._ins = Track(), Track(), Track(), Track()
        self._strips: dict[str, Strip] = {}
        self._events: deque[tuple[float, int, str]] = deque(maxlen=EVENTS)

    def add(self, message: Message) -> None:
        """Take one message into the scene."""
        if self._first_ns is None:
            self._first_ns = message.log_ns
        self.log_ns = max(self.log_ns, message.log_ns)
        self.t = (self.log_ns - self._first_ns) * 1e-9
        kind, topic = message.channel.schema, message.channel.topic
        if kind not in _SHOWN or not topic.startswith(("/in/", "/out/", "/link/")):
            return
        try:
            record = DECODERS[kind].decode(message.content)
        except msgspec.MsgspecError:
            return  # of another version: not shown
        match record:
            case Solution():
                self._add_solution(record)
            case Gnss():
                self._add_gnss(record)
            case RsbnFix():
                self._add_reply(record)
            case Event():
                self._events.append((self.t, record.severity, event_title(record.text)))
            case Reset():
                self._events.append((self.t, Severity.WARNING, f"{record.what} reset: {record.reason}"))

    def _place(self, lat: float, lon: float) -> tuple[float, float]:
        """Return metres east and north of the first position."""
        if self._origin is None:
            self._origin = Geodetic(lat, lon, 0.0)
        north, east, _ = separation(Geodetic(lat, lon, 0.0), self._origin)
        return float(east), float(north)

    def _add_solution(self, s: Solution) -> None:
        east, north = self._place(s.lat, s.lon)
        lost = s.mode in (Mode.PREDICTING, Mode.UNTRUSTED)
        gap = math.nan
        self._fixed.add(self.t, gap if lost else east, north)
        self._lost.add(self.t, east if lost else gap, north)
        self._ins.add(self.t, east + s.error_n[1], north + s.error_n[0])
        self._solution = s, self.t
        if s.false_sources:
            self._false = dict(s.false_sources)
            for name, p in s.false_sources:
                self._strip(f"false {name}").add(self.t, 100.0 * p)
        if s.sources & Source.AIR_DATA or self._false.get("airspeed", 0.0) > SUSPECT:
            self._measured["airspeed"] = self.t
        self._strip("protection").add(self.t, s.protection)
        self._strip("bound").add(self.t, None if s.bound_n is None else math.hypot(*s.bound_n))
        self._strip("sigma").add(self.t, math.sqrt(CHI2_95_2 * _largest_variance(s)))
        self._strip("error north").add(self.t, s.error_n[0])
        self._strip("error east").add(self.t, s.error_n[1])

    def _add_gnss(self, record: Gnss) -> None:
        if self._gnss is not None and record.repeats(self._gnss):
            return
        if not record.has_3d_fix:
            self._strip("gnss").add(self.t, None)
            return
        self._gnss, self._measured["gnss"] = record, self.t
        if record.v_n is not None:
            self._measured["velocity of gnss"] = self.t
        east, north = self._place(record.lat, record.lon)
        self._received.add(self.t, east, north)
        if self._solution is not None:
            s = self._solution[0]
            d_north, d_east, _ = separation(
                Geodetic(record.lat, record.lon, 0.0), Geodetic(s.lat, s.lon, 0.0)
            )
            self._strip("gnss").add(self.t, math.hypot(d_north, d_east))

    def _add_reply(self, reply: RsbnFix) -> None:
        end = self._end(reply)
        self._beacons[reply.beacon] = Beacon(reply, self.t, end)
        if end is not None and self._solution is not None:
            here = self._place(self._solution[0].lat, self._solution[0].lon)
            self._miss = max(0.95 * self._miss, math.dist(end, here))  # slow, so that the map is steady
        for kind, value in (("azimuth", reply.azimuth), ("range", reply.slant_range)):
            if value is not None:
                self._measured[f"rsbn {reply.beacon} {kind}"] = self.t

    def _end(self, reply: RsbnFix) -> tuple[float, float] | None:
        """Return the point that a reply measured; the position gives a missing range or azimuth."""
        self._place(reply.lat, reply.lon)  # the first position is the origin, also a beacon's
        reach, azimuth = reply.slant_range, reply.azimuth
        if self._solution is not None:
            s = self._solution[0]
            north, east, _ = separation(Geodetic(s.lat, s.lon, 0.0), Geodetic(reply.lat, reply.lon, 0.0))
            reach = math.hypot(north, east) if reach is None else reach
            azimuth = math.atan2(east, north) if azimuth is None else azimuth
        if reach is None or azimuth is None:
            return None
        north, east = reach * math.cos(azimuth), reach * math.sin(azimuth)
        place = displace(reply.lat, reply.lon, 0.0, north, east, 0.0)
        return self._place(place.lat, place.lon)

    def _strip(self, name: str) -> Strip:
        return self._strips.setdefault(name, Strip())

    # -- the page ------------------------------------------------------------------------------------------

    def frame(self, behind_s: float | None, ended: bool) -> dict[str, Any]:
        """Return the whole page. `behind_s`: real time since the log was written last (None: playback)."""
        now = self.t + (behind_s or 0.0)
        stopped = ended and behind_s is not None
        trust = self._trust(now, stopped)
        return {
            "log": self.name,
            "t": round(self.t, 2),
            "behind": None if behind_s is None else round(behind_s, 2),
            "ended": ended,
            "old": trust["word"] in (NO_DATA, STOPPED),
            "trust": trust,
            "numbers": self._numbers(),
            "sources": [row._asdict() for row in self._sources(now)],
            "events": [[round(t, 1), severity, text] for t, severity, text in reversed(self._events)],
            "map": self._map(now),
            "charts": [to_page(figure) | {"title": figure.title} for figure in self._charts()],
        }

    def _trust(self, now: float, stopped: bool) -> dict[str, str]:
        if stopped:
            why = f"The companion closed this log {now - self.t:.0f} s ago."
            return {"level": "caution", "word": STOPPED, "why": why}
        if self._solution is None:
            return {"level": "caution", "word": "No position yet", "why": self._waiting()}
        s, t = self._solution
        if (age := now - t) > STALE_S:
            return {"level": "fault", "word": NO_DATA, "why": f"The last position is {age:.0f} s old."}
        level, word = NAMED.get(s.status_word, ("caution", s.status_word.capitalize()))
        parts = []
        if s.mode is not Mode.FIXED:
            parts.append(f"No fix for {s.horizon_s:.0f} s.")
        else:
            used = [
                name
                for bits, name in ((Source.GNSS, "GNSS"), (Source.AZIMUTH | Source.RANGE, "beacons"))
                if s.sources & bits
            ]
            parts.append(f"Position by {' and '.join(used) or 'fixes'}.")
        false = [source_title(name) for name, p in self._false.items() if p > SUSPECT]
        if false:
            parts.append(f"Probably false: {', '.join(false)}.")
        if s.protection is not None:
            parts.append(f"Protection level {_metres(s.protection)}, a false source included.")
        return {"level": level, "word": word, "why": " ".join(parts)}

    def _waiting(self) -> str:
        """Say what was received so far."""
        has = [
            name for name, known in (("GNSS fixes", self._gnss), ("beacon replies", self._beacons)) if known
        ]
        return f"Received: {', '.join(has)}." if has else "No fix was received yet."

    def _numbers(self) -> list[tuple[str, str]]:
        if self._solution is None:
            return []
        s = self._solution[0]
        bound = None if s.bound_n is None else math.hypot(*s.bound_n)
        return [
            ("protection level", _metres(s.protection)),
            ("guaranteed bound", _metres(bound)),
            ("95 % radius", _metres(math.sqrt(CHI2_95_2 * _largest_variance(s)))),
            ("without fix", f"{s.horizon_s:.0f} s"),
            ("speed", f"{math.hypot(s.v_n[0], s.v_n[1]):.1f} m/s"),
            ("altitude (MSL)", f"{s.alt_msl:.0f} m"),
            ("latitude", f"{math.degrees(s.lat):.5f}°"),
            ("longitude", f"{math.degrees(s.lon):.5f}°"),
        ]

    def _sources(self, now: float) -> Iterator[SourceRow]:
        """Yield a row for GNSS and for every source that measured; the chart has the same sources."""
        sources = self._solution[0].sources if self._solution else 0
        for key, t in self._measured.items():
            yield self._row(key, None if t is None else now - t, bool(sources & BITS[key.rpartition(" ")[2]]))

    def _row(self, key: str, age: float | None, used: bool) -> SourceRow:
        p = self._false.get(key)
        state, level = ("used", "good") if used else ("not used", "")
        if age is None or age > SILENT_S:
            state, level = "silent", "caution"
        elif p is not None and (p > EXCLUDED or (p > SUSPECT and not used)):  # excluded until believed
            state, level = "excluded", "fault"
        elif p is not None and p > SUSPECT:
            state, level = "suspect", "caution"
        return SourceRow(
            source_title(key),
            state,
            level,
            None if p is None else round(100.0 * p, 1),
            None if age is None else round(age, 1),
        )

    def _map(self, now: float) -> dict[str, Any]:
        lines = [
            self._ins.line("inertial channel alone", COLOURS[error_statistics.INS], width=1.0, dash=True),
            self._received.line("GNSS", COLOURS[error_statistics.GNSS], style="dots"),
            self._fixed.line("estimate", COLOURS[error_statistics.CORRECTED], width=2.0),
            self._lost.line("estimate without fixes", COLOURS["bound"], width=3.0),
            self._lines_of_position(now),
            *self._regions(),
        ]
        places = [
            PlacedName(f"beacon {number}", *self._place(b.reply.lat, b.reply.lon))
            for number, b in sorted(self._beacons.items())
        ]
        frame, near, aircraft = None, None, None
        if self._solution is not None:
            s = self._solution[0]
            aircraft = (*self._place(s.lat, s.lon), math.atan2(s.v_n[1], s.v_n[0]))
            miss = self._miss if len(lines[4].x) else 0.0
            frame = _frame([line for line in lines[1:4] if len(line.x)], *aircraft[:2], miss)
            r = max(200.0, 1.5 * (s.protection or 0.0))
            near = (aircraft[0] - r, aircraft[0] + r, aircraft[1] - r, aircraft[1] + r)
        origin = self._origin or Geodetic(0.0, 0.0, 0.0)
        figure = Figure(
            "map", "Map", "m", lines,
            origin=(math.degrees(origin.lat), math.degrees(origin.lon)), frame=frame, places=tuple(places),
        )  # fmt: skip
        return to_page(figure) | {"aircraft": aircraft, "near": near}

    def _lines_of_position(self, now: float) -> Line:
        """Return azimuth and range of the beacons that answered lately."""
        xs: list[float] = []
        ys: list[float] = []
        for beacon in self._beacons.values():
            reply, end = beacon.reply, beacon.end
            if end is None or now - beacon.t > SILENT_S:
                continue
            x, y = self._place(reply.lat, reply.lon)
            if reply.azimuth is not None:
                xs += [x, end[0], math.nan]
                ys += [y, end[1], math.nan]
            if reply.slant_range is not None:
                arc = math.atan2(end[0] - x, end[1] - y) + np.linspace(-0.15, 0.15, 25)
                xs += [*(x + reply.slant_range * np.sin(arc)).tolist(), math.nan]
                ys += [*(y + reply.slant_range * np.cos(arc)).tolist(), math.nan]
        return Line(
            "lines of position", np.array(xs), np.array(ys), COLOURS[error_statistics.RSBN], width=1.2
        )

    def _regions(self) -> Iterator[Line]:
        """Yield the 95 % ellipse of the covariance, and the guaranteed and the protection circle."""
        if self._solution is None:
            return
        s = self._solution[0]
        x, y = self._place(s.lat, s.lon)
        angle = np.linspace(0.0, math.tau, 73)
        nn, ne, _, ee, _, _ = s.covariance
        values, vectors = np.linalg.eigh(np.array([[ee, ne], [ne, nn]]))
        circle = np.stack([np.cos(angle), np.sin(angle)])
        ellipse: Floats = vectors @ (np.sqrt(CHI2_95_2 * np.maximum(values, 0.0))[:, None] * circle)
        yield Line(
            "95 % ellipse", x + ellipse[0], y + ellipse[1], COLOURS[error_statistics.CORRECTED], width=1.4
        )
        if s.bound_n is not None:
            r = math.hypot(*s.bound_n)
            yield Line("guaranteed circle", x + r * circle[0], y + r * circle[1], COLOURS["bound"], dash=True)
        if s.protection is not None:
            r = s.protection
            yield Line(
                "protection level",
                x + r * circle[0],
                y + r * circle[1],
                COLOURS["second"],
                dash=True,
                width=1.1,
            )

    def _charts(self) -> Iterator[Figure]:
        since = self.t - STRIP_S
        marks = tuple(
            Mark(t, text, severity <= Severity.WARNING) for t, severity, text in self._events if t >= since
        )
        yield Figure(
            "size", "How far the position may be off", "m",
            [
                self._strip("protection").line(since, "protection level", COLOURS["second"], dash=True),
                self._strip("bound").line(since, "guaranteed bound", COLOURS["bound"], dash=True),
                self._strip("sigma").line(since, "95 % radius", COLOURS[error_statistics.CORRECTED]),
            ],
            log=True, marks=marks,
        )  # fmt: skip
        yield Figure(
            "gnss", "Distance of GNSS from the estimate", "m",
            [self._strip("gnss").line(since, "GNSS", COLOURS[error_statistics.GNSS])],
            zero=True, marks=marks,
        )  # fmt: skip
        yield Figure(
            "false",
            "Probability that a source is false",
            "%",
            list(self._false_lines(since)),
            view=(0.0, 100.0),
            marks=marks,
        )
        yield Figure(
            "inertial", "Estimated error of the inertial channel", "m",
            [
                self._strip("error north").line(since, "north", COLOURS[error_statistics.INS]),
                self._strip("error east").line(since, "east", COLOURS[error_statistics.INS], dash=True),
            ],
            marks=marks,
        )  # fmt: skip

    def _false_lines(self, since: float) -> Iterator[Line]:
        gnss = error_statistics.GNSS
        roles = {"gnss": gnss, "velocity of gnss": gnss, "airspeed": "second"}
        for name in self._measured:
            if strip := self._strips.get(f"false {name}"):
                colour = COLOURS[roles.get(name, error_statistics.RSBN)]
                dash = name.startswith("velocity") or name.endswith("range")
                yield strip.line(since, source_title(name), colour, dash=dash)


class SourceRow(NamedTuple):
    """A row of the source table: name, state and its level, probability that it is false (%), age (s)."""

    name: str
    state: str
    level: str
    false: float | None
    age: float | None


def _largest_variance(s: Solution) -> float:
    nn, ne, _, ee, _, _ = s.covariance
    return max(0.0, 0.5 * (nn + ee) + math.hypot(0.5 * (nn - ee), ne))


def _metres(value: float | None) -> str:
    if value is None or not math.isfinite(value):
        return "–"
    return (
        f"{value / 1000.0:.1f} km"
        if value >= 10_000.0
        else f"{value:.0f} m"
        if value >= 10.0
        else f"{value:.1f} m"
    )


def _frame(lines: list[Line], x: float, y: float, miss: float) -> tuple[float, float, float, float]:
    """Return a view that covers the tracks and what is around the aircraft.

    That is at least 200 m, and the ends of the lines of position, `miss` (m) from it, unless they are so far
    off that the rest would become small: 500 m and half of the tracks' extent.
    """
    xs = np.concatenate([[x], *(line.x for line in lines)])
    ys = np.concatenate([[y], *(np.where(np.isfinite(line.x), line.y, np.nan) for line in lines)])
    low_x, high_x, low_y, high_y = (float(f(a)) for a in (xs, ys) for f in (np.nanmin, np.nanmax))
    r = max(200.0, min(miss, max(500.0, 0.5 * (high_x - low_x), 0.5 * (high_y - low_y))))
    low_x, high_x, low_y, high_y = (
        min(low_x, x - r),
        max(high_x, x + r),
        min(low_y, y - r),
        max(high_y, y + r),
    )
    dx, dy = 0.06 * (high_x - low_x), 0.06 * (high_y - low_y)
    return low_x - dx, high_x + dx, low_y - dy, high_y + dy
