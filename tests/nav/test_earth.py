"""Published numbers of WGS84: NIMA TR8350.2 (2000) tables 3.1-3.4; radii by a/(1-e^2 sin^2)^(1/2) tables."""

import math

import pytest

from companion.nav import earth

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
