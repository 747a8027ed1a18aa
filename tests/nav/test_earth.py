"""Published numbers of WGS84: NIMA TR8350.2 (2000) tables 3.1-3.4; radii by a/(1-e^2 sin^2)^(1/2) tables."""

import math

import pytest

from companion.nav import earth

micro_gal_ten = 1e-7  # m/s^2
ten_micrometres = 1e-5  # the published radii are rounded to 0.1 mm


@pytest.mark.parametrize(
    ("lat_deg", "R_N", "R_E"),
    [  # equator and poles: b^2/a, a and a^2/b of TR8350.2 table 3.3
        (0.0, 6335439.32729, 6378137.0),
        (90.0, 6399593.62576, 6399593.62576),
        (-90.0, 6399593.62576, 6399593.62576),
        (45.0, 6367381.81562, 6388838.29012),
    ],
)
def test_radii_of_curvature(lat_deg: float, R_N: float, R_E: float) -> None:
    assert earth.radii(math.radians(lat_deg)) == pytest.approx((R_N, R_E), abs=ten_micrometres)


def test_ellipsoid_constants() -> None:
    assert pytest.approx(6356752.3142, abs=5e-5) == earth.B
    assert pytest.approx(6.69437999014e-3, rel=1e-11) == earth.E2


@pytest.mark.parametrize(
    ("lat_deg", "alt", "gravity"),
    [
        (0.0, 0.0, 9.7803253359),
        (90.0, 0.0, 9.8321849378),
        (-90.0, 0.0, 9.8321849378),
        (45.0, 0.0, 9.8061977694),  # Somigliana with k = 0.00193185265241, TR8350.2 (4-1)
    ],
)
def test_normal_gravity(lat_deg: float, alt: float, gravity: float) -> None:
    assert earth.gravity(math.radians(lat_deg), alt) == pytest.approx(gravity, abs=micro_gal_ten)


@pytest.mark.parametrize("lat_deg", [0.0, 30.0, 60.0, 90.0])
def test_gravity_falls_with_height_as_the_exact_field_of_the_ellipsoid(lat_deg: float) -> None:
    assert earth.gravity(math.radians(lat_deg), 10e3) == pytest.approx(
        _exact_gravity(lat_deg, 10e3), abs=1e-6
    )


def _exact_gravity(lat_deg: float, alt: float) -> float:
    """The closed field of a rotating equipotential ellipsoid (Heiskanen and Moritz, Physical Geodesy 2-7)."""
    lat = math.radians(lat_deg)
    R_E = earth.radii(lat).R_E
    x, z = (R_E + alt) * math.cos(lat), ((1 - earth.E2) * R_E + alt) * math.sin(lat)
    E = math.sqrt(earth.A**2 - earth.B**2)

    def q_of(u: float) -> float:
        return 0.5 * ((1 + 3 * u**2 / E**2) * math.atan(E / u) - 3 * u / E)

    def potential(x: float, z: float) -> float:
        d = x * x + z * z - E * E
        u = math.sqrt(0.5 * d * (1 + math.sqrt(1 + 4 * E * E * z * z / (d * d))))
        sin2_beta = (z / u) ** 2
        rotation = earth.OMEGA**2
        return (
            earth.GM / E * math.atan(E / u)
            + 0.5 * rotation * earth.A**2 * q_of(u) / q_of(earth.B) * (sin2_beta - 1 / 3)
            + 0.5 * rotation * x * x
        )

    h = 200.0  # fourth-order differences, so that neither rounding nor truncation reaches 1e-7 m/s^2

    def slope(f: object) -> float:
        assert callable(f)
        return float(8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    g_x = slope(lambda d: potential(x + d, z))
    g_z = slope(lambda d: potential(x, z + d))
    return math.hypot(g_x, g_z)


def test_earth_rate_points_north_at_the_equator_and_along_the_vertical_at_the_poles() -> None:
    assert earth.earth_rate(0.0) == pytest.approx((earth.OMEGA, 0.0, 0.0))
    assert earth.earth_rate(math.pi / 2) == pytest.approx((0.0, 0.0, -earth.OMEGA), abs=1e-19)
    assert earth.earth_rate(-math.pi / 2) == pytest.approx((0.0, 0.0, earth.OMEGA), abs=1e-19)


def test_transport_rate_turns_the_vertical_as_the_position_moves() -> None:
    lat, alt, v_north, v_east = math.radians(60.0), 3000.0, 70.0, -120.0
    R_N, R_E = earth.radii(lat)
    lat_rate, lon_rate = v_north / (R_N + alt), v_east / ((R_E + alt) * math.cos(lat))
    expected = (lon_rate * math.cos(lat), -lat_rate, -lon_rate * math.sin(lat))
    assert earth.transport_rate(lat, alt, v_north, v_east) == pytest.approx(expected, rel=1e-14)
