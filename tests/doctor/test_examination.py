"""Examination of a simulated autopilot of either make in virtual time: everything that can be missing is
removed in turn and found; nothing is changed without a request."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import pytest

from companion.config import Config, load
from companion.config.required_parameters import required_parameters
from companion.doctor.diagnosis import Diagnosis, Finding, check_airspeed
from companion.doctor.examination import OBSERVE, OBSERVE_LONGER, Examination
from companion.doctor.rendering import summary
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.link.parameter_client import ATTEMPTS, SILENCE
from companion.link.signing import Signing
from sitl.autopilot import SimulatedAutopilot
from sitl.scenarios import get_scenario
from sitl.world import World
from tests.frames import parsed

SECOND = 1_000_000_000
STEP = SECOND // 100
PARAM_SET = 23


@lru_cache(maxsize=2)
def world_of(make) -> World:
    return World(get_scenario("short", autopilot=make))


#: Transforms the bytes of one direction of the line.
Passing = Callable[[bytes], bytes]


def profile(name: str, *pairs: str) -> Config:
    return load(None, {"output.profile": name}, {}, pairs)


class Bench:
    """An autopilot and an examination connected; `to_us` and `to_it` are the line with its faults."""

    def __init__(self, make: str, config: Config | None = None) -> None:
        world = world_of(make)
        self.autopilot = SimulatedAutopilot(world.scenario, world=world)
        self.autopilot.is_armed = False
        self.config = config or profile(make)
        self.examination = Examination(self.config)
        self.now = 0
        self.sent: list[frame.Frame] = []
        self.to_us: Passing = lambda data: data
        self.to_it: Passing = lambda data: data
        self.injected: list[bytes] = []  # by others, to be received by us

    def step(self) -> None:
        self.now += STEP
        received = [self.to_us(data) for data in self.autopilot.poll(self.now)]
        for data in [*received, *self.injected]:
            if data:
                self.examination.receive(data, self.now)
        self.injected.clear()
        if self.now >= self.examination.deadline():
            self.examination.poll(self.now)
        for data in self.examination.to_send():
            self.sent.append(parsed(data))
            if passed := self.to_it(data):
                self.autopilot.receive(passed, self.now)

    def look(self, seconds: float = 60.0) -> Diagnosis:
        while not self.examination.is_done(self.now) and self.now < seconds * SECOND:
            self.step()
        return self.examination.diagnosis(self.now)

    def change(self) -> Diagnosis:
        self.examination.set_parameters()
        while not self.examination.has_all_parameters:
            self.step()
        return self.examination.diagnosis(self.now)


def problems(diagnosis: Diagnosis) -> set[str]:
    return {finding.what for finding in diagnosis.problems}


def found(diagnosis: Diagnosis, what: str) -> Finding:
    (finding,) = (finding for finding in diagnosis.findings if finding.what == what)
    return finding


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
def test_only_required_parameters_are_set(make: str) -> None:
    bench = Bench(make)
    before = dict(bench.autopilot.parameters.values)
    diagnosis = bench.look()
    needs = {need.name: need.value for need in required_parameters(profile(make), make)}
    assert {p.need.name: p.has for p in diagnosis.parameters} == {name: before[name] for name in needs}
    assert {p.need.name for p in diagnosis.wrong_parameters} == {
        n for n, value in needs.items() if before[n] != value
    }
    assert diagnosis.wrong_parameters and not diagnosis.problems
    assert not any(sent.msgid == PARAM_SET for sent in bench.sent)  # the examination changes nothing
    assert bench.autopilot.parameters.values == before

    after = bench.change()
    assert after.is_well and set(after.changed_from(diagnosis)) == {
        p.need.name for p in diagnosis.wrong_parameters
    }
    assert bench.autopilot.parameters.values == before | needs


def test_well_autopilot_is_identified_quickly() -> None:
    bench = Bench("px4")
    bench.autopilot.parameters.values |= {"EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1}
    diagnosis = bench.look()
    assert diagnosis.is_well and bench.now < OBSERVE + SECOND
    assert diagnosis.identity == (1, "px4", "fixed wing", "1.17.0-dev", False)


def test_configured_sensor_id_is_required() -> None:
    config = profile("px4", "output.global_position_sensor_id=7")
    bench = Bench("px4", config)
    bench.look()
    bench.change()
    assert bench.autopilot.parameters.values["EKF2_AGP0_ID"] == 7


def test_absent_parameter_is_reported_and_not_set() -> None:
    bench = Bench("ardupilot")
    del bench.autopilot.parameters.values["VISO_TYPE"]
    diagnosis = bench.look()
    (absent,) = (p for p in diagnosis.wrong_parameters if p.has is None)
    assert (absent.need.name, absent.trouble) == ("VISO_TYPE", SILENCE)
    after = bench.change()
    assert [p.need.name for p in after.wrong_parameters] == ["VISO_TYPE"]
    assert "VISO_TYPE" not in bench.autopilot.parameters.values


def test_profile_of_another_make_is_reported_and_no_parameter_read() -> None:
    bench = Bench("ardupilot", profile("px4"))
    diagnosis = bench.look()
    assert "output profile" in problems(diagnosis) and not diagnosis.parameters
    assert "'ardupilot'" in found(diagnosis, "output profile").advice
    assert not any(dialect.TYPES[sent.msgid].name.startswith("PARAM") for sent in bench.sent)


def test_profile_monitor_requires_no_parameters() -> None:
    diagnosis = Bench("ardupilot", profile("monitor")).look()
    assert diagnosis.is_well and not diagnosis.parameters


# -- faults of the link -------------------------------------------------------------------------------------


def without(*names: str) -> Passing:
    """Return a line that drops these messages."""

    def passing(data: bytes) -> bytes:
        found_frame = frame.parse(data)
        return (
            b""
            if isinstance(found_frame, frame.Frame) and dialect.TYPES[found_frame.msgid].name in names
            else data
        )

    return passing


@pytest.mark.parametrize(
    ("dropped", "what"),
    [("ATTITUDE", "ATTITUDE"), ("VFR_HUD", "VFR_HUD"), ("GPS_GLOBAL_ORIGIN", "GPS_GLOBAL_ORIGIN")],
)
def test_missing_message_is_found(dropped: str, what: str) -> None:
    bench = Bench("ardupilot")
    bench.to_us = without(dropped)
    diagnosis = bench.look()
    assert problems(diagnosis) - {"frames lost"} == {what}
    assert found(diagnosis, what).advice
    assert bench.now >= OBSERVE_LONGER  # it waited longer


def test_stream_of_which_nothing_arrives_is_not_called_slow() -> None:
    """As LOCAL_POSITION_NED of ArduPlane, which has not had its first fix."""
    bench = Bench("ardupilot", profile("monitor"))
    bench.to_us = without("LOCAL_POSITION_NED")
    advice = found(bench.look(), "LOCAL_POSITION_NED").advice
    assert "slow" not in advice and "fix" in advice


@pytest.mark.parametrize(
    ("source", "imu", "airspeed"),
    [("auto", False, False), ("air_data", None, False), ("imu", False, None)],
)
def test_unused_stream_may_be_missing(source: str, imu: bool | None, airspeed: bool | None) -> None:
    bench = Bench("ardupilot", profile("ardupilot", f"inertial.source={source}"))
    bench.to_us = without("RAW_IMU", "SYS_STATUS", "VFR_HUD")
    diagnosis = bench.look()
    wells = {"RAW_IMU": imu, "SYS_STATUS": airspeed, "VFR_HUD": airspeed}
    assert {name: found(diagnosis, name).is_well for name in wells} == wells
    assert all(found(diagnosis, name).found == "0.0 Hz" for name in wells)


@pytest.mark.parametrize(
    ("healthy", "pairs", "text"),
    [
        (True, ["output.profile=ardupilot"], "healthy"),
        (False, ["output.profile=ardupilot"], "none: reckoning by IMU only"),
        (False, ["output.profile=monitor"], "none: reckoning by IMU only"),
        (None, ["output.profile=ardupilot"], "not reported: not used"),
    ],
)
def test_missing_airspeed_sensor_is_reported_and_no_problem(
    healthy: bool | None, pairs: list[str], text: str
) -> None:
    (airspeed,) = check_airspeed(load(None, {}, {}, pairs), healthy)
    assert (airspeed.found, airspeed.is_well) == (text, None)
    assert bool(airspeed.advice) == (not healthy)
    assert not check_airspeed(load(None, {}, {}, [*pairs, "inertial.independent=true"]), healthy)


def test_failsafe_that_ends_a_flight_without_gnss_is_shown_and_never_set() -> None:
    bench = Bench("px4")
    limit = found(bench.look(), "COM_POS_LOW_EPH")
    assert (limit.found[:6], limit.needs, limit.is_well) == ("50 m: ", "-1 to fly on", None)
    assert found(bench.change(), "COM_POS_LOW_EPH") == limit
    other = Bench("px4")
    other.autopilot.parameters.values["COM_POS_LOW_EPH"] = -1
    assert "COM_POS_LOW_EPH" not in {finding.what for finding in other.look().findings}


@pytest.mark.parametrize(("vehicle_type", "vehicle"), [(22, "VTOL with a wing"), (2, "quadrotor")])
def test_failsafe_of_what_hovers_is_shown(vehicle_type: int, vehicle: str) -> None:
    """PX4 requires the accuracy of COM_POS_FS_EPH of a VTOL too, while it hovers."""
    bench = Bench("px4")
    bench.autopilot.parameters.values |= {"COM_POS_FS_EPH": 5.0, "EKF2_NOAID_TOUT": 5000000}

    def retyped(data: bytes) -> bytes:
        one = parsed(data)
        if one.msgid != mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return data
        message = dialect.decode(one)
        message.type = vehicle_type
        return frame.encode(message, one.sequence, one.system, one.component)

    bench.to_us = retyped
    diagnosis = bench.look()
    assert diagnosis.identity.vehicle == vehicle
    for name in ("COM_POS_LOW_EPH", "COM_POS_FS_EPH", "EKF2_NOAID_TOUT"):
        assert found(diagnosis, name).is_well is None


def fusion(*intended: int) -> bytes:
    return frame.encode(dialect.new("ESTIMATOR_SENSOR_FUSION_STATUS", intended=list(intended)), 0, 1, 1)


@pytest.mark.parametrize(
    ("pairs", "off", "on"),
    [
        ([], [1, 1, 0, 0, 1, 1, 1, 1, 0], [1, 1, 0, 1, 1, 1, 1, 1, 0]),  # of PX4, before and after its reboot
        (["output.via=odometry"], [1, 1, 0, 1, 1, 1, 1, 1, 0], [1, 1, 1, 0, 1, 1, 1, 1, 0]),
    ],
)
def test_right_parameters_of_px4_that_have_no_effect_yet_are_a_problem(
    pairs: list[str], off: list[int], on: list[int]
) -> None:
    bench = Bench("px4", profile("px4", *pairs))
    while bench.now < SECOND:
        bench.step()
    bench.injected.append(fusion(*off))
    assert "fusion of our position" not in problems(bench.look())  # wrong parameters are reported
    after = bench.change()
    assert problems(after) - {"frames lost"} == {"fusion of our position"}
    assert "reboot" in found(after, "fusion of our position").advice
    bench.injected.append(fusion(*on))
    bench.step()
    assert found(bench.examination.diagnosis(bench.now), "fusion of our position").is_well


def test_airspeed_sensor_of_the_autopilot_is_found() -> None:
    assert found(Bench("ardupilot").look(), "airspeed sensor").found == "healthy"


def text(words: str) -> bytes:
    return frame.encode(dialect.new("STATUSTEXT", severity=2, text=words.encode()), 0, 1, 1)


@pytest.mark.parametrize(
    ("words", "expected", "is_needed"),
    [
        ("PreArm: VisOdom: out of memory", "VisOdom: out of memory", True),
        ("PreArm: VisOdom: not healthy", "VisOdom: not healthy", False),
        ("EKF3 IMU0 is using GPS", "none fails", False),
    ],
)
def test_arming_checks_are_reported_and_a_missing_reboot_is_a_problem(
    words: str, expected: str, is_needed: bool
) -> None:
    bench = Bench("ardupilot")
    while bench.now < SECOND:
        bench.step()
    bench.injected.append(text(words))
    diagnosis = bench.look()
    assert found(diagnosis, "arming checks").found == expected
    assert ("reboot" in problems(diagnosis)) == is_needed
    commands = {m.command for m in map(dialect.decode, bench.sent) if m.get_type() == "COMMAND_LONG"}
    assert 401 in commands  # the checks were requested


def test_autopilot_that_drops_unsigned_frames_is_recognised() -> None:
    """It signs its own frames and answers nothing: no parameter is missing, the key is."""
    bench = Bench("ardupilot")
    signing = Signing(bytes(range(32)))

    def signed(data: bytes) -> bytes:
        unsigned = parsed(data)
        message = dialect.decode(unsigned)
        sign = lambda raw: signing.sign(raw, 1, bench.now)  # noqa: E731
        return frame.encode(message, unsigned.sequence, unsigned.system, unsigned.component, sign)

    bench.to_us, bench.to_it = signed, lambda data: b""
    diagnosis = bench.look()
    assert found(diagnosis, "signing").advice.startswith("the autopilot wants signed frames")
    assert "absent" not in summary(bench.config, diagnosis)


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
def test_line_that_carries_nothing_of_ours_is_recognised(make: str) -> None:
    """Our TX is not connected: no parameter is absent, and no stream is slow by its line."""
    bench = Bench(make)
    bench.to_it = lambda data: b""
    diagnosis = bench.look()
    assert problems(diagnosis) == {"answers", "TIMESYNC"}
    assert "check the line from our TX" in summary(bench.config, diagnosis)
    assert "absent" not in summary(bench.config, diagnosis)


def test_origin_that_is_requested_in_vain_is_no_missing_fix() -> None:
    """PX4 sends its origin on request alone: where no request arrives, there is no fix to wait for."""
    bench = Bench("px4")
    bench.to_it, bench.to_us = lambda data: b"", without("GPS_GLOBAL_ORIGIN")
    diagnosis = bench.look()
    assert found(diagnosis, "GPS_GLOBAL_ORIGIN").is_well is None
    assert "open sky" not in summary(bench.config, diagnosis)


def test_another_position_source_is_a_problem() -> None:
    bench = Bench("ardupilot")
    while bench.now < SECOND:
        bench.step()
    bench.injected.append(frame.encode(dialect.new("ODOMETRY"), 0, 1, 197))
    assert found(bench.look(), "other position source").found == "ODOMETRY of 1/197"


def test_estimate_of_an_autopilot_whose_heartbeat_is_still_to_come_is_no_other_source() -> None:
    bench = Bench("px4")
    bench.examination.receive(frame.encode(dialect.new("ODOMETRY"), 0, 1, 1), bench.now)
    assert "other position source" not in problems(bench.look())
    bench = Bench("px4")  # both in one datagram
    estimate = frame.encode(dialect.new("ODOMETRY"), 0, 1, 1)
    bench.to_us = lambda data: estimate + data
    bench.step()
    bench.to_us = lambda data: data
    assert "other position source" not in problems(bench.look())


def test_another_autopilot_is_another_position_source() -> None:
    bench = Bench("px4")
    bench.look()
    bench.examination.receive(frame.encode(dialect.new("ODOMETRY"), 0, 2, 1), bench.now)
    assert found(bench.examination.diagnosis(bench.now), "other position source").found == "ODOMETRY of 2/1"


def test_unanswered_timesync_is_found() -> None:
    bench = Bench("ardupilot")
    bench.to_it = without("TIMESYNC")
    assert problems(bench.look()) == {"TIMESYNC"}


def test_lost_frames_are_counted_and_parameters_still_read() -> None:
    bench = Bench("ardupilot")
    count = 0

    def lossy(data: bytes) -> bytes:
        nonlocal count
        count += 1
        return b"" if count % 5 == 0 else data

    bench.to_us = lossy
    diagnosis = bench.look()
    assert "frames lost" in problems(diagnosis)
    assert float(found(diagnosis, "frames lost").found.rstrip("%")) == pytest.approx(20.0, abs=2.0)
    assert all(p.has is not None for p in diagnosis.parameters)


def heartbeat(system: int, component: int, **values: Any) -> bytes:
    return frame.encode(dialect.new("HEARTBEAT", **values), 0, system, component)


def test_duplicate_id_is_found_and_an_echo_is_ignored() -> None:
    echoing = Bench("ardupilot")
    echo: list[bytes] = []

    def back(data: bytes) -> bytes:
        echo.append(data)
        return data

    echoing.to_it = back
    for _ in range(7 * SECOND // STEP):
        echoing.step()
        echoing.injected, echo[:] = list(echo), []
    assert found(echoing.examination.diagnosis(echoing.now), "our id").is_well

    double = Bench("ardupilot")
    for _ in range(2 * SECOND // STEP):
        double.step()
    double.injected.append(heartbeat(1, 191, type=18, autopilot=8, system_status=3))
    assert "our id" in problems(double.look())


@pytest.mark.parametrize(("chosen", "well"), [(0, False), (1, True)])
def test_second_autopilot_is_reported_unless_one_is_configured(chosen: int, well: bool) -> None:
    bench = Bench("ardupilot", profile("ardupilot", f"link.system_id={chosen}"))
    bench.step()
    while not bench.examination.is_connected:
        bench.step()
    bench.injected.append(heartbeat(2, 1, type=1, autopilot=3))
    assert found(bench.look(), "autopilots").is_well is well


def test_armed_state_is_from_the_last_heartbeat() -> None:
    bench = Bench("ardupilot")
    assert not bench.look().identity.is_armed
    bench.autopilot.is_armed = True
    for _ in range(3 * SECOND // STEP // 2):
        bench.step()
    assert bench.examination.diagnosis(bench.now).identity.is_armed


def test_no_autopilot_no_diagnosis() -> None:
    bench = Bench("ardupilot")
    bench.to_us = lambda data: b""
    bench.look(5.0)
    assert not bench.examination.is_connected and not bench.examination.is_done(bench.now)


def test_autopilot_without_version_is_identified_by_make() -> None:
    bench = Bench("px4")
    bench.to_us = without("AUTOPILOT_VERSION")
    diagnosis = bench.look()
    assert diagnosis.identity.version == ""
    assert {p.need.name: p.has for p in diagnosis.parameters} == {"EKF2_AGP0_ID": 0, "EKF2_AGP0_CTRL": 0}
    assert bench.change().wrong_parameters == ()
    assert bench.now < (ATTEMPTS + OBSERVE_LONGER / SECOND + 2) * SECOND


@pytest.mark.parametrize(
    ("vehicle_type", "healthy", "pairs", "text"),
    [
        (mavlink.MAV_TYPE_FIXED_WING, False, [], "none: taken for steady in the air"),
        (mavlink.MAV_TYPE_QUADROTOR, False, [], "none: by the drag of the rotors, in the air"),
        (mavlink.MAV_TYPE_QUADROTOR, None, [], "none: by the drag of the rotors, in the air"),
        (mavlink.MAV_TYPE_QUADROTOR, True, [], "healthy"),
        (mavlink.MAV_TYPE_QUADROTOR, False, ["air_data.rotor_drag_per_s=0"], "none: reckoning by IMU only"),
    ],
)
def test_airspeed_is_found_by_sensor_and_vehicle(
    vehicle_type: int, healthy: bool | None, pairs: list[str], text: str
) -> None:
    config = load(None, {}, {}, ["output.profile=ardupilot", *pairs])
    (airspeed,) = check_airspeed(config, healthy, vehicle_type)
    assert (airspeed.found, airspeed.is_well) == (text, None)
