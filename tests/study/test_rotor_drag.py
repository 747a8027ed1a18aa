"""The drag of a multirotor, measured in a flight: simulated ones give it back."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given
from hypothesis import strategies as st

from companion.analysis.replay_inputs import LogInputs
from companion.config import Config
from companion.navigator.strapdown_channel import UPRIGHT, Strap, attitude_matrix, drag_force
from companion.records import Attitude, Gnss, Imu, Stamped, Vehicle
from companion.storage.reader import LogError
from companion.study import rotor_drag
from companion.study.rotor_drag import command, fit, seconds_in_flight
from companion.units import G0
from tests.recordings import recording

NS = 1_000_000_000
DATA = Path(__file__).parents[1] / "data"


@given(st.floats(0.0, 1.0), st.floats(-math.pi, math.pi), st.floats(-3.0, 3.0), st.floats(-20.0, 20.0))
def test_the_drag_of_a_level_velocity_is_the_same_at_any_tilt(
    tilt: float, towards: float, heading: float, speed: float
) -> None:
    held = Attitude(0, 0, tilt * math.sin(towards), tilt * math.cos(towards), heading, (0.0, 0.0, 0.0))
    C_nb, v = attitude_matrix(held), np.array((speed, 0.3 * speed + 1.0, 0.0))
    x, y, _ = (-0.2 * C_nb.T @ v).tolist()
    strap = Strap(Imu(0, 0, 0, (x, y, -G0), (0.0, 0.0, 0.0)), C_nb)
    assert (drag_force(strap) is None) == (C_nb[2, 2] < UPRIGHT)
    force = drag_force(strap, 0.5)
    if C_nb[2, 2] < 0.5:
        assert force is None
    else:
        np.testing.assert_allclose(force, -0.2 * v[:2], atol=1e-9)


def flown(drag: float, flying: bool = True, wavering: float = 8.0) -> list[Stamped]:
    """A copter that goes to and fro in wind, its accelerometers off by 0.1 m/s^2; GNSS once a second."""
    found: list[Stamped] = [Vehicle(0, 0, multirotor=True, flying=flying)]
    for k in range(200 * 10):
        t_ns, t = k * NS // 10, 0.1 * k
        v = np.array((wavering * math.sin(0.11 * t), 3.0 + wavering * math.sin(0.07 * t)))
        air = np.append(v - (2.0, -4.0), 0.0)
        pitch, heading = -0.03 * air[0], math.remainder(0.05 * t, math.tau)
        held = Attitude(t_ns, t_ns, 0.2 * math.sin(0.3 * t), pitch, heading, (0.0, 0.0, 0.0))
        x, y, _ = (-drag * attitude_matrix(held).T @ air).tolist()
        f_z = -G0 / attitude_matrix(held)[2, 2]
        found += [held, Imu(t_ns, t_ns, 0, (x + 0.1, y, f_z), (0.0, 0.0, 0.0))]
        if k % 10 == 0:
            found.append(Gnss(t_ns, t_ns, 0, k, 3, 0.8, 0.1, 300.0, v_n=(*v.tolist(), 0.0)))
    return found


@pytest.mark.parametrize("drag", [0.05, 0.22, 1.0])
def test_the_drag_is_measured(drag: float) -> None:
    found = fit(seconds_in_flight(flown(drag), Config()))
    assert found.drag_per_s == pytest.approx(drag, rel=0.03)
    assert abs(found.drag_per_s - drag) < 3.0 * found.sigma + 0.002
    assert found.seconds > 180


def test_only_seconds_in_flight_count() -> None:
    assert not len(seconds_in_flight(flown(0.2, flying=False), Config()).t)


def test_a_recorded_copter_has_the_drag_of_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """quad106 of InertialNav; eleven flights of nine others have 0.18 to 0.28."""
    records = list(recording("copter"))
    monkeypatch.setattr(rotor_drag, "open_inputs", lambda log, config: LogInputs(records, dict))
    done = CliRunner().invoke(command, ["quad106.bin", "--json"], catch_exceptions=False)
    found = json.loads(done.stdout)
    assert 0.17 < found["drag_per_s"] < 0.29
    assert found["sigma"] < 0.03 and found["left_m_s"] < 1.2


def test_a_flight_too_short_and_one_without_changes_of_speed_are_one_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for records, sentence in (
        (flown(0.2)[:500], "s of a multirotor's flight"),
        (flown(0.002, wavering=0.01), "is not known to 25%: choose a flight with more changes"),
    ):
        monkeypatch.setattr(rotor_drag, "open_inputs", lambda log, config, r=records: LogInputs(r, dict))
        with pytest.raises(LogError, match=sentence):
            CliRunner().invoke(command, ["flight.bin"], catch_exceptions=False)
