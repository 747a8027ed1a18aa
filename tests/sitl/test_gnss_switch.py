"""GNSS switch by the simulation parameter of each make and version."""

import pytest

from companion.link import dialect, frame
from companion.link.parameter_client import to_wire
from sitl.autopilot import SimulatedAutopilot
from sitl.bridge import Bridge, GnssSchedule
from sitl.gnss_switch import GNSS_PARAMETERS, GnssSwitch
from sitl.scenarios import get_scenario

SECOND = 1_000_000_000


def fly_bridge(
    make: str, schedule: GnssSchedule, until_s: float
) -> tuple[SimulatedAutopilot, Bridge, list[tuple[float, str]], int]:
    pilot = SimulatedAutopilot(get_scenario("short", autopilot=make, gnss_outages=()))
    bridge, lines, now = Bridge(schedule=schedule), [], 0
    while now < until_s * SECOND:
        for data in pilot.poll(now):
            bridge.from_autopilot(data, now)
        bridge.poll(now)
        for data in bridge.to_autopilot():
            pilot.receive(data, now)
        lines += [(now / SECOND, line) for line in bridge.take_reports()]
        now = max(now + 1, min(pilot.deadline(), bridge.deadline()))
    return pilot, bridge, lines, now


@pytest.mark.parametrize(
    ("make", "name", "off", "on"), [("ardupilot", "SIM_GPS1_ENABLE", 0, 1), ("px4", "SIM_GPS_USED", 0, 10)]
)
def test_gnss_is_switched_off_and_on_at_the_scheduled_times(make: str, name: str, off: int, on: int) -> None:
    pilot, bridge, lines, _ = fly_bridge(make, GnssSchedule(20.0, 40.0), 60.0)
    (loss,) = bridge.outages
    assert loss.lost_ns / SECOND == pytest.approx(20.0, abs=1.5)
    assert loss.regained_ns / SECOND == pytest.approx(40.0, abs=1.5)
    lines = [line for _, line in lines]
    assert f"GNSS switched off: {name} = {off}" in lines and f"GNSS switched on: {name} = {on}" in lines
    assert pilot.parameters.values[name] == on


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
def test_gnss_is_restored_at_the_end(make: str) -> None:
    pilot, bridge, _, now = fly_bridge(make, GnssSchedule(20.0), 30.0)
    assert not pilot.parameters.gnss_is_on
    bridge.finish(now)
    for data in bridge.to_autopilot():
        pilot.receive(data, now)
    assert pilot.parameters.gnss_is_on


def test_gnss_parameter_is_not_accessed_without_a_schedule() -> None:
    _, bridge, lines, now = fly_bridge("ardupilot", GnssSchedule(), 30.0)
    bridge.finish(now)
    sent = [f for data in bridge.to_autopilot() for f in frame.Reader().receive(data)]
    assert not [f for f in sent if dialect.TYPES[f.msgid].name.startswith("PARAM")]
    assert bridge.outages == [] and not any("switch" in line for _, line in lines)


class FakeAutopilot:
    """Autopilot with one parameter, which may reject PARAM_SET."""

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


def exchange(switch: GnssSwitch, autopilot: FakeAutopilot, seconds: int = 12) -> list[str]:
    lines = []
    for tenth in range(10 * seconds):
        lines += switch.poll(tenth * SECOND // 10)
        for message in switch.to_send():
            if (answer := autopilot.answer(message)) is not None:
                lines += switch.receive(*answer)
    return lines


def test_older_ardupilot_has_the_inverse_parameter() -> None:
    autopilot, switch = FakeAutopilot("SIM_GPS_DISABLE", 0), GnssSwitch("ardupilot", 1)
    switch.request(on=False)
    assert exchange(switch, autopilot) == ["GNSS switched off: SIM_GPS_DISABLE = 1"]
    assert autopilot.value == 1 and switch.is_off
    switch.request(on=True)
    assert exchange(switch, autopilot) == ["GNSS switched on: SIM_GPS_DISABLE = 0"]


def test_gnss_found_off_is_switched_on() -> None:
    autopilot, switch = FakeAutopilot("SIM_GPS1_ENABLE", 0), GnssSwitch("ardupilot", 1)
    switch.request(on=True)
    exchange(switch, autopilot)
    assert autopilot.value == 1


def test_rejected_parameter_is_reported() -> None:
    autopilot, switch = FakeAutopilot("SIM_GPS1_ENABLE", 1, obeys=False), GnssSwitch("ardupilot", 1)
    switch.request(on=False)
    (line,) = exchange(switch, autopilot)
    assert "SIM_GPS1_ENABLE was not set" in line and "GNSS is unchanged" in line


@pytest.mark.parametrize("make", sorted(GNSS_PARAMETERS))
def test_missing_parameter_is_reported_once(make: str) -> None:
    (line,) = exchange(GnssSwitch(make, 1), FakeAutopilot("OTHER", 1))
    assert "GNSS cannot be switched" in line
