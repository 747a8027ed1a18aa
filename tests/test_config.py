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
