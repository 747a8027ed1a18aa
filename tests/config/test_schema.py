"""Configuration: flags beat environment beat file, and a mistake is named where it stands."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.config import Config, ConfigError, load, to_toml


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "companion.toml"
    path.write_text(text)
    return path


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    assert load(written(tmp_path, to_toml(Config())), environment={}) == Config()


def test_flags_beat_environment_beat_file(tmp_path: Path) -> None:
    path = written(tmp_path, "[gnss]\nsigma_m = 4.0\ntimeout_s = 5.0\n[rsbn]\ntimeout_s = 20.0\n")
    environment = {"COMPANION_GNSS__SIGMA_M": "3.5", "COMPANION_RSBN__TIMEOUT_S": "30", "HOME": "/"}
    config = load(path, {"rsbn.timeout_s": 40.0, "gnss.every_s": None}, environment)
    assert (config.gnss.timeout_s, config.gnss.sigma_m, config.rsbn.timeout_s) == (5.0, 3.5, 40.0)
    assert config.gnss.every_s == Config().gnss.every_s


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[lnk]\nx = 1", "there is no section [lnk]; did you mean `link`?"),
        ("[link]\ncomponent = 1", "section [link] has no key `component`; did you mean `component_id`?"),
        ("[link]\ncomponent_id = 1000", "link.component_id = 1000 is impossible: expected int <= 255"),
        ("[gnss]\nsigma_m = -1", "gnss.sigma_m = -1 is impossible: expected float > 0.0"),
        ("[gnss]\nsigma_m = nan", "gnss.sigma_m = nan is impossible: expected float"),
        ("[gnss]\nsigma_m = 'two'", "gnss.sigma_m = 'two' is impossible: expected float, got str"),
        (
            "[output]\nprofile = 'px5'",
            "output.profile: 'px5' is none of monitor, ardupilot, px4, custom; did you mean `px4`?",
        ),
        ("[output]\nvia = 'odometri'", "is none of auto, odometry, "),
        ("[output]\nvia = 3", "output.via: 3 is none of auto, "),
        ("[inertial]\nsource = 'ins'", "'ins' is none of auto, local_position, air_data, strapdown"),
        ("[link]\nconnect = 3", "link.connect = [3] is impossible: expected str, got int"),
        ("link = 3", "`link` is a section: write [link] and its keys below it"),
        ("x = [", "is no TOML"),
    ],
)
def test_a_mistake_is_one_sentence_that_names_it(tmp_path: Path, text: str, said: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load(path, environment={})
    assert said in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mistake_in_the_environment_names_the_variable() -> None:
    with pytest.raises(ConfigError, match="COMPANION_GNSS__SIGMA_M"):
        load(environment={"COMPANION_GNSS__SIGMA_M": "-3"})
    with pytest.raises(ConfigError, match="COMPANION_GNS__SIGMA_M"):
        load(environment={"COMPANION_GNS__SIGMA_M": "3"})


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("COMPANION_OUTPUT_PROFILE", "did you mean `COMPANION_OUTPUT__PROFILE`?"),
        ("COMPANION_GNSS_SIGMA_M", "did you mean `COMPANION_GNSS__SIGMA_M`?"),
        ("COMPANION_XYZZY", "write it as COMPANION_SECTION__KEY"),
    ],
)
def test_a_variable_of_ours_that_is_no_key_is_not_ignored(name: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(environment={name: "px4", "COMPANIONS": "two"})
    assert str(caught.value) == f"environment variable {name}: it names no key; {said}"


def test_one_word_is_a_list_of_one(tmp_path: Path) -> None:
    link = "udpin:127.0.0.1:14560"
    path = written(tmp_path, f"[link]\nconnect = '{link}'\n[predictor]\nahead_min = 5.0\n")
    config = load(path, environment={})
    assert config.link.connect == (link,) and config.predictor.ahead_min == (5.0,)
    assert load(environment={"COMPANION_LINK__CONNECT": link}).link.connect == (link,)
    assert load(environment={"COMPANION_LINK__CONNECT": f'["{link}", "x"]'}).link.connect == (link, "x")


def test_a_missing_file_says_how_to_begin(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="check-config --defaults"):
        load(tmp_path / "none.toml", environment={})


def test_the_restrictive_estimator_needs_its_channel() -> None:
    with pytest.raises(ConfigError, match=r"air data only: set inertial\.source"):
        load(pairs=["estimator.output=restrictive"], environment={})
    both = ["estimator.output=restrictive", "inertial.source=air_data"]
    assert load(pairs=both, environment={}).leading == "restrictive"


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        (
            ["inertial.source=local_position", "output.profile=px4"],
            "feed the autopilot its own position back",
        ),
        (["output.odometry_hz=5"], "profile 'monitor' never feeds an autopilot: set output.profile"),
        (["output.profile=px4", "output.gps_input_hz=5"], "its autopilot takes global_position_sensor, odom"),
        (["output.profile=px4", "output.via=gps_input"], "is no way of profile 'px4': choose global_pos"),
        (["output.profile=custom", "output.via=odometry"], "is no way of profile 'custom': leave it out"),
        (["output.profile=ardupilot", "output.via=gps_input", "gnss.receiver=1"], "set gnss.receiver = 0"),
    ],
)
def test_what_cannot_be_meant_together_is_refused_in_one_sentence(pairs: list[str], said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load(pairs=pairs, environment={})
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
