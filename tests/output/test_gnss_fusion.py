"""GNSS fusion of PX4: off only for a false GNSS that a beacon contradicts, then on again; else untouched."""

import math
from typing import Any

import pytest

from companion.link import dialect
from companion.output.gnss_fusion import ESTIMATOR_SENSOR_ENABLE, GnssFusion
from companion.output.source_switch import Selected
from companion.output.source_table import STEADY_S, Situation

WELL = Situation(
    fix_s=1e3, no_fix_s=-1.0, silent_s=0.1, gnss_false=1e-6, witness=False, sent_s=1e3, stopped_s=0.0
)
FALSE: dict[str, Any] = {"gnss_false": 0.9999, "witness": True}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, 1),
        (FALSE, 2),
        ({**FALSE, "witness": False}, None),
        ({**FALSE, "sent_s": STEADY_S - 0.1}, None),
        ({"fix_s": -1.0, "no_fix_s": 100.0}, None),  # lost is not false
        ({"fix_s": -1.0, "silent_s": 100.0}, None),
        ({"gnss_false": 0.5}, None),
        ({**FALSE, "witness": False, "sent_s": -1.0, "stopped_s": 5.0}, 1),
    ],
)
def test_table(changes: dict[str, Any], expected: int | None) -> None:
    decision = GnssFusion().required(WELL._replace(**changes))
    assert (decision and decision[0]) == expected


class Switch(GnssFusion):
    """In a situation that the test sets."""

    now = WELL

    def situation(self, now_ns: int) -> Situation:
        return self.now


def requests(switch: Switch, situation: Situation, result: int, at: int) -> list[tuple[float, ...]]:
    switch.now = situation
    switch.update(at)
    sent = switch.to_send(1, at)
    for _ in sent:
        switch.handle_acknowledgement(ESTIMATOR_SENSOR_ENABLE, result, at + 1)
    return [(m.command, m.param1, m.param2, m.param3) for m in sent if math.isnan(m.param4)]


def test_off_while_false_and_on_again() -> None:
    switch, second = Switch(), 10**9
    assert requests(switch, WELL, 0, second) == []
    assert requests(switch, WELL._replace(**FALSE), 0, 2 * second) == [(43006, 0.0, 0.0, 0.0)]
    assert requests(switch, WELL._replace(**FALSE), 0, 9 * second) == []
    assert requests(switch, WELL, 0, 10 * second) == [(43006, 0.0, 0.0, 1.0)]
    assert [event.text for event in switch.take_events()] == [
        "GNSS fusion off: GNSS is false, using companion",
        "GNSS fusion on: GNSS has a fix",
    ]


def test_gnss_that_is_lost_and_back_is_reported_once_and_switches_nothing() -> None:
    """PX4 goes on by our position of itself; the pilot must know."""
    switch, second = Switch(), 10**9
    lost = WELL._replace(fix_s=-1.0, no_fix_s=2.0, gnss_false=None)
    back = WELL._replace(no_fix_s=-1.0)
    situations = [
        *(WELL, lost._replace(no_fix_s=1.9), lost._replace(sent_s=-1.0), lost, lost),
        *(back._replace(fix_s=4.9), back._replace(gnss_false=0.5), back, back, lost),
    ]
    assert [requests(switch, now, 0, k * second) for k, now in enumerate(situations, 1)] == [[]] * 10
    assert [(event.rx_ns // second, event.text) for event in switch.take_events()] == [
        (4, "GNSS is lost, using companion"),
        (8, "GNSS has a fix"),
        (10, "GNSS is lost, using companion"),
    ]


def test_on_while_disarmed() -> None:
    """PX4 stores it in EKF2_SENS_EN when it disarms. The next flight would begin without GNSS."""
    switch, second = Switch(), 10**9
    switch.note_armed(True)
    assert requests(switch, WELL._replace(**FALSE), 0, second) == [(43006, 0.0, 0.0, 0.0)]
    switch.note_armed(False)
    assert requests(switch, WELL._replace(**FALSE), 0, 2 * second) == [(43006, 0.0, 0.0, 1.0)]
    assert requests(switch, WELL._replace(**FALSE), 0, 9 * second) == []
    assert switch.take_events()[-1].text == "GNSS fusion on: disarmed"
    switch.note_armed(True)
    assert requests(switch, WELL._replace(**FALSE), 0, 10 * second) == [(43006, 0.0, 0.0, 0.0)]


def test_late_acknowledgement_of_off_is_not_one_of_on() -> None:
    """The answers name no state. On a slow link PX4 disarms before it has answered; our command is lost."""
    switch, now = Switch(), 10**9
    switch.now = WELL._replace(**FALSE)
    sent = list[tuple[float, float]]()

    def fly(tenths: int, *answered_at: int) -> None:
        nonlocal now
        for k in range(tenths):
            now += 10**8
            switch.update(now)
            sent.extend((now * 1e-9, m.param3) for m in switch.to_send(1, now))
            if k in answered_at:
                switch.handle_acknowledgement(ESTIMATOR_SENSOR_ENABLE, 0, now)

    fly(13)
    switch.note_armed(False)
    fly(10, 1, 9)  # the answers to off, twice
    assert not switch.take_events()
    fly(20, 4)
    assert [event.text for event in switch.take_events()] == ["GNSS fusion on: disarmed"]
    assert [round(t, 1) for t, enabled in sent if enabled] == [2.4, 3.4]
    assert [round(t, 1) for t, enabled in sent if not enabled] == [1.1, 2.1]


def test_autopilot_that_does_not_know_the_command_is_reported_once() -> None:
    switch, second = Switch(), 10**9
    assert requests(switch, WELL, 3, second) == []
    assert requests(switch, WELL, 3, 40 * second) == [] and switch.take_events() == []  # it is on
    assert len(requests(switch, WELL._replace(**FALSE), 3, second)) == 1
    assert requests(switch, WELL._replace(**FALSE), 3, 9 * second) == []
    assert not switch.is_on_companion
    (event,) = switch.take_events()
    assert event.text.startswith("the autopilot did not accept GNSS fusion off")


def report(switch: Switch, is_on: bool, at: int) -> None:
    """PX4 reports the state of its GNSS fusion, for two seconds."""
    message = dialect.new("ESTIMATOR_SENSOR_FUSION_STATUS", intended=[is_on, 0, 0, 1, 1, 0, 1, 1, 0])
    for _ in range(2):
        by = switch.selected(message, True, 1)
        assert by is not None
        switch.handle_selected(by, at)


@pytest.mark.parametrize(("is_armed", "reason"), [(True, "GNSS has a fix"), (False, "disarmed")])
def test_left_off_by_a_companion_that_failed(is_armed: bool, reason: str) -> None:
    """In flight, and stored at landing: the next flight would begin without a healthy GNSS."""
    switch, second = Switch(), 10**9
    switch.note_armed(is_armed)
    assert requests(switch, WELL, 0, second) == []
    report(switch, False, second)
    assert requests(switch, WELL, 0, second) == [(43006, 0.0, 0.0, 1.0)]
    report(switch, True, 2 * second)
    assert [event.text for event in switch.take_events()] == [f"GNSS fusion on: {reason}"]


def test_choice_of_another_is_respected() -> None:
    """Off before the flight, on while GNSS is false, and off again in flight."""
    switch, second = Switch(), 10**9
    switch.note_armed(False)
    assert requests(switch, WELL, 0, second) == []
    report(switch, True, second)
    report(switch, False, second)
    assert requests(switch, WELL, 0, second) == []
    switch.note_armed(True)
    assert requests(switch, WELL._replace(**FALSE), 0, 100 * second) == []
    assert requests(switch, WELL, 0, 200 * second) == []
    report(switch, True, 200 * second)
    assert requests(switch, WELL._replace(**FALSE), 0, 300 * second) == [(43006, 0.0, 0.0, 0.0)]
    report(switch, False, 301 * second)
    report(switch, True, 400 * second)
    assert requests(switch, WELL._replace(**FALSE), 0, 401 * second) == []
    assert requests(switch, WELL, 0, 500 * second) == []
    report(switch, False, 500 * second)
    assert requests(switch, WELL, 0, 501 * second) == []
    assert [event.text for event in switch.take_events()] == [
        "GNSS fusion off selected by hand: the companion does not switch",
        "GNSS fusion on needed (GNSS has a fix), but GNSS fusion off selected by hand",
        "GNSS fusion on selected by hand: the companion switches again",
        "GNSS fusion off: GNSS is false, using companion",
        "GNSS fusion on selected by hand: the companion does not switch",
        "GNSS fusion off selected by hand: the companion does not switch",
    ]


def test_source_set_of_another_sender_is_not_the_fusion_of_gnss() -> None:
    switch, second = Switch(), 10**9
    command = dialect.command_long(1, 42007, param1=2.0)
    assert switch.selected(command, False, 1) is None
    switch.handle_selected(Selected(2), second)
    assert not switch.is_on_companion
    assert len(requests(switch, WELL._replace(**FALSE), 0, 2 * second)) == 1
    assert switch.is_on_companion
