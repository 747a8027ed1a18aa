"""Wall clock: it may be set at any moment, so navigation never reads it."""

import ast
import time
from dataclasses import replace
from pathlib import Path

import pytest

from companion.config import load
from companion.records import Solution
from sitl import loopback
from sitl.scenarios import get_scenario

PACKAGE = Path(__file__).parents[1] / "companion"
#: The shell (log names, signatures) and generated code.
ALLOWED = {
    "runtime/service.py",
    "runtime/signing_key.py",
    "link/generated/rsbn_dialect.py",
    "analysis/live/follow.py",  # shows how old a log's last write is
}
WALL = {("time", "time"), ("time", "time_ns"), ("datetime", "now"), ("datetime", "utcnow"), ("date", "today")}


def reads_wall_clock(path: Path) -> bool:
    text = path.read_text()
    return any(".".join(name) in text for name in WALL) and any(  # to parse all takes a second
        isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and (node.value.id, node.attr) in WALL
        for node in ast.walk(ast.parse(text))
    )


def test_only_the_shell_reads_the_wall_clock() -> None:
    found = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if reads_wall_clock(path)}
    assert {name for name in found if not name.startswith(("bench/", "doctor"))} <= ALLOWED
    assert "runtime/service.py" in found  # the search works


@pytest.mark.flight
def test_jumping_system_clock_changes_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    short, config = get_scenario("short"), loopback.simulator_config(load(None, {}, {}))
    scenario = replace(short, plan=replace(short.plan, legs=short.plan.legs[:2]))
    reference = [r for r in loopback.fly_scenario(scenario, config).records if isinstance(r, Solution)]
    true, jumps = time.time_ns, iter(range(10**9))
    monkeypatch.setattr(time, "time_ns", lambda: true() + (-1) ** next(jumps) * 3600 * 10**9)
    monkeypatch.setattr(time, "time", lambda: time.time_ns() * 1e-9)
    jumped = [r for r in loopback.fly_scenario(scenario, config).records if isinstance(r, Solution)]
    assert jumped == reference
