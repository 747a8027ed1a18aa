"""Configuration: flags override the environment, which overrides the file; mistakes are located."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from companion.config import Config, ConfigError, load, parse, to_toml


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "companion.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_formatted_configuration_is_read_back(tmp_path: Path) -> None:
    assert load(written(tmp_path, to_toml(Config())), environment={}) == Config()


def test_flags_override_environment_overrides_file(tmp_path: Path) -> None:
    path = written(tmp_path, "[gnss]\nsigma_m = 4.0\ntimeout_s = 5.0\n[rsbn]\ntimeout_s = 20.0\n")
    environment = {"COMPANION_GNSS__SIGMA_M": "3.5", "COMPANION_RSBN__TIMEOUT_S": "30", "HOME": "/"}
    config = load(path, {"rsbn.timeout_s": 40.0, "gnss.every_s": None}, environment)
    assert (config.gnss.timeout_s, config.gnss.sigma_m, config.rsbn.timeout_s) == (5.0, 3.5, 40.0)
    assert config.gnss.every_s == Config().gnss.every_s


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[lnk]\nx = 1", "there is no section [lnk]; did you mean `link`?"),
        ("[link]\ncomponent = 1", "section [link] has no key `component`; did you mean `component_id`?"),
        (
            "[link]\ncomponent_id = 1000",
            "link.component_id = 1000 is invalid: give a whole number from 1 to 255",
        ),
        ("[gnss]\nsigma_m = -1", "gnss.sigma_m = -1 is invalid: give a number from 0.01 to 1000"),
        ("[gnss]\nsigma_m = nan", "gnss.sigma_m = nan is invalid: give a number from 0.01 to 1000"),
        ("[log]\nfolder = 3", "log.folder = 3 is invalid: give text in quotes"),
        (
            "[gnss]\nsigma_m = 'two'",
            "gnss.sigma_m = 'two' is invalid: give a number from 0.01 to 1000, without quotes",
        ),
        (
            "[output]\nprofile = 'px5'",
            "output.profile: 'px5' is not one of monitor, ardupilot, px4, custom; did you mean `px4`?",
        ),
        ("[inertial]\nindependent = 'yes'", "inertial.independent = 'yes' is invalid: give true or false"),
        ("[output]\nvia = 'odometri'", "is not one of auto, odometry, "),
        ("[output]\nvia = 3", "output.via: 3 is not one of auto, "),
        ("[inertial]\nsource = 'ins'", "'ins' is not one of auto, local_position, air_data, imu"),
        ("[estimator]\nscheme = 1.5", "1.5 is not one of feedforward, feedback, nor a number from 0 to 1"),
        (
            "[log]\nmaximum_files = 1e3",
            "maximum_files = 1000.0 is invalid: give a whole number of at least 1, without point or exponent",
        ),
        ("[log]\nmaximum_files = 0", "log.maximum_files = 0 is invalid: give a whole number of at least 1"),
        ("[log]\nminimum_free_mib = 1.5", "give a whole number of at least 0"),
        ("[link]\nconnect = 3", "link.connect = [3] is invalid: give text in quotes"),
        ("[estimator]\nparallel = 'minmax_filter'", "is not one of minimax_filter, restrictive"),
        ("link = 3", "`link` is a section: write [link] and its keys below it"),
        ("sigma_m = 2", "the key `sigma_m` is in no section; did you mean `gnss.sigma_m`?"),
        ("timeout_s = 2", "no section; did you mean `gnss.timeout_s` or `rsbn.timeout_s`?"),
        ("maximum_file = 2", "no section; did you mean `log.maximum_files`?"),
        ("xyzzy = 2", "the key `xyzzy` is in no section; the sections are link, rates, "),
        ("x = [", "not valid TOML"),
        ("[output]\nprofile = px4", "line 2, column 11): `profile = px4`; write text in quotes, "),
        ("[gnss]\nsigma_m = 3\nsigma_m = 4\n", "`sigma_m = 4`; a key or section is given twice: keep one"),
        ("[gnss]\nsigma_m = 3\nsigma_m = 4", "end of document); a key or section is given twice: keep one"),
        ("[gnss]\n[gnss]\n", "line 2, column 6): `[gnss]`; a key or section is given twice: keep one"),
        ("[gnss]\nsigma_m = 3,5", "line 2, column 12): `sigma_m = 3,5`; write text in quotes"),
        ("[link]\naddresses = 1", "section [link] has no key `addresses`; it has connect, "),
        ("[gps]\nsigma_m = 1", "there is no section [gps]; did you mean `gnss`?"),
        ("[GNSS]\nsigma_m = 1", "there is no section [GNSS]; did you mean `gnss`?"),
        ("[gnss]\nSIGMA_M = 1", "section [gnss] has no key `SIGMA_M`; did you mean `sigma_m`?"),
        (
            "[gnss]\nuse_velocity = True",
            "`use_velocity = True`; write text in quotes, numbers with a decimal ",
        ),
        ("[gnss]\nuse_velocity = yes", "point, and a switch as true or false"),
        ("#" * 65_536 + "\n", "65537 bytes, but a configuration has at most 65536"),
        ("\ngnss" + 1001 * ".a" + " = 1", "line 2 has 1001 dots, at most 1000 are allowed"),
    ],
)
def test_mistake_is_reported_in_one_sentence(tmp_path: Path, text: str, expected: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load(path, environment={})
    assert expected in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_folder_in_place_of_the_file_is_reported(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"is a folder; give the TOML file$"):
        load(tmp_path, environment={})


def test_pipe_and_endless_file_are_rejected(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(ConfigError, match=f"^{path} is not a regular file; give the TOML file$"):
            load(path, environment={})


def test_file_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = written(tmp_path, "\ufeff[gnss]\nsigma_m = 4.0\n")
    assert path.read_bytes().startswith(b"\xef\xbb\xbf")
    assert load(path, environment={}).gnss.sigma_m == 4.0


@pytest.mark.parametrize(("scheme", "share"), [("feedforward", 0.0), (0.3, 0.3), ("feedback", 1.0)])
def test_scheme_is_a_word_or_a_share(tmp_path: Path, scheme: object, share: float) -> None:
    path = written(tmp_path, f"[inertial]\nsource = 'air_data'\n[estimator]\nscheme = {scheme!r}")
    assert load(path, environment={}).estimator.feedback == share


def test_number_without_an_upper_limit_is_reported_from_every_source() -> None:
    for sources in (
        {"pairs": ["log.maximum_files=100.0"], "environment": {}},
        {"environment": {"COMPANION_LOG__MAXIMUM_FILES": "1e3"}},
        {"flags": {"log.minimum_free_mib": 2.5}, "environment": {}},
    ):
        with pytest.raises(ConfigError, match="give a whole number of at least"):
            load(**sources)


def test_mistake_in_the_environment_names_the_variable() -> None:
    with pytest.raises(ConfigError, match="COMPANION_GNSS__SIGMA_M"):
        load(environment={"COMPANION_GNSS__SIGMA_M": "-3"})
    with pytest.raises(ConfigError, match="COMPANION_GNS__SIGMA_M"):
        load(environment={"COMPANION_GNS__SIGMA_M": "3"})


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("COMPANION_OUTPUT_PROFILE", "did you mean `COMPANION_OUTPUT__PROFILE`?"),
        ("COMPANION_GNSS_SIGMA_M", "did you mean `COMPANION_GNSS__SIGMA_M`?"),
        ("COMPANION_XYZZY", "write it as COMPANION_SECTION__KEY"),
    ],
)
def test_unknown_environment_variable_is_reported(name: str, expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(environment={name: "px4", "COMPANIONS": "two"})
    assert str(caught.value) == f"environment variable {name}: no such key; {expected}"


def test_single_value_is_a_list_of_one(tmp_path: Path) -> None:
    link = "udpin:127.0.0.1:14560"
    path = written(tmp_path, f"[link]\nconnect = '{link}'\n[predictor]\nahead_min = 5.0\n")
    config = load(path, environment={})
    assert config.link.connect == (link,) and config.predictor.ahead_min == (5.0,)
    assert load(environment={"COMPANION_LINK__CONNECT": link}).link.connect == (link,)
    assert load(environment={"COMPANION_LINK__CONNECT": f'["{link}", "x"]'}).link.connect == (link, "x")


def test_missing_file_error_suggests_defaults(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="check-config --defaults"):
        load(tmp_path / "none.toml", environment={})


def test_restrictive_estimator_requires_air_data() -> None:
    with pytest.raises(ConfigError, match=r"air data only: set inertial\.source"):
        load(pairs=["estimator.output=restrictive"], environment={})
    both = ["estimator.output=restrictive", "inertial.source=air_data"]
    assert load(pairs=both, environment={}).leading_estimator == "restrictive"


def test_correctors_are_taken_with_an_ins_of_its_own_or_from_a_log() -> None:
    pairs = ["inertial.correctors=stars", "inertial.independent=true"]
    for source in ("auto", "local_position"):
        assert load(pairs=[*pairs, f"inertial.source={source}"], environment={}).has_own_ins
    assert parse("[inertial]\ncorrectors = ['stars']", "a log").inertial.correctors == ("stars",)


def test_no_prediction_ahead_and_the_ends_of_the_message_ids_are_accepted() -> None:
    pairs = ["predictor.ahead_min=[]", "signing.always_accepted=[0,16777215]", "output.odometry_hz=-1"]
    assert load(pairs=pairs, environment={}).predictor.ahead_min == ()


@pytest.mark.parametrize(
    ("pairs", "expected"),
    [
        (
            ["inertial.source=local_position", "output.profile=px4"],
            "feed the autopilot its own position back",
        ),
        (["output.odometry_hz=5"], "profile 'monitor' never feeds an autopilot: set output.profile"),
        (
            ["output.profile=px4", "output.gps_input_hz=5"],
            "its autopilot accepts global_position_sensor, odom",
        ),
        (
            ["output.profile=px4", "output.via=gps_input"],
            "is not available in profile 'px4': choose global_pos",
        ),
        (
            ["output.profile=custom", "output.via=odometry"],
            "is not available in profile 'custom': remove this key",
        ),
        (["output.profile=ardupilot", "output.via=gps_input", "gnss.receiver=1"], "set gnss.receiver = 0"),
        (
            ["inertial.correctors=stars"],
            "['stars'] has an effect only with an INS of its own: set inertial.independent",
        ),
        (
            ["inertial.correctors=stars", "inertial.independent=true", "inertial.source=imu"],
            "and inertial.source = 'auto', or inertial.correctors = []",
        ),
        (
            ["gnss.sigma_m=3", "rsbn.timeout_s=9", "gnss.sigma_m=4"],
            "--set gnss.sigma_m=4: gnss.sigma_m is given twice, also as --set gnss.sigma_m=3: leave one out",
        ),
        (["link.connect=[]"], "link.connect = [] names no link: give one, for example udpin:127.0.0.1:14550"),
        (["link.component_id=1"], "link.component_id = 1 is the component of the autopilot: give another"),
        (["output.odometry_hz=-0.5"], "odometry_hz = -0.5: set -1 (the profile's rate), 0 (never), or at "),
        (
            ["predictor.ahead_min=[5,1,5]"],
            "ahead_min = [5.0, 1.0, 5.0] is not in ascending order: write [1.0, 5",
        ),
        (["signing.always_accepted=[109,-1]"], "always_accepted has -1: give message ids from 0 to 16777215"),
        (["signing.always_accepted=16777216"], "always_accepted has 16777216: give message ids from 0 to"),
        (
            ["output.profile=ardupilot", "output.odometry_hz=2"],
            "output.odometry_hz = 2: ArduPilot does not arm with less than 4 Hz; set 4 or more, or -1",
        ),
        (
            ["gnss.sigma_m=3,5"],
            "gnss.sigma_m = '3,5' is invalid: give a number from 0.01 to 1000, with a decimal",
        ),
        (['log.folder=""'], "log.folder = '' names no folder: give one, for example logs"),
        (['log.folder="a\\u0000"'], "log.folder = 'a\\x00' has a null character: remove it"),
        (['signing.stamp_file="\\u0000"'], "signing.stamp_file = '\\x00' has a null character"),
        (["log.folder=a\udcff"], "log.folder = 'a\\udcff' is not UTF-8: give another name"),
        (["log.folder=~/logs"], "log.folder = '~/logs': ~ is not expanded; write the whole path"),
        (["signing.key_file=~pilot/key"], "signing.key_file = '~pilot/key': ~ is not expanded"),
        (
            ["gnss.every_s=10"],
            "gnss.every_s = 10 leaves 10 s between fixes, and GNSS counts as absent after gnss.timeout_s = "
            "3 s: set gnss.timeout_s above 10",
        ),
        (
            ["output.profile=px4", "output.global_position_sensor_id=0"],
            "output.global_position_sensor_id = 0: EKF2_AGP0_ID = 0 is PX4's for no sensor",
        ),
        (["rates.gnss_hz=0.2"], "rates.gnss_hz = 0.2 leaves 5 s between fixes, and GNSS counts as absent"),
    ],
)
def test_invalid_combination_is_reported_in_one_sentence(pairs: list[str], expected: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(pairs=pairs, environment={})
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)
