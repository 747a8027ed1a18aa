"""MAVLink 2 signing: sign outgoing frames, verify incoming ones. No clock, no socket, one key.

    signing = Signing(read_key(path), timestamp=load_timestamp(stamp_path))
    signing.set_time(unix_ns, now_ns)           # whenever a trusted clock is read
    tail = signing.sign(data, link_id, now_ns)  # 13 bytes after a frame whose flags mark it as signed
    fault = signing.verify(frame, now_ns)       # None: accepted
    if signing.needs_saving:
        replace_text(stamp_path, f"{(timestamp := signing.timestamp_to_save())}\n")
        signing.note_saved(timestamp)

After https://mavlink.io/en/guide/message_signing.html. One object serves all links that share a key, so that
a frame received on one link cannot be replayed on another. The hash is verified first: only a frame made by a
holder of the key reaches the timestamps, so a forged frame can neither lock a sender out nor move our time.
Then the timestamp must be above the last one of its stream, which is (link id, system, component) of the
frame. A new stream may be behind our time by BEHIND. If our time comes from a trusted clock, a timestamp
ahead of it by more than AHEAD is rejected: otherwise a recording made by a station with a wrong clock would
move the time of all others. Without a trusted clock, our time is the newest timestamp of the genuine frames.

The timestamp kept on disk is LEAD ahead of all that were sent or accepted, and is written again when only
BEHIND of the lead is left; after a restart it is our time.
    DEPARTS FROM the guide: a new stream may be 50 s behind and not 60, so that no frame accepted before a
    restart is accepted again after it.
"""

from __future__ import annotations

import enum
import hashlib
import hmac
import os
from collections.abc import Iterable
from pathlib import Path

from companion.link.dialect import mavlink
from companion.link.frame import Frame

#: The guide's epoch, 2015-01-01, in UNIX nanoseconds; a timestamp counts 10 us from there in 48 bits.
EPOCH_NS = 1_420_070_400_000_000_000
TICK_NS = 10_000
#: Ticks in a second.
SECOND = 100_000
LEAD = 60 * SECOND
BEHIND = 50 * SECOND
AHEAD = 60 * SECOND
#: Upper limit of timestamps, a year before the end of their 48 bits (in 2104).
MAX_TIMESTAMP = (1 << 48) - 365 * 86_400 * SECOND


class SignatureFault(enum.Enum):
    """Why a frame was rejected."""

    UNSIGNED = "not signed"
    FORGED = "not signed with our key"
    REPLAYED = "timestamp not above the last of its stream"
    OLD = "timestamp of a new stream too old"
    FUTURE = "timestamp ahead of our time"


class Signing:
    """The key, our time, and the last timestamp of every stream. Timestamps count 10 us from 2015."""

    def __init__(
        self,
        key: bytes,
        *,
        timestamp: int = 0,
        refuse_unsigned: bool = True,
        # telemetry radios insert RADIO_STATUS into the stream and have no key
        always_accepted: Iterable[int] = (mavlink.MAVLINK_MSG_ID_RADIO_STATUS,),
    ) -> None:
        """Create the signing state of one key.

        Parameters
        ----------
        key
            The 32 bytes of the key.
        timestamp
            The timestamp on disk, from `load_timestamp`.
        refuse_unsigned
            Whether frames without a signature are rejected.
        always_accepted
            Message ids accepted without a signature.

        Raises
        ------
        ValueError
            If the key has not 32 bytes or the timestamp is out of range.
        """
        if len(key) != 32:
            raise ValueError(f"a signing key has 32 bytes, this one {len(key)}: write 64 hexadecimal digits")
        if not 0 <= timestamp < MAX_TIMESTAMP:
            raise ValueError(f"signing timestamp {timestamp} is out of range: remove the stored timestamp")
        self._key = hashlib.sha256(key)
        self.refuse_unsigned = refuse_unsigned
        self._always_accepted = frozenset(always_accepted)
        self._start = timestamp
        self._newest = timestamp  # of all that were sent, accepted or stored
        self._saved = timestamp
        self._clock: int | None = None  # trusted time less our clock
        self._streams: dict[tuple[int, int, int], int] = {}

    def set_time(self, unix_ns: int, now_ns: int) -> None:
        """Set our time from a trusted clock. Sent timestamps never go back; if they are ahead, they wait."""
        self._clock = (unix_ns - EPOCH_NS - now_ns) // TICK_NS

    def time(self, now_ns: int) -> int:
        """Return our time: the trusted clock's, not before the stored one; else the newest timestamp."""
        if self._clock is None:
            return self._newest
        return max(self._start, min(self._clock + now_ns // TICK_NS, MAX_TIMESTAMP))

    def sign(self, data: bytes, link_id: int, now_ns: int) -> bytes:
        """Return the 13 bytes to append to `data`, a frame up to its checksum with the flag SIGNED set."""
        self._newest = max(self._newest + 1, self.time(now_ns))
        head = bytes([link_id]) + self._newest.to_bytes(6, "little")
        return head + self._hash(data + head)

    def verify(self, frame: Frame, now_ns: int) -> SignatureFault | None:
        """Return why `frame` must be rejected; None accepts it and advances its stream."""
        fault = self.examine(frame, now_ns)
        if fault is None and frame.signature is not None:
            stamp = _timestamp(frame.signature)
            self._streams[_stream(frame, frame.signature)] = stamp
            self._newest = max(self._newest, stamp)
        return fault

    def examine(self, frame: Frame, now_ns: int) -> SignatureFault | None:
        """Return why `frame` must be rejected, None if it may be accepted; changes nothing."""
        if frame.signature is None:
            if self.refuse_unsigned and frame.msgid not in self._always_accepted:
                return SignatureFault.UNSIGNED
            return None
        if not hmac.compare_digest(self._hash(frame.raw[:-6]), frame.raw[-6:]):
            return SignatureFault.FORGED
        stamp = _timestamp(frame.signature)
        ours = self.time(now_ns)
        last = self._streams.get(_stream(frame, frame.signature))
        if last is not None and stamp <= last:
            return SignatureFault.REPLAYED
        if last is None and stamp < ours - BEHIND:
            return SignatureFault.OLD
        if stamp >= MAX_TIMESTAMP or (self._clock is not None and stamp > ours + AHEAD):
            return SignatureFault.FUTURE
        return None

    @property
    def needs_saving(self) -> bool:
        """Whether less than BEHIND is left of the lead of the timestamp on disk."""
        return self._newest >= self._saved - BEHIND

    def timestamp_to_save(self) -> int:
        """Return the timestamp to write to disk now; call `note_saved` with it once it is there."""
        return self._newest + LEAD

    def note_saved(self, timestamp: int) -> None:
        """Note what is on disk."""
        self._saved = timestamp

    def _hash(self, data: bytes) -> bytes:
        digest = self._key.copy()
        digest.update(data)
        return digest.digest()[:6]


def _timestamp(signature: bytes) -> int:
    return int.from_bytes(signature[1:7], "little")


def _stream(frame: Frame, signature: bytes) -> tuple[int, int, int]:
    return signature[0], frame.system, frame.component


def read_key(path: Path) -> bytes:
    """Read the 32 bytes of a key file: raw, or as 64 hexadecimal digits.

    Raises
    ------
    ValueError
        If it cannot be read, is accessible to others than its owner, or holds no key.
    """
    if path.exists() and not path.is_file():  # a pipe would keep the reader waiting
        raise ValueError(f"{path} is not a regular file: give the name of a file")
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode & 0o777
            data = file.read(1024)
    except OSError as error:
        absent = isinstance(error, FileNotFoundError)
        advice = "make one: companion signing init" if absent else "give a file that you may read"
        raise ValueError(f"{path}: the signing key cannot be read ({error.strerror}); {advice}") from None
    if mode & 0o077:
        raise ValueError(f"{path}: the signing key is accessible to others (mode {mode:04o}); chmod 600 it")
    if len(data) == 32:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != 32:
        raise ValueError(f"{path}: not a signing key: write 32 raw bytes or 64 hexadecimal digits")
    return key


def load_timestamp(path: Path) -> int:
    """Read the timestamp of a file; 0 if there is none, ValueError if it is invalid."""
    try:
        text = path.read_text("ascii").strip()
        if not text.isdecimal():
            raise ValueError
    except FileNotFoundError:
        return 0
    except (OSError, ValueError):
        raise ValueError(
            f"{path}: holds no signing timestamp; remove it (old frames may then be accepted once)"
        ) from None
    return int(text)
