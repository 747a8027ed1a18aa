"""No value that a ground station can send raises, or leaves something that cannot be sent."""

import random

import pytest

from companion.link.parameter_server import parameter_table
from sitl.endurance import parameter_sweep
from sitl.endurance.parameter_sweep import (
    CONFIGS,
    EXTREMES,
    Setting,
    at_extremes,
    at_limits,
    fly_with,
    limits,
)


def test_every_parameter_has_a_minimum_and_a_maximum_around_its_default() -> None:
    for parameter in parameter_table():
        least, greatest = limits(parameter)
        assert least <= float(parameter.value_in(CONFIGS[0])) <= greatest, parameter
        assert least < greatest < 1e7, parameter


def test_values_beyond_the_limits_change_nothing() -> None:
    greatest = {p.name: limits(p)[1] for p in parameter_table()}
    beyond = [Setting(name, 1.001 * value + 1.0) for name, value in greatest.items()]
    beyond += [
        Setting("STATUS_HZ", 1e-40),
        Setting("ODOMETRY_HZ", 4e-4),
        Setting("GNSS_SIGMA_M", EXTREMES[0]),
    ]
    assert fly_with(CONFIGS[0], beyond) == 0


def test_an_accepted_value_out_of_the_limits_fails_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameter_sweep, "limits", lambda parameter: (1.0, 2.0))
    with pytest.raises(ValueError, match=r"value=3\.5\) was accepted; its limits are 1 and 2"):
        fly_with(CONFIGS[0], [Setting("GNSS_SIGMA_M", 3.5)])


@pytest.mark.parametrize("config", CONFIGS)
def test_a_flight_survives_any_parameters(config) -> None:
    assert fly_with(config, random.Random(2).sample(at_limits() + at_extremes(), 30)) > 0
