"""Beacon answers: a beacon keeps its receiver, and hostile receivers get little of the navigator's time."""

import pytest

from companion.link.beacon_answers import (
    MAX_RECEIVERS,
    MAX_WAITING,
    REJECTED_NS,
    SILENT_NS,
    TURN_REASON,
    BeaconAnswers,
)
from companion.units import SECOND_NS

MILLI = SECOND_NS // 1000


def test_a_followed_beacon_cannot_be_taken_over() -> None:
    answers, taken = BeaconAnswers(), 0
    for ms in range(10_000):
        if ms % 1000 == 0:
            assert answers.refusal("receiver", "beacon 7", ms * MILLI) is None
        taken += answers.refusal(f"stranger {ms % 50}", "beacon 7", ms * MILLI) is None
    assert taken == 0


def test_a_silent_receiver_gives_up_its_beacon() -> None:
    answers = BeaconAnswers()
    assert answers.refusal("receiver", "beacon 7", 0) is None
    assert answers.refusal("spare", "beacon 7", SILENT_NS - 1) == "beacon 7 is received by another receiver"
    assert answers.refusal("spare", "beacon 7", SILENT_NS) is None
    assert answers.refusal("receiver", "beacon 7", SILENT_NS + 1) is not None


def test_a_rejected_receiver_waits_and_returns() -> None:
    """A flood of a thousand a second, each answer rejected, costs eight updates a second."""
    answers, used = BeaconAnswers(), 0
    for ms in range(10_000):
        receiver = f"stranger {ms % 50}"
        if answers.refusal(receiver, f"beacon {ms % 50}", ms * MILLI) is None:
            used += 1
            answers.note_rejected(receiver, ms * MILLI)
    assert used <= MAX_RECEIVERS * 10 * SECOND_NS // REJECTED_NS
    assert answers.refusal("stranger 0", "beacon 0", 10 * SECOND_NS + REJECTED_NS) is None


@pytest.mark.parametrize("false", [1, 2, 5])
@pytest.mark.parametrize("gap_ms", [10, 90])
def test_beacons_whose_answers_are_rejected_keep_no_other_of_the_receiver_out(
    false: int, gap_ms: int
) -> None:
    """A receiver's beacons answer in turn once a second; all but the last are rejected. It was never used."""
    answers, used = BeaconAnswers(), list[int]()
    for second in range(100):
        for k in range(false + 1):
            now = second * SECOND_NS + k * gap_ms * MILLI
            if answers.refusal("receiver", f"beacon {k}", now) is not None:
                continue
            if k < false:
                answers.note_rejected("receiver", now)
            else:
                used.append(second)
    assert len(used) >= 100 // (false + 1) - 2
    assert used[-1] > 100 - 2 * (false + 1)


def test_two_honest_beacons_that_are_rejected_are_not_called_too_many() -> None:
    """Then "more than 10 per second, or 2 while they are rejected" was reported every 11 s."""
    answers, reasons = BeaconAnswers(), set[str | None]()
    for second in range(60):
        for k in range(2):
            now = (1000 * second + 10 * k) * MILLI
            why = answers.refusal("receiver", f"beacon {k}", now)
            reasons.add(why)
            if why is None:
                answers.note_rejected("receiver", now)
    assert reasons == {None, TURN_REASON}


def test_a_beacon_that_waits_and_is_silent_keeps_no_other_out() -> None:
    answers = BeaconAnswers()
    assert answers.refusal("receiver", "beacon 1", 0) is None
    answers.note_rejected("receiver", 0)
    assert answers.refusal("receiver", "beacon 2", 1) is not None
    assert answers.refusal("receiver", "beacon 1", SECOND_NS) is not None
    assert answers.refusal("receiver", "beacon 1", SILENT_NS + 1) is None


def test_memory_is_bounded_whatever_beacons_are_stated() -> None:
    answers = BeaconAnswers()
    for ms in range(100_000):
        if answers.refusal(f"stranger {ms % 4}", f"beacon {ms % 65_536}", ms * MILLI) is None and ms % 2:
            answers.note_rejected(f"stranger {ms % 4}", ms * MILLI)
    assert sum(map(len, answers._waiting.values())) <= MAX_RECEIVERS * MAX_WAITING
    assert len(answers._followed) <= MAX_RECEIVERS * (20 + 10 * (SILENT_NS // SECOND_NS + 1))
