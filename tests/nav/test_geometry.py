"""Geometry: golden values, inverses, flat earths of the autopilots, lines of sight."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from companion.nav import earth
from companion.nav.geometry import (
    Geodetic,
    displace,
    enu_axes,
    from_ecef,
    from_enu,
    geodetic_to_local,
    local_to_geodetic,
    radio_horizon,
    rotation_matrix,
    separation,
    slant_range_azimuth,
    to_ecef,
    to_enu,
    wrap_angle,
)
from companion.records import Projection

micrometre = 1e-6
projections: list[Projection] = ["ardupilot", "px4", "tangent"]

latitudes = st.floats(-math.pi / 2, math.pi / 2)
longitudes = st.floats(-math.pi, math.pi, exclude_max=True)
points = st.builds(Geodetic, latitudes, longitudes, st.floats(-5e3, 5e5))
away_from_poles = st.builds(Geodetic, st.floats(-1.4, 1.4), longitudes, st.floats(-100.0, 2e4))


def degrees(lat: float, lon: float, alt: float) -> Geodetic:
    return Geodetic(math.radians(lat), math.radians(lon), alt)


@pytest.mark.parametrize(
    ("point", "xyz", "tolerance"),
    [
        # pymap3d's tests (test_geodetic.py, BSD-2-Clause), themselves checked there against pyproj
        (degrees(42, -82, 200), (660675.2518247, -4700948.68316, 4245737.66222), 1e-5),
        (degrees(0, 0, -1), (6378136.0, 0.0, 0.0), micrometre),
        (degrees(0, 90, -1), (0.0, 6378136.0, 0.0), micrometre),
        (degrees(0, -90, -1), (0.0, -6378136.0, 0.0), micrometre),
        (degrees(90, 0, -1), (0.0, 0.0, 6356751.314245179), micrometre),
        (degrees(-90, 0, -1), (0.0, 0.0, -6356751.314245179), micrometre),
        (degrees(0, -180, 0), (-6378137.0, 0.0, 0.0), micrometre),
    ],
)
def test_ecef_golden_values(point: Geodetic, xyz: tuple[float, float, float], tolerance: float) -> None:
    np.testing.assert_allclose(to_ecef(point), xyz, atol=tolerance)
    back = from_ecef(np.array(xyz))
    assert back.lat == pytest.approx(point.lat, abs=1e-12)
    assert back.alt == pytest.approx(point.alt, abs=tolerance)
    if abs(point.lat) < 1.5:
        assert wrap_angle(back.lon - point.lon) == pytest.approx(0.0, abs=1e-12)


@given(points)
@settings(max_examples=300)
def test_ecef_there_and_back_within_a_micrometre(point: Geodetic) -> None:
    r_e = to_ecef(point)
    back = from_ecef(r_e)
    np.testing.assert_allclose(to_ecef(back), r_e, rtol=0.0, atol=micrometre)
    assert back.alt == pytest.approx(point.alt, abs=micrometre)


def test_centre_of_the_earth_is_rejected() -> None:
    with pytest.raises(ValueError, match="centre of the earth"):
        from_ecef(np.array([100.0, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "east", "north", "up"),
    [
        (0.0, 0.0, (0, 1, 0), (0, 0, 1), (1, 0, 0)),
        (90.0, 0.0, (0, 1, 0), (-1, 0, 0), (0, 0, 1)),
        (0.0, 180.0, (0, -1, 0), (0, 0, 1), (-1, 0, 0)),
        (-90.0, 0.0, (0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ],
)
def test_axes_at_the_cardinal_places(
    lat_deg: float, lon_deg: float, east: object, north: object, up: object
) -> None:
    axes = enu_axes(math.radians(lat_deg), math.radians(lon_deg))
    np.testing.assert_allclose(axes, [east, north, up], atol=1e-15)


def test_line_of_sight_of_pymap3d() -> None:
    """aer (33, 70, 1000) from (42, -82, 200): pymap3d's tests (test_aer.py, test_enu.py), BSD-2-Clause."""
    origin = degrees(42, -82, 200)
    point = from_enu(np.array([186.277521, 286.842228, 939.692621]), origin)
    assert math.degrees(point.lat) == pytest.approx(42.002582, abs=5e-7)
    assert math.degrees(point.lon) == pytest.approx(-81.997752, abs=5e-7)
    assert point.alt == pytest.approx(1139.7018, abs=1e-3)
    sight = slant_range_azimuth(origin, point)
    assert math.degrees(sight.azimuth) == pytest.approx(33.0, abs=1e-6)
    assert math.degrees(sight.elevation) == pytest.approx(70.0, abs=1e-6)
    assert sight.slant_range == pytest.approx(1000.0, abs=2e-5)


@given(points, points)
@settings(max_examples=200)
def test_enu_there_and_back(point: Geodetic, origin: Geodetic) -> None:
    try:
        back = from_enu(to_enu(point, origin), origin)
    except ValueError:
        return
    np.testing.assert_allclose(to_ecef(back), to_ecef(point), rtol=0.0, atol=micrometre)


@given(away_from_poles, st.tuples(*[st.floats(-2e3, 2e3)] * 3))
@settings(max_examples=200)
def test_separation_undoes_displace(at: Geodetic, ned: tuple[float, float, float]) -> None:
    moved = displace(*at, *ned)
    np.testing.assert_allclose(separation(moved, at), ned, rtol=0.0, atol=1e-8)


@given(away_from_poles, st.floats(0.0, math.tau), st.floats(0.0, 300.0))
@settings(max_examples=200)
def test_displace_agrees_with_the_tangent_plane_to_its_first_order(
    at: Geodetic, azimuth: float, d: float
) -> None:
    north, east = d * math.cos(azimuth), d * math.sin(azimuth)
    e, n, _ = to_enu(displace(*at, north, east, 0.0), at)
    assert math.hypot(e - east, n - north) <= d * d * (1.0 + abs(math.tan(at.lat))) / 6.3e6 + micrometre


@pytest.mark.parametrize("projection", projections)
@given(
    origin=away_from_poles,
    ned=st.tuples(st.floats(-5e4, 5e4), st.floats(-5e4, 5e4), st.floats(-1e4, 1e4)),
)
@settings(max_examples=150)
def test_local_positions_there_and_back(
    projection: Projection, origin: Geodetic, ned: tuple[float, float, float]
) -> None:
    x_n = np.array(ned)
    point = local_to_geodetic(projection, origin, x_n)
    np.testing.assert_allclose(geodetic_to_local(projection, origin, point), x_n, rtol=0.0, atol=2e-6)


@pytest.mark.parametrize("projection", projections)
def test_local_positions_across_the_antimeridian(projection: Projection) -> None:
    origin = degrees(-17.0, 179.999, 10.0)
    point = local_to_geodetic(projection, origin, np.array([0.0, 1000.0, -5.0]))
    assert -math.pi <= point.lon < math.radians(-179.99)
    np.testing.assert_allclose(
        geodetic_to_local(projection, origin, point), [0.0, 1000.0, -5.0], rtol=0.0, atol=2e-6
    )


def test_ardupilot_in_its_own_integer_arithmetic() -> None:
    """Location::offset_latlng as written: integers of 1e-7 degree, factors of AP_Common/Location.h."""
    lat, lng, north, east = -353632621, 1491652374, 12345.6, -7890.1
    dlat = int(north * 89.83204953368922)
    dlng = int(east * 89.83204953368922 / math.cos(math.radians((lat + dlat / 2) * 1e-7)))
    point = local_to_geodetic(
        "ardupilot", degrees(lat * 1e-7, lng * 1e-7, 584.0), np.array([north, east, -100.0])
    )
    assert math.degrees(point.lat) * 1e7 == pytest.approx(lat + dlat, abs=1.01)
    assert math.degrees(point.lon) * 1e7 == pytest.approx(lng + dlng, abs=1.01)
    assert point.alt == 684.0


def test_px4_formula_of_map_projection_project() -> None:
    """MapProjection::project as written, acos and all, 20 km away where its rounding is below 0.1 mm."""
    origin, point = degrees(47.397742, 8.545594, 488.0), degrees(47.5, 8.75, 500.0)
    d_lon = point.lon - origin.lon
    c = math.acos(
        math.sin(origin.lat) * math.sin(point.lat)
        + math.cos(origin.lat) * math.cos(point.lat) * math.cos(d_lon)
    )
    k = c / math.sin(c) * 6371000.0
    x = k * (
        math.cos(origin.lat) * math.sin(point.lat)
        - math.sin(origin.lat) * math.cos(point.lat) * math.cos(d_lon)
    )
    y = k * math.cos(point.lat) * math.sin(d_lon)
    np.testing.assert_allclose(geodetic_to_local("px4", origin, point), [x, y, -12.0], atol=1e-4)


def test_px4_at_its_origin() -> None:
    origin = degrees(47.0, 8.0, 488.0)
    assert local_to_geodetic("px4", origin, np.zeros(3)) == origin
    np.testing.assert_array_equal(geodetic_to_local("px4", origin, origin), np.zeros(3))


@pytest.mark.parametrize("lat_deg", range(1, 90))
def test_px4_reaches_a_pole(lat_deg: int) -> None:
    for sign in (1.0, -1.0):
        origin = degrees(sign * lat_deg, 8.0, 0.0)
        north = (sign * math.pi / 2 - origin.lat) * 6371000.0
        pole = local_to_geodetic("px4", origin, (north, 0.0, 0.0))
        assert pole.lat == pytest.approx(sign * math.pi / 2, abs=1e-7)


def test_the_flat_earths_disagree_by_more_than_a_beacon_error() -> None:
    """Why the projection is an input: 100 km north of the origin they are hundreds of metres apart."""
    origin, x_n = degrees(50.0, 10.0, 0.0), np.array([100e3, 0.0, 0.0])
    lats = [local_to_geodetic(p, origin, x_n).lat * earth.A for p in projections]
    assert max(lats) - min(lats) > 100.0


def test_unknown_projection_is_reported() -> None:
    with pytest.raises(ValueError, match=r"'betaflight'.*ardupilot, px4 or tangent"):
        local_to_geodetic("betaflight", degrees(0, 0, 0), np.zeros(3))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("lat_deg", "lon_deg", "azimuth_deg"),
    [(60.5, 30.0, 0.0), (59.5, 30.0, 180.0)],
)
def test_azimuth_is_counted_from_north_clockwise_at_the_beacon(
    lat_deg: float, lon_deg: float, azimuth_deg: float
) -> None:
    beacon = degrees(60.0, 30.0, 0.0)
    sight = slant_range_azimuth(beacon, degrees(lat_deg, lon_deg, 3000.0))
    assert math.degrees(sight.azimuth) == pytest.approx(azimuth_deg, abs=1e-9)
    assert 0.0 < math.degrees(slant_range_azimuth(beacon, degrees(60.0, 30.5, 0.0)).azimuth) < 90.0
    assert 270.0 < math.degrees(slant_range_azimuth(beacon, degrees(60.0, 29.5, 0.0)).azimuth) < 360.0


def test_radio_horizon_is_the_tangent_line_over_the_four_thirds_earth() -> None:
    """The well-known 4.12 (sqrt h1 + sqrt h2) km (ITU-R P.528, ICAO Annex 10 attachment)."""
    assert radio_horizon(10.0, 1000.0) == pytest.approx(
        4.12e3 * (math.sqrt(10.0) + math.sqrt(1000.0)), rel=1e-3
    )
    assert radio_horizon(10.0, -5.0) == radio_horizon(10.0, 0.0) == radio_horizon(0.0, 10.0)


@given(st.floats(-1e3, 1e3))
def test_wrap(angle: float) -> None:
    assert -math.pi <= wrap_angle(angle) < math.pi
    assert math.remainder(wrap_angle(angle) - angle, math.tau) == pytest.approx(0.0, abs=1e-12)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3))
def test_rotation_is_the_exponential_of_its_vector(v: tuple[float, float, float]) -> None:
    x, y, z = v
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    np.testing.assert_allclose(rotation_matrix(np.array(v)), expm(cross), atol=1e-14)


def test_rotation_is_continuous_at_the_end_of_the_series() -> None:
    for angle in (1e-9, 9.99e-3, 1.001e-2, 1.0):
        s, c = math.sin(angle), math.cos(angle)
        np.testing.assert_allclose(
            rotation_matrix(np.array([0.0, 0.0, angle])),
            [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]],
            atol=1e-16,
        )
