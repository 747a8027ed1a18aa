"""Two GNSS receivers: the second one keeps a flight on GNSS while the first has no fix."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from companion.config import load
from companion.estimate import bank as banks
from companion.navigator import Navigator
from companion.navigator.receiver_choice import ReceiverChoice
from companion.output.autopilot_output import AutopilotOutput
from companion.output.source_table import SILENT_S
from companion.records import Attitude, Event, Gnss, Imu, LocalOrigin, Solution, Source
from companion.units import G0, SECOND_NS

CONFIG = load(flags={"output.profile": "ardupilot"}, environment={})
LAT, LON = 0.97, 0.65
Fix = Callable[[float], int | None]  # fix type at a time (s), None where nothing arrives


def fix(receiver: int, t: float, kind: int, north_m: float = 0.0) -> Gnss:
    """A report of a receiver of an aircraft that flies north at 20 m/s."""
    lat = LAT + (20.0 * t + north_m) / 6.37e6
    at, ms = round(t * SECOND_NS), round(t * 1e6)
    return Gnss(at, at, receiver, ms, kind, lat, LON, 300.0, v_n=(20.0, 0.0, 0.0), sigma_horizontal=1.0)


def shaken(t: float) -> list[Any]:
    """Samples of the IMU of the same aircraft."""
    at, shake = round(t * SECOND_NS), 1e-4 * math.sin(20.0 * t)
    return [Imu(at, at, 0, (shake, 0.0, -G0), (0.0, 0.0, shake)), Attitude(at, at, shake, 0.0, 0.0)]


def chosen(first: Fix, second: Fix, until: float) -> list[tuple[float, str]]:
    """Changes of the receiver in use, with five reports a second of the first and two of the second."""
    choice, found = ReceiverChoice(CONFIG), []
    for k in range(round(10 * until)):
        t = 0.1 * k
        reports = ([(0, first(t))] if k % 2 == 0 else []) + ([(1, second(t))] if k % 5 == 0 else [])
        for receiver, kind in reports:
            if kind is not None:
                _, events = choice.takes(fix(receiver, t, kind))
                found += [(t, event.text) for event in events]
    return found


def test_the_second_is_used_while_the_first_has_no_fix_and_not_a_moment_longer() -> None:
    def first(t: float) -> int:
        return 1 if 20.0 <= t < 40.0 else 3

    (lost, why), (back, again) = chosen(first, lambda t: 3, 60.0)
    assert 21.0 <= lost <= 22.0
    assert why == "GPS_RAW_INT has no fix: GPS2_RAW is used"
    assert 45.0 <= back <= 45.4
    assert again == "GPS_RAW_INT has a fix again: GPS_RAW_INT is used"


def test_a_silent_first_receiver_is_replaced_before_it_is_called_silent() -> None:
    ((lost, why),) = chosen(lambda t: 3 if t < 20.0 else None, lambda t: 3, 40.0)
    assert lost - 19.8 < SILENT_S
    assert why == "GPS_RAW_INT is silent: GPS2_RAW is used"


@pytest.mark.parametrize("until", [23.1, 23.3, 23.5])
def test_a_silence_of_both_is_the_links(until: float) -> None:
    """The second, received first after 3 s, was used for 5 s: two texts, the drift of GNSS unknown again."""

    def both(t: float) -> int | None:
        return None if 20.0 <= t < until else 3

    assert chosen(both, both, 40.0) == []
    ((lost, why),) = chosen(lambda t: 3 if t < 20.0 else None, both, 40.0)  # the first is gone for good
    assert until + 2.4 <= lost < until + SILENT_S
    assert why == "GPS_RAW_INT is silent: GPS2_RAW is used"


def test_after_a_silence_of_the_link_the_first_with_a_new_fix_is_not_trusted_sooner() -> None:
    """Received first, it was used at once: `has a fix, the other none`."""

    def first(t: float) -> int | None:
        return None if 20.0 <= t < 23.1 else 1 if 10.0 <= t < 20.0 else 3

    (_, _), (back, why) = chosen(first, lambda t: None if 20.0 <= t < 23.1 else 3, 40.0)
    assert 28.1 <= back < 29.0
    assert why == "GPS_RAW_INT has a fix again: GPS_RAW_INT is used"


def test_a_second_receiver_without_a_fix_or_flickering_changes_nothing() -> None:
    assert chosen(lambda t: 3, lambda t: 3, 30.0) == []
    assert chosen(lambda t: 3 if t < 10.0 else 1, lambda t: 1, 30.0) == []
    assert chosen(lambda t: 1 if round(10 * t) % 10 == 0 else 3, lambda t: 3, 30.0) == []


def test_it_returns_at_once_to_a_first_receiver_with_a_fix_when_the_second_has_none() -> None:
    def first(t: float) -> int:
        return 1 if 10.0 <= t < 20.0 else 3

    changes = chosen(first, lambda t: 3 if t < 22.0 else 1, 40.0)
    assert [round(t) for t, _ in changes] == [11, 22]


def test_it_returns_at_once_to_a_first_receiver_with_a_fix_when_the_second_is_silent() -> None:
    """The source switch would report a silent receiver after 3 s."""

    def first(t: float) -> int:
        return 1 if 10.0 <= t < 20.0 else 3

    (_, _), (back, why) = chosen(first, lambda t: 3 if t < 19.0 else None, 40.0)
    assert back - 18.5 < SILENT_S
    assert why == "GPS_RAW_INT has a fix, the other none: GPS_RAW_INT is used"


def test_another_preferred_receiver_applies_at_once_and_the_same_one_keeps_what_is_known() -> None:
    other = load(flags={"gnss.receiver": 1}, environment={})
    choice = ReceiverChoice(CONFIG)
    assert choice.tuned(CONFIG) is choice
    assert choice.tuned(other).takes(fix(1, 0.0, 3)) == (True, [])
    output = AutopilotOutput(CONFIG)
    output.tune(other)
    output.receive(fix(1, 0.0, 3))
    assert output._source_switch.situation(0).fix_s == 0.0


def test_neither_the_receiver_that_gps_input_feeds_nor_one_switched_off_is_used() -> None:
    fed = load(flags={"output.profile": "ardupilot", "output.via": "gps_input"}, environment={})
    off = load(flags={"gnss.second_receiver": False}, environment={})
    for config in (fed, off):
        choice = ReceiverChoice(config)
        for t in range(30):
            assert choice.takes(fix(0, t, 1)) == (True, [])
            assert choice.takes(fix(1, t + 0.1, 3)) == (False, [])


def test_set_2_is_not_requested_while_the_second_has_a_fix_and_waits_for_the_first() -> None:
    """The first fails as the link loses 2.4 s of both: the second waits as long, the switch but 3 s."""
    output, requested = AutopilotOutput(CONFIG), list[float]()
    for k in range(400):
        t, at = 0.1 * k, round(0.1 * k * SECOND_NS)
        if k % 2 == 0 and k < 200:
            output.receive(fix(0, t, 3))
        if k % 5 == 0 and not 200 < k < 225:
            output.receive(fix(1, t, 3))
        output._source_switch._sent.update(True, at)
        output._source_switch.update(at)
        requested += [m.param1 for m in output._source_switch.to_send(1, at) if m.command == 42007]
    assert set(requested) == {1}


def test_a_flight_goes_on_with_gnss_by_the_second_and_source_set_2_is_never_requested() -> None:
    """The second receiver is 3 m off the first; the first is lost for good after a minute."""
    navigator, output = Navigator(CONFIG), AutopilotOutput(CONFIG)
    found: list[Solution] = []
    events: list[str] = []
    navigator.handle(LocalOrigin(0, 0, LAT, LON, 300.0, "ardupilot"))
    for k in range(20 * 120):
        t = 0.05 * k
        at = round(t * SECOND_NS)
        shake = 1e-4 * math.sin(k)  # numbers that stand still are taken for frozen
        records = [Imu(at, at, 0, (shake, 0.0, -G0), (0.0, 0.0, shake))]
        if k % 2 == 0:
            records.append(Attitude(at, at, shake, 0.0, 0.0))
        if k % 4 == 1:
            records.append(fix(0, t, 3 if t < 60.0 else 1))
        if k % 10 == 3:
            records.append(fix(1, t, 3, 3.0))
        for record in records:
            output.receive(record)
            for out in navigator.handle(record):
                found += [out] if isinstance(out, Solution) else []
                events += [out.text] if isinstance(out, Event) else []
                if isinstance(out, Solution):
                    output._source_switch.note_output(out, True, out.rx_ns)
        navigator.settle()
        output._source_switch.update(at)
        commands = [m for m in output._source_switch.to_send(1, at) if m.param1 == 2]
        assert not commands, t
    assert [text for text in events if "GPS2_RAW" in text] == ["GPS_RAW_INT has no fix: GPS2_RAW is used"]
    after = [s for s in found if s.t_ns > 65 * SECOND_NS]
    assert all(s.sources & Source.GNSS for s in after)
    assert max(s.gnss_false for s in after) < 0.1
    off = [(s.lat - LAT) * 6.37e6 - 20.0 * s.t_ns / SECOND_NS for s in after]
    assert max(map(abs, off)) < 4.0


def test_each_change_of_the_receiver_makes_the_drift_of_gnss_unknown_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where reports without a fix, or closer than `gnss.every_s`, come in between."""
    renewed: list[float] = []
    renew = banks.renew

    def counted(*args: Any) -> Any:
        renewed.append(t)
        return renew(*args)

    monkeypatch.setattr(banks, "renew", counted)
    navigator = Navigator(load(flags={"output.profile": "ardupilot", "gnss.every_s": 1.0}, environment={}))
    for k in range(20 * 90):
        t = 0.05 * k
        records = shaken(t)
        if k % 4 == 1:
            records.append(fix(0, t, 1 if 30.0 <= t < 60.0 else 3))
        if k % 10 == 3:
            records.append(fix(1, t, 3, 3.0))
        for record in records:
            navigator.handle(record)
    assert [round(t) for t in renewed] == [31, 65]


def test_a_repeated_fix_is_not_used_again() -> None:
    navigator = Navigator(load(flags={"output.profile": "ardupilot", "gnss.every_s": 0.0}, environment={}))
    first, second = fix(0, 2.0, 3), fix(0, 2.3, 3)
    repeated = structs.replace(first, t_ns=first.t_ns + SECOND_NS // 10)
    taken = []
    for k in range(60):
        for record in shaken(0.05 * k):
            navigator.handle(record)
        for record in (first, repeated, second):
            if record.t_ns == round(0.05 * k * SECOND_NS):
                navigator.handle(record)
                taken.append(navigator.state.gnss_taken)
    assert taken == [first, first, second]


def test_fixes_that_are_not_used_cost_no_roll_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """An autopilot's fixes are 0.1 to 0.2 s late: each was a roll-back, five a second instead of two."""
    navigator, rewound = Navigator(CONFIG), list[float]()
    begin = Navigator._begin_roll_back
    monkeypatch.setattr(Navigator, "_begin_roll_back", lambda self: rewound.append(t) or begin(self))
    for k in range(20 * 30):
        t = 0.05 * k
        for record in shaken(t):
            navigator.handle(record)
        if k % 4 == 3:
            navigator.handle(structs.replace(fix(0, t - 0.14, 3), rx_ns=round(t * SECOND_NS)))
    assert navigator.state.gnss_taken is not None
    assert 45 <= len(rewound) <= 60


def test_a_fix_that_arrives_after_a_later_one_is_used_at_its_own_time() -> None:
    late, states = fix(0, 10.0, 3), []
    for arrives in (10.0, 11.0):
        navigator = Navigator(CONFIG)
        for k in range(20 * 14):
            t = 0.05 * k
            records = shaken(t)
            if k % 12 == 8 and t != late.t_ns / SECOND_NS:
                records.append(fix(0, t, 3))
            if k == round(20.0 * arrives):
                records.append(structs.replace(late, rx_ns=round(arrives * SECOND_NS)))
            for record in records:
                navigator.handle(record)
        navigator.finish()
        assert navigator.state.bank is not None
        states.append(navigator.state.bank.x)
    np.testing.assert_allclose(*states, rtol=1e-6, atol=1e-9)
