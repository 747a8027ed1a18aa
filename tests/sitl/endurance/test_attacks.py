"""Floods do not change the rate of the output (in virtual time)."""

import pytest
from click.testing import CliRunner

from sitl.endurance import attacks
from sitl.endurance.attacks import VIRTUAL, Cost, virtual_cost


@pytest.fixture(scope="module")
def quiet_hz() -> float:
    return virtual_cost("none", 3.0).odometry_hz


@pytest.mark.parametrize("name", sorted({*VIRTUAL} - {"none", "PARAM_SET extremes"}))
def test_a_flood_does_not_change_the_output(name: str, quiet_hz: float) -> None:
    """PARAM_SET may: a station may set the rates."""
    one_message = 1.0 / 3.0
    assert abs(virtual_cost(name, 3.0).odometry_hz - quiet_hz) <= 0.05 * quiet_hz + one_message


@pytest.mark.parametrize(
    ("options", "code", "shown", "hidden"),
    [
        (["--virtual", "--only", "TIMESYNC"], 0, "TIMESYNC", "forged origin"),
        (["--virtual", "--only", "term"], 2, "not flown in virtual time", "per second"),
        (["--only", "term"], 0, "exit codes: [0]", "per second"),
    ],
)
def test_only_the_attacks_asked_for_are_printed(
    options: list[str], code: int, shown: str, hidden: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: in virtual time all, and of `term` an empty table."""
    monkeypatch.setattr(attacks, "virtual_cost", lambda name: Cost(0.1, 1.0, 10.0))
    monkeypatch.setattr(attacks, "stop_during_start", lambda times: [0])
    done = CliRunner().invoke(attacks.main, options)
    assert (done.exit_code, shown in done.output, hidden in done.output) == (code, True, False)
