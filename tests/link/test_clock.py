"""Clock mapping from arrivals and TIMESYNC, with jitter, drift, false stamps and reboots."""

import random
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link.clock import DRIFT, FRESH, SLIP, WINDOW, BootClock, ClockChange
from companion.units import SECOND_NS

MS = 1_000_000
OFFSET = 1000 * SECOND_NS
UNIX_0 = 1_700_000_000 * SECOND_NS  # of the autopilot's boot


def test_without_a_stamp_the_local_time_is_the_arrival() -> None:
    assert BootClock().local(5 * SECOND_NS, 77) == 77
    assert BootClock().offset(0) is None


def test_offset_from_arrivals_is_late_by_the_least_delay() -> None:
    rng = random.Random(1)
    clock = BootClock()
    for i in range(3000):
        boot = i * 100 * MS
        clock.update(boot, boot + OFFSET + int((2 + rng.expovariate(1 / 20.0)) * MS))
    error = clock.local(200 * SECOND_NS, 10**18) - (200 * SECOND_NS + OFFSET)
    assert 2 * MS <= error < 3.5 * MS
    assert clock.uncertainty(300 * SECOND_NS + OFFSET) is None


def test_arrivals_follow_a_slow_clock() -> None:
    clock = BootClock()
    rate = 1 - 50e-6
    for i in range(36_000):  # an hour at 10 Hz
        local = OFFSET + i * 100 * MS
        clock.update(int((local - OFFSET) * rate), local + (1 + i % 7) * MS)
    error = clock.local(int((local - OFFSET) * rate), 10**18) - local
    assert abs(error) < 2 * MS  # without the allowance for drift: 180 ms


def test_timesync_error_is_at_most_half_the_shortest_round_trip() -> None:
    rng = random.Random(2)
    clock = BootClock()
    for i in range(100):
        now = OFFSET + i * SECOND_NS
        clock.update(now - OFFSET, now + 40 * MS)
        there, back = (int(rng.expovariate(1 / 8.0) * MS) + MS for _ in "ab")
        requested = clock.request(now)
        assert clock.update_timesync(requested, now + there - OFFSET, now + there + back)
        uncertainty = clock.uncertainty(now + there + back)
        offset = clock.offset(now + there + back)
        assert offset is not None and uncertainty is not None
        assert abs(offset - OFFSET) <= uncertainty
    assert uncertainty < 4 * MS


def test_timesync_follows_a_simulation_slow_by_one_per_cent() -> None:
    clock = BootClock()
    for i in range(3000):
        local = OFFSET + i * 100 * MS
        boot = int((local - OFFSET) * 0.99) + SECOND_NS
        clock.update(boot, local + 5 * MS)
        if i % 10 == 0:
            assert clock.update_timesync(
                clock.request(local), int((local + 2 * MS - OFFSET) * 0.99) + SECOND_NS, local + 4 * MS
            )
        error = clock.local(boot, local + 5 * MS) - local
        assert abs(error) < 100 * MS  # at most the age of eight answers


def test_unrequested_answers_and_answers_of_another_clock_are_rejected() -> None:
    clock = BootClock()
    clock.update(10 * SECOND_NS, 10 * SECOND_NS + OFFSET + MS)
    now = 11 * SECOND_NS + OFFSET
    assert not clock.update_timesync(123, 11 * SECOND_NS, now)
    assert not clock.update_timesync(clock.request(now), UNIX_0, now + MS)
    requested = clock.request(now)
    assert clock.update_timesync(requested, 11 * SECOND_NS, now + MS)
    assert not clock.update_timesync(requested, 11 * SECOND_NS, now + MS)  # a replay


def test_stale_answer_is_replaced_by_the_arrivals() -> None:
    clock = BootClock()
    clock.update(SECOND_NS, SECOND_NS + OFFSET + 3 * MS)
    clock.update_timesync(clock.request(SECOND_NS + OFFSET), SECOND_NS + MS, SECOND_NS + OFFSET + 2 * MS)
    assert clock.offset(SECOND_NS + OFFSET + FRESH // 2) == OFFSET
    assert clock.offset(SECOND_NS + OFFSET + 2 * FRESH) == OFFSET + 3 * MS


def test_unix_stamps_are_recognised_by_magnitude_and_mapped_by_system_time() -> None:
    clock = BootClock()
    clock.update(10 * SECOND_NS, 10 * SECOND_NS + OFFSET)
    arrival = 11 * SECOND_NS + OFFSET
    assert clock.local(UNIX_0 + 9 * SECOND_NS, arrival) == arrival  # not yet known
    clock.update_unix(0, 10 * SECOND_NS)
    assert clock.local(UNIX_0 + 9 * SECOND_NS, arrival) == arrival
    clock.update_unix(UNIX_0 + 10 * SECOND_NS, 10 * SECOND_NS)
    assert clock.local(UNIX_0 + 9 * SECOND_NS, arrival) == 9 * SECOND_NS + OFFSET
    assert clock.local(9 * SECOND_NS, arrival) == 9 * SECOND_NS + OFFSET
    assert clock.local(0, arrival) == arrival
    assert clock.local(99 * SECOND_NS, arrival) == arrival  # never later than its arrival


def test_arrivals_follow_a_simulator_slow_by_one_per_cent() -> None:
    clock = BootClock()
    for i in range(6000):  # ten minutes at 10 Hz
        local = OFFSET + i * 100 * MS
        boot = SECOND_NS + int((local - OFFSET) * 0.992)
        clock.update(boot, local + (2 + i % 7) * MS)
        assert abs(clock.local(boot, local + 20 * MS) - local) < 0.008 * WINDOW + 10 * MS
    # with the allowance for drift alone: 4.7 s


def test_temporarily_slow_link_does_not_change_the_offset() -> None:
    clock = BootClock()
    for i in range(3000):
        boot = SECOND_NS + i * 100 * MS
        delay = 2 * MS if i % 150 == 0 else 400 * MS  # one prompt message in 15 s
        clock.update(boot, boot + OFFSET + delay)
        assert clock.local(boot, 10**18) - (boot + OFFSET) < 2 * MS + DRIFT * WINDOW + 1


def test_reboot_resets_the_clock_and_a_reordered_stamp_does_not() -> None:
    clock = BootClock()
    assert not clock.update(100 * SECOND_NS, 100 * SECOND_NS + OFFSET)
    clock.update_unix(UNIX_0, 100 * SECOND_NS)
    assert not clock.update(98 * SECOND_NS, 100 * SECOND_NS + OFFSET)
    assert not clock.update(2 * SECOND_NS, 150 * SECOND_NS + OFFSET)  # it may be a delayed message
    assert clock.update(3 * SECOND_NS, 151 * SECOND_NS + OFFSET)
    assert clock.local(2 * SECOND_NS, 10**18) == 150 * SECOND_NS + OFFSET
    assert clock.local(UNIX_0, 151 * SECOND_NS + OFFSET) == 151 * SECOND_NS + OFFSET


def test_what_a_stalled_link_delivers_twice_sets_no_clock() -> None:
    """It was reported as a clock that jumped back by 4.8 s, and all of it was dated so."""
    clock = BootClock()
    for i in range(200):
        clock.update(i * 100 * MS, OFFSET + i * 100 * MS)
    held = range(20_000 * MS, 24_800 * MS, 100 * MS)
    for arrival in (24_800 * MS, 24_850 * MS):
        assert not any(clock.update(boot, OFFSET + arrival) for boot in held)
    assert abs((clock.offset(OFFSET + 25 * SECOND_NS) or 0) - OFFSET) < 100 * MS


def test_delayed_and_false_old_stamps_are_not_a_reboot() -> None:
    clock = BootClock()
    for i in range(100, 200):
        now = OFFSET + i * SECOND_NS
        assert not clock.update(i * SECOND_NS, now + MS)
        assert not clock.update((i - 10) * SECOND_NS, now + 2 * MS)  # ten seconds old, repeatedly
    assert not clock.update(50 * SECOND_NS, now + 3 * MS)
    assert not clock.update(7 * SECOND_NS, now + 4 * MS)  # older still: they do not agree
    assert clock.local(199 * SECOND_NS, 10**18) == now + MS


def test_clock_recovers_from_a_false_future_stamp_at_the_second_message() -> None:
    clock = BootClock()
    clock.update(10 * SECOND_NS, 10 * SECOND_NS + OFFSET)
    clock.update(9000 * SECOND_NS, 10 * SECOND_NS + OFFSET)
    assert not clock.update(11 * SECOND_NS, 11 * SECOND_NS + OFFSET)
    assert clock.update(12 * SECOND_NS, 12 * SECOND_NS + OFFSET)
    assert clock.local(12 * SECOND_NS, 10**18) == 12 * SECOND_NS + OFFSET


@settings(max_examples=100)
@given(
    st.lists(
        st.tuples(st.integers(0, 2 * SECOND_NS), st.integers(0, SECOND_NS // 2)), min_size=1, max_size=60
    ),
    st.floats(-90e-6, 90e-6),
)
def test_envelope_is_never_early_and_at_most_late_by_least_delay_and_drift(
    steps: list[tuple[int, int]], drift: float
) -> None:
    clock = BootClock()
    boot, best, offset = SECOND_NS, None, OFFSET
    start = boot
    for step, delay in steps:
        boot += step
        offset = OFFSET + int(drift * (boot - start))
        clock.update(boot, boot + offset + delay)
        best = delay if best is None else min(best, delay)
    got = clock.offset(boot + offset)
    assert got is not None
    span = boot - start + SECOND_NS
    assert got >= offset - 10
    assert got <= offset + best + (DRIFT + 90e-6) * span + 10


@pytest.mark.parametrize("every_s", [2, 10])
def test_autopilot_that_reads_seldom_does_not_change_the_offset(every_s: int) -> None:
    """Requests wait up to ten seconds to be read, answers arrive at once: each midpoint is off by half."""
    clock, offset = BootClock(), 700 * SECOND_NS
    requested: list[int] = []
    for ms in range(0, 120_000, 100):
        now = 1000 * SECOND_NS + ms * 1_000_000
        clock.update(now - offset - 5_000_000, now)
        if ms % 1000 == 0:
            requested.append(clock.request(now))
        if ms > 20_000 and ms % (1000 * every_s) == 900:  # slow from 20 s on; just before the next question
            for each in requested:
                clock.update_timesync(each, now - offset, now + 5_000_000)
            requested.clear()
        elif ms <= 20_000 and requested:
            clock.update_timesync(requested.pop(), now - offset, now + 5_000_000)
        found = clock.offset(now)
        assert found is not None and abs(found - offset) <= 10_000_000, ms


class LateLink:
    """An autopilot at the other end of a link with variable delay, simulated in steps of 50 ms."""

    def __init__(self, answers: bool = True) -> None:
        self.clock, self.offset, self.answers = BootClock(), OFFSET, answers
        self.late = 0
        self.ms = 0
        self.arriving: list[tuple[int, int, int]] = []  # when, requested (or 0), stamp or reading
        self.changes: list[ClockChange] = []
        self.sent_by = 0

    def run(self, seconds: float) -> float:
        """Run for `seconds`; return the largest error (s) of a mapped stamp."""
        worst, end = 0.0, self.ms + round(seconds * 1000)
        while self.ms < end:
            now = 2 * OFFSET + self.ms * MS
            self.sent_by = max(self.sent_by, now + self.late + 5 * MS)  # in order
            self.arriving.append((self.sent_by, 0, now - self.offset))
            if self.answers and self.ms % 1000 == 0:
                self.arriving.append((self.sent_by, self.clock.request(now), now - self.offset + MS))
            self.ms += 50
            while self.arriving and self.arriving[0][0] <= now:
                at, requested, reading = self.arriving.pop(0)
                if requested:
                    self.clock.update_timesync(requested, reading, at)
                elif (change := self.clock.update(reading, at)) is not None:
                    self.changes.append(change)
                worst = max(worst, abs(self.clock.local(reading, at) - (reading + self.offset)) / SECOND_NS)
        return worst


@pytest.mark.parametrize("late_s", [5, 12])
def test_link_late_for_minutes_does_not_change_the_offset(late_s: int) -> None:
    link = LateLink()
    link.run(30)
    link.late = late_s * SECOND_NS
    assert link.run(300) < DRIFT * 300 + 0.01
    assert link.clock.lateness(2 * OFFSET + link.ms * MS) / SECOND_NS == pytest.approx(late_s, abs=0.1)
    link.late = 0
    assert link.run(60) < DRIFT * 300 + 0.01
    assert link.clock.lateness(2 * OFFSET + link.ms * MS) < 50 * MS
    assert link.changes == []


def test_link_late_from_the_start_and_then_prompt_is_not_a_clock_jump() -> None:
    link = LateLink()
    link.late = 5 * SECOND_NS
    link.run(60)
    link.late = 0
    link.run(30)
    assert link.run(30) < 0.01
    assert link.changes == []


def test_without_timesync_a_late_link_changes_the_offset_at_the_slip_rate_at_most() -> None:
    link = LateLink(answers=False)
    link.run(30)
    link.late = 5 * SECOND_NS
    assert link.run(60) < SLIP * 60
    link.late = 0
    assert link.run(30) < SLIP * 60
    assert link.run(30) < 0.02


@pytest.mark.parametrize(("by_s", "silent_s"), [(0.5, 0), (2, 0), (5, 5), (60, 60)])
def test_stopped_clock_is_followed_at_the_next_answer(by_s: float, silent_s: int) -> None:
    """All messages are late from then on, as on a late link, but the round trips stay short."""
    link = LateLink()
    link.run(30)
    link.offset += round(by_s * SECOND_NS)
    link.ms += silent_s * 1000
    link.run(1.2)
    assert link.run(120) < 0.01


@pytest.mark.parametrize("by_s", [5, 900])
def test_clock_set_back_beyond_the_possible_boot_time_is_not_a_reboot(by_s: int) -> None:
    link = LateLink()
    link.run(30)
    link.offset += by_s * SECOND_NS
    link.run(0.2)
    assert link.changes == [ClockChange.SET]
    assert link.run(60) < 0.01
    assert link.changes == [ClockChange.SET]


@pytest.mark.parametrize("silent_s", [0, 8, 60])
def test_boot_time_within_the_silence_is_a_reboot(silent_s: int) -> None:
    link = LateLink()
    link.run(30)
    link.ms += silent_s * 1000
    link.offset = 2 * OFFSET + link.ms * MS - SECOND_NS
    link.run(0.2)
    assert link.changes == [ClockChange.REBOOTED]


@pytest.mark.parametrize("up_s", [35, 200, 395])
def test_reboot_in_a_silence_is_detected_though_stamps_do_not_go_back(up_s: int) -> None:
    link = LateLink()
    link.offset = 2 * OFFSET - SECOND_NS  # just booted
    link.run(30)
    link.ms += 400_000
    link.offset += (431 - up_s) * SECOND_NS
    link.run(0.2)
    assert link.changes == [ClockChange.REBOOTED]
    assert link.run(60) < 0.01


@pytest.mark.parametrize(("late_s", "flown_s"), [(9, 30), (60, 900)])
def test_late_messages_after_a_silence_are_not_a_reboot(late_s: int, flown_s: int) -> None:
    """Late within the limit of a link, or older than the silence, as after a stalled line."""
    link = LateLink()
    link.offset = 2 * OFFSET - SECOND_NS
    link.run(flown_s)
    before = link.clock.offset(OFFSET + link.ms * MS)
    link.ms += late_s * 1000
    link.late = late_s * SECOND_NS
    link.run(1.2)
    assert link.changes == [] and before is not None
    assert abs((link.clock.offset(OFFSET + link.ms * MS) or 0) - before) < MS


def test_answer_before_the_first_stamp_is_not_used() -> None:
    clock = BootClock()
    assert not clock.update_timesync(clock.request(OFFSET), 10**9 * SECOND_NS, OFFSET + MS)
    clock.update(5 * SECOND_NS, OFFSET + 2 * MS)
    assert clock.offset(OFFSET + 2 * MS) == OFFSET + 2 * MS - 5 * SECOND_NS


def test_unstamped_message_is_as_late_as_a_stamped_one() -> None:
    clock = BootClock()
    clock.update(10 * SECOND_NS, 10 * SECOND_NS + OFFSET)
    clock.update(11 * SECOND_NS, 11 * SECOND_NS + OFFSET + 300 * MS)
    arrival = 11 * SECOND_NS + OFFSET + 310 * MS
    assert clock.local(0, arrival) == pytest.approx(arrival - 300 * MS, abs=MS)
    clock.update(12 * SECOND_NS, 17 * SECOND_NS + OFFSET)
    arrival = 17 * SECOND_NS + OFFSET + 10 * MS
    assert clock.local(0, arrival) == pytest.approx(arrival - 5 * SECOND_NS, abs=MS)


DELAYS = st.lists(st.tuples(*[st.integers(1, 5000)] * 2), min_size=5, max_size=40)


def answered(clock: BootClock, boot: Callable[[int], int], delays: list[tuple[int, int]]) -> list[float]:
    """The rate after each answer, one requested a second; delays there and back in ms."""
    rates = []
    for i, (there, back) in enumerate(delays):
        now = OFFSET + i * SECOND_NS
        clock.update(boot(now), now + MS)
        requested = clock.request(now)
        clock.update_timesync(requested, boot(now + there * MS), now + (there + back) * MS)
        rates.append(clock.rate)
    return rates


@given(DELAYS, st.floats(-1e-4, 1e-4))
def test_no_delay_makes_a_clock_of_real_time_seem_fast_or_slow(
    delays: list[tuple[int, int]], drift: float
) -> None:
    rates = answered(BootClock(), lambda now: round((now - OFFSET) * (1.0 + drift)) + 10**12, delays)
    assert set(rates) == {1.0}


@pytest.mark.parametrize("rate", [0.2, 0.5, 0.9, 1.1, 1.5, 3.0, 20.0])
def test_simulation_that_is_not_in_real_time_is_found_in_seconds(rate: float) -> None:
    rates = answered(BootClock(), lambda now: round((now - OFFSET) * rate) + 10**12, [(3, 5)] * 20)
    assert rates[5] == 1.0 and rates[7:] == pytest.approx([rate] * 13, abs=0.05 * rate)


def test_simulation_that_is_in_real_time_again_is_used_again() -> None:
    def boot(now: int) -> int:
        return 10**12 + 4 * min(now - OFFSET, 20 * SECOND_NS) + max(now - OFFSET - 20 * SECOND_NS, 0)

    rates = answered(BootClock(), boot, [(3, 5)] * 40)
    assert rates[19] == pytest.approx(4.0, abs=0.1) and rates[25] != 1.0 == rates[33]


@pytest.mark.parametrize("by_s", [-3.0, 3600.0])
def test_clock_that_is_set_once_is_not_fast(by_s: float) -> None:
    def boot(now: int) -> int:
        return 10**13 + now + (round(by_s * SECOND_NS) if now > OFFSET + 10 * SECOND_NS else 0)

    assert set(answered(BootClock(), boot, [(3, 5)] * 30)) == {1.0}
