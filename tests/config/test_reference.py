"""Configuration reference: complete, the same in the file, on the page and in the schema."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, get_type_hints

import msgspec
import pytest
from click.testing import CliRunner

from companion.command_line import cli
from companion.config import Config, ConfigError, load, to_toml
from companion.config.presets import PRESETS, recommend_preset
from companion.config.reference import TEXTS, UNITS, Key, commented_toml, keys, markdown
from companion.config.schema import SECTIONS

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"
#: Numbers that are counts, ids, probabilities or times in the unit of another key.
WITHOUT_UNIT = {
    "link.system_id",
    "link.component_id",
    "strapdown.imu",
    "gnss.receiver",
    "integrity.rows",
    "integrity.risk",
    "output.global_position_sensor_id",
    "log.maximum_files",
}


def names(config: Config) -> list[tuple[str, str]]:
    sections = config.__struct_fields__
    return [(section, key) for section in sections for key in getattr(config, section).__struct_fields__]


def test_every_key_is_described_and_no_other() -> None:
    assert [(section, key) for section, table in TEXTS.items() for key in table] == names(Config())
    for key in keys():
        assert key.text.endswith(".") and key.change and not key.change.endswith("."), key


@pytest.mark.parametrize("key", list(keys()), ids=lambda key: f"{key.section}.{key.name}")
def test_every_number_has_a_unit_or_is_known_to_have_none(key: Key) -> None:
    is_number = isinstance(key.default, float | int) and not isinstance(key.default, bool)
    assert bool(key.unit) == (is_number and f"{key.section}.{key.name}" not in WITHOUT_UNIT) or (
        key.unit and isinstance(key.default, tuple)
    )
    assert key.allowed


@pytest.mark.parametrize("key", list(keys()), ids=lambda key: f"{key.section}.{key.name}")
def test_stated_range_is_the_one_that_is_enforced(key: Key) -> None:
    kind = SECTIONS[key.section]

    def is_valid(value: Any) -> bool:
        try:
            msgspec.convert({key.name: value}, kind)
        except msgspec.ValidationError:
            return False
        return True

    words = key.allowed.replace(",", "").split()
    if key.allowed[:1].isdigit() or key.allowed.startswith("-"):
        low, high = float(words[0]), float(words[2])
        whole = int if get_type_hints(kind)[key.name] is int else float
        assert is_valid(whole(low)) and is_valid(whole(high))
        assert not is_valid(whole(low - 1)) and not is_valid(whole(high + 1))
    elif words[:2] == ["at", "least"]:
        assert is_valid(int(words[2])) and not is_valid(int(words[2]) - 1)
    elif key.unit == "" and isinstance(key.default, str) and key.allowed != "text":
        assert all(is_valid(choice) for choice in key.allowed.split(", ")) and not is_valid("none of them")


def test_units_are_found_by_the_longest_end() -> None:
    ends = list(UNITS)
    assert not any(later.endswith(end) for i, end in enumerate(ends) for later in ends[i + 1 :])


def test_page_is_what_the_schema_gives() -> None:
    assert PAGE.read_text() == markdown(), "run: make docs/configuration.md"


@pytest.mark.parametrize("preset", [None, *PRESETS])
def test_printed_file_has_a_comment_at_every_key_and_is_read_back(preset: str | None, tmp_path: Path) -> None:
    arguments = ["check-config", "--defaults", *(["--preset", preset] if preset else [])]
    done = CliRunner().invoke(cli, arguments)
    file = tmp_path / "companion.toml"
    file.write_text(done.output)
    config = load(preset=preset, environment={})
    assert load(file, environment={}) == config
    assert done.output == commented_toml(config)
    lines = done.output.splitlines()
    at = [number for number, line in enumerate(lines) if " = " in line and not line.startswith("#")]
    assert len(at) == len(names(config))
    assert all(lines[number - 1].startswith("# ") for number in at)
    assert max(map(len, lines)) <= 100


def test_file_and_flags_override_a_preset(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("[inertial]\ngyro_drift_deg_h = 3.0\n")
    config = load(file, preset="mems", environment={}, pairs=["inertial.tilt_arcsec=60"])
    assert (config.inertial.gyro_drift_deg_h, config.inertial.tilt_arcsec) == (3.0, 60.0)
    assert config.inertial.accelerometer_bias_ug == PRESETS["mems"].values["inertial.accelerometer_bias_ug"]


@pytest.mark.parametrize("preset", PRESETS)
def test_a_file_that_takes_a_preset_away_is_rejected(preset: str, tmp_path: Path) -> None:
    """The file of `check-config --defaults` has every key: with it the service sent nothing."""
    file = tmp_path / "companion.toml"
    file.write_text(CliRunner().invoke(cli, ["check-config", "--defaults"]).output)
    with pytest.raises(ConfigError) as caught:
        load(file, preset=preset, environment={})
    assert f"--preset {preset} has no effect: {file} overrides its " in str(caught.value)
    assert all(name in str(caught.value) for name in PRESETS[preset].values)
    (first, value), *_ = PRESETS[preset].values.items()
    given_back = load(file, pairs=[f"{first}={json.dumps(value)}"], preset=preset, environment={})
    assert given_back == load(file, pairs=[f"{first}={json.dumps(value)}"], environment={})
    file.write_text(CliRunner().invoke(cli, ["check-config", "--defaults", "--preset", preset]).output)
    assert load(file, preset=preset, environment={}) == load(preset=preset, environment={})


def test_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match="did you mean `px4`"):
        load(preset="px5", environment={})


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--preset", "px4", "--preset", "mems"], "--preset mems: --preset px4 is given too: leave one out"),
        (["--config", "a.toml", "--config", "b.toml"], "--config b.toml: --config a.toml is given too"),
    ],
)
def test_a_second_preset_or_file_is_rejected(options: list[str], expected: str) -> None:
    done = CliRunner().invoke(cli, ["doctor", *options])
    assert isinstance(done.exception, ConfigError) and expected in str(done.exception)


def test_presets_of_a_stock_autopilot_never_take_its_position_for_an_ins() -> None:
    for name in ("stock-autopilot", "px4"):
        assert not load(preset=name, environment={}).has_own_ins
    assert (recommend_preset("ardupilot"), recommend_preset("px4")) == ("stock-autopilot", "px4")
    assert recommend_preset("other") is None


@pytest.mark.parametrize("preset", ["stock-autopilot", "px4"])
def test_a_preset_for_an_autopilot_without_an_ins_rejects_one(preset: str, tmp_path: Path) -> None:
    (file := tmp_path / "ins.toml").write_text("[inertial]\nindependent = true\n")
    for path, pairs, where in (
        (None, ["inertial.independent=true"], "--set inertial."),
        (file, [], str(file)),
    ):
        with pytest.raises(ConfigError, match=r"without an INS of its own, and .*: leave out one") as caught:
            load(path, preset=preset, environment={}, pairs=pairs)
        assert where in str(caught.value)


def test_presets_have_the_order_of_their_grades() -> None:
    grades = [
        load(preset=name, environment={}).inertial for name in ("navigation-ins", "tactical-ins", "mems")
    ]
    for key in ("gyro_drift_deg_h", "accelerometer_bias_ug", "tilt_arcsec", "heading_arcmin"):
        values = [getattr(grade, key) for grade in grades]
        assert values == sorted(set(values)), key


def test_plain_configuration_stays_short_without_comments() -> None:
    assert "#" not in to_toml(Config())
