"""Floods do not change the rate of the output (in virtual time)."""

import pytest

from sitl.endurance.attacks import ATTACKS, virtual_cost

FLOODS = [name for name, attack in ATTACKS.items() if not attack.tcp and not attack.first and name != "none"]


@pytest.fixture(scope="module")
def quiet_hz() -> float:
    return virtual_cost("none", 3.0).odometry_hz


@pytest.mark.parametrize("name", [name for name in FLOODS if name != "PARAM_SET extremes"])
def test_a_flood_does_not_change_the_output(name: str, quiet_hz: float) -> None:
    """PARAM_SET may: a station may set the rates."""
    one_message = 1.0 / 3.0
    assert abs(virtual_cost(name, 3.0).odometry_hz - quiet_hz) <= 0.05 * quiet_hz + one_message
