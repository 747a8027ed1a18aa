"""The examination over a simulated autopilot of either make, in virtual time: each thing that can be missing
is taken away in turn, and is found; nothing is changed unasked."""

from collections.abc import Callable
from typing import Any

import pytest

from companion.config import Config, load
from companion.config.required_parameters import needed
from companion.doctor.diagnosis import Diagnosis, Finding
from companion.doctor.examination import WATCHED, WATCHED_LONGER, Examination
from companion.link import dialect, frame
from companion.link.parameter_client import ATTEMPTS, SILENCE
from sitl.autopilot import Autopilot
from sitl.scenarios import named
from sitl.world import World

SECOND = 1_000_000_000
STEP = SECOND // 100
PARAM_SET = 23
WORLDS = {make: World(named("short", autopilot=make)) for make in ("ardupilot", "px4")}
#: What passes from the autopilot to the companion.
Passing = Callable[[bytes], bytes]


def profile(name: str, *pairs: str) -> Config:
    return load(None, {"output.profile": name}, {}, pairs)


class Bench:
    """An autopilot and an examination joined; `to_us` and `to_it` stand for the line and its faults."""

    def __init__(self, make: str, config: Config | None = None) -> None:
        world = WORLDS[make]
        self.autopilot = Autopilot(world.scenario, world=world)
        self.autopilot.is_armed = False
        self.examination = Examination(config or profile(make))
        self.now = 0
        self.sent: list[frame.Frame] = []
        self.to_us: Passing = lambda data: data
        self.to_it: Passing = lambda data: data
        self.spoken: list[bytes] = []  # by others, to be heard by us

    def step(self) -> None:
        self.now += STEP
        heard = [self.to_us(data) for data in self.autopilot.poll(self.now)]
        for data in [*heard, *self.spoken]:
            if data:
                self.examination.receive(data, self.now)
        self.spoken.clear()
        if self.now >= self.examination.deadline():
            self.examination.poll(self.now)
        for data in self.examination.to_send():
            found = frame.examine(data)
            assert isinstance(found, frame.Frame)
            self.sent.append(found)
            if passed := self.to_it(data):
                self.autopilot.receive(passed, self.now)

    def look(self, seconds: float = 60.0) -> Diagnosis:
        while not self.examination.is_done(self.now) and self.now < seconds * SECOND:
            self.step()
        return self.examination.diagnosis(self.now)

    def change(self) -> Diagnosis:
        self.examination.change()
        while not self.examination.is_read:
            self.step()
        return self.examination.diagnosis(self.now)


def amiss(diagnosis: Diagnosis) -> set[str]:
    return {finding.what for finding in diagnosis.amiss}


def found(diagnosis: Diagnosis, what: str) -> Finding:
    (finding,) = (finding for finding in diagnosis.findings if finding.what == what)
    return finding


@pytest.mark.parametrize("make", ["ardupilot", "px4"])
def test_what_is_needed_is_found_and_set_and_nothing_else(make: str) -> None:
    bench = Bench(make)
    before = dict(bench.autopilot.parameters.values)
    diagnosis = bench.look()
    needs = {need.name: need.value for need in needed(profile(make), make)}
    assert {p.need.name: p.has for p in diagnosis.parameters} == {name: before[name] for name in needs}
    assert {p.need.name for p in diagnosis.wrong} == {n for n, value in needs.items() if before[n] != value}
    assert diagnosis.wrong and not diagnosis.amiss
    assert not any(sent.msgid == PARAM_SET for sent in bench.sent)  # looking changes nothing
    assert bench.autopilot.parameters.values == before

    after = bench.change()
    assert after.is_well and set(after.changed_from(diagnosis)) == {p.need.name for p in diagnosis.wrong}
    assert bench.autopilot.parameters.values == before | needs


def test_a_well_one_is_soon_known_and_the_make_is_told() -> None:
    bench = Bench("px4")
    bench.autopilot.parameters.values |= {"EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1}
    diagnosis = bench.look()
    assert diagnosis.is_well and bench.now < WATCHED + SECOND
    assert diagnosis.identity == (1, "px4", "fixed wing", "1.17.0-dev", False)


def test_the_id_of_our_sensor_is_the_one_that_is_needed() -> None:
    config = profile("px4", "output.global_position_sensor_id=7")
    bench = Bench("px4", config)
    bench.look()
    bench.change()
    assert bench.autopilot.parameters.values["EKF2_AGP0_ID"] == 7


def test_a_parameter_that_is_not_there_is_said_to_be_absent_and_not_set() -> None:
    bench = Bench("ardupilot")
    del bench.autopilot.parameters.values["VISO_TYPE"]
    diagnosis = bench.look()
    (absent,) = (p for p in diagnosis.wrong if p.has is None)
    assert (absent.need.name, absent.trouble) == ("VISO_TYPE", SILENCE)
    after = bench.change()
    assert [p.need.name for p in after.wrong] == ["VISO_TYPE"]
    assert "VISO_TYPE" not in bench.autopilot.parameters.values


def test_the_profile_of_another_make_is_told_and_no_parameter_asked_for() -> None:
    bench = Bench("ardupilot", profile("px4"))
    diagnosis = bench.look()
    assert "output profile" in amiss(diagnosis) and not diagnosis.parameters
    assert "'ardupilot'" in found(diagnosis, "output profile").advice
    assert not any(dialect.TYPES[sent.msgid].name.startswith("PARAM") for sent in bench.sent)


def test_a_monitor_needs_no_parameters() -> None:
    diagnosis = Bench("ardupilot", profile("monitor")).look()
    assert diagnosis.is_well and not diagnosis.parameters


# -- the link, and what may be wrong with it -----------------------------------------------------------------


def without(*names: str) -> Passing:
    """A line that swallows these messages."""

    def passing(data: bytes) -> bytes:
        seen = frame.examine(data)
        return b"" if isinstance(seen, frame.Frame) and dialect.TYPES[seen.msgid].name in names else data

    return passing


@pytest.mark.parametrize(
    ("swallowed", "what"),
    [("ATTITUDE", "ATTITUDE"), ("VFR_HUD", "VFR_HUD"), ("GPS_GLOBAL_ORIGIN", "GPS_GLOBAL_ORIGIN")],
)
def test_what_does_not_come_is_found(swallowed: str, what: str) -> None:
    bench = Bench("ardupilot")
    bench.to_us = without(swallowed)
    diagnosis = bench.look()
    assert amiss(diagnosis) - {"frames lost"} == {what}
    assert found(diagnosis, what).advice
    assert bench.now >= WATCHED_LONGER  # it was given time


@pytest.mark.parametrize(("channel", "well"), [("air_data", None), ("strapdown", False)])
def test_a_stream_may_be_missing_where_the_inertial_channel_has_no_use_for_it(
    channel: str, well: bool | None
) -> None:
    bench = Bench("ardupilot", profile("ardupilot", f"inertial.source={channel}"))
    bench.to_us = without("RAW_IMU")
    imu = found(bench.look(), "RAW_IMU")
    assert imu.is_well is well and imu.found == "0.0 Hz"


def test_a_timesync_without_answer_is_found() -> None:
    bench = Bench("ardupilot")
    bench.to_it = without("TIMESYNC")
    assert amiss(bench.look()) == {"TIMESYNC"}


def test_lost_frames_are_counted_and_the_parameters_read_all_the_same() -> None:
    bench = Bench("ardupilot")
    count = 0

    def lossy(data: bytes) -> bytes:
        nonlocal count
        count += 1
        return b"" if count % 5 == 0 else data

    bench.to_us = lossy
    diagnosis = bench.look()
    assert "frames lost" in amiss(diagnosis)
    assert float(found(diagnosis, "frames lost").found.rstrip("%")) == pytest.approx(20.0, abs=2.0)
    assert all(p.has is not None for p in diagnosis.parameters)


def speaking(system: int, component: int, **values: Any) -> bytes:
    return frame.encode(dialect.new("HEARTBEAT", **values), 0, system, component)


def test_another_with_our_id_is_found_and_our_own_echo_is_none() -> None:
    echoing = Bench("ardupilot")
    echo: list[bytes] = []

    def back(data: bytes) -> bytes:
        echo.append(data)
        return data

    echoing.to_it = back
    for _ in range(7 * SECOND // STEP):
        echoing.step()
        echoing.spoken, echo[:] = list(echo), []
    assert found(echoing.examination.diagnosis(echoing.now), "our id").is_well

    double = Bench("ardupilot")
    for _ in range(2 * SECOND // STEP):
        double.step()
    double.spoken.append(speaking(1, 191, type=18, autopilot=8, system_status=3))
    assert "our id" in amiss(double.look())


@pytest.mark.parametrize(("chosen", "well"), [(0, False), (1, True)])
def test_a_second_autopilot_is_told_unless_one_was_chosen(chosen: int, well: bool) -> None:
    bench = Bench("ardupilot", profile("ardupilot", f"link.system_id={chosen}"))
    bench.step()
    while not bench.examination.is_heard:
        bench.step()
    bench.spoken.append(speaking(2, 1, type=1, autopilot=3))
    assert found(bench.look(), "autopilots").is_well is well


def test_whether_it_is_armed_is_the_last_heartbeat_s_word() -> None:
    bench = Bench("ardupilot")
    assert not bench.look().identity.is_armed
    bench.autopilot.is_armed = True
    for _ in range(3 * SECOND // STEP // 2):
        bench.step()
    assert bench.examination.diagnosis(bench.now).identity.is_armed


def test_nobody_there_is_no_diagnosis() -> None:
    bench = Bench("ardupilot")
    bench.to_us = lambda data: b""
    bench.look(5.0)
    assert not bench.examination.is_heard and not bench.examination.is_done(bench.now)


def test_an_autopilot_that_tells_no_version_is_believed_by_its_make() -> None:
    bench = Bench("px4")
    bench.to_us = without("AUTOPILOT_VERSION")
    diagnosis = bench.look()
    assert diagnosis.identity.version == ""
    assert {p.need.name: p.has for p in diagnosis.parameters} == {"EKF2_AGP0_ID": 0, "EKF2_AGP0_CTRL": 0}
    assert bench.change().wrong == ()
    assert bench.now < (ATTEMPTS + WATCHED_LONGER / SECOND + 2) * SECOND
