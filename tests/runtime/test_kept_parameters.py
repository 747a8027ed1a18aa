"""Kept parameters are used until two starts with them failed; then they are set aside, with a sentence."""

import os
from pathlib import Path

import pytest

from companion.config import Config, ConfigError, load
from companion.runtime.kept_parameters import KeptParameters


@pytest.fixture
def kept(tmp_path: Path) -> KeptParameters:
    boot = tmp_path / "boot_id"
    boot.write_text("one\n")
    path = tmp_path / "parameters.toml"
    path.write_text("[gnss]\nsigma_m = 7.0\n")
    return KeptParameters(path, boot)


def start(kept: KeptParameters) -> tuple[Config, list[str]]:
    config, notes = kept.load(Config(), lambda: load(None, environment={}, tuned=kept.path))
    kept.count_start()
    return config, notes


def test_two_failed_starts_drop_the_parameters(kept: KeptParameters) -> None:
    for _ in range(2):
        config, notes = start(kept)
        assert config.gnss.sigma_m == 7.0 and notes == []
    config, (note,) = start(kept)
    assert config == Config()
    assert "the last 2 starts with them failed" in note and "parameters.toml.rejected" in note
    assert not kept.path.exists() and kept.path.with_name("parameters.toml.rejected").exists()
    assert start(kept) == (Config(), [])  # and flies on without them


def test_a_confirmed_start_does_not_count(kept: KeptParameters) -> None:
    for _ in range(5):
        config, notes = start(kept)
        assert config.gnss.sigma_m == 7.0 and notes == []
        kept.confirm()


def test_a_withdrawn_start_neither_counts_nor_excuses_others(kept: KeptParameters) -> None:
    for has_failed in (False, False, True, False, False, True):
        assert start(kept)[1] == []
        if not has_failed:
            kept.withdraw_start()
    assert "the last 2 starts with them failed" in start(kept)[1][0]


def test_power_cuts_do_not_count(kept: KeptParameters, tmp_path: Path) -> None:
    for boot in "abcde":
        (tmp_path / "boot_id").write_text(boot)
        assert start(kept)[1] == []


def test_values_that_no_longer_pass_the_checks_are_dropped_at_once(kept: KeptParameters) -> None:
    kept.path.write_text("[rates]\ngnss_hz = 1e-40\n")
    config, (note,) = start(kept)
    assert config == Config() and "rates.gnss_hz = 1e-40: set 0, or at least 0.01 Hz" in note


def test_a_disk_that_cannot_be_written_does_not_prevent_the_start(kept: KeptParameters) -> None:
    kept._count_path.mkdir()
    for _ in range(4):
        config, notes = start(kept)
        assert config.gnss.sigma_m == 7.0 and notes == []


def test_a_folder_is_rejected_and_stays_where_it_is(tmp_path: Path) -> None:
    """A mistake of the configuration: it was renamed, with all that is in it, and the service started."""
    folder = tmp_path / "folder"
    folder.mkdir()
    with pytest.raises(ConfigError, match=f"link.parameters_file: {folder} is no regular file: give another"):
        start(KeptParameters(folder, tmp_path / "boot_id"))
    assert folder.is_dir() and not folder.with_name("folder.rejected").exists()


def test_a_device_is_rejected(tmp_path: Path) -> None:
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    with pytest.raises(ConfigError, match="is no regular file"):
        start(KeptParameters(fifo, tmp_path / "boot_id"))
    assert fifo.is_fifo()


def test_the_configuration_is_no_file_for_parameters(kept: KeptParameters) -> None:
    """The first value that a station sets would replace all of it."""
    link = kept.path.with_name("link.toml")
    link.symlink_to(kept.path)
    with pytest.raises(ConfigError, match="is the configuration file: give another"):
        kept.load(Config(), Config, link)
    link.unlink()
    link.touch()
    assert kept.load(Config(), Config, link) == (Config(), [])
