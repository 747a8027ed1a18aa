"""GNSS of a simulated autopilot that obeys, off and on by its own parameter, whichever that is."""

import pytest

from companion.link import dialect, frame
from companion.link.parameter_client import to_wire
from sitl.autopilot import Autopilot
from sitl.bridge import Bridge, Orders
from sitl.gnss_switch import KNOBS, GnssSwitch
from sitl.scenarios import named

SECOND = 1_000_000_000


def flown(
    make: str, orders: Orders, until_s: float
) -> tuple[Autopilot, Bridge, list[tuple[float, str]], int]:
    pilot = Autopilot(named("short", autopilot=make, gnss_outages=()))
    bridge, told, now = Bridge(orders=orders), [], 0
    while now < until_s * SECOND:
        for data in pilot.poll(now):
            bridge.from_autopilot(data, now)
        bridge.poll(now)
        for data in bridge.to_autopilot():
            pilot.receive(data, now)
        told += [(now / SECOND, line) for line in bridge.take_told()]
        now = max(now + 1, min(pilot.deadline(), bridge.deadline()))
    return pilot, bridge, told, now


@pytest.mark.parametrize(
    ("make", "name", "off", "on"), [("ardupilot", "SIM_GPS1_ENABLE", 0, 1), ("px4", "SIM_GPS_USED", 0, 10)]
)
def test_it_is_lost_and_comes_back_as_ordered(make: str, name: str, off: int, on: int) -> None:
    pilot, bridge, told, _ = flown(make, Orders(20.0, 40.0), 60.0)
    (loss,) = bridge.losses
    assert loss.lost_ns / SECOND == pytest.approx(20.0, abs=1.5)
    assert loss.back_ns / SECOND == pytest.approx(40.0, abs=1.5)
    lines = [line for _, line in told]
    assert f"GNSS switched off: {name} = {off}" in lines and f"GNSS switched on: {name} = {on}" in lines
    assert pilot.parameters.values[name] == on


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
def test_it_is_left_as_it_was_found(make: str) -> None:
    pilot, bridge, _, now = flown(make, Orders(20.0), 30.0)
    assert not pilot.parameters.gnss_is_on
    bridge.finish(now)
    for data in bridge.to_autopilot():
        pilot.receive(data, now)
    assert pilot.parameters.gnss_is_on


def test_it_is_not_touched_where_nothing_was_ordered() -> None:
    _, bridge, told, now = flown("ardupilot", Orders(), 30.0)
    bridge.finish(now)
    sent = [f for data in bridge.to_autopilot() for f in frame.Reader().receive(data)]
    assert not [f for f in sent if dialect.TYPES[f.msgid].name.startswith("PARAM")]
    assert bridge.losses == [] and not any("switch" in line for _, line in told)


class Fake:
    """An autopilot with one parameter, which may refuse to be set."""

    def __init__(self, name: str, value: int, obeys: bool = True) -> None:
        self.name, self.value, self.obeys = name, value, obeys

    def answer(self, message):
        if message.param_id != self.name:
            return None
        if message.get_type() == "PARAM_SET" and self.obeys:
            self.value = int(message.param_value)
        value = to_wire(self.value, 2, "cast")
        message = dialect.new("PARAM_VALUE", param_id=self.name, param_value=value, param_type=2)
        (found,) = frame.Reader().receive(frame.encode(message, 0, 1, 1))
        return message, found


def settle(switch: GnssSwitch, fake: Fake, seconds: int = 12) -> list[str]:
    told = []
    for tenth in range(10 * seconds):
        told += switch.poll(tenth * SECOND // 10)
        for message in switch.to_send():
            if (answer := fake.answer(message)) is not None:
                told += switch.receive(*answer)
    return told


def test_an_older_ardupilot_has_the_opposite_parameter() -> None:
    fake, switch = Fake("SIM_GPS_DISABLE", 0), GnssSwitch("ardupilot", 1)
    switch.order(on=False)
    assert settle(switch, fake) == ["GNSS switched off: SIM_GPS_DISABLE = 1"]
    assert fake.value == 1 and switch.is_off
    switch.order(on=True)
    assert settle(switch, fake) == ["GNSS switched on: SIM_GPS_DISABLE = 0"]


def test_one_that_was_left_off_is_switched_on_all_the_same() -> None:
    fake, switch = Fake("SIM_GPS1_ENABLE", 0), GnssSwitch("ardupilot", 1)
    switch.order(on=True)
    settle(switch, fake)
    assert fake.value == 1


def test_what_is_refused_is_told() -> None:
    fake, switch = Fake("SIM_GPS1_ENABLE", 1, obeys=False), GnssSwitch("ardupilot", 1)
    switch.order(on=False)
    (line,) = settle(switch, fake)
    assert "SIM_GPS1_ENABLE was not set" in line and "GNSS stays as it is" in line


@pytest.mark.parametrize("make", sorted(KNOBS))
def test_where_there_is_none_that_is_told_once(make: str) -> None:
    (line,) = settle(GnssSwitch(make, 1), Fake("OTHER", 1))
    assert "GNSS cannot be switched" in line
