"""The autopilot's time on the companion's clock. Pure: every instant is handed in.

MAVLink stamps its measurements with the time since the autopilot's boot, or with UNIX time. Two ways lead
from there to the companion's clock, local = boot + offset:

  arrival   Every stamped message gives arrival - stamp = offset + delay with delay >= 0, so the offset lies
            on the lower envelope of what arrives. The envelope may rise slowly (DRIFT), as fast as two
            crystals may part. It is there from the first message, needs no answer, and errs by the least
            delay (late).
  TIMESYNC  The autopilot's clock read between two readings of ours: asked - reading <= offset <= answered -
            reading. Among recent answers the one of least round trip is believed, a little less with every
            second of its age, and its middle taken. Preferred while it is fresh and agrees with the
            arrivals. One whose round trip is longer than ROUGH waited somewhere, most likely on one way of
            the two (a link that is late, an autopilot that reads seldom), and its middle may be off by
            seconds: it does not take the place of a better one, and alone it only bounds what the arrivals
            tell.

All that arrives late from one moment on is a link that is late, or a clock that stood still or was set back.
A late link leaves the lower bound of TIMESYNC where it was, for its round trips are as long as it is late;
a clock set back moves it at once. So while TIMESYNC is answered nothing but that bound lifts the envelope,
and measurements that come late are placed when they were made. Where it is not answered there is no telling
the two apart, and the envelope follows the least delay of the last WINDOW, but no faster than SLIP: a
simulator's clock may run slow by a hundredth.

A stamp that arrives before even TIMESYNC's lower bound lets it (before the envelope, without one) is of a
clock that was set forward. Stamps that go back by seconds are of a reboot, if the autopilot can be so young:
everything is forgotten and begun again. (So is the wrap of a 32-bit millisecond stamp after 49.7 days.) If
not, its clock was set back and only the mapping is begun again. After a silence in which the autopilot may
have booted its stamps need not go back: that they are behind by more than any link is late tells as much. One
alone may be a straggler or a false one: it is believed when the next agrees with it.
"""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import NamedTuple

SECOND = 1_000_000_000
#: How fast two clocks may part: crystals at the ends of the temperature range.
DRIFT = 100e-6
#: Two stamps this much older than the newest one mean a reboot.
BACK = 3 * SECOND
#: Without TIMESYNC the envelope follows the least delay heard in so long,
WINDOW = 20 * SECOND
#: but rises no faster than a simulator's clock may run slow.
SLIP = 0.012
#: Arrivals that fall below what is possible by more tell that the autopilot's clock was set.
JUMP = 1 * SECOND
#: A TIMESYNC reading that makes the last arrival early, or later than any link is, is of another clock.
LATEST = 10 * SECOND
#: What comes later than this is told as late, and what is not stamped is taken for as late as what is.
LATE = 1 * SECOND
#: A round trip beyond this is no measure of the way.
ROUGH = SECOND // 4
#: For so long an answer of TIMESYNC is believed.
FRESH = 60 * SECOND
#: Stamps from here on (September 2001) are UNIX time; no autopilot is up for 31 years.
UNIX_EPOCH_FROM = 10**9 * SECOND


class News(Enum):
    """What a stamp may tell of the autopilot's clock."""

    REBOOTED = "rebooted"
    SET = "set"


class Answer(NamedTuple):
    """One TIMESYNC answer: when it was asked and came, and the reading in between, all in ns."""

    asked: int
    reading: int
    at: int

    @property
    def round_trip(self) -> int:
        """From question to answer."""
        return self.at - self.asked

    @property
    def least(self) -> int:
        """No offset is less: the reading was taken after the question."""
        return self.asked - self.reading

    @property
    def most(self) -> int:
        """Nor greater: it was taken before the answer came."""
        return self.at - self.reading

    @property
    def offset(self) -> int:
        """The middle, in error by half the round trip at most."""
        return (self.asked + self.at) // 2 - self.reading


class BootClock:
    """Maps one autopilot's stamps to the companion's clock. All times are integer nanoseconds."""

    def __init__(self) -> None:
        self._asked: deque[int] = deque(maxlen=64)
        self.outlier: int | None = None
        self._reset()

    def _reset(self) -> None:
        self._newest = -1
        self._heard_at = 0  # arrival of the newest
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

    def heard(self, boot: int, received: int) -> News | None:
        """Take the stamp of a message that was stamped when sent. Returns what it tells of the clock."""
        seen, news = received - boot, None
        if boot < self._newest - BACK or self._slept(boot, received):
            doubted, self._back = self._back, (boot, seen)
            if doubted is None or boot < doubted[0] or abs(seen - doubted[1]) > BACK:
                return None
            is_young = boot <= received - self._heard_at + LATEST
            news = News.REBOOTED if is_young else News.SET
            self._reset()
        self._back = None
        if boot > self._newest:
            self._newest, self._heard_at = boot, received
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
            if seen < self._possible(received) - JUMP:
                self._answers.clear()
                self._best = None
                news = News.SET
            self._envelope = self._followed(self._envelope, seen, received)
        self._envelope_at = received
        return news

    def _slept(self, boot: int, received: int) -> bool:
        """Whether this stamp, though no step back, is of one that booted in the silence before it."""
        if boot > received - self._heard_at:
            return False
        offset = self.offset(received)
        return offset is not None and received - boot - offset > LATEST

    def _possible(self, now: int) -> int:
        """The least offset that there can be: by TIMESYNC, without it by what has arrived."""
        if self._is_answered(now):
            return max(answer.least - int(DRIFT * (now - answer.at)) for answer in self._answers)
        assert self._envelope is not None
        return self._envelope

    def _followed(self, envelope: int, seen: int, now: int) -> int:
        """The envelope once something has arrived."""
        passed = now - self._envelope_at
        followed = min(envelope + int(DRIFT * passed), seen)
        if self._is_answered(now):
            return followed
        return max(followed, min(self._least[0][1], envelope + int(SLIP * passed)))

    def _is_answered(self, now: int) -> bool:
        return bool(self._answers) and now - self._answers[-1].at < FRESH

    def heard_unix(self, unix: int, boot: int) -> None:
        """Take a pair of the autopilot's two times, valid at one instant (SYSTEM_TIME). UNIX 0 is not set."""
        if unix >= UNIX_EPOCH_FROM:
            self._unix_minus_boot = unix - boot

    def ask(self, now: int) -> int:
        """Return the stamp to send in a TIMESYNC request."""
        self._asked.append(now)
        return now

    def answered(self, asked: int, reading: int, now: int) -> bool:
        """Take a TIMESYNC answer; False if it is not to a question of ours, means another clock, or
        nothing stamped was heard yet.

        `outlier` then says by how much (ns) it would have the last message arrive early (below 0) or late.
        """
        self.outlier = None
        if asked not in self._asked:
            return False
        self._asked.remove(asked)
        if self._envelope is None:
            return False  # nothing was heard that it could be judged by
        answer = Answer(asked, reading, now)
        if self._seen - answer.least < -JUMP or self._seen - answer.most > LATEST:
            self.outlier = self._seen - answer.offset
            return False
        self._envelope = max(self._envelope, answer.least)
        # One clock has no two answers that exclude one another: it was set, or slips faster than a crystal.
        self._answers = deque((a for a in self._answers if self._agree(a, answer)), self._answers.maxlen)
        self._answers.append(answer)
        best = min(self._answers, key=lambda a: a.round_trip + 2 * DRIFT * (now - a.at))
        held = self._best
        if held is not None and held.round_trip <= ROUGH < best.round_trip and self._agree(held, answer):
            best = held if now - held.at < FRESH else best
        self._best = best
        return True

    @staticmethod
    def _agree(before: Answer, after: Answer) -> bool:
        drift = int(DRIFT * (after.at - before.at))
        return before.least - drift <= after.most and after.least <= before.most + drift

    def offset(self, now: int) -> int | None:
        """Return local minus boot time, None before anything was heard."""
        best, envelope = self._best, self._envelope
        if best is None or now - best.at >= FRESH:
            return envelope
        if best.round_trip <= ROUGH or envelope is None:
            return best.offset
        return min(max(envelope, best.least), best.most)

    def uncertainty(self, now: int) -> int | None:
        """Return half the round trip, plus drift, that the offset rests on; None if on arrivals alone."""
        if self._best is None or now - self._best.at >= FRESH:
            return None
        return self._best.round_trip // 2 + int(DRIFT * (now - self._best.at))

    def lateness(self, now: int) -> int:
        """By how much (ns) the last stamped message came after its time; 0 before one was heard."""
        offset = self.offset(now)
        return 0 if offset is None or self._envelope is None else max(self._seen - offset, 0)

    def local(self, stamp: int, received: int) -> int:
        """Return when a message stamped `stamp` (since boot, or UNIX) was valid, on the companion's clock.

        Never later than its arrival. The arrival itself where the stamp cannot be mapped yet; where it is 0
        (unknown) the arrival too, less the lateness of what is stamped if that is late.
        """
        offset = self.offset(received)
        if stamp <= 0:
            late = self.lateness(received)
            return received - late if late > LATE else received
        if offset is None:
            return received
        if stamp >= UNIX_EPOCH_FROM:
            if self._unix_minus_boot is None:
                return received
            stamp -= self._unix_minus_boot
        return min(stamp + offset, received)
