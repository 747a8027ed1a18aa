"""Source sets: asked for when GNSS is lost and we are good, taken back when it is trusted; none too soon."""

import itertools

from companion.output.source_switch import GOOD_NS, LOST_NS, RETURNED_NS, SECOND, TRIES, Switching

TENTH = SECOND // 10
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)


class Flight:
    """An autopilot that answers `answer` (None: nothing), and our navigation, ten times a second."""

    def __init__(self, answer: int | None = ACCEPTED) -> None:
        self.switching, self.now, self.answer = Switching(), 10**12, answer
        self.asked: list[tuple[float, int, int]] = []
        self.told: list[tuple[float, str]] = []

    def fly(self, seconds: float, gnss: bool, sent: bool = True) -> float:
        """Fly on; the time at its end, s."""
        for _ in range(round(10 * seconds)):
            self.now += TENTH
            self.switching.update(gnss, sent, self.now)
            for m in self.switching.to_send(7, self.now):
                assert (m.target_system, m.target_component, m.command) == (7, 1, 42007)
                self.asked.append((self.now * 1e-9, m.param1, m.confirmation))
                if self.answer is not None:
                    self.switching.acknowledged(42007, self.answer, self.now + TENTH // 2)
            self.told += [(e.rx_ns * 1e-9, e.text) for e in self.switching.take_events()]
        return self.now * 1e-9

    @property
    def sets(self) -> list[int]:
        return [source_set for _, source_set, _ in self.asked]


def test_set_2_when_gnss_is_lost_and_1_when_it_is_trusted_again() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    assert flight.sets == [1]  # whatever set it had before we came
    lost = flight.fly(0.1, gnss=False)
    back = flight.fly(60.0, gnss=False)
    flight.fly(60.0, gnss=True)
    assert flight.sets == [1, 2, 1]
    assert flight.asked[1][0] - lost == LOST_NS / SECOND
    assert abs(flight.asked[2][0] - back - RETURNED_NS / SECOND) <= 0.11
    assert [text for _, text in flight.told] == [
        "EKF source set 1: GNSS is trusted again",
        "EKF source set 2: GNSS is lost, our position leads",
        "EKF source set 1: GNSS is trusted again",
    ]


def test_set_2_is_not_asked_for_before_our_own_position_goes_out() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True, sent=False)
    flight.fly(60.0, gnss=False, sent=False)
    assert flight.sets == [1]
    good = flight.fly(0.1, gnss=False, sent=True)
    flight.fly(10.0, gnss=False, sent=True)
    assert flight.sets == [1, 2]
    assert flight.asked[1][0] - good == GOOD_NS / SECOND


def test_a_position_that_comes_and_goes_is_not_good() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True, sent=False)
    for _ in range(20):
        flight.fly(2.5, gnss=False, sent=True)
        flight.fly(0.1, gnss=False, sent=False)
    assert flight.sets == [1]


def test_a_receiver_that_flickers_switches_nothing() -> None:
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


def test_a_silence_of_the_navigator_is_no_sign_of_good() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    flight.fly(1.0, gnss=False)
    flight.now += 60 * SECOND
    flight.fly(1.0, gnss=False)
    assert flight.sets == [1]


def test_it_is_repeated_until_it_is_acknowledged() -> None:
    flight = Flight()
    flight.fly(30.0, gnss=True)
    flight.answer = None
    flight.fly(5.0, gnss=False)
    flight.answer = TEMPORARILY_REJECTED
    flight.fly(2.0, gnss=False)
    flight.answer = ACCEPTED
    flight.fly(20.0, gnss=False)
    asked = flight.asked[1:]
    assert [confirmation for *_, confirmation in asked] == list(range(len(asked)))
    assert 4 <= len(asked) <= 6
    assert all(round(b[0] - a[0], 6) == 1.0 for a, b in itertools.pairwise(asked))
    assert flight.told[-1][1].startswith("EKF source set 2")


def test_it_is_given_up_with_one_event() -> None:
    for answer, said in ((None, "10 tries"), (FAILED, "10 tries"), (DENIED, "2"), (UNSUPPORTED, "3")):
        flight = Flight(answer)
        flight.fly(100.0, gnss=False)
        assert len(flight.asked) == (TRIES if "tries" in said else 1)
        ((_, text),) = flight.told
        assert said in text and "source set 2" in text and "by hand" in text
        flight.answer = ACCEPTED
        flight.fly(30.0, gnss=True)
        assert flight.sets[-1] == 1  # the next wish is asked for again


def test_the_answer_to_another_command_is_none() -> None:
    flight = Flight(None)
    flight.fly(6.0, gnss=False)
    flight.switching.acknowledged(511, ACCEPTED, flight.now)
    count = len(flight.asked)
    flight.fly(5.0, gnss=False)
    assert len(flight.asked) > count


def test_an_answer_that_comes_unasked_is_none() -> None:
    flight = Flight()
    flight.switching.acknowledged(42007, ACCEPTED, flight.now)
    flight.fly(10.0, gnss=False)
    assert flight.sets == [2]
    flight.switching.acknowledged(42007, DENIED, flight.now)
    assert not flight.switching.take_events()


def test_after_a_reboot_it_is_asked_for_anew() -> None:
    flight = Flight()
    flight.fly(10.0, gnss=False)
    flight.switching.rebooted()
    flight.fly(10.0, gnss=False)
    assert flight.sets == [2, 2]
