"""Disturbances: order of the general state, stochastic and bounded ones, their feeds."""

import math

import numpy as np
import pytest

from companion.nav import disturbances as dist
from companion.nav.discretization import discretise
from companion.nav.error_model import INS_STATES, aircraft_model


def everything() -> tuple[dist.Disturbance, ...]:
    """The whole of (1.34): wind and gravity bounded, the rest stochastic."""
    return (
        dist.gyro_constant(1e-8),
        dist.gyro_drift(1 / 18e3, 5e-9),
        dist.accelerometer_fast(1 / 180, 1e-5),
        dist.accelerometer_slow(1 / 3600, 3e-5),
        dist.wind(30.0, 1 / 3600, 10e3, bound=0.01),
        dist.gravity(30.0, 10e3, bound=1e-6),
        *dist.free_gyro(0.4, 1 / 18e3, 1e-8),
        dist.radio_drift(("O1", "O2"), 1 / 600, 20.0),
    )


def test_the_general_state_in_its_order() -> None:
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    assert model.states == (
        *INS_STATES,
        *("E0X", "E0Y", "E0Z", "EX", "EY", "EZ"),
        *("AX", "AY", "AsX", "AsY"),
        *("wN", "wE", "GX", "GY"),
        *("dg", "dd", "b1", "b2", "O1", "O2"),
    )
    n = len(model.states)
    assert model.A.shape == model.Q.shape == (n, n) and model.B.shape == (n, 4) and model.sigma.shape == (n,)


def test_a_bounded_disturbance_has_a_column_and_no_noise() -> None:
    """(1.35), (1.37): what is in B u is not in W, and the other way round."""
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    driven = model.B.any(axis=1)
    assert [s for s, d in zip(model.states, driven, strict=True) if d] == ["wN", "wE", "GX", "GY"]
    assert not np.diag(model.Q)[driven].any()
    np.testing.assert_array_equal(model.B.sum(axis=0), 1.0)
    np.testing.assert_array_equal(model.C, [0.01, 0.01, 1e-6, 1e-6])


def test_a_stochastic_disturbance_is_stationary_at_its_sigma() -> None:
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    step = discretise(model.A, model.Q, model.B, 10.0)
    for name in ("EX", "AX", "AsY", "b1", "O2"):
        i = model.states.index(name)
        variance = step.A[i, i] ** 2 * model.sigma[i] ** 2 + step.Q[i, i]
        assert variance == pytest.approx(model.sigma[i] ** 2, rel=1e-9)
    constant = model.states.index("E0X")
    assert step.A[constant, constant] == pytest.approx(1.0) and step.Q[constant, constant] == 0.0
    assert model.sigma[constant] == 1e-8


def test_each_feeds_its_channel() -> None:
    model = aircraft_model(1.0, 20.0, 20.0, added=everything())
    index = {s: i for i, s in enumerate(model.states)}
    for fed, feeding in (
        *(("PX", "EX"), ("PY", "EY"), ("PZ", "EZ"), ("PX", "E0X"), ("PZ", "E0Z")),
        *(("dVN", "AX"), ("dVE", "AY"), ("dVN", "AsX"), ("dVE", "AsY"), ("dVN", "GX"), ("dVE", "GY")),
    ):
        assert model.A[index[fed], index[feeding]] == 1.0
    winds = [index["wN"], index["wE"]]
    assert not model.A[:7, winds].any()
    assert model.A[winds[0], winds[0]] == pytest.approx(-(1 / 3600 + 30.0 / 10e3))


def test_a_free_gyro_turns_by_its_drift() -> None:
    """(1.21) is a rotation by the parallactic angle: the axis moves as far as the drift turns it."""
    model = aircraft_model(1.0, 0.0, 0.0, added=dist.free_gyro(0.4, 1e-5, 1e-8))
    block = model.A[7:9, 9:11]
    np.testing.assert_allclose(block @ block.T, np.eye(2), atol=1e-15)
    np.testing.assert_allclose(block[0], [-math.cos(0.4), math.sin(0.4)], atol=1e-15)


@pytest.mark.parametrize(
    ("decay", "sigma", "bound"), [(-1.0, 0.0, None), (1.0, math.nan, None), (1.0, 0.5, 0.1), (1.0, 0.0, -1.0)]
)
def test_bad_disturbance_is_reported_by_name(decay: float, sigma: float, bound: float | None) -> None:
    with pytest.raises(ValueError, match="EX/EY/EZ"):
        dist.gyro_drift(decay, sigma, bound)


def test_repeated_or_unknown_name_is_rejected() -> None:
    with pytest.raises(ValueError, match="EX, EY, EZ"):
        aircraft_model(1.0, 0.0, 0.0, added=(dist.gyro_drift(1.0, 1.0), dist.gyro_drift(2.0, 1.0)))
    with pytest.raises(ValueError, match="cannot feed nowhere"):
        lost = dist.Disturbance(("x",), 1.0, feeds=(("nowhere", "x", 1.0),))
        aircraft_model(1.0, 0.0, 0.0, added=(lost,))
