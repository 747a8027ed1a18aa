"""Documentation against the code: configurations, parameters, rates, times and link budgets."""

import re
import tomllib
from pathlib import Path

import pytest

from companion.config import Config, load, parse
from companion.config.profiles import PROFILES
from companion.config.required_parameters import required_parameters
from companion.link.dialect import type_named
from companion.output.gate import withholding_reason
from companion.records import Mode, Solution, Trust
from companion.runtime.core import requested_rates
from companion.units import SECOND_NS

ROOT = Path(__file__).parents[1]
PAGES = {
    name: (ROOT / "docs" / f"{name}.md").read_text() for name in ("ardupilot", "px4", "install", "outputs")
}
OVERHEAD = 12  # bytes of a MAVLink 2 frame round its payload
LACKING = {"ardupilot": {"HIGHRES_IMU"}, "px4": {"RAW_IMU", "EKF_STATUS_REPORT"}}
MAKES = ("ardupilot", "px4")


def rows(page: str) -> list[list[str]]:
    lines = [line for line in PAGES[page].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def row(page: str, first: str) -> list[str]:
    (found,) = (cells for cells in rows(page) if cells[0].startswith(first))
    return found


def profile(name: str, *pairs: str) -> Config:
    return load(None, {"output.profile": name}, {}, pairs)


@pytest.mark.parametrize("page", MAKES)
def test_configuration_in_docs_is_valid(page: str) -> None:
    (block,) = re.findall(r"```toml\n(.*?)```", PAGES[page], re.DOTALL)
    assert parse(block, page).output.profile == page


@pytest.mark.parametrize("page", MAKES)
def test_parameters_in_docs_are_the_required_ones(page: str) -> None:
    for need in required_parameters(profile(page)):
        cells = row(page, f"`{need.name}`")
        assert float(cells[1]) == need.value
        assert ("reboot" in cells[2]) is need.reboot, need.name


@pytest.mark.parametrize("page", MAKES)
def test_output_methods_in_docs_have_their_rates_and_parameters(page: str) -> None:
    default = {need.name for need in required_parameters(profile(page))}
    for via, method in PROFILES[page].methods.items():
        cells = row(page, f"`{via}`")
        assert cells[1] == f"{method.rate_hz:g} Hz"
        for need in required_parameters(profile(page, f"output.via={via}")):
            assert need.name in default or f"`{need.name}` {need.value:g}" in cells[2]


def size(message: str) -> int:
    return type_named(message).layout.size + OVERHEAD


@pytest.mark.parametrize("page", MAKES)
def test_link_budget_in_docs(page: str) -> None:
    config = profile(page)
    requested = sum(
        size(name) * hz for name, hz in requested_rates(config).items() if name not in LACKING[page]
    )
    sent = sum(size(name) * hz for name, hz in config.output.rates_hz.items()) + size("HEARTBEAT")
    assert float(row(page, "asked for")[1]) == pytest.approx(requested, rel=0.05)
    assert float(row(page, "sent")[2]) == pytest.approx(sent, rel=0.1)
    if page == "ardupilot":
        others = float(row(page, "ArduPilot's other messages")[1])
        assert (requested + others) / 5760 == pytest.approx(0.8, abs=0.05)  # "four fifths" of 57600 baud


@pytest.mark.parametrize("trust", list(Trust))
def test_trust_table_in_docs_matches_the_gate(trust: Trust) -> None:
    solution = Solution(
        SECOND_NS,
        SECOND_NS,
        Mode.FIXED,
        "kalman",
        *(1.0, 0.5, 800.0, (30.0, 0.0, 0.0), (16.0, 0.0, 0.0, 16.0, 0.0, 9.0)),
        *((0.0, 0.0), (0.0, 0.0), 0, 0.0),
        trust=trust,
    )
    _, fused, reset = row("outputs", trust.name.lower())
    assert fused.split(",")[0] == reset == ("withheld" if withholding_reason(solution) else "goes out")


def test_unit_settings_in_docs_match_the_unit() -> None:
    unit = (ROOT / "deploy" / "companion.service").read_text().splitlines()
    settings = re.findall(r"`([A-Z][A-Za-z]+=[^`]+)`", PAGES["install"])
    assert len(settings) >= 6
    for setting in settings:
        assert setting in unit or setting == "ReadWritePaths=", setting
    assert "StartLimitIntervalSec=120" in unit and "StartLimitBurst=10" in unit  # "ten in two minutes"


@pytest.mark.parametrize("page", PAGES)
def test_links_in_docs_exist(page: str) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", PAGES[page]):
        assert (ROOT / "docs" / target).exists(), target


def test_every_extra_in_docs_and_errors_exists() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = set(re.findall(r"'\.\[(\w+)\]'", (ROOT / "README.md").read_text()))
    assert {"report", "plot", "logs"} <= named <= set(extras)
    for source in (*ROOT.glob("companion/**/*.py"), *ROOT.glob("sitl/*.py")):
        assert set(re.findall(r"missing_package\(.*\"(\w+)\"\)", source.read_text())) <= set(extras), source
        assert "navigation-companion[" not in source.read_text(), source  # it is not on a package index
