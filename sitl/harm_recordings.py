"""Recordings through the navigator: what was done to healthy fixes of GNSS, and with which result.

Telemetry logs go frame by frame through the whole `CompanionCore` in virtual time, other logs record by
record through the navigator. The flights of `harm` have a truth beside them,
aligned by the time since boot.
"""

from __future__ import annotations

import csv
import io
import lzma
import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from companion.config import Config, OutputConfig
from companion.config.profiles import PROFILES
from companion.importers import sources, tlog
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.navigator import Navigator, inertial_track
from companion.output.autopilot_output import AutopilotOutput
from companion.output.encode import Receiver
from companion.output.source_table import COMPANION_SET
from companion.records import (
    Attitude,
    Event,
    GlobalPosition,
    Gnss,
    LocalOrigin,
    LocalPosition,
    Rejection,
    Solution,
    Stamped,
)
from companion.runtime.core import CompanionCore
from companion.units import SECOND_NS, Floats

LINK = "main"
BESIDE = OutputConfig(profile="ardupilot")
_SWITCHED = PROFILES["ardupilot"].switched
START_NS = SECOND_NS  # companion's clock at the first frame
TRUTH_LATE_S = 0.10  # the simulator's time is so much behind the autopilot's time since boot
MOST_REFUSED_S, MOST_WORSE_M = 2.0, 1.0
GAP_S = 1.5  # positions are not interpolated across a longer gap
_KEPT = (Solution, Event, Rejection, Gnss, GlobalPosition, LocalPosition, LocalOrigin)

#: Recordings in the data folder, and from when to when (s of the log) GNSS is not healthy.
LOGS: dict[str, tuple[tuple[float, float], ...]] = {
    "autopilot_sitl/plane_gps_loss.tlog": (),
    "autopilot_sitl/plane_gps_input_aid.tlog": (),
    "autopilot_sitl/plane_wind_change.tlog": (),
    "autopilot_sitl/px4_global_position_sensor.tlog": (),
    "umn_fixed_wing": (),
    "dronekit_copter/flight.tlog": (),
    "inertialnav/TestLog2.mat": (),
    "inertialnav/f450_glitch_log.zip": ((126.0, 128.5),),
}


class RecordingResult(NamedTuple):
    """What was seen on one recording: times s, distances m; None where there is nothing to compare.

    `set_2_s` is when source set 2 was first requested, `harmful` whether the receiver had a healthy fix then.
    """

    name: str
    seconds: float
    fixes: int
    refused_s: float
    corrected_m: float | None
    autopilot_m: float | None
    truth_m: float | None
    excluded: bool
    set_2_s: float | None
    harmful: bool
    passed: bool


class RecordingLog:
    """Log in memory: records, requests for source set 2, and the autopilot's time since boot.

    Whatever the flight is configured to send, an output for ArduPilot runs beside it with all records, to
    show when set 2 would be requested. Its origin is the first fix, and no parameter is wrong.
    """

    def __init__(self, config: Config) -> None:
        self.records: list[Stamped] = []
        self.boot_ms: list[tuple[int, int]] = []  # flight time (ns) and time since boot (ms)
        self.set_2_ns: list[int] = []
        self._boot_ms = 0
        self._output = AutopilotOutput(replace(config, output=BESIDE))
        self._receiver = Receiver(autopilot="ardupilot", system=1)
        self._next_ns = 0

    def record(self, record: Stamped, channel: str | None = None) -> None:
        """Keep the record; pair the flight time of an attitude with its time since boot."""
        if isinstance(record, _KEPT):
            self.records.append(record)
        elif isinstance(record, Attitude) and self._boot_ms:
            self.boot_ms.append((record.t_ns, self._boot_ms))
        self._follow(record)

    def frame(self, link: str, outgoing: bool, data: bytes, t_ns: int) -> None:
        """Note requests for source set 2, and the time since boot of an ATTITUDE."""
        found = frame.parse(data)
        if not isinstance(found, frame.Frame):
            return
        if not outgoing and found.msgid == mavlink.MAVLINK_MSG_ID_ATTITUDE:
            self._boot_ms = dialect.decode(found).time_boot_ms
        elif outgoing and found.msgid == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
            self._note_requests([dialect.decode(found)], t_ns)

    def _follow(self, record: Stamped) -> None:
        """Pass a record to the output beside; its commands are decided once a second, as in the core."""
        self._output.receive(record)
        if isinstance(record, Gnss) and record.has_3d_fix and self._receiver.origin is None:
            origin = LocalOrigin(record.t_ns, record.rx_ns, record.lat, record.lon, record.alt_msl)
            self._receiver = self._receiver._replace(origin=origin)
        if isinstance(record, Solution):
            self._output.messages(record, _SWITCHED, self._receiver)
        if record.rx_ns >= self._next_ns:
            self._next_ns = record.rx_ns + SECOND_NS
            self._note_requests(self._output.poll(self._receiver, record.rx_ns), record.rx_ns)

    def _note_requests(self, messages: Iterable[dialect.Message], t_ns: int) -> None:
        self.set_2_ns += [t_ns for message in messages if is_set_2(message)]


def is_set_2(message: dialect.Message) -> bool:
    """Whether a COMMAND_LONG requests source set 2."""
    return bool(
        message.command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET and int(message.param1) == COMPANION_SET
    )


def fly_frames(entries: Iterable[tlog.TlogEntry], config: Config) -> RecordingLog:
    """Pass the frames of a telemetry log to the companion's core at the times they were received."""
    log = RecordingLog(config)
    core = CompanionCore(config, log, (LINK,))
    offset: int | None = None
    for rx_ns, found in entries:
        offset = START_NS - rx_ns if offset is None else offset
        now = rx_ns + offset
        while (due := core.deadline()) <= now:
            core.poll(due)
            core.to_send(LINK, due)
        core.receive(LINK, found.raw, now)
        core.to_send(LINK, now)
        core.settle()
        core.take_events()
    return log


def fly_log(records: Iterable[Stamped], config: Config) -> RecordingLog:
    """Pass records of any origin to the navigator."""
    log, navigator = RecordingLog(config), Navigator(config)
    for record in records:
        log.record(record)
        for output in navigator.handle(record):
            log.record(output)
        navigator.settle()
    return log


# ---------------------------------------------------------------------------------------------------------
# Judging
# ---------------------------------------------------------------------------------------------------------


class Track(NamedTuple):
    """Positions over time: s, radians."""

    t: Floats
    lat: Floats
    lon: Floats

    @classmethod
    def of(cls, rows: Iterable[tuple[float, float, float]]) -> Track:
        """Build a track of rows (s, rad, rad), in order of time and without repetitions."""
        unique = {row[0]: row for row in rows}
        table = np.array([unique[t] for t in sorted(unique)]).reshape(-1, 3)
        return cls(table[:, 0], table[:, 1], table[:, 2])

    def distance(self, other: Track) -> Floats:
        """Return the horizontal distances (m) at the times of `other`; NaN beside gaps."""
        if len(self.t) < 2:
            return np.full(len(other.t), math.nan)
        after = np.clip(np.searchsorted(self.t, other.t), 1, len(self.t) - 1)
        gap = self.t[after] - self.t[after - 1]
        outside = (other.t < self.t[0]) | (other.t > self.t[-1]) | (gap > GAP_S)
        north = (np.interp(other.t, self.t, self.lat) - other.lat) * 6.37e6
        east = (np.interp(other.t, self.t, self.lon) - other.lon) * 6.38e6 * np.cos(other.lat)
        return np.where(outside, math.nan, np.hypot(north, east))


def autopilot_track(records: Sequence[Stamped]) -> Track:
    """Return the autopilot's own position: the global one, or the local one with its origin."""
    found = [(r.t_ns * 1e-9, r.lat, r.lon) for r in records if isinstance(r, GlobalPosition)]
    if found:
        return Track.of(found)
    origin: LocalOrigin | None = None
    for r in records:
        if isinstance(r, LocalOrigin):
            origin = r
        elif isinstance(r, LocalPosition) and origin is not None:
            place = inertial_track.point(r, origin).position
            found.append((r.t_ns * 1e-9, place.lat, place.lon))
    return Track.of(found)


def new_fixes(records: Iterable[Stamped]) -> Iterator[Gnss]:
    """Yield the fixes of the first receiver that are no repetitions, once there is a solution."""
    last: Gnss | None = None
    solved = False
    for r in records:
        solved = solved or isinstance(r, Solution)
        if isinstance(r, Gnss) and r.receiver == 0 and (last is None or not r.repeats(last)):
            last = r
            if solved:
                yield r


def longest_refusal(fixes: Sequence[tuple[Gnss, bool]], refused: set[int]) -> float:
    """Return the longest time (s) for which healthy fixes were refused: until one was used again.

    `fixes` are pairs of a fix and whether it is healthy, `refused` the arrival times (ns) of rejected ones.
    """
    longest, since = 0.0, None
    for fix, healthy in fixes:
        if not healthy:
            since = None
        elif fix.rx_ns in refused:
            since = fix.rx_ns if since is None else since  # arrival: stamps may be wrong after a reboot
            longest = max(longest, (fix.rx_ns - since) * 1e-9)
        elif since is not None:
            longest, since = max(longest, (fix.rx_ns - since) * 1e-9), None
    return longest


def judge_recording(
    name: str, log: RecordingLog, false: Sequence[tuple[float, float]], truth: Track | None = None
) -> RecordingResult:
    """Judge one flown recording; `false` are the times (s of its clock) at which GNSS is not healthy."""
    records = log.records

    def healthy(fix: Gnss) -> bool:
        return fix.has_3d_fix and not any(a <= fix.t_ns * 1e-9 < b for a, b in false)

    fixes = [(fix, healthy(fix)) for fix in new_fixes(records)]
    refused = {r.rx_ns for r in records if isinstance(r, Rejection) and r.source.lower().startswith("gnss")}
    good = Track.of((f.t_ns * 1e-9, f.lat, f.lon) for f, is_good in fixes if is_good)
    solutions = Track.of((r.t_ns * 1e-9, r.lat, r.lon) for r in records if isinstance(r, Solution))
    corrected, autopilot = _median(solutions.distance(good)), _median(autopilot_track(records).distance(good))
    against = None if truth is None else _median(truth.distance(solutions))
    longest = longest_refusal(fixes, refused)
    harmful = any(_healthy_at(t_ns, fixes) for t_ns in log.set_2_ns)
    worse = corrected is not None and autopilot is not None and corrected - autopilot > MOST_WORSE_M
    begin = fixes[0][0].t_ns if fixes else 0
    return RecordingResult(
        name=name,
        seconds=(fixes[-1][0].t_ns - begin) * 1e-9 if fixes else 0.0,
        fixes=len(good.t),
        refused_s=longest,
        corrected_m=corrected,
        autopilot_m=autopilot,
        truth_m=against,
        excluded=any(isinstance(r, Event) and r.text.startswith("gnss is excluded") for r in records),
        set_2_s=(log.set_2_ns[0] - begin) * 1e-9 if log.set_2_ns else None,
        harmful=harmful,
        passed=len(solutions.t) > 0 and longest <= MOST_REFUSED_S and not harmful and not worse,
    )


def _healthy_at(t_ns: int, fixes: Sequence[tuple[Gnss, bool]]) -> bool:
    """Whether the last fix that arrived before `t_ns` is healthy and not older than two seconds."""
    before = [(fix, good) for fix, good in fixes if fix.rx_ns <= t_ns]
    return bool(before) and before[-1][1] and t_ns - before[-1][0].rx_ns < 2 * SECOND_NS


def _median(values: Floats) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


# ---------------------------------------------------------------------------------------------------------
# Files
# ---------------------------------------------------------------------------------------------------------


def read_truth(path: Path) -> tuple[Track, float | None]:
    """Return the truth over the time since boot (s, rad), and the time since boot at which `t` is zero."""
    text = lzma.decompress(path.read_bytes()).decode()
    rows: list[dict[str, Any]] = list(csv.DictReader(io.StringIO(text)))
    boot = [float(row["sim"]) + TRUTH_LATE_S for row in rows]
    places = ((math.radians(float(row["lat"])), math.radians(float(row["lon"]))) for row in rows)
    track = Track.of((boot_s, *place) for boot_s, place in zip(boot, places))
    t = [float(row["t"]) for row in rows]
    zero = next((b for (a, b), (x, y) in zip(pairwise(boot), pairwise(t)) if x < 0.0 <= y), None)
    return track, zero


def fly_harm(path: Path, truth_path: Path) -> RecordingResult:
    """Fly a recording of `harm` with the profile it was flown with, and judge it against the truth."""
    data = lzma.decompress(path.read_bytes())
    log = fly_frames(tlog.Tlog(data), Config(output=BESIDE))
    name = f"harm/{path.name.removesuffix('.tlog.xz')}"
    truth, false = None, []
    if truth_path.exists() and log.boot_ms:
        track, zero = read_truth(truth_path)
        flight_s, boot_s = np.array([(t_ns * 1e-9, ms * 1e-3) for t_ns, ms in log.boot_ms]).T
        # point by point: a simulator that is slower than real time drifts against the companion's clock
        truth = track._replace(t=np.interp(track.t, boot_s, flight_s, left=math.nan, right=math.nan))
        truth = Track(*(column[np.isfinite(truth.t)] for column in truth))
        if "spoof" in name and zero is not None:
            false = [(float(np.interp(zero, boot_s, flight_s)), math.inf)]
    return judge_recording(name, log, false, truth)


def list_recordings(data: Path) -> list[str]:
    """List the recordings that are there."""
    harm = sorted(f"harm/{path.name}" for path in (data / "harm").glob("*.tlog.xz"))
    return [*harm, *(name for name in LOGS if (data / name).exists())]


def fly_named(data: Path, name: str) -> RecordingResult:
    """Fly one recording of `list_recordings`; those of `LOGS` by default configuration."""
    path, config = data / name, Config()
    if name.startswith("harm/"):
        return fly_harm(path, path.with_name(path.name.replace(".tlog.xz", ".truth.csv.xz")))
    if path.suffix == ".tlog":
        log = fly_frames(tlog.read(path), config)
    else:
        log = fly_log(sources.open_source(path), config)
    return judge_recording(name, log, LOGS[name])
