"""MAVLink 2 signatures: made for what goes out, judged for what comes in. No clock, no socket, one key.

    signing = Signing(read_key(path), timestamp=stored(stamps))
    signing.follow(unix_ns, now_ns)             # whenever a clock that is trusted tells the time
    tail = signing.sign(data, link_id, now_ns)  # 13 bytes behind a frame whose flags say it is signed
    reason = signing.judge(frame, now_ns)       # None: let it in
    if signing.wants_storing: store(stamps, signing.to_store())

After https://mavlink.io/en/guide/message_signing.html. One object serves all links of one key, so that what
was heard on one of them cannot be played back on another. The hash is verified first; only a frame made by a
holder of the key reaches the stamps, so a forged one can neither lock a sender out nor move our clock. Then
the stamp must be above the last of its stream, which is (link id, system, component) of the frame; a stream
not known yet may be behind our time by BEHIND. A stamp farther ahead of our time than AHEAD is refused when
our time comes from a trusted clock: a recording of a station whose clock once stood wrong would otherwise
drag everybody along. Without such a clock, time is what genuine frames say.

Kept on disk is a stamp LEAD ahead of all that was sent or accepted, and written again when only BEHIND is
left of the lead; after a restart it is our time.
    DEPARTS FROM the guide: an unknown stream may be 50 s behind and not 60, so that nothing that was
    accepted before a restart is accepted once more after it.
"""

from __future__ import annotations

import enum
import hashlib
import hmac
import os
from collections.abc import Iterable
from pathlib import Path

from companion.link.frame import Frame

#: The guide's epoch, 2015-01-01, in UNIX nanoseconds; a stamp counts 10 us from there in 48 bits.
EPOCH_NS = 1_420_070_400_000_000_000
TICK_NS = 10_000
SECOND = 100_000
LEAD = 60 * SECOND
BEHIND = 50 * SECOND
AHEAD = 60 * SECOND
#: No genuine stamp is this near to the end of its 48 bits (in 2104): it would leave nothing to go on with.
FARTHEST = (1 << 48) - 365 * 86_400 * SECOND
#: RADIO_STATUS: telemetry radios put it into the stream themselves and hold no key.
RADIO_STATUS = 109


class Refusal(enum.Enum):
    """Why a frame was not let in."""

    UNSIGNED = "it is not signed"
    FORGED = "its signature is not of our key"
    REPLAYED = "its stamp is not above the last of its stream"
    OLD = "its stream is new and its stamp is old"
    FUTURE = "its stamp is ahead of our time"


class Signing:
    """The key, our time, and the last stamp of every stream. Stamps are in units of 10 us since 2015."""

    def __init__(
        self,
        key: bytes,
        *,
        timestamp: int = 0,
        refuse_unsigned: bool = True,
        always_accepted: Iterable[int] = (RADIO_STATUS,),
    ) -> None:
        """`timestamp`: what was stored (`stored`). `always_accepted`: message ids let in without a signature.

        ValueError if the key is not of 32 bytes or the stamp is none.
        """
        if len(key) != 32:
            raise ValueError(f"a signing key has 32 bytes, this one {len(key)}: write 64 hexadecimal digits")
        if not 0 <= timestamp < FARTHEST:
            raise ValueError(f"{timestamp} is no stamp of this century: remove the stored stamp")
        self._key = hashlib.sha256(key)
        self._refuse_unsigned = refuse_unsigned
        self._always_accepted = frozenset(always_accepted)
        self._begun = timestamp
        self._newest = timestamp  # of all that was sent, accepted or stored
        self._kept = timestamp  # what is on disk
        self._clock: int | None = None  # trusted time less our instant
        self._streams: dict[tuple[int, int, int], int] = {}

    def follow(self, unix_ns: int, now_ns: int) -> None:
        """Take the time of a trusted clock. Our stamps never go back; where they are ahead they wait."""
        self._clock = (unix_ns - EPOCH_NS - now_ns) // TICK_NS

    def time(self, now_ns: int) -> int:
        """Our time as a stamp: the trusted clock's, not before what was stored; else the newest stamp."""
        if self._clock is None:
            return self._newest
        return max(self._begun, min(self._clock + now_ns // TICK_NS, FARTHEST))

    def sign(self, data: bytes, link_id: int, now_ns: int) -> bytes:
        """The 13 bytes that follow `data`, a whole frame up to its checksum with the flag SIGNED set."""
        self._newest = max(self._newest + 1, self.time(now_ns))
        head = bytes([link_id]) + self._newest.to_bytes(6, "little")
        return head + self._hash(data + head)

    def judge(self, frame: Frame, now_ns: int) -> Refusal | None:
        """Say why `frame` must be refused; None lets it in and advances its stream."""
        if frame.signature is None:
            if self._refuse_unsigned and frame.msgid not in self._always_accepted:
                return Refusal.UNSIGNED
            return None
        if not hmac.compare_digest(self._hash(frame.raw[:-6]), frame.raw[-6:]):
            return Refusal.FORGED
        stamp = int.from_bytes(frame.signature[1:7], "little")
        stream = (frame.signature[0], frame.system, frame.component)
        ours = self.time(now_ns)
        last = self._streams.get(stream)
        if last is not None and stamp <= last:
            return Refusal.REPLAYED
        if last is None and stamp < ours - BEHIND:
            return Refusal.OLD
        if stamp >= FARTHEST or (self._clock is not None and stamp > ours + AHEAD):
            return Refusal.FUTURE
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return None

    @property
    def wants_storing(self) -> bool:
        """Whether the stamp on disk is soon passed by."""
        return self._newest >= self._kept - BEHIND

    def to_store(self) -> int:
        """The stamp to be put on disk now; it is taken for done."""
        self._kept = self._newest + LEAD
        return self._kept

    def _hash(self, data: bytes) -> bytes:
        digest = self._key.copy()
        digest.update(data)
        return digest.digest()[:6]


def read_key(path: Path) -> bytes:
    """The 32 bytes of a key file: raw, or as 64 hexadecimal digits. It must be its owner's alone.

    ValueError says what is wrong with it.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode & 0o777
            data = file.read(1024)
    except OSError as error:
        raise ValueError(
            f"{path}: the signing key cannot be read ({error.strerror}); "
            "make one: (umask 077; head -c32 /dev/urandom | xxd -p -c64 > key)"
        ) from None
    if mode & 0o077:
        raise ValueError(f"{path}: others may reach the signing key (mode {mode:04o}); chmod 600 it")
    if len(data) == 32:
        return data
    try:
        key = bytes.fromhex(data.decode("ascii"))
    except ValueError:
        key = b""
    if len(key) != 32:
        raise ValueError(f"{path}: is no signing key: write 32 raw bytes or 64 hexadecimal digits")
    return key


def stored(path: Path) -> int:
    """The stamp that `store` left, 0 where none is. ValueError where something else stands there."""
    try:
        text = path.read_text("ascii").strip()
        if not text.isdecimal():
            raise ValueError
    except FileNotFoundError:
        return 0
    except (OSError, ValueError):
        raise ValueError(
            f"{path}: holds no stamp of signed frames; remove it, and old frames may be accepted once"
        ) from None
    return int(text)


def store(path: Path, stamp: int) -> None:
    """Put `stamp` on disk so that a power cut leaves the old one or this one. OSError if it cannot be."""
    beside = path.with_name(path.name + ".new")
    with beside.open("w", encoding="ascii") as file:
        file.write(f"{stamp}\n")
        file.flush()
        os.fsync(file.fileno())
    os.replace(beside, path)
