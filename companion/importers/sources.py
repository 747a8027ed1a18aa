"""Log importer: records from the logs of other recorders, as the companion would have received them.

    source = sources.open_source(path)
    for record in source: ...           # Stamped records, in order of arrival
    source.summary()                    # counts, after the iteration

A tlog passes through the Session (autopilot detection, reboots, clock) and `link.decode` exactly as in
flight; only the transport is missing. The clock is the UNIX time of the program that wrote the log. If no
message of the log states the local origin (old autopilots), it is inferred from local and global positions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from companion.importers import dataflash, inertialnav, px4_csv, tlog, ulog
from companion.link.decode import DECODED, MAKES, Autopilot, Sender, decode
from companion.link.dialect import mavlink, rsbn
from companion.link.session import LinkUp, MessageReceived, Rebooted, SecondAutopilot, Session
from companion.nav.geometry import Projection
from companion.navigator.local_origin import LOG_WINDOW_NS, infer_origin
from companion.records import (
    Event,
    FilterStatus,
    GlobalPosition,
    LocalOrigin,
    LocalPosition,
    Reboot,
    Reset,
    Severity,
    Stamped,
)
from companion.storage.reader import LogError

_RSBN = rsbn.MAVLINK_MSG_ID_RSBN_MEASUREMENT  # sent by a beacon receiver, which is a separate component
_POSITION_ABSOLUTE = mavlink.EKF_POS_HORIZ_ABS  # the same bit as ESTIMATOR_POS_HORIZ_ABS


class ImportSummary(NamedTuple):
    """Counts of an imported log.

    `corrupt` counts runs of bytes that are not a frame, `torn` the bytes of a truncated end.
    """

    messages: int
    corrupt: int
    unknown: int
    torn: int
    reboots: int
    records: int


class TlogSource:
    """The records of one tlog, read once. With `autopilot_system`, only that system id is the autopilot."""

    def __init__(self, log: tlog.Tlog, autopilot_system: int | None = None) -> None:
        self.log = log
        self.reboots = self.records = 0
        self._session = Session(autopilot_system=autopilot_system)
        self._sender = Sender(self._session.clock)
        stated = any(
            entry.frame.msgid == mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN for entry in tlog.Tlog(log.data)
        )
        self._origin = None if stated else OriginFinder()

    def __iter__(self) -> Iterator[Stamped]:
        """Yield records in order of arrival.

        Inputs, truth, rejections, and a Reset and a Reboot at each reboot.
        """
        for rx_ns, found in self.log:
            for event in self._session.receive(found.raw, rx_ns):
                for record in self._records(event):
                    self.records += 1
                    yield record
            self._session.to_send()  # discard replies: there is no link

    def summary(self) -> ImportSummary:
        """Return the counts so far."""
        log = self.log
        return ImportSummary(log.messages, log.corrupt, log.unknown, log.torn, self.reboots, self.records)

    def _records(self, event: object) -> Iterator[Stamped]:
        match event:
            case MessageReceived(received_ns=rx_ns, frame=found, from_autopilot=ours):
                if found.msgid not in DECODED or not (ours or found.msgid == _RSBN):
                    return
                for record in decode(event.message, rx_ns, self._sender):
                    yield record
                    if self._origin and (origin := self._origin.update(record, self._sender.autopilot)):
                        yield origin
            case LinkUp(at_ns, system, kind):
                make = MAKES.get(kind, "other")
                self._sender = self._sender._replace(autopilot=make)
                yield Event(at_ns, at_ns, Severity.INFO, f"autopilot {system} ({make}) detected")
            case Rebooted(at_ns, system):
                self.reboots += 1
                self._origin = self._origin and OriginFinder()
                yield Reset(at_ns, at_ns, "flight", f"autopilot {system} rebooted: its boot time decreased")
                yield Reboot(at_ns, at_ns, system)
            case SecondAutopilot(at_ns, system, kept):
                yield Event(
                    at_ns, at_ns, Severity.WARNING, f"autopilot {system} ignored: autopilot {kept} is in use"
                )


class OriginFinder:
    """Infers the local origin of a log in which no message states it (see `navigator.local_origin`).

    Only once per boot, and not before the autopilot's filter flags its horizontal position as valid.
    """

    def __init__(self) -> None:
        self._local: LocalPosition | None = None
        self._global: GlobalPosition | None = None
        self._position_valid = False
        self._found = False

    def update(self, record: Stamped, autopilot: Autopilot) -> LocalOrigin | None:
        """Add a record. Return the origin once, as soon as it can be inferred."""
        if isinstance(record, LocalPosition):
            self._local = record
        elif isinstance(record, GlobalPosition):
            self._global = record
        elif isinstance(record, FilterStatus):
            self._position_valid = bool(record.flags & _POSITION_ABSOLUTE)
        local, known = self._local, self._global
        if self._found or not self._position_valid or local is None or known is None:
            return None
        projection: Projection = "tangent" if autopilot == "other" else autopilot
        origin = infer_origin(local, known, projection, LOG_WINDOW_NS)
        self._found = origin is not None
        return origin


class OnboardSource:
    """A log recorded on board, read once; its counts are records, as it has no frames."""

    def __init__(self, records: Iterable[Stamped]) -> None:
        self._read = records
        self.reboots = self.records = 0

    def __iter__(self) -> Iterator[Stamped]:
        """Yield records in the order of the log."""
        for record in self._read:
            self.records += 1
            self.reboots += isinstance(record, Reboot)
            yield record

    def summary(self) -> ImportSummary:
        """Return the counts so far."""
        return ImportSummary(self.records, 0, 0, 0, self.reboots, self.records)


_READERS: dict[str, Callable[[Path], Iterable[Stamped]]] = {
    ".bin": dataflash.read,
    ".log": dataflash.read,
    ".ulg": ulog.read,
    ".mat": inertialnav.read_matlab,
    ".zip": inertialnav.read_tables,
}
LOG_SUFFIXES = (".tlog", *_READERS)
"""File name suffixes of the logs of other recorders."""


def open_source(path: Path, autopilot_system: int | None = None) -> TlogSource | OnboardSource:
    """Open a log of another recorder by its suffix: a `.tlog`, an onboard log, or a folder of topics.

    Raises ValueError or LogError, one sentence, if it does not exist or its type is not supported.
    """
    if not path.exists():
        raise LogError(f"{path}: no such log")
    kind = path.suffix.lower()
    if kind not in LOG_SUFFIXES and not path.is_dir():
        raise ValueError(
            f"{path}: unknown file type; give .mcap, {', '.join(LOG_SUFFIXES)} or a folder of topics"
        )
    if path.is_dir():
        return OnboardSource(
            inertialnav.read_tables(path) if inertialnav.has_tables(path) else px4_csv.read(path)
        )
    if kind == ".tlog":
        return TlogSource(tlog.read(path), autopilot_system)
    return OnboardSource(_READERS[kind](path))
