"""Documentation against the code: configurations, parameters, rates, times and link budgets."""

import re
import tomllib
from pathlib import Path

import pytest

from companion.analysis import error_statistics
from companion.analysis.summary import is_worse_than_inertial
from companion.config import Config, load, parse, to_toml
from companion.config.profiles import MESSAGES, PROFILES
from companion.config.required_parameters import required_parameters
from companion.estimate import bank
from companion.link.decode import DECODED
from companion.link.dialect import TYPES, rsbn, type_named
from companion.link.parameter_server import parameter_table
from companion.navigator import own_channel, own_error_model
from companion.output import source_table
from companion.output.gate import MAX_AGE_S, withholding_reason
from companion.records import Trust
from companion.runtime.links import requested_rates
from companion.units import SECOND_NS
from tests.solutions import solution_at

ROOT = Path(__file__).parents[1]
PAGES = {path.stem: path.read_text() for path in (ROOT / "docs").glob("*.md")}
FRONT = ("README", "ARCHITECTURE", "CONTRIBUTING", "CHANGELOG", "examples/README")
OVERHEAD = 12  # bytes of a MAVLink 2 frame round its payload
LACKING = {"ardupilot": {"HIGHRES_IMU", "GPS2_RAW"}, "px4": {"RAW_IMU", "EKF_STATUS_REPORT", "GPS2_RAW"}}
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
        (stated,) = re.findall(r"fills ([\d.]+) of 57600 baud", PAGES[page])
        assert (requested + others) / 5760 == pytest.approx(float(stated), abs=0.02)


@pytest.mark.parametrize("trust", list(Trust))
def test_trust_table_in_docs_matches_the_gate(trust: Trust) -> None:
    _, fused, reset = row("outputs", trust.name.lower())
    is_withheld = withholding_reason(solution_at(SECOND_NS, trust=trust)) is not None
    assert fused.split(",")[0] == reset == ("withheld" if is_withheld else "goes out")


def test_unit_settings_in_docs_match_the_unit() -> None:
    unit = (ROOT / "deploy" / "companion.service").read_text().splitlines()
    settings = re.findall(r"`([A-Z][A-Za-z]+=[^`]+)`", PAGES["install"])
    assert len(settings) >= 6
    for setting in settings:
        assert setting in unit or setting == "ReadWritePaths=", setting
    assert "StartLimitIntervalSec=120" in unit and "StartLimitBurst=10" in unit  # "ten in two minutes"


@pytest.mark.parametrize("page", [*(f"docs/{name}" for name in PAGES), *FRONT])
def test_links_exist(page: str) -> None:
    path = ROOT / f"{page}.md"
    for target in re.findall(r"\]\(([^)#]+)\)", path.read_text()):
        assert target.startswith("https:") or (path.parent / target).exists(), target


def test_every_page_is_in_the_site_and_the_front_pages_in_the_readme() -> None:
    readme, site = (ROOT / "README.md").read_text(), (ROOT / "mkdocs.yml").read_text()
    for path in (ROOT / "docs").rglob("*.md"):
        assert f" {path.relative_to(ROOT / 'docs')}\n" in site, path
    for page in ("docs/index", "docs/tutorial", *FRONT[1:]):
        assert f"({page}.md)" in readme, page


def test_readme_is_a_screen_and_a_bit_and_architecture_a_short_read() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 90
    assert len((ROOT / "ARCHITECTURE.md").read_text().splitlines()) <= 200


def known_keys() -> set[str]:
    return {
        f"{section}.{key}" for section, table in tomllib.loads(to_toml(Config())).items() for key in table
    }


@pytest.mark.parametrize("page", [*(f"docs/{name}" for name in PAGES), "README"])
def test_configuration_keys_in_docs_exist(page: str) -> None:
    keys = known_keys()
    sections = {key.partition(".")[0] for key in keys}
    for section, key in re.findall(r"`(\w+)\.([a-z]\w*)(?: =[^`]*)?`", (ROOT / f"{page}.md").read_text()):
        if section in sections and key not in ("py", "service"):
            assert f"{section}.{key}" in keys, f"{section}.{key}"


def test_files_and_functions_in_architecture_exist() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    folders = [
        "",
        "companion",
        *(f"companion/{p.name}" for p in (ROOT / "companion").iterdir() if p.is_dir()),
    ]
    for name in set(re.findall(r"`((?:\w+/)*\w+\.(?:py|xml|toml|md))\b", text)):
        assert any((ROOT / folder / name).exists() for folder in folders), name
    source = "\n".join(path.read_text() for path in ROOT.glob("companion/**/*.py"))
    for name in set(re.findall(r"`(?:[\w/]+\.)?(_?[a-z]\w+)(?:\(\w*\))?`", text)) - {"make", "lint"}:
        if "_" in name.strip("_") or name.startswith("_"):
            assert re.search(rf"\b{name}\b", source), name


def conditions_by_set(page: str) -> dict[str, str]:
    """Of the table of source sets: condition by set, in one string each."""
    found: dict[str, str] = {}
    name = ""
    for cells in rows(page):
        if len(cells) == 2 and (cells[0].startswith("set ") or (not cells[0] and name)):
            name = cells[0] or name
            found[name] = found.get(name, "") + " " + cells[1]
        else:
            name = ""
    return found


def test_source_set_table_in_docs_has_the_times_of_the_code() -> None:
    table = conditions_by_set("ardupilot")
    seconds = {
        name: [float(x) for x in re.findall(r"\*\*([\d.]+) s\*\*", text)] for name, text in table.items()
    }
    assert seconds["set 2"] == [source_table.STEADY_S, source_table.NO_FIX_S, source_table.SILENT_S]
    assert seconds["set 1"] == [source_table.FIX_S, source_table.STOPPED_S]
    for name, predicates in (("set 2", source_table.TO_COMPANION), ("set 1", source_table.TO_GNSS)):
        for predicate in predicates:
            assert f"EKF source {name}: {predicate.reason}" in table[name]
    assert f"above {source_table.FALSE}" in table["set 2"]
    assert f"below {source_table.BELIEVED}" in table["set 1"]


def test_drivers_in_docs_are_those_of_the_own_channel() -> None:
    named = [(cells[0].strip("`"), cells[2]) for cells in rows("estimators") if cells[0].startswith("`")]
    drivers = [(by, f"{own_channel.SILENT_NS[by] / 1e9:g} s") for by in own_channel.ORDER]
    assert named == [*drivers, *((by, "") for by in own_error_model.HELD)]


def test_probabilities_in_docs_are_the_settings_of_the_bank() -> None:
    settings, text = bank.Settings(), " ".join(PAGES["estimators"].split())
    assert f"the source is false is above {settings.suspect:g}" in text
    assert f"**Excluded**: above {settings.excluded:g}" in text
    assert f"again: below {settings.believed:g}" in text
    assert settings.hysteresis == 9.0
    assert "nine times as probable" in text


def test_limit_against_the_inertial_channel_in_docs() -> None:
    limit = (
        r"phase of (\d+) s or more was above ([\d.]+) times that of the inertial channel alone plus (\d+) m"
    )
    ((seconds, times, more),) = re.findall(limit, PAGES["report"])

    def is_worse(seconds: float, error: float) -> bool:
        rms = {error_statistics.INS: 10.0, error_statistics.CORRECTED: error}
        return is_worse_than_inertial(error_statistics.PhaseErrors("neither", seconds, rms, {}, *(None,) * 5))

    largest = 10.0 * float(times) + float(more)
    assert is_worse(float(seconds), largest + 0.01)
    assert not is_worse(float(seconds), largest - 0.01)
    assert not is_worse(float(seconds) - 1.0, 10.0 * largest)


@pytest.mark.parametrize(
    "text",
    [
        "fixes of the window contradict the stated errors: guaranteed bound 4.2 times wider",
        "autopilot 1 silent for 5 s",
        "no solution for 3 s: no data from the inertial channel",
        f"ODOMETRY withheld: position is older than {MAX_AGE_S:g} s",
    ],
)
def test_troubleshooting_has_the_text_of_the_code(text: str) -> None:
    assert row("troubleshooting", f"`{text}`")
    source = "\n".join(path.read_text() for path in ROOT.glob("companion/**/*.py"))
    for part in re.split(r"[\d.]+|ODOMETRY|: ", text):  # without what is filled in
        assert part in source


def test_every_extra_in_docs_and_errors_exists() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = set(re.findall(r"'\.\[(\w+)\]'", PAGES["install"]))
    assert {"report", "plot", "fleet", "campaign"} <= named <= set(extras)
    for source in (*ROOT.glob("companion/**/*.py"), *ROOT.glob("sitl/*.py")):
        assert set(re.findall(r"missing_package\(.*\"(\w+)\"\)", source.read_text())) <= set(extras), source
        assert "navigation-companion[" not in source.read_text(), source  # it is not on a package index


def test_parameters_in_docs_are_those_of_the_server() -> None:
    named = [cells for cells in rows("ground-station") if re.fullmatch(r"`[A-Z_]+`", cells[0])]
    assert [(cells[0].strip("`"), tuple(cells[1].strip("`").split("."))) for cells in named] == [
        (parameter.name, (parameter.section, parameter.key)) for parameter in parameter_table()
    ]


def test_messages_in_docs_are_those_of_the_code_at_their_rates() -> None:
    received, sent = PAGES["messages"].split("## Sent")
    named = set(re.findall(r"\b[A-Z][A-Z0-9]*_[A-Z0-9_]+\b", received)) | {
        "ATTITUDE",
        "AIRSPEED",
        "WIND",
        "HEARTBEAT",
    }
    assert {TYPES[msgid].name for msgid in DECODED} <= named
    for cells in rows("messages"):
        for name in re.findall(r"[A-Z0-9_]+", cells[0]):
            if (hz := requested_rates(profile("ardupilot", "output.via=gps_input")).get(name)) and cells[1]:
                assert float(cells[1]) == hz, name
    for message in MESSAGES.values():
        assert message in sent, message


@pytest.mark.parametrize("name", [TYPES[n].name for n in sorted(rsbn.mavlink_map) if n >= 180000])
def test_fields_of_private_messages_in_docs_are_all_of_them(name: str) -> None:
    (table,) = re.findall(rf"^{name} .*?\n\n((?:\|.*\n)+)", PAGES["messages"], re.MULTILINE)
    named = [field for line in table.splitlines() for field in re.findall(r"`(\w+)`", line.split("|")[1])]
    assert sorted(named) == sorted(field.name for field in type_named(name).fields)


@pytest.mark.parametrize("name", ["estimate", "nav"])
def test_api_pages_show_examples(name: str) -> None:
    shown = re.findall(r'^--8<-- "(.*)"$', (ROOT / "docs" / "api" / f"{name}.md").read_text(), re.MULTILINE)
    assert shown and all((ROOT / path).exists() for path in shown)
