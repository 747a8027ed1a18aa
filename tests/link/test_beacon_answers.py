"""Beacon answers: a beacon keeps its receiver, and hostile receivers get little of the navigator's time."""

from companion.link.beacon_answers import MAX_RECEIVERS, REJECTED_NS, SILENT_NS, BeaconAnswers
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
        if answers.refusal(receiver, ms % 50, ms * MILLI) is None:
            used += 1
            answers.note_rejected(receiver, ms * MILLI)
    assert used <= MAX_RECEIVERS * 10 * SECOND_NS // REJECTED_NS
    assert answers.refusal("stranger 0", 0, 10 * SECOND_NS + REJECTED_NS) is None


def test_memory_is_bounded_whatever_beacons_are_stated() -> None:
    answers = BeaconAnswers()
    for ms in range(100_000):
        answers.refusal(f"stranger {ms % 4}", ms % 65_536, ms * MILLI)
    assert len(answers._followed) <= MAX_RECEIVERS * (20 + 10 * (SILENT_NS // SECOND_NS + 1))
