"""The autopilot's time on the companion's clock. Pure: every instant is handed in.

MAVLink stamps its measurements with the time since the autopilot's boot, or with UNIX time. Two ways lead
from there to the companion's clock, local = boot + offset:

  arrival   Every stamped message gives arrival - stamp = offset + delay with delay >= 0, so the offset lies
            on the lower envelope of what arrives. The envelope may rise slowly (DRIFT), as fast as two
            crystals may part, and at once to the least delay of the last WINDOW: a simulator's clock may run
            slow by a hundredth. It is there from the first message, needs no answer, and errs by the least
            delay (late).
  TIMESYNC  The autopilot's clock read between two readings of ours: offset = middle - reading, in error by
            half the round trip at most. Among recent answers the one of least round trip is believed, a
            little less with every second of its age. Preferred while it is fresh and agrees with the
            arrivals. One whose round trip is longer than ROUGH waited somewhere, most likely on one way of
            the two (an autopilot that reads seldom), and its middle may be off by seconds: it does not take
            the place of a better one, and alone it only bounds what the arrivals tell.

Stamps that go back by seconds are a reboot: everything is forgotten and begun again. (So is the wrap of a
32-bit millisecond stamp after 49.7 days.) One alone may be a straggler or a false one: it is believed when
the next agrees with it.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

SECOND = 1_000_000_000
#: How fast two clocks may part: crystals at the ends of the temperature range.
DRIFT = 100e-6
#: Two stamps this much older than the newest one mean a reboot.
BACK = 3 * SECOND
#: The envelope is never below the least delay heard in so long.
WINDOW = 20 * SECOND
#: Arrivals that fall below the envelope by more tell that the autopilot's clock was set.
JUMP = 1 * SECOND
#: A TIMESYNC reading that makes the last arrival early, or later than any link is, is of another clock.
LATEST = 10 * SECOND
#: A round trip beyond this is no measure of the way.
ROUGH = SECOND // 4
#: For so long an answer of TIMESYNC is believed.
FRESH = 60 * SECOND
#: Stamps from here on (September 2001) are UNIX time; no autopilot is up for 31 years.
UNIX_EPOCH_FROM = 10**9 * SECOND


class Answer(NamedTuple):
    """One TIMESYNC answer: the offset it gives, its round trip and when it came, all in ns."""

    offset: int
    round_trip: int
    at: int


class BootClock:
    """Maps one autopilot's stamps to the companion's clock. All times are integer nanoseconds."""

    def __init__(self) -> None:
        self._asked: deque[int] = deque(maxlen=8)
        self.outlier: int | None = None
        self._reset()

    def _reset(self) -> None:
        self._newest = -1
        self._envelope: int | None = None
        self._envelope_at = 0
        self._seen = 0  # the last arrival - stamp
        # Of the last WINDOW, (arrival, arrival - stamp), increasing in both: the first is the least.
        self._least: deque[tuple[int, int]] = deque()
        self._back: tuple[int, int] | None = None  # a stamp gone back, and its arrival - stamp
        self._answers: deque[Answer] = deque(maxlen=8)
        self._best: Answer | None = None
        self._unix_minus_boot: int | None = None
        self._asked.clear()

    def heard(self, boot: int, received: int) -> bool:
        """Take the stamp of a message that was stamped when sent. Returns True if it tells of a reboot."""
        seen = received - boot
        rebooted = False
        if boot < self._newest - BACK:
            doubted, self._back = self._back, (boot, seen)
            if doubted is None or boot < doubted[0] or abs(seen - doubted[1]) > BACK:
                return False
            rebooted = True
            self._reset()
        self._back = None
        self._newest = max(self._newest, boot)
        self._seen = seen
        least = self._least
        while least and least[-1][1] >= seen:
            least.pop()
        least.append((received, seen))
        while least[0][0] < received - WINDOW:
            least.popleft()
        if self._envelope is None:
            self._envelope = seen
        else:
            raised = self._envelope + int(DRIFT * (received - self._envelope_at))
            if seen < raised - JUMP:
                self._answers.clear()
                self._best = None
            self._envelope = max(min(raised, seen), least[0][1])
        self._envelope_at = received
        return rebooted

    def heard_unix(self, unix: int, boot: int) -> None:
        """Take a pair of the autopilot's two times, valid at one instant (SYSTEM_TIME). UNIX 0 is not set."""
        if unix >= UNIX_EPOCH_FROM:
            self._unix_minus_boot = unix - boot

    def ask(self, now: int) -> int:
        """Return the stamp to send in a TIMESYNC request."""
        self._asked.append(now)
        return now

    def answered(self, asked: int, reading: int, now: int) -> bool:
        """Take a TIMESYNC answer; False if it is not to a question of ours or means another clock.

        `outlier` then says by how much (ns) it would have the last message arrive early (below 0) or late.
        """
        self.outlier = None
        if asked not in self._asked:
            return False
        self._asked.remove(asked)
        answer = Answer((asked + now) // 2 - reading, now - asked, now)
        if self._envelope is not None:
            delay = self._seen - answer.offset
            if not -JUMP <= delay <= LATEST:
                self.outlier = delay
                return False
            # The offset is certainly no less than this: a simulated clock may slip faster than any crystal.
            self._envelope = max(self._envelope, answer.offset - answer.round_trip // 2)
        self._answers.append(answer)
        best = min(self._answers, key=lambda a: a.round_trip + 2 * DRIFT * (now - a.at))
        held = self._best is not None and self._best.round_trip <= ROUGH and now - self._best.at < FRESH
        if best.round_trip <= ROUGH or not held:
            self._best = best
        return True

    def offset(self, now: int) -> int | None:
        """Return local minus boot time, None before anything was heard."""
        best, envelope = self._best, self._envelope
        if best is None or now - best.at >= FRESH:
            return envelope
        if best.round_trip <= ROUGH or envelope is None:
            return best.offset
        return min(max(envelope, best.offset - best.round_trip // 2), best.offset + best.round_trip // 2)

    def uncertainty(self, now: int) -> int | None:
        """Return half the round trip, plus drift, that the offset rests on; None if on arrivals alone."""
        if self._best is None or now - self._best.at >= FRESH:
            return None
        return self._best.round_trip // 2 + int(DRIFT * (now - self._best.at))

    def local(self, stamp: int, received: int) -> int:
        """Return when a message stamped `stamp` (since boot, or UNIX) was valid, on the companion's clock.

        Never later than its arrival. The arrival itself where the stamp is 0 or cannot be mapped yet.
        """
        offset = self.offset(received)
        if stamp <= 0 or offset is None:
            return received
        if stamp >= UNIX_EPOCH_FROM:
            if self._unix_minus_boot is None:
                return received
            stamp -= self._unix_minus_boot
        return min(stamp + offset, received)
