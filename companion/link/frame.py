"""MAVLink frame reader and writer. Knows no clock, no socket, no key, and no meaning of a message.

    reader = Reader()
    for event in reader.receive(data):     # any split of the stream gives the same events
        ...                                # Frame | UnknownFrame | BadFrame
    reader.close()                         # at the end of a file: events of the bytes still buffered

A frame (MAVLink 1 or 2) is accepted if its checksum over header, payload and the message's CRC_EXTRA byte is
correct. After a rejection the search continues at the next byte, so a lost or damaged byte costs only the
frame it hit, and not the frames that a wrong length would cover.

The checksum of an unknown message id cannot be verified. Such a frame is skipped as a whole only if another
frame starts where it ends (a magic byte, and legal flags for MAVLink 2); otherwise it is treated as noise and
its bytes are searched too. It is reported without its payload. It counts as neither received nor lost where
its sequence number is the next one of its sender.

The buffer holds at most one frame of maximum size and the header of the next. No input raises. A signature is
kept with its frame and not verified.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Callable
from typing import NamedTuple

from fastcrc import crc16

from companion.link import dialect

MAGIC_V1, MAGIC_V2 = 0xFE, 0xFD
SIGNED = 0x01
SIGNATURE_SIZE = 13
#: Header, longest payload, checksum, signature.
MAX_FRAME_SIZE = 10 + 255 + 2 + SIGNATURE_SIZE
#: Maximum of buffered bytes: a frame of unknown id whose successor's flags are not received yet.
MAX_WAITING = MAX_FRAME_SIZE + 2
#: Senders with sequence counters of their own; frames of further senders count in the total only.
MAX_SENDERS = 256
#: A run of rejected bytes is reported at this length at the latest.
MAX_RUN = 1024

_MAGIC = re.compile(b"[\xfd\xfe]")
#: CRC_EXTRA by message id.
_CHECK_BYTE = {msgid: bytes([kind.crc_extra]) for msgid, kind in dialect.TYPES.items()}
_BASE_SIZE = {msgid: kind.base_size for msgid, kind in dialect.TYPES.items()}
_crc = crc16.mcrf4xx


class Frame(NamedTuple):
    """A frame with a correct checksum. `payload` is as sent: MAVLink 2 trims trailing zeros."""

    msgid: int
    payload: bytes
    sequence: int
    system: int
    component: int
    #: 13 bytes: link id, timestamp, hash; not verified.
    signature: bytes | None
    #: The whole frame as received, signature included.
    raw: bytes


class UnknownFrame(NamedTuple):
    """An apparent frame of a message unknown to the dialects; its contents are not verified."""

    msgid: int
    sequence: int
    system: int
    component: int
    size: int


class Reason(enum.Enum):
    """Why bytes were rejected."""

    JUNK = "no frame starts here"
    CHECKSUM = "wrong checksum"
    LENGTH = "a MAVLink 1 payload shorter than its message"
    FLAGS = "unknown incompatibility flags"
    UNKNOWN = "unknown message id, not followed by another frame"
    TORN = "the input ended inside a frame"


class BadFrame(NamedTuple):
    """A run of rejected bytes up to the next frame: why its first byte was rejected, and its length."""

    reason: Reason
    size: int


class Counts(NamedTuple):
    """Frames of one sender: received, and lost by the sequence numbers."""

    received: int
    lost: int


Event = Frame | UnknownFrame | BadFrame


def parse(buffer: bytes, at: int = 0) -> Frame | UnknownFrame | Reason | None:
    """Parse the frame at `at`: a frame, the reason why there is none, or None if more bytes are needed.

    `Reader` calls it at every position; a container that knows where its frames start (tlog) can call it
    alone.
    """
    left = len(buffer) - at
    if left < 8:
        return None if left <= 0 or buffer[at] in (MAGIC_V1, MAGIC_V2) else Reason.JUNK
    magic = buffer[at]
    signed = 0
    if magic == MAGIC_V2:
        signed = buffer[at + 2]
        if signed > SIGNED:
            return Reason.FLAGS
        head = at + 10
        end = head + buffer[at + 1]
        size = end + 2 - at + SIGNATURE_SIZE * signed
        if left < size:
            return None
        sequence, system, component = buffer[at + 4 : at + 7]
        msgid = buffer[at + 7] | buffer[at + 8] << 8 | buffer[at + 9] << 16
    elif magic == MAGIC_V1:
        head = at + 6
        end = head + buffer[at + 1]
        size = end + 2 - at
        if left < size:
            return None
        sequence, system, component, msgid = buffer[at + 2 : head]
    else:
        return Reason.JUNK
    check_byte = _CHECK_BYTE.get(msgid)
    if check_byte is None:
        follows = _starts_frame(buffer, at + size)
        if follows is None:
            return None
        return UnknownFrame(msgid, sequence, system, component, size) if follows else Reason.UNKNOWN
    if _crc(buffer[at + 1 : end] + check_byte) != buffer[end] | buffer[end + 1] << 8:
        return Reason.CHECKSUM
    if magic == MAGIC_V1 and end - head < _BASE_SIZE[msgid]:
        return Reason.LENGTH
    raw = buffer[at : at + size]
    signature = raw[-SIGNATURE_SIZE:] if signed else None
    return Frame(msgid, buffer[head:end], sequence, system, component, signature, raw)


def _starts_frame(buffer: bytes, at: int) -> bool | None:
    """Return whether a frame seems to start at `at`; None if more bytes are needed."""
    head = buffer[at : at + 3]
    if not head or (head[0] == MAGIC_V2 and len(head) < 3):
        return None
    return head[0] == MAGIC_V1 or (head[0] == MAGIC_V2 and head[2] <= SIGNED)


class Reader:
    """Frame reader of one byte stream, which may be split anywhere; counts frames by sender."""

    def __init__(self, counting: bool = True) -> None:
        """`counting`: count every frame; if False, the caller calls `count` for each accepted frame, and
        `skip` for each unknown one, in their order.
        """
        self._counting = counting
        self._waiting = b""
        self._run = 0
        self._run_reason = Reason.JUNK
        self._senders: dict[tuple[int, int], list[int]] = {}  # next sequence number, received, lost
        self.received = self.lost = 0  # of all senders

    def receive(self, data: bytes) -> list[Event]:
        """Process the next bytes of the stream; return the completed events in order."""
        return self._scan(self._waiting + data if self._waiting else bytes(data), ended=False)

    def close(self) -> list[Event]:
        """Return the events of the buffered bytes at the end of the stream. The reader may be used again."""
        events = self._scan(self._waiting, ended=True)
        self._end_run(events)
        return events

    @property
    def waiting(self) -> int:
        """Number of bytes that wait for the rest of their frame, at most MAX_WAITING."""
        return len(self._waiting)

    @property
    def counts(self) -> dict[tuple[int, int], Counts]:
        """Frames received and lost by (system, component).

        A step back of the sequence (a reordered or repeated frame, a reboot) does not count as a loss. A gap
        of 128 frames or more cannot be distinguished from a step back.
        """
        return {sender: Counts(received, lost) for sender, (_, received, lost) in self._senders.items()}

    def count(self, frame: Frame) -> None:
        """Count a frame of its sender, and the frames lost before it."""
        sequence = frame.sequence
        self.received += 1
        sender = self._senders.get((frame.system, frame.component))
        if sender is None:
            if len(self._senders) < MAX_SENDERS:
                self._senders[frame.system, frame.component] = [sequence + 1 & 0xFF, 1, 0]
            return
        gap = sequence - sender[0] & 0xFF
        if 0 < gap < 128:
            sender[2] += gap
            self.lost += gap
        sender[0] = sequence + 1 & 0xFF
        sender[1] += 1

    def skip(self, frame: UnknownFrame) -> None:
        """Expect the sequence number after `frame`, if its own was expected; it may be noise."""
        sender = self._senders.get((frame.system, frame.component))
        if sender is not None and sender[0] == frame.sequence:
            sender[0] = frame.sequence + 1 & 0xFF

    def _scan(self, buffer: bytes, ended: bool) -> list[Event]:
        events: list[Event] = []
        at, end = 0, len(buffer)
        while at < end:
            found = parse(buffer, at)
            if isinstance(found, Frame):
                if self._run:
                    self._end_run(events)
                if self._counting:
                    self.count(found)
                events.append(found)
                at += len(found.raw)
            elif isinstance(found, UnknownFrame):
                self._end_run(events)
                if self._counting:
                    self.skip(found)
                events.append(found)
                at += found.size
            elif found is not None or ended:
                magic = _MAGIC.search(buffer, at + 1)
                after = magic.start() if magic else end
                self._reject(Reason.TORN if found is None else found, after - at, events)
                at = after
            else:
                break
        self._waiting = buffer[at:]
        return events

    def _reject(self, reason: Reason, size: int, events: list[Event]) -> None:
        if not self._run:
            self._run_reason = reason
        self._run += size
        while self._run >= MAX_RUN:
            events.append(BadFrame(self._run_reason, MAX_RUN))
            self._run -= MAX_RUN
            self._run_reason = Reason.JUNK

    def _end_run(self, events: list[Event]) -> None:
        if self._run:
            events.append(BadFrame(self._run_reason, self._run))
            self._run = 0


def encode(
    message: dialect.Message,
    sequence: int,
    system: int,
    component: int,
    sign: Callable[[bytes], bytes] | None = None,
) -> bytes:
    """Encode `message` as a MAVLink 2 frame. ValueError if a field does not fit its wire type.

    `sign` returns the 13 bytes of the signature for the frame that precedes them.
    """
    msgid = dialect.id_of(message)
    payload = dialect.payload(message).rstrip(b"\0") or b"\0"
    header = bytes((len(payload), SIGNED if sign else 0, 0, sequence, system, component))
    body = header + msgid.to_bytes(3, "little") + payload
    data = b"\xfd" + body + _crc(body + _CHECK_BYTE[msgid]).to_bytes(2, "little")
    return data + sign(data) if sign else data
