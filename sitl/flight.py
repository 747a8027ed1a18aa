"""Simulated fixed-wing trajectory over WGS84 at 50 Hz, with the measurements of a perfect IMU.

Airspeed, heading and height are sums of smooth steps (three continuous derivatives); the wind is added to the
velocity. Position is the integral of the velocity, specific force follows from its derivative, attitude from
the force (coordinated flight: no lateral force, nose along the air velocity), body rates from the attitude.
Integrating the IMU therefore reproduces the trajectory.

Sensors, errors and links are not modelled here; t counts seconds from 0. All arrays have one row per sample;
vectors are NED (`_n`) or forward-right-down (`_b`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.nav.earth import E2, G_EQUATOR, G_POLE, GM, OMEGA, A, B, F
from companion.units import Floats

RATE_HZ = 50.0
TURN_RATE = np.radians(4.0)
"""Maximum turn rate, rad/s: a bank of about 15 degrees at 38 m/s."""
CLIMB_RATE = 3.0
"""Maximum climb or sink rate, m/s."""
ACCELERATION = 2.5
"""Maximum acceleration along the path, m/s^2."""
_STEEPEST_SLOPE = 2.1875  # of `smooth_step`: scales the duration of a change to keep its maximum rate


@dataclass(frozen=True, slots=True)
class Leg:
    """Flight leg: turn the short way to `heading_deg`, change airspeed (m/s) and height above the start (m).

    The new values are kept until `duration_s` is over.
    """

    duration_s: float
    heading_deg: float
    airspeed: float
    height: float


@dataclass(frozen=True, slots=True)
class WindChange:
    """Wind from `start_s` on, blowing towards north and east (m/s), reached smoothly within `over_s`."""

    start_s: float
    north: float
    east: float
    over_s: float = 20.0


@dataclass(frozen=True, slots=True)
class FlightPlan:
    """Flight plan: start (degrees, m above the ellipsoid), legs and winds."""

    legs: tuple[Leg, ...]
    lat_deg: float = 60.0
    lon_deg: float = 30.0
    alt: float = 100.0
    winds: tuple[WindChange, ...] = ()

    def __post_init__(self) -> None:
        if not self.legs:
            raise ValueError("the flight plan has no legs: give at least one")
        if any(leg.duration_s <= 0.0 for leg in self.legs):
            raise ValueError("a leg of the flight plan has no duration: make every duration_s positive")
        if abs(self.lat_deg) > 85.0:
            raise ValueError(f"the flight starts at latitude {self.lat_deg:g}: keep within 85 degrees")

    @property
    def duration_s(self) -> float:
        """Duration of the flight, s."""
        return sum(leg.duration_s for leg in self.legs)


class Trajectory(NamedTuple):
    """True trajectory, n rows.

    `attitude` is roll, pitch, heading (rad); `f_b` specific force (m/s^2) and `w_b` angular rate relative to
    inertial space (rad/s) in body axes; `v_n` and `wind_n` in m/s; `airspeed` is true airspeed.
    """

    t: Floats
    lat: Floats
    lon: Floats
    alt: Floats
    v_n: Floats
    attitude: Floats
    f_b: Floats
    w_b: Floats
    wind_n: Floats
    airspeed: Floats

    def at(self, t: npt.ArrayLike) -> Trajectory:
        """Interpolate linearly at times `t` (s, within the flight); the error is below a millimetre."""
        t = np.atleast_1d(np.asarray(t, dtype=np.float64))
        x = np.clip((t - self.t[0]) * RATE_HZ, 0.0, len(self.t) - 1.0)
        i = np.minimum(x.astype(np.intp), len(self.t) - 2)
        part = x - i

        def between(a: Floats) -> Floats:
            share = part if a.ndim == 1 else part[:, None]
            out: Floats = a[i] + share * (a[i + 1] - a[i])
            return out

        values = {name: between(getattr(self, name)) for name in self._fields}
        unwrapped = np.unwrap(self.attitude[:, 2])
        values["attitude"][:, 2] = (unwrapped[i] + part * (unwrapped[i + 1] - unwrapped[i])) % (2.0 * np.pi)
        values["t"] = t
        return Trajectory(**values)


def smooth_step(t: Floats, start: float, lasting: float) -> Floats:
    """Smooth step from 0 at `start` to 1 after `lasting` seconds, with three continuous derivatives."""
    u = np.clip((t - start) / lasting, 0.0, 1.0)
    out: Floats = u**4 * (35.0 + u * (-84.0 + u * (70.0 - 20.0 * u)))
    return out


def fly_plan(plan: FlightPlan) -> Trajectory:
    """Compute the trajectory of the plan at 50 Hz from t = 0 to its end."""
    t = np.arange(round(plan.duration_s * RATE_HZ) + 1) / RATE_HZ
    airspeed, heading, height = _profiles(t, plan.legs)
    climb = derivative(height)
    wind_n = _wind(t, plan.winds)
    sin_pitch = np.clip(climb / np.maximum(airspeed, 10.0), -0.5, 0.5)
    forward = airspeed * np.sqrt(1.0 - sin_pitch**2)
    # on the runway the wind does not change the velocity over ground
    airborne = np.clip(height / 20.0, 0.0, 1.0) ** 2
    airborne = airborne * (3.0 - 2.0 * np.sqrt(airborne))
    wind_n = wind_n * airborne[:, None]
    v_n = wind_n + np.stack([forward * np.cos(heading), forward * np.sin(heading), -climb], axis=1)
    lat, lon = _position(v_n, np.radians(plan.lat_deg), np.radians(plan.lon_deg), plan.alt + height)
    return _attitude_and_imu(
        t, lat, lon, plan.alt + height, v_n, heading, np.arcsin(sin_pitch), wind_n, airspeed
    )


def radii(lat: Floats) -> tuple[Floats, Floats]:
    """Return meridian and prime vertical radii of curvature, m: `companion.nav.earth.radii` on arrays."""
    w2 = 1.0 - E2 * np.sin(lat) ** 2
    R_E = A / np.sqrt(w2)
    return R_E * (1.0 - E2) / w2, R_E


def gravity(lat: Floats, alt: Floats) -> Floats:
    """Return normal gravity, m/s^2: Somigliana's on the ellipsoid, second order in height above it.

    NIMA TR8350.2 (4-1), (4-3); accurate to 1e-6 m/s^2 up to 20 km.
    """
    s2 = np.sin(lat) ** 2
    k = B * G_POLE / (A * G_EQUATOR) - 1.0
    m = OMEGA**2 * A**2 * B / GM
    g_0 = G_EQUATOR * (1.0 + k * s2) / np.sqrt(1.0 - E2 * s2)
    h = alt / A
    out: Floats = g_0 * (1.0 - 2.0 * (1.0 + F + m - 2.0 * F * s2) * h + 3.0 * h * h)
    return out


def rotation(attitude: Floats) -> Floats:
    """Return C_nb (n, 3, 3), body to NED, of roll, pitch, heading (n, 3)."""
    (sr, sp, sh), (cr, cp, ch) = np.sin(attitude.T), np.cos(attitude.T)
    rows = [
        [cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh],
        [cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch],
        [-sp, sr * cp, cr * cp],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def derivative(x: Floats) -> Floats:
    """Differentiate samples at 50 Hz along the first axis, fourth order (second at the ends)."""
    out = np.gradient(x, axis=0)
    out[2:-2] = (8.0 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) / 12.0
    scaled: Floats = out * RATE_HZ
    return scaled


def _profiles(t: Floats, legs: Sequence[Leg]) -> tuple[Floats, Floats, Floats]:
    """Airspeed, heading (continuous, rad) and height above the start as sums of smooth steps."""
    airspeed, height = np.zeros_like(t), np.zeros_like(t)
    heading = np.full_like(t, np.radians(legs[0].heading_deg))
    last = Leg(1.0, legs[0].heading_deg, 0.0, 0.0)
    start = 0.0
    for leg in legs:
        turn = np.radians((leg.heading_deg - last.heading_deg + 180.0) % 360.0 - 180.0)
        changes = (
            (airspeed, leg.airspeed - last.airspeed, ACCELERATION),
            (heading, turn, TURN_RATE),
            (height, leg.height - last.height, CLIMB_RATE),
        )
        for profile, change, rate in changes:
            if change:
                lasting = max(_STEEPEST_SLOPE * abs(change) / rate, 4.0)
                if lasting > leg.duration_s:
                    raise ValueError(
                        f"the leg at {start:g} s is too short: its changes need {lasting:.0f} s, it has "
                        f"{leg.duration_s:g} s"
                    )
                # only the samples from the start of the leg change: 40 min take 20 ms
                first = int(start * RATE_HZ)
                profile[first:] += change * smooth_step(t[first:], start, lasting)
        last, start = leg, start + leg.duration_s
    return airspeed, heading, height


def _wind(t: Floats, winds: Sequence[WindChange]) -> Floats:
    """Wind (n, 3) in NED: the first entry from the start, the others as smooth changes."""
    wind_n = np.zeros((len(t), 3))
    last = (0.0, 0.0)
    for index, wind in enumerate(winds):
        change = np.array([wind.north - last[0], wind.east - last[1], 0.0])
        share = np.ones_like(t) if index == 0 else smooth_step(t, wind.start_s, wind.over_s)
        wind_n += share[:, None] * change
        last = (wind.north, wind.east)
    return wind_n


def _integral(rate: Floats) -> Floats:
    """Integral of samples at 50 Hz from the first sample: end-corrected trapezoids (fourth order)."""
    out = np.zeros_like(rate)
    slope = derivative(rate)
    steps = 0.5 * (rate[1:] + rate[:-1]) / RATE_HZ - (slope[1:] - slope[:-1]) / (12.0 * RATE_HZ**2)
    np.cumsum(steps, out=out[1:])
    return out


def _position(v_n: Floats, lat_0: float, lon_0: float, alt: Floats) -> tuple[Floats, Floats]:
    """Latitude and longitude by integration; three iterations, as the radii depend weakly on latitude."""
    lat = np.full(len(alt), lat_0)
    for _ in range(3):
        lat = lat_0 + _integral(v_n[:, 0] / (radii(lat)[0] + alt))
    lon = lon_0 + _integral(v_n[:, 1] / ((radii(lat)[1] + alt) * np.cos(lat)))
    return lat, (lon + np.pi) % (2.0 * np.pi) - np.pi


def _attitude_and_imu(
    t: Floats,
    lat: Floats,
    lon: Floats,
    alt: Floats,
    v_n: Floats,
    heading: Floats,
    pitch: Floats,
    wind_n: Floats,
    airspeed: Floats,
) -> Trajectory:
    """Attitude and IMU from velocity and direction of the nose: Groves (5.54) inverted."""
    R_N, R_E = radii(lat)
    zero = np.zeros_like(t)
    w_ie = OMEGA * np.stack([np.cos(lat), zero, -np.sin(lat)], axis=1)
    lon_rate = v_n[:, 1] / (R_E + alt)
    w_en = np.stack([lon_rate, -v_n[:, 0] / (R_N + alt), -lon_rate * np.tan(lat)], axis=1)
    f_n = derivative(v_n) + np.cross(2.0 * w_ie + w_en, v_n)
    f_n[:, 2] -= gravity(lat, alt)

    # the roll without lateral force: f resolved along the wings of the unbanked body and down
    level = rotation(np.stack([zero, pitch, heading], axis=1))
    f_level = np.einsum("nij,ni->nj", level, f_n)
    roll = np.arctan2(f_level[:, 1], -f_level[:, 2])
    attitude = np.stack([roll, pitch, heading], axis=1)
    C_nb = rotation(attitude)
    roll_rate, pitch_rate, heading_rate = derivative(attitude).T
    w_nb_b = np.stack(
        [
            roll_rate - heading_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + heading_rate * np.sin(roll) * np.cos(pitch),
            -pitch_rate * np.sin(roll) + heading_rate * np.cos(roll) * np.cos(pitch),
        ],
        axis=1,
    )
    w_b = w_nb_b + np.einsum("nij,ni->nj", C_nb, w_ie + w_en)
    attitude[:, 2] %= 2.0 * np.pi
    f_b = np.einsum("nij,ni->nj", C_nb, f_n)
    return Trajectory(t, lat, lon, alt, v_n, attitude, f_b, w_b, wind_n, airspeed)
