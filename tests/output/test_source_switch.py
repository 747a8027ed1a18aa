"""Source switch: set 2 when GNSS is lost and our output is steady, set 1 when GNSS is trusted again."""

import itertools

from companion.output.source_switch import (
    GNSS_LOST_NS,
    GNSS_TRUSTED_NS,
    MAX_TRIES,
    OUTPUT_STEADY_NS,
    SourceSwitch,
)
from companion.units import SECOND_NS

TENTH = SECOND_NS // 10
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)


class Flight:
    """An autopilot that answers with `answer` (None: no answer), and our solutions at 10 Hz."""

    def __init__(self, answer: int | None = ACCEPTED) -> None:
        self.switch, self.now, self.answer = SourceSwitch(), 10**12, answer
        self.requests: list[tuple[float, int, int]] = []
        self.reports: list[tuple[float, str]] = []

    def fly(self, seconds: float, gnss: bool, sent: bool = True) -> float:
        """Simulate `seconds`; return the time at the end, s."""
        for _ in range(round(10 * seconds)):
            self.now += TENTH
            self.switch.update(gnss, sent, self.now)
            for m in self.switch.to_send(7, self.now):
                assert (m.target_system, m.target_component, m.command) == (7, 1, 42007)
                self.requests.append((self.now * 1e-9, m.param1, m.confirmation))
                if self.answer is not None:
                    self.switch.handle_acknowledgement(42007, self.answer, self.now + TENTH // 2)
            self.reports += [(e.rx_ns * 1e-9, e.text) for e in self.switch.take_events()]
        return self.now * 1e-9

    @property
    def sets(self) -> list[int]:
        return [source_set for _, source_set, _ in self.requests]


def test_set_2_on_gnss_loss_and_set_1_on_its_return() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    assert flight.sets == [1]  # the initial set is unknown
    lost = flight.fly(0.1, gnss=False)
    back = flight.fly(60.0, gnss=False)
    flight.fly(60.0, gnss=True)
    assert flight.sets == [1, 2, 1]
    assert flight.requests[1][0] - lost == GNSS_LOST_NS / SECOND_NS
    assert abs(flight.requests[2][0] - back - GNSS_TRUSTED_NS / SECOND_NS) <= 0.11
    assert [text for _, text in flight.reports] == [
        "EKF source set 1: GNSS is trusted again",
        "EKF source set 2: GNSS is lost, using companion",
        "EKF source set 1: GNSS is trusted again",
    ]


def test_set_2_requires_our_position_to_be_sent() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True, sent=False)
    flight.fly(60.0, gnss=False, sent=False)
    assert flight.sets == [1]
    good = flight.fly(0.1, gnss=False, sent=True)
    flight.fly(10.0, gnss=False, sent=True)
    assert flight.sets == [1, 2]
    assert flight.requests[1][0] - good == OUTPUT_STEADY_NS / SECOND_NS


def test_intermittent_output_is_not_steady() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True, sent=False)
    for _ in range(20):
        flight.fly(2.5, gnss=False, sent=True)
        flight.fly(0.1, gnss=False, sent=False)
    assert flight.sets == [1]


def test_intermittent_gnss_switches_nothing() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    for _ in range(50):
        flight.fly(1.5, gnss=False)
        flight.fly(1.5, gnss=True)
    assert flight.sets == [1]
    flight.fly(10.0, gnss=False)
    for _ in range(50):
        flight.fly(9.0, gnss=True)
        flight.fly(1.0, gnss=False)
    assert flight.sets == [1, 2]


def test_gap_in_solutions_restarts_the_timers() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    flight.fly(1.0, gnss=False)
    flight.now += 60 * SECOND_NS
    flight.fly(1.0, gnss=False)
    assert flight.sets == [1]


def test_command_is_repeated_until_acknowledged() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    flight.answer = None
    flight.fly(5.0, gnss=False)
    flight.answer = TEMPORARILY_REJECTED
    flight.fly(2.0, gnss=False)
    flight.answer = ACCEPTED
    flight.fly(20.0, gnss=False)
    requests = flight.requests[1:]
    assert [confirmation for *_, confirmation in requests] == list(range(len(requests)))
    assert 4 <= len(requests) <= 6
    assert all(round(b[0] - a[0], 6) == 1.0 for a, b in itertools.pairwise(requests))
    assert flight.reports[-1][1].startswith("EKF source set 2")


def test_rejected_command_is_reported_once() -> None:
    for answer, expected in ((None, "10 tries"), (FAILED, "10 tries"), (DENIED, "2"), (UNSUPPORTED, "3")):
        flight = Flight(answer)
        flight.fly(100.0, gnss=False)
        assert len(flight.requests) == (MAX_TRIES if "tries" in expected else 1)
        ((_, text),) = flight.reports
        assert expected in text and "source set 2" in text and "by hand" in text
        flight.answer = ACCEPTED
        flight.fly(30.0, gnss=True)
        assert flight.sets[-1] == 1  # the next set is requested


def test_acknowledgement_of_another_command_is_ignored() -> None:
    flight = Flight(None)
    flight.fly(6.0, gnss=False)
    flight.switch.handle_acknowledgement(511, ACCEPTED, flight.now)
    count = len(flight.requests)
    flight.fly(5.0, gnss=False)
    assert len(flight.requests) > count


def test_unrequested_acknowledgement_is_ignored() -> None:
    flight = Flight()
    flight.switch.handle_acknowledgement(42007, ACCEPTED, flight.now)
    flight.fly(10.0, gnss=False)
    assert flight.sets == [2]
    flight.switch.handle_acknowledgement(42007, DENIED, flight.now)
    assert not flight.switch.take_events()


def test_after_a_reboot_the_source_set_is_requested_again() -> None:
    flight = Flight()
    flight.fly(10.0, gnss=False)
    flight.switch = SourceSwitch()  # as AutopilotOutput.handle_reboot does
    flight.fly(10.0, gnss=False)
    assert flight.sets == [2, 2]
