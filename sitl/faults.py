"""Fault models as functions on streams: records to records, or chunks of bytes to chunks of bytes.

`RECORD_FAULTS` change one kind of sensor record inside a window of flight time. `LINK_FAULTS` change the
chunks (frames) sent to the companion. `AUTOPILOT_FAULTS` (reboot, clock, local origin) are carried out by
`sitl.autopilot`. `CONSUMER_FAULTS` concern the receivers of the companion's output: the autopilot, and the
disk of the log (`FullDisk`). A `Fault` gives name, window, size and, for beacons, which one. The docstring of
each function defines the size.

Record faults use `t_ns`, the flight time; delays change `rx_ns`.
"""

from __future__ import annotations

import errno
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from fastcrc import crc16
from msgspec.structs import replace

from companion.link import dialect
from companion.nav.geometry import displace
from companion.records import AirData, Attitude, Gnss, LocalPosition, RsbnFix, Stamped
from companion.storage.mcap_file import DiskFile

R = TypeVar("R", bound=Stamped)
Generator = np.random.Generator

FAST_M_S = 10.0  # the course is known at this speed
OUTAGE_S = 60.0  # without a fix, before the fix of "gnss-return"


@dataclass(frozen=True, slots=True)
class Fault:
    """Fault from `start_s` to `end_s` of flight time; `size` None: the default size.

    `beacon` limits a beacon fault to one beacon.
    """

    name: str
    start_s: float
    end_s: float = math.inf
    size: float | None = None
    beacon: int | None = None

    def __post_init__(self) -> None:
        if self.name not in NAMES:
            raise ValueError(f"unknown fault {self.name!r}: choose one of {', '.join(NAMES)}")
        if not 0.0 <= self.start_s < self.end_s:
            raise ValueError(
                f"fault {self.name} from {self.start_s:g} to {self.end_s:g} s: it must start at 0 or later "
                "and end after its start"
            )

    def covers(self, t_ns: int) -> bool:
        """Whether the fault is active at this flight time."""
        return self.start_s <= t_ns * 1e-9 < self.end_s


class TimedBytes(NamedTuple):
    """Bytes that arrive at the companion at `due_ns`."""

    due_ns: int
    data: bytes


# ---------------------------------------------------------------------------------------------------------
# Faults of one record: (record, fault, size, rng) -> changed record, or None to drop it
# ---------------------------------------------------------------------------------------------------------

RecordChange: TypeAlias = Callable[[Any, Fault, float, Generator], Any]


def _displace_fix(fix: Gnss, north: float, east: float) -> Gnss:
    there = displace(fix.lat, fix.lon, 0.0, north, east, 0.0)
    return replace(fix, lat=there.lat, lon=there.lon)


def gnss_jump(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """Displace the fix `size` metres to the north-east."""
    return _displace_fix(fix, size * math.sqrt(0.5), size * math.sqrt(0.5))


def gnss_spoof(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """Drift the fix eastwards at `size` m/s, with a consistent velocity."""
    v_n = fix.v_n and (fix.v_n[0], fix.v_n[1] + size, fix.v_n[2])
    return replace(_displace_fix(fix, 0.0, size * (fix.t_ns * 1e-9 - fault.start_s)), v_n=v_n)


def gnss_accelerate(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """Drift the fix eastwards with an acceleration of `size` m/s^2, with a consistent velocity."""
    t = fix.t_ns * 1e-9 - fault.start_s
    v_n = fix.v_n and (fix.v_n[0], fix.v_n[1] + size * t, fix.v_n[2])
    return replace(_displace_fix(fix, 0.0, 0.5 * size * t * t), v_n=v_n)


def gnss_velocity(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """Make the velocity greater by the share `size` than the positions move.

    ArduPilot's simulator flies over a sphere, whose positions are read on the ellipsoid: 0.25 % at 60 deg.
    """
    return replace(fix, v_n=fix.v_n and (fix.v_n[0] * (1.0 + size), fix.v_n[1] * (1.0 + size), fix.v_n[2]))


def gnss_return(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """Remove the fix for `OUTAGE_S`; after it the fix is displaced `size` metres to the north-east."""
    in_outage = fix.t_ns * 1e-9 - fault.start_s < OUTAGE_S
    return without_fix(fix) if in_outage else gnss_jump(fix, fault, size, rng)


def gnss_jam(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """Remove the fix."""
    return without_fix(fix)


def without_fix(fix: Gnss) -> Gnss:
    """Return the record without a fix: type 1, 0 satellites, last position unchanged."""
    return replace(fix, fix=1, satellites=0, v_n=None, sigma_horizontal=None, sigma_velocity=None)


def beacon_bias(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """Add `size` metres to the slant range."""
    return replace(fix, slant_range=None if fix.slant_range is None else max(fix.slant_range + size, 0.0))


def beacon_position(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """Displace the stated beacon position `size` metres to the north."""
    return replace(fix, lat=displace(fix.lat, fix.lon, fix.alt, size, 0.0, 0.0).lat)


def beacon_north(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """Add `size` radians to the azimuth."""
    return replace(fix, azimuth=None if fix.azimuth is None else (fix.azimuth + size) % math.tau)


def multipath(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """Add multipath to a third of the answers: exponential range error (mean `size` m), azimuth 1 deg."""
    detour, turned, hit = rng.exponential(size), math.radians(rng.standard_normal()), rng.random() < 1.0 / 3.0
    if not hit:
        return fix
    return beacon_north(beacon_bias(fix, fault, detour, rng), fault, turned, rng)


def drop_out(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix | None:
    """Drop an answer with probability `size`."""
    return None if rng.random() < size else fix


def ins_reset(local: LocalPosition, fault: Fault, size: float, rng: Generator) -> LocalPosition:
    """Shift the local position `size` metres to the south-west, as at a filter reset."""
    (north, east, down), leg = local.x_n, size * math.sqrt(0.5)
    return replace(local, x_n=(north - leg, east - leg, down))


def ins_drift(local: LocalPosition, fault: Fault, size: float, rng: Generator) -> LocalPosition:
    """Drift the local position to the south at `size` m/s, with a consistent velocity."""
    (north, east, down), (v_north, v_east, v_down) = local.x_n, local.v_n
    gone = size * (local.t_ns * 1e-9 - fault.start_s)
    return replace(local, x_n=(north - gone, east, down), v_n=(v_north - size, v_east, v_down))


def nan_fields(local: LocalPosition, fault: Fault, size: float, rng: Generator) -> LocalPosition:
    """Set position and velocity to NaN."""
    return replace(local, x_n=(math.nan,) * 3, v_n=(math.nan,) * 3)


def icing(air: AirData, fault: Fault, size: float, rng: Generator) -> AirData:
    """Ice the pitot tube: airspeed decreases by the fraction `size` within a minute and stays low."""
    grown = min((air.t_ns * 1e-9 - fault.start_s) / 60.0, 1.0)
    return replace(air, airspeed=air.airspeed * (1.0 - size * grown))


def pitot_stuck(air: AirData, fault: Fault, size: float, rng: Generator) -> AirData:
    """Hold the airspeed at `size` m/s."""
    return replace(air, airspeed=size)


def pitot_scale(air: AirData, fault: Fault, size: float, rng: Generator) -> AirData:
    """Multiply the airspeed by `size`."""
    return replace(air, airspeed=air.airspeed * size)


def heading_off(attitude: Attitude, fault: Fault, size: float, rng: Generator) -> Attitude:
    """Add `size` radians to the heading."""
    return replace(attitude, heading=(attitude.heading + size) % math.tau)


def wind_shear(air: AirData, fault: Fault, size: float, rng: Generator) -> AirData:
    """Step the head wind by `size` m/s with unchanged ground track."""
    return replace(air, airspeed=max(air.airspeed + size, 0.0))


# ---------------------------------------------------------------------------------------------------------
# Faults of a whole stream
# ---------------------------------------------------------------------------------------------------------


def per_record(change: RecordChange) -> Callable[[Sequence[R], Fault, float, Generator], list[R]]:
    """Return the stream fault that applies `change` to every record in the window."""

    def stream_fault(stream: Sequence[R], fault: Fault, size: float, rng: Generator) -> list[R]:
        changed = []
        for record in stream:
            affected = fault.covers(record.t_ns)
            if affected and fault.beacon is not None:
                affected = getattr(record, "beacon", fault.beacon) == fault.beacon
            after = change(record, fault, size, rng) if affected else record
            if after is not None:
                changed.append(after)
        return changed

    return stream_fault


def repeat_last(*stamps: str) -> Callable[[Sequence[R], Fault, float, Generator], list[R]]:
    """Return the stream fault that repeats the last record before the window, of the same beacon.

    Times advance, and the receiver's own stamp if `stamps` names it; an air-data message has none, so it
    looks new.
    """

    def stream_fault(stream: Sequence[R], fault: Fault, size: float, rng: Generator) -> list[R]:
        out: list[R] = []
        last: dict[int | None, R] = {}
        for record in stream:
            source = getattr(record, "beacon", None)
            if fault.covers(record.t_ns):
                new = {name: getattr(record, name) for name in ("t_ns", "rx_ns", *stamps)}
                out.append(replace(last.setdefault(source, record), **new))
            else:
                last[source] = record
                out.append(record)
        return out

    return stream_fault


def delayed(stream: Sequence[R], fault: Fault, size: float, rng: Generator) -> list[R]:
    """Delay records by `size` seconds, with correct stamps."""
    delay = round(size * 1e9)
    moved = [replace(r, rx_ns=r.rx_ns + delay) if fault.covers(r.t_ns) else r for r in stream]
    return sorted(moved, key=lambda r: r.rx_ns)


def stamped_late(stream: Sequence[Gnss], fault: Fault, size: float, rng: Generator) -> list[Gnss]:
    """Delay fixes by `size` seconds and stamp them at their arrival, as a receiver without a stamp does."""
    delay = round(size * 1e9)

    def late(r: Gnss) -> Gnss:
        stamp_us = r.stamp_us and r.stamp_us + delay // 1000  # 0: none
        return replace(r, t_ns=r.t_ns + delay, rx_ns=r.rx_ns + delay, stamp_us=stamp_us)

    return sorted((late(r) if fault.covers(r.t_ns) else r for r in stream), key=lambda r: r.rx_ns)


def lever_arm(stream: Sequence[Gnss], fault: Fault, size: float, rng: Generator) -> list[Gnss]:
    """Move the antenna `size` metres ahead of the IMU along the course; in turns it has its own velocity.

    At a low speed the course is that of the nearest time at a higher one.
    """
    fixes = [(r.t_ns * 1e-9, *r.v_n[:2]) for r in stream if r.v_n and math.hypot(*r.v_n[:2]) > FAST_M_S]
    t, north, east = np.array(fixes).T
    at = np.array([r.t_ns * 1e-9 for r in stream])
    course = np.interp(at, t, np.unwrap(np.arctan2(east, north)))
    times, first = np.unique(at, return_index=True)  # a fix may come twice
    rates = np.interp(at, times, np.gradient(course[first], times))
    out = []
    for fix, angle, rate in zip(stream, course.tolist(), rates.tolist()):
        if fault.covers(fix.t_ns):
            ahead = size * math.cos(angle), size * math.sin(angle)
            v = fix.v_n and (fix.v_n[0] - rate * ahead[1], fix.v_n[1] + rate * ahead[0], fix.v_n[2])
            fix = replace(_displace_fix(fix, *ahead), v_n=v)
        out.append(fix)
    return out


def beacons_anywhere(stream: Sequence[RsbnFix], fault: Fault, size: float, rng: Generator) -> list[RsbnFix]:
    """State each beacon at a wrong place, 1 km to `size` metres off, each scale of distance alike."""
    off: dict[int, tuple[float, float]] = {}
    out = []
    for fix in stream:
        if fix.beacon not in off:
            away, bearing = 1000.0 * (size / 1000.0) ** rng.random(), math.tau * rng.random()
            off[fix.beacon] = away * math.cos(bearing), away * math.sin(bearing)
        there = displace(fix.lat, fix.lon, fix.alt, *off[fix.beacon], 0.0)
        is_wrong = fault.covers(fix.t_ns) and fault.beacon in (None, fix.beacon)
        out.append(replace(fix, lat=there.lat, lon=there.lon) if is_wrong else fix)
    return out


class RecordFault(NamedTuple):
    """Record fault: kind of record, default size, function."""

    kind: type[Stamped]
    size: float
    apply: Callable[[Sequence[Any], Fault, float, Generator], list[Any]]


RECORD_FAULTS: dict[str, RecordFault] = {
    "gnss-jump": RecordFault(Gnss, 500.0, per_record(gnss_jump)),
    "gnss-spoof": RecordFault(Gnss, 2.0, per_record(gnss_spoof)),
    "gnss-accelerate": RecordFault(Gnss, 0.003, per_record(gnss_accelerate)),
    "gnss-velocity": RecordFault(Gnss, -0.003, per_record(gnss_velocity)),
    "gnss-return": RecordFault(Gnss, 450.0, per_record(gnss_return)),
    "gnss-latency": RecordFault(Gnss, 0.2, stamped_late),
    "gnss-lever-arm": RecordFault(Gnss, 5.0, lever_arm),
    "gnss-jam": RecordFault(Gnss, 0.0, per_record(gnss_jam)),
    "gnss-frozen": RecordFault(Gnss, 0.0, repeat_last()),
    "gnss-stale": RecordFault(Gnss, 0.0, repeat_last("stamp_us")),
    "gnss-late": RecordFault(Gnss, 5.0, delayed),
    "beacon-bias": RecordFault(RsbnFix, 1000.0, per_record(beacon_bias)),
    "beacon-position": RecordFault(RsbnFix, 3000.0, per_record(beacon_position)),
    "beacon-anywhere": RecordFault(RsbnFix, 160e3, beacons_anywhere),
    "beacon-north": RecordFault(RsbnFix, math.radians(2.0), per_record(beacon_north)),
    "beacon-multipath": RecordFault(RsbnFix, 1500.0, per_record(multipath)),
    "beacon-drop-out": RecordFault(RsbnFix, 0.5, per_record(drop_out)),
    "beacon-frozen": RecordFault(RsbnFix, 0.0, repeat_last()),
    "beacon-late": RecordFault(RsbnFix, 5.0, delayed),
    "ins-reset": RecordFault(LocalPosition, 200.0, per_record(ins_reset)),
    "ins-drift": RecordFault(LocalPosition, 1.0, per_record(ins_drift)),
    "ins-frozen": RecordFault(LocalPosition, 0.0, repeat_last()),
    "ins-nan": RecordFault(LocalPosition, 0.0, per_record(nan_fields)),
    "airspeed-icing": RecordFault(AirData, 0.5, per_record(icing)),
    "airspeed-frozen": RecordFault(AirData, 0.0, repeat_last()),
    "pitot-stuck": RecordFault(AirData, 8.0, per_record(pitot_stuck)),
    "pitot-scale": RecordFault(AirData, 1.5, per_record(pitot_scale)),
    "heading-off": RecordFault(Attitude, math.radians(5.0), per_record(heading_off)),
    "wind-shear": RecordFault(AirData, 8.0, per_record(wind_shear)),
}


def apply_record_faults(
    kind: type[Stamped], stream: Sequence[R], faults: Sequence[Fault], rng: Generator
) -> list[R]:
    """Apply all faults of this `kind` of record to the stream, in order."""
    out = list(stream)
    for fault in faults:
        model = RECORD_FAULTS.get(fault.name)
        if model is not None and model.kind is kind:
            out = model.apply(out, fault, model.size if fault.size is None else fault.size, rng)
    return out


# ---------------------------------------------------------------------------------------------------------
# Faults of the link, on chunks of bytes inside the window
# ---------------------------------------------------------------------------------------------------------


def link_loss(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Drop every chunk with probability `size`."""
    return [chunk for chunk in chunks if rng.random() >= size]


def duplicates(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Duplicate a chunk with probability `size`."""
    return [chunk for chunk in chunks for _ in range(1 + (rng.random() < size))]


def reordering(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Delay every chunk by up to `size` seconds, so that later chunks overtake it."""
    return [TimedBytes(due + int(rng.random() * size * 1e9), data) for due, data in chunks]


def link_late(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Delay everything by `size` seconds; order is kept, so chunks after the window wait too."""
    return [TimedBytes(due + round(size * 1e9), data) for due, data in chunks]


def bit_errors(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Flip every bit with probability `size`."""
    out = []
    for due, data in chunks:
        flips = np.packbits(rng.random(8 * len(data)) < size)
        out.append(TimedBytes(due, (np.frombuffer(data, np.uint8) ^ flips).tobytes()))
    return out


def garbage(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Insert random bytes before every chunk, `size` on average."""
    return [
        TimedBytes(due, rng.bytes(int(rng.integers(0, round(2 * size) + 1))) + data) for due, data in chunks
    ]


def truncated(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Truncate a chunk with probability `size`."""
    return [
        TimedBytes(due, data[: int(rng.integers(0, len(data)))] if rng.random() < size else data)
        for due, data in chunks
    ]


def second_autopilot(chunks: Sequence[TimedBytes], size: float, rng: Generator) -> list[TimedBytes]:
    """Repeat every frame with system id `size`."""
    out = []
    for due, data in chunks:
        body = data[1:5] + bytes((int(size),)) + data[6:-2]
        check = dialect.TYPES[int.from_bytes(data[7:10], "little")].crc_extra
        crc = crc16.mcrf4xx(body + bytes((check,)))
        out += [TimedBytes(due, data), TimedBytes(due, data[:1] + body + crc.to_bytes(2, "little"))]
    return out


class LinkFault(NamedTuple):
    """Link fault: default size, function."""

    size: float
    apply: Callable[[Sequence[TimedBytes], float, Generator], list[TimedBytes]]


#: In order of application: faults that need whole frames first, damage to bytes last.
LINK_FAULTS: dict[str, LinkFault] = {
    "second-autopilot": LinkFault(2.0, second_autopilot),
    "link-loss": LinkFault(1.0, link_loss),
    "duplicates": LinkFault(0.1, duplicates),
    "reordering": LinkFault(0.2, reordering),
    "link-late": LinkFault(5.0, link_late),
    "bit-errors": LinkFault(1e-3, bit_errors),
    "garbage": LinkFault(20.0, garbage),
    "cut": LinkFault(0.1, truncated),
}

#: Name -> default size: seconds of silence after a reboot, clock jump in seconds, shift of the local origin
#: to the north-east in metres (sent with the next GPS_GLOBAL_ORIGIN).
AUTOPILOT_FAULTS: dict[str, float] = {"reboot": 8.0, "clock-jump": 3600.0, "origin-change": 1000.0}

#: Name -> default size: seconds between two reads of a slow autopilot; unused for a disk.
CONSUMER_FAULTS: dict[str, float] = {"slow-consumer": 10.0, "disk-full": 0.0}

NAMES: tuple[str, ...] = (*RECORD_FAULTS, *LINK_FAULTS, *AUTOPILOT_FAULTS, *CONSUMER_FAULTS)


class FullDisk(DiskFile):
    """Disk for the log that rejects writes while `full`."""

    full = False

    def write(self, at: int, data: bytes) -> None:
        """Write `data`; while `full`, write half of it and raise ENOSPC, as a full disk does."""
        if self.full:
            super().write(at, data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write(at, data)


def apply_link_faults(
    chunks: Sequence[TimedBytes], t_ns: int, faults: Sequence[Fault], rng: Generator
) -> list[TimedBytes]:
    """Apply all active link faults to the chunks sent at flight time `t_ns`."""
    out = list(chunks)
    on = {fault.name: fault for fault in faults if fault.covers(t_ns)}
    for name, model in LINK_FAULTS.items():
        if name in on:
            size = on[name].size
            out = model.apply(out, model.size if size is None else size, rng)
    return out
