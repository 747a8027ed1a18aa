"""Disturbances: order of the general state, stochastic and bounded ones, what they drive."""

import math

import numpy as np
import pytest

from companion.nav import disturbances as dist
from companion.nav.discretization import discretise
from companion.nav.error_model import INS_STATES, aircraft_model


def everything() -> tuple[dist.Disturbance, ...]:
    """All kinds, the current bounded, the rest stochastic."""
    return (
        dist.gyro_drift(1 / 18e3, 5e-9),
        dist.accelerometer(1 / 180, 1e-5),
        dist.current(30.0, 1 / 3600, 10e3, bound=0.01),
        dist.gravity(30.0, 10e3, 3e-5),
    )


def test_the_general_state_in_its_order() -> None:
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    assert model.states == (
        *INS_STATES,
        *("EX", "EY", "EZ"),
        *("AX", "AY", "VcX", "VcY", "GX", "GY"),
    )
    n = len(model.states)
    assert model.A.shape == model.Q.shape == (n, n) and model.B.shape == (n, 2)


def test_a_bounded_disturbance_has_a_column_and_no_noise() -> None:
    """(1.35), (1.37): what is in B u is not in W, and the other way round."""
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    driven = model.B.any(axis=1)
    assert [s for s, d in zip(model.states, driven, strict=True) if d] == ["VcX", "VcY"]
    assert not np.diag(model.Q)[driven].any()
    np.testing.assert_array_equal(model.B.sum(axis=0), 1.0)
    np.testing.assert_array_equal(model.C, [0.01, 0.01])


def test_a_stochastic_disturbance_is_stationary_at_its_sigma() -> None:
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    step = discretise(model.A, model.Q, model.B, 10.0)
    for name, sigma in (("EX", 5e-9), ("AX", 1e-5), ("GY", 3e-5)):
        i = model.states.index(name)
        variance = step.A[i, i] ** 2 * sigma**2 + step.Q[i, i]
        assert variance == pytest.approx(sigma**2, rel=1e-9)


def test_each_drives_its_channel() -> None:
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    index = {s: i for i, s in enumerate(model.states)}
    for driven, driving in (
        *(("PX", "EX"), ("PY", "EY"), ("PZ", "EZ")),
        *(("dVN", "AX"), ("dVE", "AY"), ("dVN", "GX"), ("dVE", "GY")),
    ):
        assert model.A[index[driven], index[driving]] == 1.0
    currents = [index["VcX"], index["VcY"]]
    assert not model.A[:7, currents].any()
    assert model.A[currents[0], currents[0]] == pytest.approx(-(1 / 3600 + 30.0 / 10e3))


@pytest.mark.parametrize(
    ("decay", "sigma", "bound"), [(-1.0, 0.0, None), (1.0, math.nan, None), (1.0, 0.5, 0.1), (1.0, 0.0, -1.0)]
)
def test_bad_disturbance_is_reported_by_name(decay: float, sigma: float, bound: float | None) -> None:
    with pytest.raises(ValueError, match="EX/EY/EZ"):
        dist.Disturbance(("EX", "EY", "EZ"), decay, sigma, bound)


def test_repeated_or_unknown_name_is_rejected() -> None:
    with pytest.raises(ValueError, match="EX, EY, EZ"):
        aircraft_model(1.0, 0.0, 0.0, added=(dist.gyro_drift(1.0, 1.0), dist.gyro_drift(2.0, 1.0)))
    with pytest.raises(ValueError, match="cannot drive nowhere"):
        lost = dist.Disturbance(("x",), 1.0, drives=("nowhere",))
        aircraft_model(1.0, 0.0, 0.0, added=(lost,))
