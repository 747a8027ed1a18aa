"""Log importer: records from the logs of other recorders, as the companion would have received them.

    source = sources.open_source(path)
    for record in source: ...           # Stamped records, in order of arrival
    source.summary()                    # counts, after the iteration

A tlog passes through the Session (autopilot detection, reboots, clock) and `link.decode` exactly as in
flight; only the transport is missing. Its clock is the autopilot's boot time, counted from the UNIX time of
the first message, so that a stalled link does not change the flight. If no message of the log states the
local origin (old autopilots), it is inferred from local and global positions.

Every source reads what is intact: damaged parts are skipped and named once, by an event at the end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import NamedTuple, Protocol

from companion.importers import (
    dataflash,
    dataflash_messages,
    inertialnav,
    px4_csv,
    tlog,
    ulog,
    ulog_messages,
)
from companion.importers.foreign_file import MAX_TEXT, Damage, map_file, usable
from companion.link.decode import DECODED, MAKES, Autopilot, Sender, decode
from companion.link.dialect import MEASUREMENTS, Message, mavlink
from companion.link.frame import Frame
from companion.link.session import LinkUp, MessageReceived, Rebooted, SecondAutopilot, Session
from companion.link.status_text import CHUNK
from companion.navigator.local_origin import LOG_WINDOW_NS, infer_origin
from companion.records import (
    Event,
    FilterStatus,
    GlobalPosition,
    LocalOrigin,
    LocalPosition,
    Projection,
    Reboot,
    Reset,
    Severity,
    Stamped,
)
from companion.storage.mcap_file import MAGIC
from companion.storage.reader import LogError

_STATUSTEXT: int = mavlink.MAVLINK_MSG_ID_STATUSTEXT
_POSITION_ABSOLUTE = mavlink.EKF_POS_HORIZ_ABS  # the same bit as ESTIMATOR_POS_HORIZ_ABS


class ImportSummary(NamedTuple):
    """Counts of an imported log.

    `corrupt` counts the parts that could not be read, `torn` the bytes of a truncated end of a tlog.
    """

    messages: int
    corrupt: int
    unknown: int
    torn: int
    reboots: int
    records: int


def read_ahead(records: Iterable[Stamped]) -> tuple[Stamped | None, Iterator[Stamped]]:
    """Return the first record, None without one, and an iterator over all records, the first included."""
    rest = iter(records)
    first = next(rest, None)
    return first, rest if first is None else chain((first,), rest)


class _Records:
    """Usable records of a log, read once and counted."""

    def __init__(self, path: Path, records: Iterable[Stamped], damage: Damage) -> None:
        self.damage = damage
        self.reboots = self.records = 0
        self._usable = usable(path, records, damage)

    def read_first(self) -> None:
        """Read the first record ahead. Raises LogError if nothing can be read."""
        _, self._usable = read_ahead(self._usable)

    def __iter__(self) -> Iterator[Stamped]:
        """Yield the records in the order of the log, damage as an event at the end."""
        for record in self._usable:
            self.records += 1
            self.reboots += isinstance(record, Reboot)
            yield record


class TlogSource(_Records):
    """The records of one tlog in order of arrival: inputs, truth, events, rejections; a Reset and a Reboot at
    each reboot. With `autopilot_system`, only that system id is the autopilot.
    """

    def __init__(
        self, log: tlog.Tlog, autopilot_system: int | None = None, path: Path = Path("the tlog")
    ) -> None:
        if autopilot_system is not None:
            _check_autopilot(log, autopilot_system, path)
        super().__init__(path, self._all_records(), Damage())
        self.log = log
        self._session = Session(autopilot_system=autopilot_system)
        self._sender = Sender(self._session.clock)
        self._times = tlog.BootTimeBase()
        self._text = ""  # of a STATUSTEXT in several parts
        self._origin = None if log.contains(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN) else OriginFinder()

    def summary(self) -> ImportSummary:
        """Return the counts so far."""
        log = self.log
        return ImportSummary(log.messages, log.corrupt, log.unknown, log.torn, self.reboots, self.records)

    def _all_records(self) -> Iterator[Stamped]:
        log, session = self.log, self._session
        doubtful: Frame | None = None  # a frame whose boot time has to be confirmed by the next
        for rx_ns, found in log:
            ours = found.system == session.autopilot and found.component == mavlink.MAV_COMP_ID_AUTOPILOT1
            boot_us = tlog.boot_time_us(found) if ours else None
            now_ns = self._times.update(rx_ns // 1000, boot_us)
            if boot_us is not None and doubtful is not None and not self._times.confirmed:
                self.damage.add(
                    f"a message at {rx_ns} ns", len(doubtful.raw), "its boot time does not continue"
                )
                doubtful = None
            if now_ns is None:
                doubtful = found
                continue
            for each in (found,) if doubtful is None or boot_us is None else (doubtful, found):
                for event in session.receive_frame(each, now_ns):
                    yield from self._records(event)
            if session.is_confirmed:  # another vehicle later in the log has its own clock, origin and flight
                session.lock_to_system(session.autopilot, now_ns)
            doubtful = doubtful if boot_us is None else None
            session.to_send()  # discard replies: there is no link
        if log.corrupt:
            more = f"and {log.corrupt - 1} more" if log.corrupt > 1 else "only"
            self.damage.add(f"byte {log.corrupt_at}", log.corrupt_bytes, f"not a frame, {more}")
        if session.autopilot is None:
            self.damage.whole = "it has no HEARTBEAT of an autopilot"
        if log.torn:
            self.damage.add(f"byte {len(log.data) - log.torn}", log.torn, "truncated")

    def _records(self, event: object) -> Iterator[Stamped]:
        match event:
            case MessageReceived(received_ns=rx_ns, frame=found, from_autopilot=ours):
                if ours and found.msgid == _STATUSTEXT:
                    yield from self._status_text(event.message, rx_ns)
                if found.msgid not in DECODED or not (ours or found.msgid in MEASUREMENTS):
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
                self._origin = self._origin and OriginFinder()
                yield Reset(at_ns, at_ns, "flight", f"autopilot {system} rebooted: its boot time decreased")
                yield Reboot(at_ns, at_ns, system)
            case SecondAutopilot(at_ns, system, kept):
                used = kept or self._session.required_system  # 0: that one has not been received yet
                text = f"autopilot {system} ignored: autopilot {used} is in use; link.system_id selects one"
                yield Event(at_ns, at_ns, Severity.WARNING, text)

    def _status_text(self, message: Message, rx_ns: int) -> Iterator[Event]:
        """Convert a text of the autopilot; a text in parts (MAVLink 2) when its last part has arrived."""
        part = message.text
        self._text = part if message.chunk_seq == 0 else (self._text + part)[:MAX_TEXT]
        if (message.id == 0 or len(part) < CHUNK) and self._text.strip():
            yield Event(rx_ns, rx_ns, min(message.severity, Severity.DEBUG), self._text)


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


class OnboardSource(_Records):
    """The records of a log recorded on board; it has no frames to count."""

    def __init__(self, path: Path, log: ForeignLog) -> None:
        super().__init__(path, log, log.damage)

    def summary(self) -> ImportSummary:
        """Return the counts so far."""
        return ImportSummary(self.records, self.damage.parts, 0, 0, self.reboots, self.records)


class ForeignLog(Protocol):
    """A log of another recorder, opened; parts that cannot be read are in `damage`."""

    damage: Damage

    def __iter__(self) -> Iterator[Stamped]:
        """Yield records by time."""


_READERS: dict[str, Callable[[Path], ForeignLog]] = {
    ".bin": dataflash.DataflashLog,
    ".log": dataflash.DataflashLog,
    ".ulg": ulog.UlogFile,
    ".ulog": ulog.UlogFile,
    ".mat": inertialnav.read_matlab,
    ".zip": inertialnav.read_tables,
    "tables": inertialnav.read_tables,  # folders
    "topics": px4_csv.CsvFolder,
}
#: Suffixes of the formats that begin with bytes of their own.
_BEGINNINGS: dict[bytes, tuple[str, ...]] = {
    MAGIC: (".mcap",),
    ulog_messages.MAGIC: (".ulg", ".ulog"),
    dataflash_messages.HEAD + b"\x80": (".bin", ".log"),
}
LOG_SUFFIXES = (".tlog", *(kind for kind in _READERS if kind.startswith(".")))
"""File name suffixes of the logs of other recorders."""


def _check_autopilot(log: tlog.Tlog, wanted: int, path: Path) -> None:
    """Check that a log has this autopilot. Raises LogError, with those that it has."""
    systems = set[int]()
    for entry in tlog.Tlog(log.data):
        if entry.frame.component == mavlink.MAV_COMP_ID_AUTOPILOT1:
            if entry.frame.system == wanted:
                return
            systems.add(entry.frame.system)
    has = " and ".join(map(str, sorted(systems)))
    if has:
        raise LogError(
            f"{path}: it has no autopilot {wanted}; it has {has}: set link.system_id, or leave it out"
        )


def open_source(
    path: Path, autopilot_system: int | None = None, others: tuple[str, ...] = ()
) -> TlogSource | OnboardSource:
    """Open a log of another recorder by its suffix: a `.tlog`, an onboard log, or a folder of topics.

    Raises LogError, one sentence, if it does not exist or cannot be read, or its type is not supported; the
    sentence lists `others`, suffixes that the caller reads itself, too.
    """
    if not path.exists():
        raise LogError(f"{path}: no such log")
    kind = path.suffix.lower()
    if kind not in LOG_SUFFIXES and not path.is_dir():
        known = ", ".join((*others, *LOG_SUFFIXES))
        raise LogError(f"{path}: unknown file type; give {known} or a folder of topics")
    if path.is_file():
        start = map_file(path)[: len(MAGIC)]
        for magic, suffixes in _BEGINNINGS.items():
            if start.startswith(magic) and kind not in suffixes:
                raise LogError(f"{path} is a {suffixes[0]} log by its content: give it that ending")
    if path.is_dir():
        kind = "tables" if inertialnav.has_tables(path) else "topics"
    source: TlogSource | OnboardSource
    if kind == ".tlog":
        source = TlogSource(tlog.read(path), autopilot_system, path)
    else:
        source = OnboardSource(path, _READERS[kind](path))
    source.read_first()
    return source
