"""Correctors of an INS: each row against the measurement of a displaced, tilted INS."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from companion.config import Config, InertialConfig
from companion.nav.geometry import Geodetic, displace, to_ecef
from companion.navigator import corrector_measurements as measured
from companion.navigator.channel import Nominal
from companion.navigator.corrected_ins import CorrectedIns, corrected_ins
from companion.navigator.inertial_track import Point
from companion.navigator.ins_channel import InsChannel
from companion.records import RangeDifference, SecondIns, StarFix
from sitl.correctors import direction

ALL = ("airspeed", "hyperbolic", "stars", "second_ins")
TRUE = Geodetic(math.radians(60.0), math.radians(30.0), 800.0)
ERROR = (400.0, -250.0)
MASTER, SECONDARY = (
    (math.radians(61.5), math.radians(26.0), 50.0),
    (math.radians(58.0), math.radians(27.0), 50.0),
)


def channel(*names: str) -> CorrectedIns:
    unit = structs.replace(InertialConfig(independent=True), correctors=names or ALL)
    found = corrected_ins(Config(inertial=unit))
    assert isinstance(found, CorrectedIns)
    return found


def ins(v_n: tuple[float, float, float] = (30.0, 20.0, 0.0)) -> Point:
    return Point(0, displace(*TRUE, *ERROR, 0.0), v_n)


def state(model: CorrectedIns, **errors: float) -> Any:
    x = np.zeros(model.n)
    for name, value in {"dx": ERROR[0], "dy": ERROR[1], **errors}.items():
        x[model.names.index(name)] = value
    return x


def test_states_of_the_correctors_follow_those_of_the_ins() -> None:
    model = channel()
    assert model.n == len(model.names) == len(set(model.names)) == 36
    assert model.prior().shape == (7, 36, 36)
    assert isinstance(corrected_ins(Config(inertial=InertialConfig(independent=True))), InsChannel)
    assert channel("stars").n == 18  # the tilt is a state of the INS


def test_transition_is_that_of_the_ins_and_of_wandering_biases() -> None:
    model = channel()
    v_n = (30.0, 20.0, 0.0)
    nominal = Nominal(Point(20_000_000_000, TRUE, v_n), (0.0, 0.0), Point(0, TRUE, v_n))
    Phi, Q = model.transition(nominal)
    np.testing.assert_allclose(Phi[:18, :18], model.ins.transition(nominal).Phi)
    assert not Phi[:18, 18:].any() and not Phi[18:, :18].any()
    np.testing.assert_allclose(Phi[24:, 24:], model.ins.transition(nominal).Phi[:12, :12])  # second unit
    assert not Phi[24:, :24].any() and not Phi[:24, 24:].any()
    k = model.names.index("chain0")
    assert Phi[k, k] == pytest.approx(math.exp(-20.0 / 3600.0), rel=1e-9)
    assert (np.linalg.eigvalsh(Q[0]) > -1e-12).all()


@pytest.mark.parametrize("centre", [(0.0, 0.0), (350.0, -200.0)])
def test_line_of_position_of_a_displaced_ins(centre: tuple[float, float]) -> None:
    model = channel()
    here = np.array(to_ecef(TRUE))
    d = [float(np.linalg.norm(here - to_ecef(Geodetic(*place)))) for place in (MASTER, SECONDARY)]
    record = RangeDifference(0, 0, 1, *MASTER, *SECONDARY, d[0] - d[1] + 70.0, 50.0)
    point = ins()
    corrected = point._replace(position=displace(*point.position, -centre[0], -centre[1], 0.0))
    rows = measured.range_difference(model, corrected, centre, record)
    predicted = rows.H @ state(
        model, chain1=-70.0
    )  # the bias is that of the INS side: computed minus measured
    assert rows.z == pytest.approx(predicted, abs=1.0)  # m, of the curvature over 500 m


@pytest.mark.parametrize(("star_lat", "star_lon"), [(20.0, -20.0), (10.0, 70.0), (50.0, 100.0)])
def test_star_against_a_tilted_ins(star_lat: float, star_lon: float) -> None:
    model = channel()
    place = math.radians(star_lat), math.radians(star_lon)
    tilt = np.array([2e-4, -3e-4, 5e-4])  # P, minus the rotation of the platform
    s_n = direction(TRUE.lat, TRUE.lon, *place)
    seen = s_n + np.cross(tilt, s_n)
    altitude, azimuth = math.asin(-seen[2] / np.linalg.norm(seen)), math.atan2(seen[1], seen[0])
    record = StarFix(0, 0, 0, *place, altitude, azimuth, 1e-4, 1e-4)
    rows = measured.star(model, ins(), (0.0, 0.0), record)
    assert rows is not None
    x = state(model, PX=tilt[0], PY=tilt[1], PZ=tilt[2])
    np.testing.assert_allclose(rows.z, rows.H @ x, atol=2e-6)  # second order in 5e-4
    assert len(measured.star(model, ins(), (0.0, 0.0), structs.replace(record, azimuth=None)).z) == 1  # type: ignore[union-attr]


def test_star_below_the_horizon_is_not_used() -> None:
    record = StarFix(0, 0, 0, math.radians(-60.0), math.radians(30.0), 0.1, None, 1e-4, 1e-4)
    assert measured.star(channel(), ins(), (0.0, 0.0), record) is None


def test_airspeed_at_a_wrong_heading_in_wind() -> None:
    model = channel()
    wind, heading, speed, PZ, dv = np.array([4.0, -6.0]), 0.7, 38.0, 2e-3, np.array([0.5, -0.3])
    air = speed * np.array([math.cos(heading), math.sin(heading)])
    v_ins = air + wind + dv
    point = ins((float(v_ins[0]), float(v_ins[1]), 0.0))
    rows = measured.airspeed(model, point, 1.01 * speed, heading + PZ, 1.0)
    x = state(model, dVN=dv[0], dVE=dv[1], wN=wind[0], wE=wind[1], PZ=PZ, scale=0.01)
    np.testing.assert_allclose(rows.z, rows.H @ x, atol=0.02)


def test_second_ins_is_compared_in_metres() -> None:
    model = channel("second_ins")
    place = displace(*TRUE, -120.0, 80.0, 0.0)
    rows = measured.second_ins(model, ins(), SecondIns(0, 0, 2, place[0], place[1]))
    np.testing.assert_allclose(rows.z, rows.H @ state(model, dx2=-120.0, dy2=80.0), atol=0.1)


def test_second_ins_is_as_coarse_as_the_grade() -> None:
    first = channel("second_ins").prior()
    unit = slice(18, 30)
    np.testing.assert_array_equal(first[:, unit, unit], first[:, :12, :12])
