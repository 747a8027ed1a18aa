"""Inferred local origin: the local position relative to it is the global position, in every projection."""

import math

import pytest

from companion.nav.geometry import Geodetic, local_to_geodetic, separation
from companion.navigator.local_origin import LIVE_WINDOW_NS, LOG_WINDOW_NS, infer_origin
from companion.records import GlobalPosition, LocalPosition, Projection

V_N = (30.0, -20.0, 1.0)
one_millimetre = 1e-3


def positions(
    origin: Geodetic, x_n: tuple[float, float, float], projection: Projection, apart_ns: int
) -> tuple[LocalPosition, GlobalPosition]:
    """A local position, and the global position of the same aircraft `apart_ns` later."""
    later = tuple(x + v * apart_ns * 1e-9 for x, v in zip(x_n, V_N, strict=True))
    point = local_to_geodetic(projection, origin, later)
    return LocalPosition(0, 5, x_n, V_N), GlobalPosition(apart_ns, apart_ns + 3, *point, V_N, 0.0)


@pytest.mark.parametrize("projection", ["ardupilot", "px4", "tangent"])
@pytest.mark.parametrize("lat_deg", [0.0, -35.0, 60.0])
@pytest.mark.parametrize("lon_deg", [10.0, 179.99])
def test_origin_is_inferred_far_from_it(projection: Projection, lat_deg: float, lon_deg: float) -> None:
    origin = Geodetic(math.radians(lat_deg), math.radians(lon_deg), 100.0)
    local, known = positions(origin, (8000.0, 9000.0, -300.0), projection, 40_000_000)
    found = infer_origin(local, known, projection, LIVE_WINDOW_NS)
    assert found is not None
    assert (found.t_ns, found.rx_ns, found.projection) == (known.t_ns, known.rx_ns, projection)
    error = separation(Geodetic(found.lat, found.lon, found.alt_msl), origin)
    assert math.hypot(*error) < one_millimetre


@pytest.mark.parametrize("window_ns", [LIVE_WINDOW_NS, LOG_WINDOW_NS])
def test_positions_too_far_apart_in_time_give_no_origin(window_ns: int) -> None:
    origin = Geodetic(0.9, 0.5, 0.0)
    for apart_ns, inferred in ((window_ns, True), (window_ns + 1, False), (-window_ns - 1, False)):
        local, known = positions(origin, (10.0, 20.0, -30.0), "tangent", apart_ns)
        assert (infer_origin(local, known, "tangent", window_ns) is not None) is inferred
