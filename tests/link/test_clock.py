"""The autopilot's time comes out of arrivals and of TIMESYNC, through jitter, drift, lies and a reboot."""

import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link.clock import DRIFT, FRESH, SECOND, SLIP, WINDOW, BootClock, News

MS = 1_000_000
OFFSET = 1000 * SECOND
UNIX_0 = 1_700_000_000 * SECOND  # of the autopilot's boot


def test_before_anything_is_heard_the_arrival_is_all_there_is() -> None:
    assert BootClock().local(5 * SECOND, 77) == 77
    assert BootClock().offset(0) is None


def test_arrivals_alone_find_the_offset_but_for_the_least_delay() -> None:
    rng = random.Random(1)
    clock = BootClock()
    for i in range(3000):
        boot = i * 100 * MS
        clock.heard(boot, boot + OFFSET + int((2 + rng.expovariate(1 / 20.0)) * MS))
    error = clock.local(200 * SECOND, 10**18) - (200 * SECOND + OFFSET)
    assert 2 * MS <= error < 3.5 * MS
    assert clock.uncertainty(300 * SECOND + OFFSET) is None


def test_arrivals_follow_a_clock_that_runs_slow() -> None:
    clock = BootClock()
    rate = 1 - 50e-6
    for i in range(36_000):  # an hour at 10 Hz
        local = OFFSET + i * 100 * MS
        clock.heard(int((local - OFFSET) * rate), local + (1 + i % 7) * MS)
    error = clock.local(int((local - OFFSET) * rate), 10**18) - local
    assert abs(error) < 2 * MS  # without the allowance for drift: 180 ms


def test_timesync_errs_by_half_the_round_trip_at_most_and_prefers_the_shortest() -> None:
    rng = random.Random(2)
    clock = BootClock()
    for i in range(100):
        now = OFFSET + i * SECOND
        clock.heard(now - OFFSET, now + 40 * MS)
        there, back = (int(rng.expovariate(1 / 8.0) * MS) + MS for _ in "ab")
        asked = clock.ask(now)
        assert clock.answered(asked, now + there - OFFSET, now + there + back)
        uncertainty = clock.uncertainty(now + there + back)
        offset = clock.offset(now + there + back)
        assert offset is not None and uncertainty is not None
        assert abs(offset - OFFSET) <= uncertainty
    assert uncertainty < 4 * MS


def test_timesync_follows_a_simulation_that_slips_by_a_hundredth() -> None:
    clock = BootClock()
    for i in range(3000):
        local = OFFSET + i * 100 * MS
        boot = int((local - OFFSET) * 0.99) + SECOND
        clock.heard(boot, local + 5 * MS)
        if i % 10 == 0:
            assert clock.answered(
                clock.ask(local), int((local + 2 * MS - OFFSET) * 0.99) + SECOND, local + 4 * MS
            )
        error = clock.local(boot, local + 5 * MS) - local
        assert abs(error) < 100 * MS  # eight answers' age at most


def test_answers_to_nobody_and_of_another_clock_are_refused() -> None:
    clock = BootClock()
    clock.heard(10 * SECOND, 10 * SECOND + OFFSET + MS)
    now = 11 * SECOND + OFFSET
    assert not clock.answered(123, 11 * SECOND, now)
    assert not clock.answered(clock.ask(now), UNIX_0, now + MS)
    asked = clock.ask(now)
    assert clock.answered(asked, 11 * SECOND, now + MS)
    assert not clock.answered(asked, 11 * SECOND, now + MS)  # a replay


def test_a_stale_answer_gives_way_to_the_arrivals() -> None:
    clock = BootClock()
    clock.heard(SECOND, SECOND + OFFSET + 3 * MS)
    clock.answered(clock.ask(SECOND + OFFSET), SECOND + MS, SECOND + OFFSET + 2 * MS)
    assert clock.offset(SECOND + OFFSET + FRESH // 2) == OFFSET
    assert clock.offset(SECOND + OFFSET + 2 * FRESH) == OFFSET + 3 * MS


def test_unix_stamps_are_told_by_their_size_and_mapped_through_system_time() -> None:
    clock = BootClock()
    clock.heard(10 * SECOND, 10 * SECOND + OFFSET)
    arrival = 11 * SECOND + OFFSET
    assert clock.local(UNIX_0 + 9 * SECOND, arrival) == arrival  # not yet known
    clock.heard_unix(0, 10 * SECOND)
    assert clock.local(UNIX_0 + 9 * SECOND, arrival) == arrival
    clock.heard_unix(UNIX_0 + 10 * SECOND, 10 * SECOND)
    assert clock.local(UNIX_0 + 9 * SECOND, arrival) == 9 * SECOND + OFFSET
    assert clock.local(9 * SECOND, arrival) == 9 * SECOND + OFFSET
    assert clock.local(0, arrival) == arrival
    assert clock.local(99 * SECOND, arrival) == arrival  # never later than it came


def test_arrivals_alone_follow_a_simulator_that_runs_slow_by_a_hundredth() -> None:
    clock = BootClock()
    for i in range(6000):  # ten minutes at 10 Hz
        local = OFFSET + i * 100 * MS
        boot = SECOND + int((local - OFFSET) * 0.992)
        clock.heard(boot, local + (2 + i % 7) * MS)
        assert abs(clock.local(boot, local + 20 * MS) - local) < 0.008 * WINDOW + 10 * MS
    # with the allowance for drift alone: 4.7 s


def test_a_link_that_is_slow_for_a_while_does_not_move_the_clock() -> None:
    clock = BootClock()
    for i in range(3000):
        boot = SECOND + i * 100 * MS
        delay = 2 * MS if i % 150 == 0 else 400 * MS  # one prompt message in 15 s
        clock.heard(boot, boot + OFFSET + delay)
        assert clock.local(boot, 10**18) - (boot + OFFSET) < 2 * MS + DRIFT * WINDOW + 1


def test_a_reboot_begins_everything_anew_and_a_reordered_stamp_nothing() -> None:
    clock = BootClock()
    assert not clock.heard(100 * SECOND, 100 * SECOND + OFFSET)
    clock.heard_unix(UNIX_0, 100 * SECOND)
    assert not clock.heard(98 * SECOND, 100 * SECOND + OFFSET)
    assert not clock.heard(2 * SECOND, 150 * SECOND + OFFSET)  # it may yet be a straggler
    assert clock.heard(3 * SECOND, 151 * SECOND + OFFSET)
    assert clock.local(2 * SECOND, 10**18) == 150 * SECOND + OFFSET
    assert clock.local(UNIX_0, 151 * SECOND + OFFSET) == 151 * SECOND + OFFSET


def test_stragglers_and_false_old_stamps_are_no_reboot() -> None:
    clock = BootClock()
    for i in range(100, 200):
        now = OFFSET + i * SECOND
        assert not clock.heard(i * SECOND, now + MS)
        assert not clock.heard((i - 10) * SECOND, now + 2 * MS)  # ten seconds old, time and again
    assert not clock.heard(50 * SECOND, now + 3 * MS)
    assert not clock.heard(7 * SECOND, now + 4 * MS)  # older still: they do not agree
    assert clock.local(199 * SECOND, 10**18) == now + MS


def test_a_false_stamp_from_the_future_heals_at_the_second_message() -> None:
    clock = BootClock()
    clock.heard(10 * SECOND, 10 * SECOND + OFFSET)
    clock.heard(9000 * SECOND, 10 * SECOND + OFFSET)
    assert not clock.heard(11 * SECOND, 11 * SECOND + OFFSET)
    assert clock.heard(12 * SECOND, 12 * SECOND + OFFSET)
    assert clock.local(12 * SECOND, 10**18) == 12 * SECOND + OFFSET


@settings(deadline=None, max_examples=100)
@given(
    st.lists(st.tuples(st.integers(0, 2 * SECOND), st.integers(0, SECOND // 2)), min_size=1, max_size=60),
    st.floats(-90e-6, 90e-6),
)
def test_the_envelope_is_never_early_and_never_later_than_the_best_delay_and_drift(
    steps: list[tuple[int, int]], drift: float
) -> None:
    clock = BootClock()
    boot, best, offset = SECOND, None, OFFSET
    start = boot
    for step, delay in steps:
        boot += step
        offset = OFFSET + int(drift * (boot - start))
        clock.heard(boot, boot + offset + delay)
        best = delay if best is None else min(best, delay)
    got = clock.offset(boot + offset)
    assert got is not None
    span = boot - start + SECOND
    assert got >= offset - 10
    assert got <= offset + best + (DRIFT + 90e-6) * span + 10


@pytest.mark.parametrize("every_s", [2, 10])
def test_an_autopilot_that_reads_seldom_does_not_move_the_clock(every_s: int) -> None:
    """Questions wait up to ten seconds to be read, answers come at once: each middle is off by half."""
    clock, offset = BootClock(), 700 * SECOND
    asked: list[int] = []
    for ms in range(0, 120_000, 100):
        now = 1000 * SECOND + ms * 1_000_000
        clock.heard(now - offset - 5_000_000, now)
        if ms % 1000 == 0:
            asked.append(clock.ask(now))
        if ms > 20_000 and ms % (1000 * every_s) == 900:  # slow from 20 s on; just before the next question
            for each in asked:
                clock.answered(each, now - offset, now + 5_000_000)
            asked.clear()
        elif ms <= 20_000 and asked:
            clock.answered(asked.pop(), now - offset, now + 5_000_000)
        found = clock.offset(now)
        assert found is not None and abs(found - offset) <= 10_000_000, ms


class Way:
    """An autopilot at the other end of a link that may be late, played by the second or finer."""

    def __init__(self, answers: bool = True, every_ms: int = 50) -> None:
        self.clock, self.offset, self.answers, self.every_ms = BootClock(), OFFSET, answers, every_ms
        self.late = 0
        self.ms = 0
        self.arriving: list[tuple[int, int, int]] = []  # when, asked (or 0), stamp or reading
        self.news: list[News] = []
        self.sent_by = 0

    def run(self, seconds: float) -> float:
        """Go on for so long; how wrong (s) a stamp of now was mapped at most."""
        worst, end = 0.0, self.ms + round(seconds * 1000)
        while self.ms < end:
            now = 2 * OFFSET + self.ms * MS
            self.sent_by = max(self.sent_by, now + self.late + 5 * MS)  # in order
            self.arriving.append((self.sent_by, 0, now - self.offset))
            if self.answers and self.ms % 1000 == 0:
                self.arriving.append((self.sent_by, self.clock.ask(now), now - self.offset + MS))
            self.ms += self.every_ms
            while self.arriving and self.arriving[0][0] <= now:
                at, asked, reading = self.arriving.pop(0)
                if asked:
                    self.clock.answered(asked, reading, at)
                elif (news := self.clock.heard(reading, at)) is not None:
                    self.news.append(news)
                worst = max(worst, abs(self.clock.local(reading, at) - (reading + self.offset)) / SECOND)
        return worst


@pytest.mark.parametrize("late_s", [5, 12])
def test_a_link_late_for_minutes_leaves_the_clock_where_it_was(late_s: int) -> None:
    way = Way()
    way.run(30)
    way.late = late_s * SECOND
    assert way.run(300) < DRIFT * 300 + 0.01
    assert way.clock.lateness(2 * OFFSET + way.ms * MS) / SECOND == pytest.approx(late_s, abs=0.1)
    way.late = 0
    assert way.run(60) < DRIFT * 300 + 0.01
    assert way.clock.lateness(2 * OFFSET + way.ms * MS) < 50 * MS
    assert way.news == []


def test_a_link_late_from_the_first_word_is_no_clock_that_leaps_when_it_gets_prompt() -> None:
    way = Way()
    way.late = 5 * SECOND
    way.run(60)
    way.late = 0
    way.run(30)
    assert way.run(30) < 0.01
    assert way.news == []


def test_without_timesync_a_late_link_moves_the_clock_no_faster_than_a_simulator_may_slip() -> None:
    way = Way(answers=False)
    way.run(30)
    way.late = 5 * SECOND
    assert way.run(60) < SLIP * 60
    way.late = 0
    assert way.run(30) < SLIP * 60
    assert way.run(30) < 0.02


@pytest.mark.parametrize(("by_s", "silent_s"), [(0.5, 0), (2, 0), (5, 5), (60, 60)])
def test_a_clock_that_stood_still_is_followed_at_the_next_answer(by_s: float, silent_s: int) -> None:
    """Everything arrives late from then on, as on a late link; but the answers come as promptly as ever."""
    way = Way()
    way.run(30)
    way.offset += round(by_s * SECOND)
    way.ms += silent_s * 1000
    way.run(1.2)
    assert way.run(120) < 0.01


@pytest.mark.parametrize("by_s", [5, 900])
def test_a_clock_set_back_is_no_reboot_of_an_autopilot_that_cannot_be_so_young(by_s: int) -> None:
    way = Way()
    way.run(30)
    way.offset += by_s * SECOND
    way.run(0.2)
    assert way.news == [News.SET]
    assert way.run(60) < 0.01
    assert way.news == [News.SET]


@pytest.mark.parametrize("silent_s", [0, 8, 60])
def test_an_autopilot_that_can_be_so_young_rebooted(silent_s: int) -> None:
    way = Way()
    way.run(30)
    way.ms += silent_s * 1000
    way.offset = 2 * OFFSET + way.ms * MS - SECOND
    way.run(0.2)
    assert way.news == [News.REBOOTED]


@pytest.mark.parametrize("up_s", [35, 200, 395])
def test_a_reboot_in_a_silence_is_noticed_though_its_stamps_do_not_go_back(up_s: int) -> None:
    way = Way()
    way.offset = 2 * OFFSET - SECOND  # just booted
    way.run(30)
    way.ms += 400_000
    way.offset += (431 - up_s) * SECOND
    way.run(0.2)
    assert way.news == [News.REBOOTED]
    assert way.run(60) < 0.01


@pytest.mark.parametrize(("late_s", "flown_s"), [(9, 30), (60, 900)])
def test_a_silence_after_which_all_comes_late_is_no_reboot(late_s: int, flown_s: int) -> None:
    """Late by no more than a link may be; or older than the silence, as what a stalled line brings is."""
    way = Way()
    way.offset = 2 * OFFSET - SECOND
    way.run(flown_s)
    before = way.clock.offset(OFFSET + way.ms * MS)
    way.ms += late_s * 1000
    way.late = late_s * SECOND
    way.run(1.2)
    assert way.news == [] and before is not None
    assert abs((way.clock.offset(OFFSET + way.ms * MS) or 0) - before) < MS


def test_the_first_answer_is_not_believed_before_there_is_anything_to_judge_it_by() -> None:
    clock = BootClock()
    assert not clock.answered(clock.ask(OFFSET), 10**9 * SECOND, OFFSET + MS)
    clock.heard(5 * SECOND, OFFSET + 2 * MS)
    assert clock.offset(OFFSET + 2 * MS) == OFFSET + 2 * MS - 5 * SECOND


def test_what_has_no_stamp_is_as_late_as_what_has_one() -> None:
    clock = BootClock()
    clock.heard(10 * SECOND, 10 * SECOND + OFFSET)
    clock.heard(11 * SECOND, 11 * SECOND + OFFSET + 300 * MS)
    arrival = 11 * SECOND + OFFSET + 310 * MS
    assert clock.local(0, arrival) == arrival  # a slow link is not a late one
    clock.heard(12 * SECOND, 17 * SECOND + OFFSET)
    arrival = 17 * SECOND + OFFSET + 10 * MS
    assert clock.local(0, arrival) == pytest.approx(arrival - 5 * SECOND, abs=MS)
