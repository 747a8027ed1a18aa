"""Output profiles: default messages and rates, and the required autopilot parameters."""

from __future__ import annotations

import itertools

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import Config, ConfigError, InertialConfig, OutputConfig, load
from companion.config.profiles import MESSAGES, PROFILES
from companion.config.required_parameters import failsafe_limits, required_parameters
from companion.config.validate import find_conflicts

STATUS = {"NAVIGATION_STATUS": 1.0}


def configured(*pairs: str) -> Config:
    return load(pairs=pairs, environment={})


def sent(config: Config) -> dict[str, float]:
    return {name: hz for name, hz in config.output.rates_hz.items() if hz > 0.0}


@pytest.mark.parametrize(
    ("pairs", "rates"),
    [
        ([], {}),
        (["output.profile=monitor"], {}),
        (["output.profile=custom"], {}),
        (["output.profile=custom", "output.vision_hz=6"], {"VISION_POSITION_ESTIMATE": 6.0}),
        (["output.profile=ardupilot"], {"ODOMETRY": 10.0}),
        (["output.profile=ardupilot", "output.odometry_hz=4"], {"ODOMETRY": 4.0}),
        (["output.profile=ardupilot", "output.odometry_hz=0"], {}),
        (["output.profile=ardupilot", "output.via=vision"], {"VISION_POSITION_ESTIMATE": 10.0}),
        (["output.profile=ardupilot", "output.via=gps_input"], {"GPS_INPUT": 10.0}),
        (["output.profile=ardupilot", "output.via=external_position"], {"COMMAND_INT": 1.0}),
        (["output.profile=px4"], {"GLOBAL_POSITION_SENSOR": 2.0}),
        (["output.profile=px4", "output.via=odometry"], {"ODOMETRY": 10.0}),
        (["output.profile=px4", "output.via=vision"], {"VISION_POSITION_ESTIMATE": 10.0}),
        (["output.profile=px4", "output.via=external_position"], {"COMMAND_INT": 0.5}),
    ],
)
def test_output_rates(pairs: list[str], rates: dict[str, float]) -> None:
    config = configured(*pairs)
    assert sent(config) == STATUS | rates
    assert config.output.feeds_estimator == bool(rates)
    assert config.output.pace_hz == max(5.0, *rates.values(), 0.0)


VISO = {"VISO_TYPE": 1, "EK3_SRC2_POSXY": 6, "EK3_SRC2_VELXY": 0, "EK3_SRC2_POSZ": 1, "EK3_SRC2_VELZ": 0}
VISO["EK3_SRC2_YAW"] = 1


@pytest.mark.parametrize(
    ("pairs", "parameters", "reboot"),
    [
        ([], {}, set()),
        (["output.profile=ardupilot"], VISO, {"VISO_TYPE"}),
        (["output.profile=ardupilot", "output.via=vision"], VISO, {"VISO_TYPE"}),
        (
            ["output.profile=ardupilot", "output.via=gps_input"],
            {"GPS2_TYPE": 14, "GPS_AUTO_SWITCH": 1, "EK3_GPS_CHECK": 23},
            {"GPS2_TYPE"},
        ),
        (["output.profile=ardupilot", "output.via=external_position"], {}, set()),
        (
            ["output.profile=px4", "output.global_position_sensor_id=3"],
            {"EKF2_AGP0_ID": 3, "EKF2_AGP0_CTRL": 1},
            {"EKF2_AGP0_ID", "EKF2_AGP0_CTRL"},
        ),
        (["output.profile=px4", "output.via=odometry"], {"EKF2_EV_CTRL": 1}, set()),
        (["output.profile=px4", "output.via=vision"], {"EKF2_EV_CTRL": 1}, set()),
        (["output.profile=px4", "output.via=external_position"], {}, set()),
    ],
)
def test_required_parameters(pairs: list[str], parameters: dict[str, float], reboot: set[str]) -> None:
    found = required_parameters(configured(*pairs))
    assert {p.name: p.value for p in found} == parameters
    assert len(found) == len(parameters)
    assert {p.name for p in found if p.reboot} == reboot


def test_profile_custom_requires_the_parameters_of_the_connected_make() -> None:
    config = configured("output.profile=custom", "output.odometry_hz=5")
    assert {p.name: p.value for p in required_parameters(config, "ardupilot")} == VISO
    assert {p.name: p.value for p in required_parameters(config, "px4")} == {"EKF2_EV_CTRL": 1}
    assert required_parameters(config) == required_parameters(config, "other") == ()


@pytest.mark.parametrize(
    ("pairs", "make", "hovers", "names"),
    [
        ([], "px4", True, set()),
        (["output.profile=ardupilot"], "ardupilot", True, set()),
        (["output.profile=px4"], "px4", False, {"COM_POS_LOW_EPH"}),
        (["output.profile=px4"], "px4", True, {"COM_POS_LOW_EPH", "COM_POS_FS_EPH", "EKF2_NOAID_TOUT"}),
        (["output.profile=custom", "output.odometry_hz=5"], "px4", False, {"COM_POS_LOW_EPH"}),
        (["output.profile=custom", "output.odometry_hz=5"], "other", True, set()),
    ],
)
def test_failsafe_limits(pairs: list[str], make: str, hovers: bool, names: set[str]) -> None:
    limits = failsafe_limits(configured(*pairs), make, hovers)
    assert {limit.name for limit in limits} == names
    for limit in limits:  # its value lets the autopilot fly on, and PX4's default does not
        default = {"COM_POS_LOW_EPH": 50.0, "COM_POS_FS_EPH": 5.0, "EKF2_NOAID_TOUT": 5e6}[limit.name]
        assert limit.is_met(limit.value) and not limit.is_met(default)
        assert limit.is_met(0.0) == (limit.name == "COM_POS_LOW_EPH")  # PX4 tests it only above 0


outputs = st.builds(
    OutputConfig,
    profile=st.sampled_from(list(PROFILES)),
    via=st.sampled_from(["auto", *MESSAGES]),
    odometry_hz=st.sampled_from([-1.0, 0.0, 5.0]),
    vision_hz=st.sampled_from([-1.0, 0.0, 5.0]),
    gps_input_hz=st.sampled_from([-1.0, 0.0, 5.0]),
    global_position_sensor_hz=st.sampled_from([-1.0, 0.0, 2.0]),
    external_position_hz=st.sampled_from([-1.0, 0.0, 0.5]),
)
sources = st.sampled_from(["auto", "local_position", "air_data", "imu"])


@settings(max_examples=300)
@given(output=outputs, source=sources)
def test_no_configuration_feeds_an_autopilot_its_own_position(output: OutputConfig, source: str) -> None:
    config = Config(output=output, inertial=InertialConfig(source=source))
    if not list(find_conflicts(config)) and output.feeds_estimator:
        assert not config.has_own_ins
        assert config.inertial.source != "local_position"
        assert output.profile != "monitor"


@pytest.mark.parametrize("profile", ["ardupilot", "px4"])
def test_local_position_is_independent_only_if_configured(profile: str) -> None:
    pairs = [f"output.profile={profile}", "inertial.source=local_position"]
    with pytest.raises(ConfigError, match=r"inertial\.independent"):
        configured(*pairs)
    assert configured(*pairs, "inertial.independent=true").has_own_ins


@pytest.mark.parametrize(
    ("source", "sensors", "own_ins"),
    [
        ("auto", {"local_position", "air_data", "imu"}, True),
        ("local_position", {"local_position"}, True),
        ("air_data", {"air_data"}, False),
        ("imu", {"imu"}, False),
    ],
)
def test_inertial_source_is_what_may_be_used(source: str, sensors: set[str], own_ins: bool) -> None:
    config = configured(f"inertial.source={source}")
    assert {name for name in ("local_position", "air_data", "imu") if config.uses(name)} == sensors  # type: ignore[arg-type]
    assert not config.has_own_ins
    assert configured(f"inertial.source={source}", "inertial.independent=true").has_own_ins is own_ins


def test_every_output_method_of_every_profile_is_valid() -> None:
    for name, via in itertools.chain.from_iterable(
        [(name, via) for via in profile.methods] for name, profile in PROFILES.items()
    ):
        config = msgspec.structs.replace(Config(), output=OutputConfig(profile=name, via=via))
        assert not list(find_conflicts(config))
        assert list(sent(config)) == [MESSAGES[via], "NAVIGATION_STATUS"]
