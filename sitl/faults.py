"""What goes wrong, as functions on streams: records in and records out, or chunks of bytes in and out.

`RECORD_FAULTS` act on one kind of record of what the sensors say, inside a window of flight time.
`LINK_FAULTS` act on the chunks (frames) that leave for the companion. What concerns the autopilot itself
(its reboot, its clock, its local origin) it carries out alone: `AUTOPILOT_FAULTS` names them.
`CONSUMER_FAULTS` are of those who take what the companion gives: the autopilot, and the log's disk
(`FullDisk`). A `Fault` is the order for one: name, window, size and, where it matters, which beacon. The
size's meaning stands in each function.

Record faults read `t_ns`, the flight's time, and write `rx_ns` where they delay.
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
from companion.records import AirData, Gnss, LocalPosition, RsbnFix, Stamped
from companion.storage.mcap_file import DiskFile

R = TypeVar("R", bound=Stamped)
Generator = np.random.Generator


@dataclass(frozen=True, slots=True)
class Fault:
    """An order for a fault from `start_s` to `end_s` of flight time; `size` None: the fault's usual one.

    `beacon` confines a fault of beacons to one of them.
    """

    name: str
    start_s: float
    end_s: float = math.inf
    size: float | None = None
    beacon: int | None = None

    def __post_init__(self) -> None:
        if self.name not in NAMES:
            raise ValueError(f"no fault is called {self.name!r}: choose one of {', '.join(NAMES)}")
        if not 0.0 <= self.start_s < self.end_s:
            raise ValueError(
                f"fault {self.name} from {self.start_s:g} to {self.end_s:g} s: let it start at 0 or later "
                "and end after its start"
            )

    def covers(self, t_ns: int) -> bool:
        """Whether the fault is on at this flight time."""
        return self.start_s <= t_ns * 1e-9 < self.end_s


class Chunk(NamedTuple):
    """Bytes that reach the companion at `due_ns`."""

    due_ns: int
    data: bytes


# ---------------------------------------------------------------------------------------------------------
# Faults of one record: (record, fault, size, rng) -> the record changed, or None for none
# ---------------------------------------------------------------------------------------------------------

Change: TypeAlias = Callable[[Any, Fault, float, Generator], Any]


def _moved(fix: Gnss, north: float, east: float) -> Gnss:
    there = displace(fix.lat, fix.lon, 0.0, north, east, 0.0)
    return replace(fix, lat=there.lat, lon=there.lon)


def gnss_jump(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """The fix stands `size` metres to the north-east."""
    return _moved(fix, size * math.sqrt(0.5), size * math.sqrt(0.5))


def gnss_spoof(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """The fix is drawn off eastwards at `size` m/s; its velocity tells the same lie."""
    v_n = fix.v_n and (fix.v_n[0], fix.v_n[1] + size, fix.v_n[2])
    return replace(_moved(fix, 0.0, size * (fix.t_ns * 1e-9 - fault.start_s)), v_n=v_n)


def gnss_jam(fix: Gnss, fault: Fault, size: float, rng: Generator) -> Gnss:
    """No fix."""
    return without_fix(fix)


def without_fix(fix: Gnss) -> Gnss:
    """The type is 1, the satellites are 0, the last numbers stay."""
    return replace(fix, fix=1, satellites=0, v_n=None, sigma_horizontal=None, sigma_velocity=None)


def beacon_bias(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """The range is `size` metres long."""
    return replace(fix, slant_range=None if fix.slant_range is None else max(fix.slant_range + size, 0.0))


def beacon_position(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """The beacon's stated position is `size` metres north of the true one."""
    return replace(fix, lat=displace(fix.lat, fix.lon, fix.alt, size, 0.0, 0.0).lat)


def beacon_north(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """The azimuth is `size` radians too great."""
    return replace(fix, azimuth=None if fix.azimuth is None else (fix.azimuth + size) % math.tau)


def multipath(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix:
    """Every third answer came by a detour: longer by an exponential of mean `size` metres, azimuth off by
    a normal of 1 degree."""
    detour, turned, hit = rng.exponential(size), math.radians(rng.standard_normal()), rng.random() < 1.0 / 3.0
    if not hit:
        return fix
    return beacon_north(beacon_bias(fix, fault, detour, rng), fault, turned, rng)


def drop_out(fix: RsbnFix, fault: Fault, size: float, rng: Generator) -> RsbnFix | None:
    """An answer in `size` of all cases does not come."""
    return None if rng.random() < size else fix


def ins_reset(local: LocalPosition, fault: Fault, size: float, rng: Generator) -> LocalPosition:
    """The local position leaps by `size` metres to the south-west, as when a filter resets itself."""
    (north, east, down), leg = local.x_n, size * math.sqrt(0.5)
    return replace(local, x_n=(north - leg, east - leg, down))


def nan_fields(local: LocalPosition, fault: Fault, size: float, rng: Generator) -> LocalPosition:
    """Position and velocity are NaN on the wire."""
    return replace(local, x_n=(math.nan,) * 3, v_n=(math.nan,) * 3)


def icing(air: AirData, fault: Fault, size: float, rng: Generator) -> AirData:
    """A pitot tube ices up: airspeed sinks by the share `size` within a minute and reads low from then on."""
    grown = min((air.t_ns * 1e-9 - fault.start_s) / 60.0, 1.0)
    return replace(air, airspeed=air.airspeed * (1.0 - size * grown))


def wind_shear(air: AirData, fault: Fault, size: float, rng: Generator) -> AirData:
    """The head wind grows by `size` m/s at once while the path over ground is held."""
    return replace(air, airspeed=max(air.airspeed + size, 0.0))


# ---------------------------------------------------------------------------------------------------------
# Faults of a whole stream
# ---------------------------------------------------------------------------------------------------------


def each(change: Change) -> Callable[[Sequence[R], Fault, float, Generator], list[R]]:
    """The stream fault that changes every record in the window by `change`."""

    def stream_fault(stream: Sequence[R], fault: Fault, size: float, rng: Generator) -> list[R]:
        changed = []
        for record in stream:
            touched = fault.covers(record.t_ns)
            if touched and fault.beacon is not None:
                touched = getattr(record, "beacon", fault.beacon) == fault.beacon
            after = change(record, fault, size, rng) if touched else record
            if after is not None:
                changed.append(after)
        return changed

    return stream_fault


def frozen(stream: Sequence[R], fault: Fault, size: float, rng: Generator) -> list[R]:
    """The last record before the window is said again and again, its own time (or stamp) and all."""
    return _repeated(stream, fault, lambda last, record: replace(last, t_ns=record.t_ns, rx_ns=record.rx_ns))


def stale(stream: Sequence[Gnss], fault: Fault, size: float, rng: Generator) -> list[Gnss]:
    """The last fix before the window is said again and again under stamps that go on."""
    return _repeated(
        stream,
        fault,
        lambda last, due: replace(last, t_ns=due.t_ns, rx_ns=due.rx_ns, stamp_us=due.stamp_us),
    )


def _repeated(stream: Sequence[R], fault: Fault, again: Callable[[R, R], R]) -> list[R]:
    """Inside the window `again` of the last record before it (of the same beacon) and of the one due."""
    out: list[R] = []
    last: dict[int | None, R] = {}
    for record in stream:
        source = getattr(record, "beacon", None)
        if fault.covers(record.t_ns):
            # An air-data message has no stamp: it seems new each time. A fix keeps its receiver's stamp.
            out.append(again(last.setdefault(source, record), record))
        else:
            last[source] = record
            out.append(record)
    return out


def late(stream: Sequence[R], fault: Fault, size: float, rng: Generator) -> list[R]:
    """Records arrive `size` seconds late, honestly stamped."""
    delay = round(size * 1e9)
    moved = [replace(r, rx_ns=r.rx_ns + delay) if fault.covers(r.t_ns) else r for r in stream]
    return sorted(moved, key=lambda r: r.rx_ns)


class RecordFault(NamedTuple):
    """How a fault of records is done: to which kind, its usual size, by what."""

    kind: type[Stamped]
    size: float
    apply: Callable[[Sequence[Any], Fault, float, Generator], list[Any]]


RECORD_FAULTS: dict[str, RecordFault] = {
    "gnss-jump": RecordFault(Gnss, 500.0, each(gnss_jump)),
    "gnss-spoof": RecordFault(Gnss, 2.0, each(gnss_spoof)),
    "gnss-jam": RecordFault(Gnss, 0.0, each(gnss_jam)),
    "gnss-frozen": RecordFault(Gnss, 0.0, frozen),
    "gnss-stale": RecordFault(Gnss, 0.0, stale),
    "gnss-late": RecordFault(Gnss, 5.0, late),
    "beacon-bias": RecordFault(RsbnFix, 1000.0, each(beacon_bias)),
    "beacon-position": RecordFault(RsbnFix, 3000.0, each(beacon_position)),
    "beacon-north": RecordFault(RsbnFix, math.radians(2.0), each(beacon_north)),
    "beacon-multipath": RecordFault(RsbnFix, 1500.0, each(multipath)),
    "beacon-drop-out": RecordFault(RsbnFix, 0.5, each(drop_out)),
    "beacon-frozen": RecordFault(RsbnFix, 0.0, frozen),
    "beacon-late": RecordFault(RsbnFix, 5.0, late),
    "ins-reset": RecordFault(LocalPosition, 200.0, each(ins_reset)),
    "ins-frozen": RecordFault(LocalPosition, 0.0, frozen),
    "ins-nan": RecordFault(LocalPosition, 0.0, each(nan_fields)),
    "airspeed-icing": RecordFault(AirData, 0.5, each(icing)),
    "airspeed-frozen": RecordFault(AirData, 0.0, frozen),
    "wind-shear": RecordFault(AirData, 8.0, each(wind_shear)),
}


def spoil(kind: type[Stamped], stream: Sequence[R], faults: Sequence[Fault], rng: Generator) -> list[R]:
    """The stream of records of `kind` after all faults that concern it, in their order."""
    out = list(stream)
    for fault in faults:
        law = RECORD_FAULTS.get(fault.name)
        if law is not None and law.kind is kind:
            out = law.apply(out, fault, law.size if fault.size is None else fault.size, rng)
    return out


# ---------------------------------------------------------------------------------------------------------
# Faults of the link: chunks of bytes; each in the list falls inside the window
# ---------------------------------------------------------------------------------------------------------


def link_loss(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """Every chunk is lost with probability `size`."""
    return [chunk for chunk in chunks if rng.random() >= size]


def duplicates(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """A chunk comes twice with probability `size`."""
    return [chunk for chunk in chunks for _ in range(1 + (rng.random() < size))]


def reordering(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """Every chunk is held for up to `size` seconds, so that later ones overtake it."""
    return [Chunk(due + int(rng.random() * size * 1e9), data) for due, data in chunks]


def link_late(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """Everything comes `size` seconds late; what is sent after the window waits its turn behind it."""
    return [Chunk(due + round(size * 1e9), data) for due, data in chunks]


def bit_errors(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """Every bit is wrong with probability `size`."""
    out = []
    for due, data in chunks:
        flips = np.packbits(rng.random(8 * len(data)) < size)
        out.append(Chunk(due, (np.frombuffer(data, np.uint8) ^ flips).tobytes()))
    return out


def garbage(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """Before every chunk come random bytes, `size` on average."""
    return [Chunk(due, rng.bytes(int(rng.integers(0, round(2 * size) + 1))) + data) for due, data in chunks]


def cut(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """A chunk ends too early with probability `size`."""
    return [
        Chunk(due, data[: int(rng.integers(0, len(data)))] if rng.random() < size else data)
        for due, data in chunks
    ]


def second_autopilot(chunks: Sequence[Chunk], size: float, rng: Generator) -> list[Chunk]:
    """Everything is said once more, by another system whose number is `size`."""
    out = []
    for due, data in chunks:
        body = data[1:5] + bytes((int(size),)) + data[6:-2]
        check = dialect.TYPES[int.from_bytes(data[7:10], "little")].crc_extra
        crc = crc16.mcrf4xx(body + bytes((check,)))
        out += [Chunk(due, data), Chunk(due, data[:1] + body + crc.to_bytes(2, "little"))]
    return out


class LinkFault(NamedTuple):
    """How a fault of the link is done: its usual size, by what."""

    size: float
    apply: Callable[[Sequence[Chunk], float, Generator], list[Chunk]]


#: Those that need whole frames stand first: bytes are damaged last.
LINK_FAULTS: dict[str, LinkFault] = {
    "second-autopilot": LinkFault(2.0, second_autopilot),
    "link-loss": LinkFault(1.0, link_loss),
    "duplicates": LinkFault(0.1, duplicates),
    "reordering": LinkFault(0.2, reordering),
    "link-late": LinkFault(5.0, link_late),
    "bit-errors": LinkFault(1e-3, bit_errors),
    "garbage": LinkFault(20.0, garbage),
    "cut": LinkFault(0.1, cut),
}

#: Name -> usual size: seconds of silence after a reboot, seconds by which every clock leaps, metres to the
#: north-east by which the origin of the local position moves (told when GPS_GLOBAL_ORIGIN is next due).
AUTOPILOT_FAULTS: dict[str, float] = {"reboot": 8.0, "clock-jump": 3600.0, "origin-change": 1000.0}

#: Name -> usual size: seconds between two reads of an autopilot that is slow, nothing for a disk.
CONSUMER_FAULTS: dict[str, float] = {"slow-consumer": 10.0, "disk-full": 0.0}

NAMES: tuple[str, ...] = (*RECORD_FAULTS, *LINK_FAULTS, *AUTOPILOT_FAULTS, *CONSUMER_FAULTS)


class FullDisk(DiskFile):
    """A disk for the log that takes nothing while `full`."""

    full = False

    def write(self, data: bytes) -> None:
        """Append all of `data`, or a part and an error, as full disks do."""
        if self.full:
            super().write(data[: len(data) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        super().write(data)


def disturb(chunks: Sequence[Chunk], t_ns: int, faults: Sequence[Fault], rng: Generator) -> list[Chunk]:
    """The chunks sent at flight time `t_ns` after all faults of the link that are on."""
    out = list(chunks)
    on = {fault.name: fault for fault in faults if fault.covers(t_ns)}
    for name, law in LINK_FAULTS.items():
        if name in on:
            size = on[name].size
            out = law.apply(out, law.size if size is None else size, rng)
    return out
