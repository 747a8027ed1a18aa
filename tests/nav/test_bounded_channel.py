"""Bounded errors of an INS: transition against the simulator's integrator, force against samples."""

import math

import numpy as np
import pytest

from companion.nav.bounded_channel import BoundedDrift, BoundedIns, Motion, UnitErrors, WanderingForce
from companion.units import G0
from sitl.bound_study import STEP_S, fly
from sitl.sensors import propagate

UNIT = UnitErrors(4.8e-8, 18_000.0, 5.8e-7, 50e-6 * G0, 3600.0, 2e-4, 0.5, 1e-4, 9e-4, 1e-4, 3e-4)


@pytest.mark.parametrize("path", ["straight", "turns", "orbit"])
@pytest.mark.parametrize("start", [2, 4, 6, 7, 9, 10])
def test_transition_is_the_simulator_s(path: str, start: int) -> None:
    """Ten minutes of one initial error or constant sensor error, at 45 deg, in steps of a second."""
    flight = fly("jet", path, 45.0, 600.0)
    law, x = BoundedIns(UNIT), np.zeros(15)
    size = law.prior()[start]
    x[start] = size
    initial, drive = np.zeros(7), np.zeros((len(flight.t), 7))
    if start < 7:
        initial[start] = size
    else:
        heading = flight.attitude[:, 2] - flight.attitude[0, 2]
        where = 4 if start < 10 else 2
        if start == 9:
            drive[:, 6] = size
        else:
            drive[:, where], drive[:, where + 1] = size * np.cos(heading), size * np.sin(heading)
    truth = propagate(flight, initial, drive)[-1, :4]
    v, per_step = flight.v_n, round(1.0 / STEP_S)
    for k in range(0, len(flight.t) - 2, per_step):
        motion = Motion(
            float(flight.lat[k]), tuple(v[k, :2].tolist()), tuple(v[k + per_step, :2].tolist()), 1.0
        )
        x = law.step(motion)[0] @ x
    assert np.hypot(*(x[:2] - truth[:2])) < 0.04 * np.hypot(*truth[:2]) + 0.02
    assert np.hypot(*(x[2:4] - truth[2:])) < 0.04 * np.hypot(*truth[2:]) + 2e-4


def test_unit_force_is_an_acceleration() -> None:
    Phi, B, Q = BoundedIns(UNIT).step(Motion(0.8, (10.0, 0.0), (10.0, 0.0), 10.0))
    np.testing.assert_allclose(B[:4], [[50.0, 0.0], [0.0, 50.0], [10.0, 0.0], [0.0, 10.0]], atol=0.03)
    assert Phi.shape == Q.shape == (15, 15)


def test_wandering_force_has_the_variance_of_its_samples() -> None:
    """Random walk of the tilt, drift and bias relative to the anchor, from 4000 simulated histories."""
    rng, dt, n, many = np.random.default_rng(5), 20.0, 75, 4000
    drift = np.cumsum(rng.normal(0.0, UNIT.gyro * math.sqrt(2.0 * dt / UNIT.gyro_s), (many, n)), axis=1)
    tilt = np.cumsum(rng.normal(0.0, UNIT.tilt_walk * math.sqrt(dt), (many, n)) + drift * dt, axis=1)
    phi = math.exp(-dt / UNIT.accelerometer_s)
    bias = np.zeros((many, n + 1))
    bias[:, 0] = rng.normal(0.0, UNIT.accelerometer, many)
    for k in range(n):
        step = rng.normal(0.0, UNIT.accelerometer * math.sqrt(1.0 - phi**2), many)
        bias[:, k + 1] = phi * bias[:, k] + step
    force = G0 * tilt + bias[:, 1:] - bias[:, :1]
    age = dt * np.arange(1.0, n + 1.0)
    walk = WanderingForce(UNIT._replace(velocity_walk=0.0))
    covariance = walk.covariance(age)
    np.testing.assert_allclose(walk.bound(age[10:]), force.std(axis=0)[10:], rtol=0.06)
    np.testing.assert_allclose(np.sqrt(covariance.diagonal()), walk.bound(age), rtol=1e-9)
    sampled = np.cov(force[:, 10::20].T)
    np.testing.assert_allclose(covariance[10::20, 10::20], sampled, rtol=0.12)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    np.testing.assert_allclose(walk.bound(-age), walk.bound(age))


def test_dead_reckoning_errors_turn_with_the_course() -> None:
    """A circle flown with a scale error comes back to where it began; a straight line does not."""
    law = BoundedDrift(0.0, 0.05, scale=0.03, heading=0.02)
    circle = line = np.array([0.0, 0.0, 0.0, 0.0, 0.03, 0.02])
    for k in range(360):
        a, b = math.radians(k), math.radians(k + 1)
        before, after = (30.0 * math.cos(a), 30.0 * math.sin(a)), (30.0 * math.cos(b), 30.0 * math.sin(b))
        circle = law.step(Motion(0.8, before, after, 1.0))[0] @ circle
        line = law.step(Motion(0.8, (30.0, 0.0), (30.0, 0.0), 1.0))[0] @ line
    assert np.hypot(*circle[:2]) < 1e-9
    np.testing.assert_allclose(line[:2], [30.0 * 360.0 * 0.03, 30.0 * 360.0 * 0.02])
