"""Source switch over a link that loses and delays commands and answers: on a good link the table rules again.

GNSS, our output and the link change at random; the autopilot does what arrives and answers it. The script of
deploy/ardupilot, or PX4, reports the leading set once a second. No set is selected by hand.
"""

import random

import pytest

from companion.output.gnss_fusion import ESTIMATOR_SENSOR_ENABLE, GnssFusion
from companion.output.source_switch import Selected, SourceSwitch
from companion.records import Gnss
from companion.units import SECOND_NS
from tests.output.test_source_switch import beacon_fix
from tests.solutions import solution_at

TENTH = SECOND_NS // 10


class Way:
    """One direction of the link: in order, late by `delay_ns`; a share `loss` does not arrive."""

    def __init__(self, chance: random.Random) -> None:
        self.loss, self.delay_ns = 0.0, 0
        self._chance, self._under_way = chance, list[tuple[int, int]]()

    def send(self, what: int, now: int) -> None:
        if self._chance.random() >= self.loss:
            after = self._under_way[-1][0] if self._under_way else 0
            self._under_way.append((max(now + self.delay_ns, after), what))

    def arrived(self, now: int) -> list[int]:
        found = [what for at, what in self._under_way if at <= now]
        self._under_way = [each for each in self._under_way if each[0] > now]
        return found


class LossyFlight:
    """A switch and an autopilot; `leading` is the set that leads, or 1 and 2 for PX4's fusion on and off."""

    def __init__(self, switch: SourceSwitch, is_reported: bool, seed: int) -> None:
        self.switch, self.is_reported, self.chance = switch, is_reported, random.Random(seed)
        self.up, self.down = Way(self.chance), Way(self.chance)
        self.now, self.leading = 10**12, 1
        self.texts: list[str] = []

    def fly(self, seconds: float, is_good: bool) -> None:
        """Fly in a situation drawn at random."""
        draw = self.chance.choice
        for way in (self.up, self.down):
            way.loss = 0.0 if is_good else draw((0.0, 0.3, 0.9, 1.0))
            way.delay_ns = TENTH if is_good else draw((0, 1, 6)) * TENTH
        fix, sent, false = draw((3, 1)), draw((True, True, False)), draw((1e-6, 1e-6, 0.5, 0.9999))
        self.switch.note_armed(draw((True, True, False)))
        for tick in range(round(10 * seconds)):
            self.now += TENTH
            if tick % 2:
                self.switch.receive(Gnss(self.now, self.now, 0, self.now // 1000, fix, 1.0, 0.5, 100.0))
            if tick % 10 == 0:
                self.switch.receive(beacon_fix(self.now, 1300.0 if false > 0.9 else 0.0))
            if tick % 10 == 5 and self.is_reported:
                self.down.send(-self.leading, self.now)
            found = solution_at(self.now, gnss_false=false, witness=True)
            self.switch.note_output(found, sent, self.now)
            self.switch.update(self.now)
            self._exchange()

    def _exchange(self) -> None:
        for m in self.switch.to_send(1, self.now):
            if m.command == self.switch.command:
                is_fusion = m.command == ESTIMATOR_SENSOR_ENABLE
                self.up.send(2 - round(m.param3) if is_fusion else round(m.param1), self.now)
        for requested in self.up.arrived(self.now):
            self.leading = requested
            self.down.send(0, self.now)  # the answer
        for report in self.down.arrived(self.now):
            if report:
                self.switch.handle_selected(Selected(-report, is_report=True), self.now)
            else:
                self.switch.handle_acknowledgement(self.switch.command, 0, self.now)
        self.texts += [event.text for event in self.switch.take_events()]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("is_reported", [False, True])
@pytest.mark.parametrize("kind", [SourceSwitch, GnssFusion])
def test_required_set_leads_on_a_good_link(kind: type[SourceSwitch], is_reported: bool, seed: int) -> None:
    flight = LossyFlight(kind(), is_reported, seed)
    for _ in range(8):
        for _ in range(3):
            flight.fly(flight.chance.uniform(0.3, 12.0), is_good=False)
        flight.fly(60.0, is_good=True)
        decision = flight.switch.required(flight.switch.situation(flight.now))
        assert decision is None or flight.leading == decision[0]
    assert not any("selected by hand" in text for text in flight.texts)
