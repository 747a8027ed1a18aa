"""What a radio measurement says about the inertial error: records in, observations and fixes out.

Everything is brought into the plane tangent at the INS position of the same instant, through ECEF, so that a
beacon 400 km away is exact: x east, y north, z up, metres, the INS at the origin. The place the observations
find there is minus the INS error.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import cast

import numpy as np

from companion.config import GnssConfig, RsbnConfig
from companion.estimate.fusion import (
    CONE_OF_SILENCE,
    Azimuth,
    Observation,
    Position,
    Range,
)
from companion.nav.geometry import Geodetic, Triple, enu_axes, from_enu, separation, to_ecef
from companion.navigator.inertial_track import Point
from companion.records import Gnss, RsbnFix, Source, Vector2
from companion.units import Floats

#: A receiver that states no accuracy of its velocity was seen to report 2 to 3 m/s at rest in its first
#: seven seconds. ArduPilot and PX4 wait for ten seconds of good fixes.
SETTLING_S, SETTLING_M_S = 10.0, 3.0
#: Below a speed (seen up to 1.75 m/s, fix after fix for seconds) u-blox receivers hold the last course, and
#: GPS_RAW_INT and DataFlash have speed and course: the velocity is in any direction. Its sigma in speeds.
HELD_COURSE_M_S, HELD_COURSE = 3.0, 4.0
_SAME_COURSE = 1e-5  # rad; messages have steps of 1.7e-4
#: A beacon's stated place (m) and the times of its answers (s) are so far off. Beside a runway an angle is a
#: metre: answers 0.3 s late excluded a healthy GNSS, 1 km from a beacon.
PLACE_M, LATE_S = 5.0, 0.3


def from_gnss(
    record: Gnss, nominal: Point, settings: GnssConfig, centre: Vector2 = (0.0, 0.0)
) -> tuple[Observation, ...]:
    """A GNSS fix as a position about the nominal point less the error `centre` (north, east, m)."""
    sigma = _stated(record, settings)
    north, east, _ = separation(Geodetic(record.lat, record.lon, record.alt_msl), nominal.position)
    place = (east + centre[1], north + centre[0])
    return (Position(place, ((sigma**2, 0.0), (0.0, sigma**2))),)


def white_sigma(record: Gnss, settings: GnssConfig) -> float:
    """One sigma an axis (m) of a fix, its drift left out."""
    stated = _stated(record, settings)
    return max(math.sqrt(stated**2 - settings.sigma_m**2), settings.sigma_m / 3.0)


def velocity_sigma(
    record: Gnss, first_ns: int, settings: GnssConfig, before: Gnss | None = None, share: float = 1.0
) -> float:
    """One sigma an axis (m/s) of a fix's velocity.

    The receiver's first fix was at `first_ns`; `before` is the last one that was used, if there is one. Of
    what is stated a `share` is used.
    """
    if record.sigma_velocity is not None:
        stated = share * record.sigma_velocity
    else:
        stated = SETTLING_M_S if (record.t_ns - first_ns) * 1e-9 < SETTLING_S else 0.0
    if before is not None and _is_course_held(before, record):
        assert record.v_n is not None
        stated = max(stated, HELD_COURSE * math.hypot(*record.v_n[:2]))
    return max(stated, settings.sigma_velocity_m_s)


def _is_course_held(before: Gnss, record: Gnss) -> bool:
    """Whether a slow receiver repeats the course of an earlier fix to the last digit."""
    if before.v_n is None or record.v_n is None or before.receiver != record.receiver:
        return False
    (n, e, _), (north, east, _) = before.v_n, record.v_n
    size = math.hypot(n, e) * math.hypot(north, east)
    slow = 0.0 < math.hypot(north, east) < HELD_COURSE_M_S
    return slow and abs(n * east - e * north) <= _SAME_COURSE * size and n * north + e * east > 0.0


def _stated(record: Gnss, settings: GnssConfig) -> float:
    return max(record.sigma_horizontal or 0.0, settings.sigma_m)


def from_rsbn(record: RsbnFix, ins: Point, settings: RsbnConfig) -> tuple[Azimuth | Range, ...]:
    """A beacon's azimuth and slant range, whichever are there, with the floors of the configuration.

    Their sigmas take in how far place and time of the beacon may be off.
    """
    here = ins.position
    (x, y, z), axes_beacon = _on_earth(record.lat, record.lon, record.alt)
    x_0, y_0, z_0 = to_ecef(here)
    axes = enu_axes(here.lat, here.lon)
    place = _times(axes, (x - x_0, y - y_0, z - z_0))
    displaced = displaced_sigma(math.hypot(*ins.v_n[:2]))
    sigma_azimuth, sigma_range = beacon_sigmas(record, settings)
    observations: list[Azimuth | Range] = []
    if record.azimuth is not None:
        sigma = math.hypot(sigma_azimuth, displaced / max(math.hypot(*place), 1.0))
        turned = tuple([_times(axes, axis) for axis in axes_beacon])  # C_e^b C_enu^e, row by row
        observations.append(Azimuth(place, record.azimuth, sigma, turned))
    if record.slant_range is not None:
        sigma = math.hypot(sigma_range, displaced)
        observations.append(Range(place, record.slant_range, sigma))
    return tuple(observations)


def beacon_sigmas(record: RsbnFix, settings: RsbnConfig) -> tuple[float, float]:
    """Standard deviations of azimuth (rad) and slant range (m): as stated, but not below the floors."""
    share = 0.01 * settings.sigma_range_percent * (record.slant_range or 0.0)
    least_azimuth, least_range = math.radians(settings.sigma_azimuth_deg), settings.sigma_range_m + share
    return max(record.sigma_azimuth, least_azimuth), max(record.sigma_range, least_range)


def displaced_sigma(speed: float) -> float:
    """How far off a sight may be by the beacon's stated place and the time of its answer, m."""
    return math.hypot(PLACE_M, LATE_S * speed)


def in_cone_of_silence(z: Azimuth, distance: float | None) -> bool:
    """Whether the origin of the plane is in the cone of silence of the azimuth's beacon, at a measured
    `distance` (m) where there is one: no azimuth is used there.
    """
    x, y, z_b = cast(Triple, z.beacon)
    axes = cast(tuple[Triple, Triple, Triple], z.axes)
    east, north, up = _times(axes, (-x, -y, -z_b))
    slant = math.hypot(east, north, up) if distance is None else distance
    return abs(up) > math.sin(CONE_OF_SILENCE) * slant


@lru_cache(maxsize=64)
def _on_earth(lat: float, lon: float, alt: float) -> tuple[Triple, tuple[Triple, Triple, Triple]]:
    """Of a beacon, which stays where it is: ECEF position and axes east, north, up."""
    return to_ecef(Geodetic(lat, lon, alt)), enu_axes(lat, lon)


def _times(C: tuple[Triple, Triple, Triple], v: Triple) -> Triple:
    (a, b, c), (d, e, f), (g, h, i) = C
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def source_of(z: Observation) -> Source:
    """The source that an observation of a beacon comes from."""
    return Source.AZIMUTH if isinstance(z, Azimuth) else Source.RANGE


def predict_sight(z: Azimuth | Range, at: Floats) -> tuple[Floats, Floats, Floats]:
    """Predict an azimuth (rad) or a slant range (m) at positions `at` (R, 3), east, north, up of the nominal.

    Returns
    -------
    value, east, north : (R,) the prediction and its derivatives by position.
    """
    d = at - np.asarray(z.beacon)
    if isinstance(z, Range):
        value = np.sqrt((d * d).sum(axis=1))
        far = np.maximum(value, 1.0)  # a position may be the beacon's own
        return value, d[:, 0] / far, d[:, 1] / far
    axes = np.eye(3) if z.axes is None else np.asarray(z.axes)
    b = d @ axes.T
    e, n = b[:, 0], b[:, 1]
    rho2 = np.maximum(e * e + n * n, 1.0)
    g = (n / rho2)[:, None] * axes[0] - (e / rho2)[:, None] * axes[1]
    return np.arctan2(e, n), g[:, 0], g[:, 1]


def distance(z: Azimuth | Range) -> float:
    """Distance of the beacon from the nominal position, m."""
    x, y, up = cast(Triple, z.beacon)
    return math.hypot(x, y, up)


def sight_variance(z: Azimuth | Range, height_sigma: float) -> float:
    """Variance of an azimuth (rad^2) or a range (m^2), the unknown height of the aircraft included."""
    if isinstance(z, Azimuth):
        return z.sigma**2
    up = cast(Triple, z.beacon)[2]
    slope = up / max(distance(z), 1.0)
    return z.sigma**2 + (slope * height_sigma) ** 2


def place(record: RsbnFix, alt: float) -> Geodetic | None:
    """Roughly where azimuth and range are at height `alt`, the earth taken for flat; None without both."""
    if record.azimuth is None or record.slant_range is None:
        return None
    up = alt - record.alt
    distance = math.sqrt(max(record.slant_range**2 - up * up, 0.0))
    east, north = distance * math.sin(record.azimuth), distance * math.cos(record.azimuth)
    beacon = Geodetic(record.lat, record.lon, record.alt)
    return from_enu(np.array([east, north, up]), beacon)._replace(alt=alt)
