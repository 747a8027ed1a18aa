"""The system's clock may be set at any moment: nothing that navigates looks at it."""

import ast
import time
from pathlib import Path

import pytest

from companion.config import load
from companion.link.signing import Signing
from companion.records import Solution
from companion.service import SET_AFTER_NS, Keys
from sitl import loopback
from sitl.scenarios import named

PACKAGE = Path(__file__).parents[1] / "companion"
#: The shell (log names, signatures), and what measures or belongs to no flight.
MAY_LOOK = {"service.py", "link/rsbn_dialect.py"}
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


def test_a_clock_that_was_never_set_is_not_followed_and_one_set_in_flight_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board without a battery wakes in 1970: by such a clock every genuine frame would be of the future."""
    monkeypatch.setattr(time, "time_ns", lambda: 3600 * 10**9)
    keys = Keys(Signing(bytes(32)), tmp_path / "stamp")
    assert keys.signing.time(time.monotonic_ns()) == 0
    monkeypatch.setattr(time, "time_ns", lambda: SET_AFTER_NS + 10**9)
    keys.follow()
    assert keys.signing.time(time.monotonic_ns()) > 0
