"""Mapping of an autopilot's boot time to the companion's clock. Pure: the caller supplies every time.

MAVLink stamps measurements with the time since the autopilot's boot, or with UNIX time. Two methods estimate
the offset to the companion's clock, local = boot + offset:

  arrival   Every stamped message gives arrival - stamp = offset + delay with delay >= 0, so the offset is the
            lower envelope of these differences. The envelope may rise slowly (DRIFT), as fast as two crystals
            may drift apart. It is available from the first message, needs no answer, and is late by the least
            delay.
  TIMESYNC  The autopilot's clock is read between two readings of ours: requested - reading <= offset <=
            received - reading. Of the recent answers the one with the shortest round trip is used (with a
            penalty for its age), and its midpoint is taken. Preferred while it is recent and agrees with the
            arrivals. An answer whose round trip is longer than MAX_ROUND_TRIP was delayed, most likely in one
            direction only (a late link, an autopilot that reads seldom), and its midpoint may be wrong by
            seconds. It does not replace a better answer; alone, it only bounds the estimate from arrivals.

If all messages arrive late from one moment on, either the link is late, or the autopilot's clock stopped or
was set back. A late link leaves the lower bound of TIMESYNC unchanged, because its round trips grow by the
same delay; a clock set back moves that bound at once. So while TIMESYNC is answered, only that bound raises
the envelope, and late measurements are placed at the time they were made. Without TIMESYNC the two cases
cannot be distinguished, and the envelope follows the least delay of the last WINDOW, but no faster than SLIP:
a simulator's clock may run slow by one per cent.

A stamp that arrives earlier than TIMESYNC's lower bound (without TIMESYNC: the envelope) allows means that
the clock was set forward. Stamps that go back by seconds mean a reboot, if the autopilot can be that young:
the whole state is reset. (The wrap of a 32-bit millisecond stamp after 49.7 days does the same.) If it
cannot, its clock was set back, and only the mapping is reset. After a silence in which the autopilot may have
booted, its stamps need not go back: stamps behind by more than any link delay mean a reboot too. A single
such stamp may be delayed or false: it is accepted when the next one agrees with it.
"""

from __future__ import annotations

from collections import deque
from enum import Enum
from typing import NamedTuple

from companion.units import SECOND_NS

#: Relative drift of two clocks: crystals at the ends of the temperature range.
DRIFT = 100e-6
#: Two stamps older than the newest one by this much mean a reboot.
BACK = 3 * SECOND_NS
#: They are apart by this at least, and arrive in step, where no silence came before: a link that stalled may
#: deliver what it held back twice, all at once.
BACK_APART = SECOND_NS // 100
#: Without TIMESYNC the envelope follows the least delay of this window,
WINDOW = 20 * SECOND_NS
#: but rises no faster than a simulator's clock may run slow.
SLIP = 0.012
#: Arrivals earlier than possible by more than this mean that the autopilot's clock was set.
JUMP = 1 * SECOND_NS
#: A TIMESYNC reading by which the last arrival is later than this belongs to another clock.
MAX_LATENESS = 10 * SECOND_NS
#: A message later than this is reported as late.
LATE = 1 * SECOND_NS
#: A longer round trip does not measure the offset.
MAX_ROUND_TRIP = SECOND_NS // 4
#: How long a TIMESYNC answer is used.
FRESH = 60 * SECOND_NS
#: A simulation is not flown in real time if its clock is faster or slower than ours by more than this share
#: between the most of so many TIMESYNC answers.
RATE_LIMIT, RATE_SAMPLES = 0.05, 10
#: Stamps from here on (September 2001) are UNIX time; no autopilot runs for 31 years.
UNIX_EPOCH_FROM = 10**9 * SECOND_NS


class ClockChange(Enum):
    """Change of the autopilot's clock detected from a stamp."""

    REBOOTED = "rebooted"
    SET = "set"


class TimesyncSample(NamedTuple):
    """One TIMESYNC answer: times of request and reception, and the reading in between, all in ns."""

    requested: int
    reading: int
    received: int

    @property
    def round_trip(self) -> int:
        """Time from request to answer."""
        return self.received - self.requested

    @property
    def min_offset(self) -> int:
        """Lower bound of the offset: the reading was taken after the request."""
        return self.requested - self.reading

    @property
    def max_offset(self) -> int:
        """Upper bound of the offset: the reading was taken before the answer arrived."""
        return self.received - self.reading

    @property
    def offset(self) -> int:
        """Midpoint of the bounds, in error by half the round trip at most."""
        return (self.requested + self.received) // 2 - self.reading


class RateDetector:
    """Shows that the autopilot's clock does not run in real time, by TIMESYNC alone."""

    def __init__(self) -> None:
        self.rate = 1.0  # how fast it runs by ours
        self._last: TimesyncSample | None = None
        self._drifts: deque[float] = deque(maxlen=RATE_SAMPLES)

    def follow(self, sample: TimesyncSample) -> None:
        """Take the next answer.

        The bounds of two answers prove the least drift of the offset between them, whatever the delays; most
        of the last answers must show it, for a clock that is set or stands still once is not fast or slow.
        """
        last, self._last = self._last, sample
        if last is None or sample.requested <= last.requested:
            return
        elapsed = sample.requested - last.requested
        falls = min(sample.max_offset - last.min_offset, 0) / elapsed
        rises = max(sample.min_offset - last.max_offset, 0) / elapsed
        self._drifts.append(rises + falls)
        beyond = sorted(drift for drift in self._drifts if abs(drift) > RATE_LIMIT)
        if not beyond:
            self.rate = 1.0
        elif self.rate == 1.0 and (len(beyond) > RATE_SAMPLES // 2 and beyond[0] * beyond[-1] > 0.0):
            self.rate = round(1.0 - beyond[len(beyond) // 2], 1)


class BootClock:
    """Maps one autopilot's stamps to the companion's clock. All times are integer nanoseconds."""

    def __init__(self) -> None:
        self._requests: deque[int] = deque(maxlen=64)
        self.outlier: int | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the autopilot's clock."""
        self._newest = -1  # newest stamp
        self._newest_received = 0
        self._envelope: int | None = None
        self._envelope_at = 0
        self._last_difference = 0  # arrival - stamp of the last message
        # (arrival, arrival - stamp) of the last WINDOW, increasing in both: the first is the least
        self._least: deque[tuple[int, int]] = deque()
        self._back: tuple[int, int] | None = None  # a stamp that went back, and its arrival
        self._samples: deque[TimesyncSample] = deque(maxlen=8)
        self._best: TimesyncSample | None = None
        self._unix_minus_boot: int | None = None
        self._requests.clear()
        self._rate_detector = RateDetector()

    @property
    def rate(self) -> float:
        """How fast the autopilot's clock runs by ours: 1 in real time."""
        return self._rate_detector.rate

    def update(self, boot: int, received: int) -> ClockChange | None:
        """Process the stamp of a message that was stamped when sent; return a detected clock change."""
        difference, change = received - boot, None
        if boot < self._newest - BACK or self._booted_in_silence(boot, received):
            first = self._back
            if first is None or boot < first[0] or abs(difference - (first[1] - first[0])) > BACK:
                self._back = boot, received
                return None
            apart = boot - first[0]
            is_in_step = apart >= BACK_APART and 2 * (received - first[1]) >= apart
            if received - self._newest_received < SECOND_NS and not is_in_step:
                return None
            is_young = boot <= received - self._newest_received + MAX_LATENESS
            change = ClockChange.REBOOTED if is_young else ClockChange.SET
            self.reset()
        self._back = None
        if boot > self._newest:
            self._newest, self._newest_received = boot, received
        self._last_difference = difference
        least = self._least
        while least and least[-1][1] >= difference:
            least.pop()
        least.append((received, difference))
        while least[0][0] < received - WINDOW:
            least.popleft()
        if self._envelope is None:
            self._envelope = difference
        else:
            if difference < self._min_offset(received) - JUMP:
                self._samples.clear()
                self._best = None
                change = ClockChange.SET
            self._envelope = self._next_envelope(self._envelope, difference, received)
        self._envelope_at = received
        return change

    def _booted_in_silence(self, boot: int, received: int) -> bool:
        """Return whether the sender of this stamp booted in the silence before it."""
        if boot > received - self._newest_received:
            return False
        offset = self.offset(received)
        return offset is not None and received - boot - offset > MAX_LATENESS

    def _min_offset(self, now: int) -> int:
        """Return the lower bound of the offset: by TIMESYNC, without it by the arrivals."""
        if self._is_answered(now):
            return max(s.min_offset - int(DRIFT * (now - s.received)) for s in self._samples)
        assert self._envelope is not None
        return self._envelope

    def _next_envelope(self, envelope: int, difference: int, now: int) -> int:
        """Return the envelope after an arrival."""
        elapsed = now - self._envelope_at
        followed = min(envelope + int(DRIFT * elapsed), difference)
        if self._is_answered(now):
            return followed
        return max(followed, min(self._least[0][1], envelope + int(SLIP * elapsed)))

    def _is_answered(self, now: int) -> bool:
        return bool(self._samples) and now - self._samples[-1].received < FRESH

    def update_unix(self, unix: int, boot: int) -> None:
        """Process the autopilot's two times of one instant (SYSTEM_TIME). UNIX time 0 is "not set"."""
        if unix >= UNIX_EPOCH_FROM:
            self._unix_minus_boot = unix - boot

    def request(self, now: int) -> int:
        """Return the stamp to send in a TIMESYNC request."""
        self._requests.append(now)
        return now

    def has_requested(self, stamp: int) -> bool:
        """Whether a request of ours with this stamp is not answered yet."""
        return stamp in self._requests

    def update_timesync(self, requested: int, reading: int, now: int) -> bool:
        """Process a TIMESYNC answer; return whether it is used.

        It is not used if it answers no request of ours, belongs to another clock, or no stamped message was
        received yet. If it belongs to another clock, `outlier` is the age (ns) that the last message would
        have by it, negative if it would be early; otherwise `outlier` is None.
        """
        self.outlier = None
        if requested not in self._requests:
            return False
        self._requests.remove(requested)
        if self._envelope is None:
            return False  # no stamp to check it against
        sample = TimesyncSample(requested, reading, now)
        self._rate_detector.follow(sample)
        age = self._last_difference
        if age - sample.min_offset < -JUMP or age - sample.max_offset > MAX_LATENESS:
            self.outlier = age - sample.offset
            return False
        self._envelope = max(self._envelope, sample.min_offset)
        # samples that contradict the newest: the clock was set, or drifts faster than a crystal
        self._samples = deque((s for s in self._samples if self._agree(s, sample)), self._samples.maxlen)
        self._samples.append(sample)
        best = min(self._samples, key=lambda s: s.round_trip + 2 * DRIFT * (now - s.received))
        last = self._best
        if (
            last is not None
            and last.round_trip <= MAX_ROUND_TRIP < best.round_trip
            and self._agree(last, sample)
        ):
            best = last if now - last.received < FRESH else best
        self._best = best
        return True

    @staticmethod
    def _agree(before: TimesyncSample, after: TimesyncSample) -> bool:
        drift = int(DRIFT * (after.received - before.received))
        return before.min_offset - drift <= after.max_offset and after.min_offset <= before.max_offset + drift

    def offset(self, now: int) -> int | None:
        """Return local minus boot time, None before the first stamp."""
        best, envelope = self._best, self._envelope
        if best is None or now - best.received >= FRESH:
            return envelope
        if best.round_trip <= MAX_ROUND_TRIP or envelope is None:
            return best.offset
        return min(max(envelope, best.min_offset), best.max_offset)

    def uncertainty(self, now: int) -> int | None:
        """Return half the round trip, plus drift, behind the offset; None if it rests on arrivals alone."""
        if self._best is None or now - self._best.received >= FRESH:
            return None
        return self._best.round_trip // 2 + int(DRIFT * (now - self._best.received))

    def lateness(self, now: int) -> int:
        """Return the delay (ns) of the last stamped message; 0 before the first."""
        offset = self.offset(now)
        return 0 if offset is None or self._envelope is None else max(self._last_difference - offset, 0)

    def local(self, stamp: int, received: int) -> int:
        """Return the local time for which a message stamped `stamp` (since boot, or UNIX) is valid.

        Never later than its arrival. The arrival itself if the stamp cannot be mapped yet. For stamp 0
        (unknown) the arrival less the delay of the last stamped message: both came over the same link in the
        order in which they were sent, so an unstamped message is not ahead of those around it.
        """
        offset = self.offset(received)
        if stamp <= 0:
            return received - self.lateness(received)
        if offset is None:
            return received
        if stamp >= UNIX_EPOCH_FROM:
            if self._unix_minus_boot is None:
                return received
            stamp -= self._unix_minus_boot
        return min(stamp + offset, received)
