"""The system's clock may be set at any moment: nothing that navigates looks at it."""

import ast
import time
from pathlib import Path

import pytest

from companion.config import load
from companion.records import Solution
from sitl import loopback
from sitl.scenarios import named

PACKAGE = Path(__file__).parents[1] / "companion"
#: The shell (log names, signatures), and what measures or belongs to no flight.
MAY_LOOK = {"service.py", "keys.py", "link/rsbn_dialect.py"}
WALL = {("time", "time"), ("time", "time_ns"), ("datetime", "now"), ("datetime", "utcnow"), ("date", "today")}


def looks_at_the_wall(path: Path) -> bool:
    return any(
        isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and (node.value.id, node.attr) in WALL
        for node in ast.walk(ast.parse(path.read_text()))
    )


def test_only_the_shell_asks_for_the_time_of_day() -> None:
    found = {str(path.relative_to(PACKAGE)) for path in PACKAGE.rglob("*.py") if looks_at_the_wall(path)}
    assert {name for name in found if not name.startswith(("bench/", "doctor"))} <= MAY_LOOK
    assert "service.py" in found  # the search finds what is there


def test_a_system_clock_that_leaps_changes_no_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario, config = named("short"), loopback.simulated(load(None, {}, {}))
    calm = [r for r in loopback.fly(scenario, config).kept if isinstance(r, Solution)]
    true, leaps = time.time_ns, iter(range(10**9))
    monkeypatch.setattr(time, "time_ns", lambda: true() + (-1) ** next(leaps) * 3600 * 10**9)
    monkeypatch.setattr(time, "time", lambda: time.time_ns() * 1e-9)
    leapt = [r for r in loopback.fly(scenario, config).kept if isinstance(r, Solution)]
    assert leapt == calm
