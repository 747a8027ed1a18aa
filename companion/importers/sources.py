"""Foreign logs -> records: what the companion would have heard, had it been on that flight.

    source = sources.open_source(path)
    for record in source: ...           # Stamped records, in order of arrival
    source.summary()                    # counts, once it is read through

A tlog goes through the link's own Session (who the autopilot is, its reboots, its clock) and through
`wire.decode`, exactly as in flight; only the transport is missing. The clock is the log writer's UNIX time.
Where the log nowhere tells the local origin (old autopilots did not), it is inferred from local and global
positions of one instant.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from companion.importers import dataflash, inertialnav, px4_csv, tlog, ulog
from companion.link import dialect
from companion.link.decode import MAKES, Autopilot, Sender, decode
from companion.link.session import LinkUp, MessageReceived, Rebooted, SecondAutopilot, Session
from companion.nav.geometry import Geodetic, Projection, local_to_geodetic, wrap
from companion.records import (
    Event,
    FilterStatus,
    GlobalPosition,
    LocalOrigin,
    LocalPosition,
    Reboot,
    Reset,
    Stamped,
)
from companion.storage.reader import LogError

_WARNING, _INFO = 4, 6  # MAV_SEVERITY
_GPS_GLOBAL_ORIGIN = 49
_RSBN = dialect.type_named("RSBN_MEASUREMENT").msgid  # a beacon receiver is a component of its own
_POSITION_ABSOLUTE = 16  # EKF_POS_HORIZ_ABS and ESTIMATOR_POS_HORIZ_ABS


class Summary(NamedTuple):
    """What a log held. `corrupt` counts chunks that are no frame, `torn` the bytes of an unfinished end."""

    messages: int
    corrupt: int
    unknown: int
    torn: int
    reboots: int
    records: int


class TlogSource:
    """The records of one tlog, read once. `autopilot_system` heeds no other than that system id."""

    def __init__(self, log: tlog.Tlog, autopilot_system: int | None = None) -> None:
        self.log = log
        self.reboots = self.records = 0
        self._session = Session(autopilot_system=autopilot_system)
        self._sender = Sender(self._session.clock)
        told = any(entry.frame.msgid == _GPS_GLOBAL_ORIGIN for entry in tlog.Tlog(log.data))
        self._origin = None if told else OriginFinder()

    def __iter__(self) -> Iterator[Stamped]:
        """Records in order of arrival: inputs, truth, rejections, and a Reset and a Reboot where one was."""
        for rx_ns, found in self.log:
            for event in self._session.receive(found.raw, rx_ns):
                for record in self._records(event):
                    self.records += 1
                    yield record
            self._session.to_send()  # answers nobody waits for

    def summary(self) -> Summary:
        """The counts so far."""
        log = self.log
        return Summary(log.messages, log.corrupt, log.unknown, log.torn, self.reboots, self.records)

    def _records(self, event: object) -> Iterator[Stamped]:
        match event:
            case MessageReceived(rx_ns, message, found, ours) if ours or found.msgid == _RSBN:
                for record in decode(message, rx_ns, self._sender):
                    yield record
                    if self._origin and (origin := self._origin.see(record, self._sender.autopilot)):
                        yield origin
            case LinkUp(at_ns, system, kind):
                make = MAKES.get(kind, "other")
                self._sender = self._sender._replace(autopilot=make)
                yield Event(at_ns, at_ns, _INFO, f"autopilot {system} ({make}) is heard")
            case Rebooted(at_ns, system):
                self.reboots += 1
                self._origin = self._origin and OriginFinder()
                yield Reset(at_ns, at_ns, "flight", f"autopilot {system} began anew: its boot time went back")
                yield Reboot(at_ns, at_ns, system)
            case SecondAutopilot(at_ns, system, kept):
                yield Event(at_ns, at_ns, _WARNING, f"autopilot {system} is ignored: {kept} is the vehicle's")


class OriginFinder:
    """The local origin out of a local and a global position of about one instant, where no message tells it.

    Both come from one filter, so they are one point; what is left is the rounding of GLOBAL_POSITION_INT
    (1 cm) and what the aircraft does within `APART_NS`: 0.2 m r.m.s. on a copter that sends both at 1-2 Hz.
    Nothing is inferred before the filter vouches for its horizontal position, nor twice.
    """

    APART_NS = 150_000_000

    def __init__(self) -> None:
        self._local: LocalPosition | None = None
        self._global: GlobalPosition | None = None
        self._sound = False
        self._found = False

    def see(self, record: Stamped, autopilot: Autopilot) -> LocalOrigin | None:
        """Take a record; returns the origin once, as soon as it can be told."""
        if isinstance(record, LocalPosition):
            self._local = record
        elif isinstance(record, GlobalPosition):
            self._global = record
        elif isinstance(record, FilterStatus):
            self._sound = bool(record.flags & _POSITION_ABSOLUTE)
        local, known = self._local, self._global
        if self._found or not self._sound or local is None or known is None:
            return None
        if abs(known.t_ns - local.t_ns) > self.APART_NS:
            return None
        self._found = True
        return _origin_between(local, known, "tangent" if autopilot == "other" else autopilot)


def _origin_between(local: LocalPosition, known: GlobalPosition, projection: Projection) -> LocalOrigin:
    """Where `local` is counted from, `known` being the same point a moment apart."""
    later_s = (known.t_ns - local.t_ns) * 1e-9
    x_n = np.array(local.x_n) + later_s * np.array(local.v_n)
    point = origin = Geodetic(known.lat, known.lon, known.alt_msl)
    for _ in range(4):  # a contraction: each turn gains the ratio of the distance to the earth's radius
        back = local_to_geodetic(projection, origin, x_n)
        origin = Geodetic(
            origin.lat + point.lat - back.lat,
            wrap(origin.lon + point.lon - back.lon),
            origin.alt + point.alt - back.alt,
        )
    rx_ns = max(local.rx_ns, known.rx_ns)
    return LocalOrigin(known.t_ns, rx_ns, origin.lat, origin.lon, origin.alt, projection)


class OnboardSource:
    """A log written on board, read once; the counts are of records, for there are no frames."""

    def __init__(self, records: Iterable[Stamped]) -> None:
        self._read = records
        self.reboots = self.records = 0

    def __iter__(self) -> Iterator[Stamped]:
        """Records in the order of the log."""
        for record in self._read:
            self.records += 1
            self.reboots += isinstance(record, Reboot)
            yield record

    def summary(self) -> Summary:
        """The counts so far."""
        return Summary(self.records, 0, 0, 0, self.reboots, self.records)


_READERS: dict[str, Callable[[Path], Iterable[Stamped]]] = {
    ".bin": dataflash.read,
    ".log": dataflash.read,
    ".ulg": ulog.read,
    ".mat": inertialnav.read_matlab,
    ".zip": inertialnav.read_tables,
}
KINDS = (".tlog", *_READERS)
"""How the names of other recorders' logs end."""


def open_source(path: Path, autopilot_system: int | None = None) -> TlogSource | OnboardSource:
    """Open a log of another recorder by its name: a `.tlog`, one written on board, or a folder of topics.

    ValueError or LogError, one sentence, if there is none or it is of no kind that is read.
    """
    if not path.exists():
        raise LogError(f"{path}: no such log")
    kind = path.suffix.lower()
    if kind not in KINDS and not path.is_dir():
        raise ValueError(
            f"{path} is of no kind that is read here: give .mcap, {', '.join(KINDS)} or a folder of topics"
        )
    if path.is_dir():
        return OnboardSource(
            inertialnav.read_tables(path) if inertialnav.is_tables(path) else px4_csv.read(path)
        )
    if kind == ".tlog":
        return TlogSource(tlog.read(path), autopilot_system)
    return OnboardSource(_READERS[kind](path))
