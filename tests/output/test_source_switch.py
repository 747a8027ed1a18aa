"""Source switch: what the table requires is requested until acknowledged; what another selects is left."""

import itertools
import math
from typing import Any

import pytest

from companion.link import dialect
from companion.link.dialect import mavlink
from companion.nav.geometry import Geodetic, displace, slant_range_azimuth
from companion.output.source_switch import FRESH_S, MAX_TRIES, Selected, SourceSwitch, selected
from companion.output.source_table import FIX_S, NO_FIX_S, SILENT_S, STEADY_S, STOPPED_S
from companion.records import GlobalPosition, Gnss, RsbnFix
from companion.units import SECOND_NS
from tests.solutions import solution_at

TENTH = SECOND_NS // 10
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)


def beacon_fix(now: int, off: float) -> RsbnFix:
    """Return an answer of a beacon 60 km to the east, its azimuth off by `off` (m, one sigma is 131 m)."""
    place, beacon = Geodetic(1.0, 0.5, 100.0), displace(1.0, 0.5, 100.0, 0.0, 60e3, 0.0)
    true = slant_range_azimuth(beacon, place)
    azimuth = true.azimuth + off / 60e3 + 1e-9 * (now // TENTH)  # else it would be a receiver that hangs
    return RsbnFix(now, now, 1, *beacon, azimuth, true.slant_range, math.radians(0.125), 110.0)


class Flight:
    """An autopilot that answers with `answer` (None: no answer); its receiver and our solutions at 5 Hz.

    `sends_when_asked`: it sends the receiver's message on request.
    """

    def __init__(self, answer: int | None = ACCEPTED, sends_when_asked: bool = False) -> None:
        self.switch, self.now, self.answer = SourceSwitch(), 10**12, answer
        self.sends_when_asked = sends_when_asked
        self.lack = ""
        self.drawn_m = 0.0  # by which GNSS is drawn off, east
        self.requests: list[tuple[float, int, int]] = []
        self.asked: list[float] = []
        self.reports: list[tuple[float, str]] = []

    def fly(
        self,
        seconds: float,
        fix: bool | None = True,
        sent: bool = True,
        solved: bool = True,
        false: float = 1e-6,
        witness: bool = True,
        contradicted: bool | None = None,
    ) -> float:
        """Simulate `seconds`, `fix` None is a silent receiver; return the time at the end, s.

        The beacon contradicts GNSS (by ten sigma) where GNSS is false, or as `contradicted`.
        """
        for k in range(round(10 * seconds)):
            self.now += TENTH
            if fix is not None and k % 2:
                self.switch.receive(self.gnss(3 if fix else 1))
            if solved and witness and k % 10 == 0:
                is_false = false > 0.9 if contradicted is None else contradicted
                self.switch.receive(beacon_fix(self.now, 1300.0 if is_false else 0.0))
            if solved:
                found = solution_at(self.now, gnss_false=false, witness=witness)
                self.switch.note_output(found, sent, self.now)
            if solved or k % 10 == 0:
                self.switch.update(self.now, self.lack)
            for m in self.switch.to_send(7, self.now):
                if m.command == mavlink.MAV_CMD_REQUEST_MESSAGE:
                    assert (m.target_system, m.param1) == (7, mavlink.MAVLINK_MSG_ID_GPS_RAW_INT)
                    self.asked.append(self.now * 1e-9)
                    if self.sends_when_asked:
                        self.switch.receive(self.gnss(3))
                    continue
                assert (m.target_system, m.target_component, m.command) == (7, 1, 42007)
                self.requests.append((self.now * 1e-9, m.param1, m.confirmation))
                if self.answer is not None:
                    self.switch.handle_acknowledgement(42007, self.answer, self.now + TENTH // 2)
            self.reports += [(e.rx_ns * 1e-9, e.text) for e in self.switch.take_events()]
        return self.now * 1e-9

    def gnss(self, fix: int) -> Gnss:
        lat, lon, alt = displace(1.0, 0.5, 100.0, 0.0, self.drawn_m, 0.0)
        return Gnss(self.now, self.now, 0, self.now // 1000, fix, lat, lon, alt)

    @property
    def sets(self) -> list[int]:
        return [source_set for _, source_set, _ in self.requests]


BY_OTHER = {
    "it flies by the other": (80.0, 0.0, 2.0, [1]),
    "the two are near": (12.0, 0.0, 0.5, [1]),
    "both are drawn off alike": (80.0, 78.0, 79.0, [1, 2]),
    "both are false": (80.0, -300.0, -300.0, [1, 2]),
    "it blends them": (2000.0, 0.0, 300.0, [1, 2]),
    "it flies by the false one": (80.0, 0.0, 80.0, [1, 2]),
}


def fly_two(flight: Flight, seconds: int, used_m: float, other_m: float, own_m: float, **how: Any) -> None:
    """Fly with two receivers and the autopilot so far east; the first is false."""
    flight.drawn_m = used_m
    for _ in range(seconds):
        now = flight.now
        lat, lon, alt = displace(1.0, 0.5, 100.0, 0.0, other_m, 0.0)
        flight.switch.note_other(Gnss(now, now, 1, now // 1000, 3, lat, lon, alt))
        lat, lon, alt = displace(1.0, 0.5, 100.0, 0.0, own_m, 0.0)
        flight.switch.note_own(GlobalPosition(now, now, lat, lon, alt, (0.0, 0.0, 0.0), 0.0))
        flight.fly(1.0, false=0.9999, **how)


@pytest.mark.parametrize("case", BY_OTHER)
def test_a_false_receiver_takes_off_no_autopilot_that_flies_by_the_other(case: str) -> None:
    """Flown (GPS_AUTO_SWITCH 1): the first receiver 80 m off, the autopilot 1 m off by the second one."""
    used_m, other_m, own_m, requested = BY_OTHER[case]
    flight = Flight()
    flight.fly(20.0)
    fly_two(flight, 40, used_m, other_m, own_m)
    assert flight.sets == requested


def test_a_gap_in_the_streams_takes_no_autopilot_off_its_other_receiver() -> None:
    flight = Flight()
    flight.fly(20.0)
    fly_two(flight, 30, 80.0, 0.0, 1.0)
    flight.fly(8.0, false=0.9999)  # nothing of the other receiver, and no position
    fly_two(flight, 30, 80.0, 0.0, 1.0)
    assert flight.sets == [1]


def test_on_our_position_the_autopilot_flies_by_no_receiver() -> None:
    """It was on the false one: once our position stops it does not go back, though it is at the other one."""
    flight = Flight()
    flight.fly(20.0)
    fly_two(flight, 30, 80.0, 0.0, 80.0)
    fly_two(flight, 30, 80.0, 0.0, 1.0)
    fly_two(flight, 8, 80.0, 0.0, 1.0, sent=False)
    assert flight.sets == [1, 2]


def test_set_2_on_gnss_loss_and_set_1_on_its_return() -> None:
    flight = Flight()
    lost = flight.fly(30.0)
    assert flight.sets == [1]  # the initial set is unknown
    back = flight.fly(60.0, fix=False)
    flight.fly(60.0)
    assert flight.sets == [1, 2, 1]
    assert flight.requests[1][0] - lost == pytest.approx(NO_FIX_S, abs=0.31)
    assert flight.requests[2][0] - back == pytest.approx(FIX_S, abs=0.31)
    assert [text for _, text in flight.reports] == [
        "EKF source set 1: GNSS has a fix",
        "EKF source set 2: GNSS is lost, using companion",
        "EKF source set 1: GNSS has a fix",
    ]


def test_set_2_is_not_requested_while_it_has_no_position_of_ours() -> None:
    flight = Flight()
    flight.fly(30.0)
    flight.lack = "EK3_SRC2_POSXY is 0"
    flight.fly(60.0, fix=False)
    assert flight.sets == [1]
    assert [text for _, text in flight.reports[1:]] == [
        "EKF source set 2 needed, but EK3_SRC2_POSXY is 0: run companion doctor"
    ]
    flight.lack = ""
    flight.fly(10.0, fix=False)
    assert flight.sets == [1, 2]


@pytest.mark.parametrize("lie", [False, True])
def test_set_2_whose_lack_is_found_too_late_is_left_again(lie: bool) -> None:
    """The parameters are read after it was requested, or change. A GNSS held false is worse than none."""
    flight = Flight()
    flight.fly(30.0)
    dark: dict[str, Any] = {"false": 1.0 - 1e-6} if lie else {"fix": False}
    flight.fly(30.0, **dark)
    assert flight.sets == [1, 2]
    flight.lack = "EK3_SRC2_POSXY is 0"
    flight.fly(60.0, **dark)
    assert flight.sets == ([1, 2] if lie else [1, 2, 1])
    assert [text for _, text in flight.reports[2:]] == [
        "EKF source set 2 needed, but EK3_SRC2_POSXY is 0: run companion doctor",
        *([] if lie else ["EKF source set 1: EK3_SRC2_POSXY is 0"]),
    ]


def test_silent_receiver() -> None:
    flight = Flight()
    silent = flight.fly(30.0)
    flight.fly(30.0, fix=None)
    flight.fly(30.0)
    assert flight.sets == [1, 2, 1]
    assert flight.requests[1][0] - silent == pytest.approx(SILENT_S, abs=0.31)
    assert flight.reports[1][1] == "EKF source set 2: GNSS receiver silent, using companion"
    assert len(flight.asked) == 9  # and no longer in vain


def test_a_stream_that_another_station_has_stopped_is_no_silent_receiver() -> None:
    flight = Flight(sends_when_asked=True)
    flight.fly(30.0)
    flight.fly(60.0, fix=None)
    assert flight.sets == [1]
    assert 50 <= len(flight.asked) <= 60  # once a second


def test_rejected_innovations_never_switch() -> None:
    """A navigator that trusts no fix, without a witness or short of certainty, leaves the autopilot alone."""
    flight = Flight()
    flight.fly(30.0)
    flight.fly(600.0, false=1.0, witness=False)
    flight.fly(600.0, false=0.998, witness=True)
    assert flight.sets == [1]


def test_false_gnss_with_a_witness() -> None:
    flight = Flight()
    flight.fly(30.0)
    flight.fly(30.0, false=0.9999)
    assert flight.sets == [1, 2]
    assert flight.reports[-1][1] == "EKF source set 2: GNSS is false, using companion"
    flight.fly(60.0, false=0.5)  # not believed again: stays
    assert flight.sets == [1, 2]
    flight.fly(60.0, false=0.01)
    assert flight.sets == [1, 2, 1]


def test_false_gnss_that_the_beacon_agrees_with_switches_nothing() -> None:
    """Flown: a turn in turbulence was taken for a drift of GNSS; the beacon was received and saw nothing."""
    flight = Flight()
    flight.fly(60.0)
    flight.fly(600.0, false=1.0, witness=True, contradicted=False)
    assert flight.sets == [1]


def test_lost_witness_leaves_the_aircraft_on_our_position_while_it_goes_out() -> None:
    """A fix that was held false is not fit to lead because the beacon is silent for a while."""
    flight = Flight()
    flight.fly(30.0)
    flight.fly(30.0, false=1.0)
    flight.fly(60.0, false=1.0, witness=False)
    assert flight.sets == [1, 2]
    flight.fly(5.0, false=1.0, witness=False, sent=False)
    assert flight.sets == [1, 2, 1]  # nothing goes out: ArduPilot would be lost on set 2


@pytest.mark.parametrize("solved", [True, False])
def test_silence_of_our_output_returns_to_set_1(solved: bool) -> None:
    """GNSS returns in the dark moment when our output stops: withheld, or no solutions at all."""
    flight = Flight()
    flight.fly(30.0)
    flight.fly(30.0, fix=False)
    stopped = flight.fly(1.0, fix=True)
    flight.fly(10.0, sent=False, solved=solved)
    assert flight.sets == [1, 2, 1]
    assert STOPPED_S <= flight.requests[2][0] - stopped <= STOPPED_S + 1.1
    assert flight.reports[-1][1] == "EKF source set 1: no companion position"


def test_solutions_that_end_return_to_set_1_after_a_false_gnss() -> None:
    """A lie held with a witness is not forgotten at once; a solution of a minute ago says nothing more."""
    flight = Flight()
    flight.fly(30.0)
    ended = flight.fly(30.0, false=1.0)
    flight.fly(120.0, solved=False)
    assert flight.sets == [1, 2, 1]
    assert flight.requests[2][0] - ended == pytest.approx(FRESH_S, abs=1.1)


def test_set_2_requires_our_position_to_be_sent() -> None:
    flight = Flight()
    flight.fly(30.0, sent=False)
    good = flight.fly(60.0, fix=False, sent=False)
    assert flight.sets == [1]
    flight.fly(10.0, fix=False)
    assert flight.sets == [1, 2]
    assert flight.requests[1][0] - good == pytest.approx(STEADY_S, abs=0.11)


def test_intermittent_output_is_not_steady() -> None:
    flight = Flight()
    flight.fly(30.0, sent=False)
    for _ in range(20):
        flight.fly(2.5, fix=False)
        flight.fly(0.1, fix=False, sent=False)
    assert flight.sets == [1]


def test_flickering_receiver_switches_nothing() -> None:
    flight = Flight()
    flight.fly(30.0)
    for _ in range(50):
        flight.fly(1.5, fix=False)
        flight.fly(1.5, fix=True)
    assert flight.sets == [1]
    flight.fly(10.0, fix=False)
    for _ in range(50):
        flight.fly(4.0, fix=True)
        flight.fly(1.0, fix=False)
    assert flight.sets == [1, 2]


def test_restart_in_the_dark() -> None:
    """A companion that restarts while the autopilot is on set 2 takes it back to set 1 when GNSS returns."""
    flight = Flight()
    flight.fly(20.0, fix=False, sent=False)  # nothing to send yet
    assert flight.sets == []
    flight.fly(20.0, fix=True, solved=False)  # and no solution: set 1 all the same
    assert flight.sets == [1]


def test_command_is_repeated_until_acknowledged() -> None:
    flight = Flight()
    flight.fly(30.0)
    flight.answer = None
    flight.fly(5.0, fix=False)
    flight.answer = TEMPORARILY_REJECTED
    flight.fly(2.0, fix=False)
    flight.answer = ACCEPTED
    flight.fly(20.0, fix=False)
    requests = flight.requests[1:]
    assert [confirmation for *_, confirmation in requests] == list(range(len(requests)))
    assert 5 <= len(requests) <= 7
    assert all(round(b[0] - a[0], 6) == 1.0 for a, b in itertools.pairwise(requests))
    assert flight.reports[-1][1].startswith("EKF source set 2")


@pytest.mark.parametrize(
    ("then", "sets"),
    [({"fix": True}, [2, 2, 1]), ({"fix": False, "sent": False}, [2, 2])],
    ids=["GNSS is back", "our position is withheld"],
)
def test_command_is_not_repeated_once_it_is_not_required(then: dict[str, Any], sets: list[int]) -> None:
    """ArduPilot accepts set 2 without a position too; an acknowledgement may have been lost."""
    flight = Flight()
    flight.fly(30.0)
    flight.answer = None
    flight.fly(3.5, fix=False)
    flight.fly(5.5, **then)
    assert flight.sets == [1, *sets]
    flight.answer = ACCEPTED
    flight.fly(5.0, fix=False)
    flight.fly(20.0, fix=False)
    assert flight.sets[-1] == 2 and flight.switch.is_on_companion


def test_rejected_command_is_reported_once() -> None:
    for answer, expected in ((None, "10 tries"), (FAILED, "10 tries"), (DENIED, "2"), (UNSUPPORTED, "3")):
        flight = Flight(answer)
        flight.fly(100.0, fix=False)
        times = [t for t, _, _ in flight.requests]
        rounds = [0, *(k for k, (a, b) in enumerate(itertools.pairwise(times), 1) if b - a > 2.0)]
        assert rounds == ([0, MAX_TRIES, 2 * MAX_TRIES] if "tries" in expected else [0])
        ((_, text),) = flight.reports
        assert expected in text and "source set 2" in text and "by hand" in text
        flight.answer = ACCEPTED
        flight.fly(30.0)
        assert flight.sets[-1] == 1  # the next set is requested


def test_a_command_that_nobody_heard_is_repeated_when_the_link_is_back() -> None:
    """The link to the autopilot is lost for 18 s as GNSS returns: set 1 is requested again later."""
    flight = Flight()
    flight.fly(30.0)
    flight.fly(30.0, fix=False)
    flight.answer = None
    flight.fly(18.0)
    flight.answer = ACCEPTED
    flight.fly(40.0)
    assert flight.reports[-1][1] == "EKF source set 1: GNSS has a fix"
    assert not flight.switch.is_on_companion
    quiet = len(flight.requests)
    flight.fly(100.0)
    assert len(flight.requests) == quiet


def test_acknowledgement_of_another_command_is_ignored() -> None:
    flight = Flight(None)
    flight.fly(6.0, fix=False)
    flight.switch.handle_acknowledgement(511, ACCEPTED, flight.now)
    count = len(flight.requests)
    flight.fly(5.0, fix=False)
    assert len(flight.requests) > count


def test_unrequested_acknowledgement_is_ignored() -> None:
    flight = Flight()
    flight.switch.handle_acknowledgement(42007, ACCEPTED, flight.now)
    flight.fly(10.0, fix=False)
    assert flight.sets == [2]
    flight.switch.handle_acknowledgement(42007, DENIED, flight.now)
    assert not flight.switch.take_events()


def test_after_a_reboot_the_source_set_is_requested_again() -> None:
    flight = Flight()
    flight.fly(10.0, fix=False)
    flight.switch = SourceSwitch()  # as AutopilotOutput.handle_reboot does
    flight.fly(10.0, fix=False)
    assert flight.sets == [2, 2]


# ---------------------------------------------------------------------------------------------------------
# Somebody else selects
# ---------------------------------------------------------------------------------------------------------

#: How a person's choice reaches the companion.
BY_PERSON = [
    lambda n: (dialect.new("COMMAND_LONG", command=42007, param1=n), False),
    lambda n: (dialect.new("COMMAND_INT", command=42007, param1=n), False),
    lambda n: (dialect.new("STATUSTEXT", text=b"Using EKF Source Set %d" % n), True),
    lambda n: (dialect.new("NAMED_VALUE_FLOAT", name=b"EKFSRC", value=n), True),
]


def by_others(flight: Flight, message: Any, from_autopilot: bool) -> None:
    by = selected(message, from_autopilot, 1)
    assert by is not None
    for _ in range(2):
        flight.switch.handle_selected(by, flight.now)


@pytest.mark.parametrize("how", BY_PERSON)
def test_a_persons_choice_is_respected_until_he_hands_back(how: Any) -> None:
    flight = Flight()
    flight.fly(30.0)
    flight.fly(30.0, fix=False)
    assert flight.sets == [1, 2]
    by_others(flight, *how(1))  # in the dark the pilot prefers the autopilot's own reckoning
    flight.fly(30.0, fix=False)
    flight.fly(30.0)
    flight.fly(30.0, fix=False)
    assert flight.sets == [1, 2]
    assert [text for _, text in flight.reports[2:]] == [
        "EKF source set 1 selected by hand: the companion does not switch",
        "EKF source set 2 needed (GNSS is lost), but EKF source set 1 selected by hand",
    ]
    by_others(flight, *how(2))
    flight.fly(10.0, fix=False)
    flight.fly(10.0)
    assert flight.sets == [1, 2, 1]


def test_a_choice_that_agrees_changes_nothing() -> None:
    flight = Flight()
    by_others(flight, *BY_PERSON[0](1))  # before the companion has anything to decide
    flight.fly(30.0)
    by_others(flight, *BY_PERSON[2](1))
    flight.fly(30.0, fix=False)
    assert flight.sets == [2]
    assert len(flight.reports) == 1


def test_the_scripts_own_choice_is_no_persons() -> None:
    """The companion stalls while GNSS is held false: the script selects set 1; then our position returns."""
    flight = Flight()
    flight.fly(30.0)
    flight.fly(30.0, false=1.0)
    flight.now += 5 * SECOND_NS  # stalled
    script = dialect.new("NAMED_VALUE_FLOAT", name=b"EKFSRC", value=-1.0), True
    by_others(flight, *script)
    flight.fly(10.0, false=1.0)
    assert flight.sets == [1, 2, 2]


@pytest.mark.parametrize("is_steady", [False, True])
def test_one_report_made_before_our_command_is_ignored(is_steady: bool) -> None:
    flight = Flight()
    flight.fly(30.0)
    if is_steady:
        reported(flight, 1, 10)
    flight.fly(10.0, fix=False)
    flight.switch.handle_selected(Selected(1, is_report=True), flight.now)
    flight.switch.handle_selected(Selected(2, is_report=True), flight.now)
    flight.switch.handle_selected(Selected(1, is_report=True), flight.now)
    flight.fly(10.0)
    assert flight.sets == [1, 2, 1]
    assert len(flight.reports) == 3


def reported(flight: Flight, source_set: int, seconds: int, **situation: Any) -> None:
    """Fly while the script reports `source_set` once a second."""
    for _ in range(seconds):
        flight.fly(1.0, **situation)
        flight.switch.handle_selected(Selected(source_set, is_report=True), flight.now)


def test_the_scripts_report_of_the_former_set_is_no_choice_while_ours_is_not_answered() -> None:
    """The uplink is lost for 18 s as GNSS is: the companion took set 1 for a person's choice for good."""
    flight = Flight()
    reported(flight, 1, 30)
    flight.answer = None
    reported(flight, 1, 18, fix=False)
    flight.answer = ACCEPTED
    reported(flight, 1, 20, fix=False)
    assert not flight.switch.is_on_companion
    reported(flight, 2, 10, fix=False)  # tried again after 30 s
    assert flight.switch.is_on_companion
    assert not any("by hand: the companion" in text for _, text in flight.reports)


def test_the_scripts_report_of_our_set_is_no_choice_where_its_acknowledgement_was_lost() -> None:
    flight = Flight()
    reported(flight, 1, 30)
    flight.answer = None
    flight.fly(3.0, fix=False)
    assert flight.sets == [1, 2]
    flight.answer = ACCEPTED
    reported(flight, 2, 4)  # GNSS is back before the next try
    assert flight.switch.is_on_companion
    flight.fly(10.0)
    assert flight.sets == [1, 2, 1]
    assert [text for _, text in flight.reports] == ["EKF source set 1: GNSS has a fix"] * 2


@pytest.mark.parametrize(
    ("name", "fields", "from_autopilot"),
    [
        ("COMMAND_LONG", {"command": 42007, "param1": 0.0}, False),
        ("COMMAND_LONG", {"command": 42007, "param1": math.nan}, False),
        ("COMMAND_LONG", {"command": 42007, "param1": 1.5}, False),
        ("COMMAND_LONG", {"command": 400, "param1": 1.0}, False),
        ("COMMAND_LONG", {"command": 42007, "param1": 3.0, "target_system": 2}, False),  # another aircraft's
        ("COMMAND_INT", {"command": 42007, "param1": 3.0, "target_component": 191}, False),
        ("STATUSTEXT", {"text": b"Using EKF Source Set 2"}, False),
        ("STATUSTEXT", {"text": b"Using EKF Source Set 4"}, True),
        ("NAMED_VALUE_FLOAT", {"name": b"EKFSRC", "value": 0.0}, True),
        ("NAMED_VALUE_FLOAT", {"name": b"EKFSRC", "value": math.inf}, True),
        ("NAMED_VALUE_FLOAT", {"name": b"OTHER", "value": 1.0}, True),
    ],
)
def test_other_messages_select_nothing(name: str, fields: dict[str, Any], from_autopilot: bool) -> None:
    assert selected(dialect.new(name, **fields), from_autopilot, 1) is None


def test_a_single_position_of_a_slow_output_is_not_steady() -> None:
    """At 0.2 Hz set 2 was requested 3 s after the only one, for ten seconds."""
    switch, period_ns = SourceSwitch(), 5 * SECOND_NS
    switch.note_output(solution_at(SECOND_NS), True, SECOND_NS, period_ns)
    for k in range(1, 20):
        assert switch.situation(SECOND_NS * k).sent_s < STEADY_S
    for k in range(4):
        now = (100 + 5 * k) * SECOND_NS
        switch.note_output(solution_at(now), True, now, period_ns)
    assert switch.situation(now).sent_s >= STEADY_S
