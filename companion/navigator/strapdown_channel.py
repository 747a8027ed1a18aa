"""Strapdown reckoning: accelerometers turned by the autopilot's attitude, an inertial channel of our own.

Specific force is turned to the level frame and gravity is added; `own_channel` integrates it over the earth,
from the first fix on. The attitude is the autopilot's; the gyros carry it from one sample to the next of the
IMU. No position and no velocity of the autopilot's comes in. Heights are pressure altitudes, as with air
data: the vertical channel is unstable alone. What the attitude's error makes of it is in `own_error_model`.

It needs the IMU at `IMU_HZ` and the attitude at `ATTITUDE_HZ` or more, and says what it does not get. A
sample at the end of an accelerometer's or gyro's range is not used, and none is while the vertical force,
averaged, is not gravity's: then units or orientation are wrong. Vibration and buffet, folded down by
sampling, are noise, measured by the scatter of the samples. What is folded to nearly 0 Hz it cannot see.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from msgspec import Struct, structs

from companion.nav.geometry import rotation_matrix
from companion.records import Attitude, Imu, Vector2, Vector3
from companion.units import G0, SECOND_NS, Floats

IMU_HZ, ATTITUDE_HZ = 5.0, 2.0  # wanted at least
LEAST = 0.7  # of which so much must come: streams are asked for again below it
FEW = 5  # samples that show no rate yet
SLOWEST_S = 2.0  # a longer interval is a silence and shows no rate either
STALE_S = 1.0  # an attitude older than this is not carried on by gyros
GAP_S = 0.3  # between samples of the IMU: within a longer gap its rates are not known
F_MAX = 0.995 * 16.0 * G0  # [m/s^2] the range of common accelerometers
W_MAX = 0.995 * math.radians(2000.0)  # [rad/s] and gyros
VERTICAL = 0.5  # of gravity, by which the vertical force may differ from it
VERTICAL_S = 10.0  # averaged over so long: nobody climbs 50 m/s faster after it
STAYS = 0.5  # of the scatter of the samples, in the velocity
UPRIGHT = 0.87  # cosine of the tilt (30 deg) up to which the drag of rotors is used
MANOEUVRE_M_S2, MANOEUVRE_S = 1.0, 2.0  # a manoeuvre is a greater mean acceleration over so long
MANOEUVRE_SQRT_S = 0.12  # velocity noise per acceleration above it, m/s/sqrt(s) per m/s^2
#: An attitude is wrong whose tilt the autopilot corrects faster than this against the gyros, averaged over
#: `TILTING_S`, and for `WRONG_S` after it: 3.5 deg/s at most in 18 healthy flights, 15 where it failed.
#: By an IMU slower than `GYRO_HZ` it is not judged.
TILTING_RAD_S, TILTING_S, WRONG_S = math.radians(5.0), 4.0, 10.0
GYRO_HZ = 15.0


class Pace(NamedTuple):
    """How fast a record comes: time of the last, how many, their mean interval (s)."""

    t_ns: int = 0
    heard: int = 0
    interval: float = 0.0

    def with_one(self, t_ns: int) -> Pace:
        """With one more at `t_ns`; about the last twenty count."""
        if not self.heard:
            return Pace(t_ns, 1)
        dt = min((t_ns - self.t_ns) * 1e-9, SLOWEST_S)
        gain = max(1.0 / self.heard, 0.05)
        return Pace(t_ns, self.heard + 1, self.interval + gain * (dt - self.interval))

    @property
    def hz(self) -> float:
        """0 before it is known."""
        return 1.0 / self.interval if self.heard > FEW and self.interval > 0.0 else 0.0


class Strap(Struct, frozen=True):
    """What is needed to go on: last sample; attitude, and the time that it is of; when samples came again
    after a gap; rates, vertical specific force averaged (m/s^2, down); how fast the tilt is corrected against
    the gyros, about north and east (rad/s), when that was last too fast; why the last sample moves nothing,
    and whether only because samples or attitudes are too few.
    """

    imu: Imu | None = None
    C_nb: Floats | None = None
    C_ns: int = 0
    gap_ns: int = 0
    imu_pace: Pace = Pace()
    attitude_pace: Pace = Pace()
    down: float = -G0
    tilting: Vector2 = (0.0, 0.0)
    wrong_ns: int | None = None
    why: str = "no IMU arrives"
    is_slow: bool = False


def sense(s: Strap, record: Attitude) -> Strap:
    """With one more attitude."""
    C_nb, C_ns = attitude_matrix(record), record.t_ns
    if s.imu is not None and (dt := (s.imu.t_ns - record.t_ns) * 1e-9) >= -GAP_S:
        C_nb, C_ns = C_nb @ rotation_matrix(np.array(s.imu.w_b) * min(dt, STALE_S)), s.imu.t_ns
        s = _judged(s, C_nb, record.t_ns)
    return structs.replace(s, C_nb=C_nb, C_ns=C_ns, attitude_pace=s.attitude_pace.with_one(record.t_ns))


def _judged(s: Strap, C_nb: Floats, t_ns: int) -> Strap:
    """With how fast the attitude of `t_ns` corrects the tilt that the gyros carried on from the one before.

    Only the tilt is judged: a heading that steps is modelled by the bank.
    """
    dt = (t_ns - s.attitude_pace.t_ns) * 1e-9
    if s.C_nb is None or dt <= 0.0 or s.gap_ns > s.attitude_pace.t_ns:
        return s
    if dt > STALE_S:
        return structs.replace(s, tilting=(0.0, 0.0))
    turned = C_nb @ s.C_nb.T
    gain = (1.0 - math.exp(-dt / TILTING_S)) / dt
    north, east = s.tilting
    north += gain * (0.5 * float(turned[2, 1] - turned[1, 2]) - dt * north)
    east += gain * (0.5 * float(turned[0, 2] - turned[2, 0]) - dt * east)
    is_wrong = math.hypot(north, east) > TILTING_RAD_S and s.imu_pace.hz > GYRO_HZ
    return structs.replace(s, tilting=(north, east), wrong_ns=t_ns if is_wrong else s.wrong_ns)


def receive(s: Strap, record: Imu) -> Strap:
    """With one more sample; `why` is empty where it can be used, else a sentence."""
    before = s.imu or record
    dt = (record.t_ns - before.t_ns) * 1e-9
    s = structs.replace(s, imu_pace=s.imu_pace.with_one(record.t_ns))
    if dt > GAP_S:
        s, before = structs.replace(s, gap_ns=record.t_ns), record
    if why := _senseless(record) or ("no attitude arrives" if s.C_nb is None else ""):
        return structs.replace(s, why=why, is_slow=False)
    assert s.C_nb is not None
    since = min((record.t_ns - s.C_ns) * 1e-9, STALE_S)
    C_nb = s.C_nb @ rotation_matrix(0.5 * (np.array(before.w_b) + record.w_b) * since)
    s = structs.replace(s, imu=record, C_nb=C_nb, C_ns=record.t_ns)
    gain = min(dt / VERTICAL_S, 0.1)
    s = structs.replace(s, down=s.down + gain * (float(C_nb[2] @ record.f_b) - s.down))
    why, slow = _unfit(s), _slow(s)
    return structs.replace(s, why=why or slow, is_slow=bool(slow and not why))


def acceleration(s: Strap) -> Vector3:
    """Acceleration over ground, north, east and down (m/s^2), of the last sample; Coriolis left out."""
    assert s.imu is not None
    assert s.C_nb is not None
    f_n = s.C_nb @ s.imu.f_b
    return float(f_n[0]), float(f_n[1]), float(f_n[2]) + G0


def drag_force(s: Strap, least: float = UPRIGHT) -> Vector2 | None:
    """Specific force of a multirotor's drag, north and east (m/s^2), by the last sample.

    None where the cosine of the tilt is below `least`: an attitude that is wrong or late counts most there.

    Rotors of fixed pitch pull along the body's z axis; what is across is the drag of the velocity in their
    plane, f_b = -drag C_nb' v of a level velocity v. Returned is -drag v: the level part of f_b is less, by
    the square of the cosine of the tilt. A climb is left out.
    """
    assert s.imu is not None
    assert s.C_nb is not None
    (a, b, _), (c, d, _), (_, _, upright) = s.C_nb.tolist()
    if upright < least:
        return None
    x, y, _ = s.imu.f_b
    return (d * x - c * y) / upright, (a * y - b * x) / upright


def lasting(mean: Vector3, a: Vector3, dt: float) -> Vector3:
    """Mean of the last `MANOEUVRE_S` with one more sample: an acceleration by gusts averages out."""
    gain = min(dt / MANOEUVRE_S, 1.0)
    x, y, z = mean
    return x + gain * (a[0] - x), y + gain * (a[1] - y), z + gain * (a[2] - z)


def manoeuvre(mean: Vector3) -> float:
    """How much a mean acceleration is above that of level flight in turbulence, m/s^2."""
    return max(math.hypot(*mean) - MANOEUVRE_M_S2, 0.0)


def velocity_variance(a: tuple[Vector3, ...], mean: Vector3, dt: float) -> float:
    """Variance (m/s)^2, on each level axis, that the noise of the last sample of `a` adds in `dt` seconds.

    Half of the scatter, which is that of the second difference of three samples; a steady turn has none. Of
    white noise all of it would stay in the velocity. Of an aircraft's buffet some is sampled fast enough and
    comes out again: 0.2 to 0.4 stayed in four flights of ArduPlane, at 20 and 24 Hz, straight and in turns,
    0.6 in one turn. And a share of the `mean` acceleration, whatever its direction: an attitude that is
    wrong while the aircraft manoeuvres turns it. In an aerobatic flight (InertialNav's TestLog2, up to 6 g)
    0.06 to 0.13 m/s/sqrt(s) per m/s^2 were measured against GNSS velocity, over 0.4 to 5 s and from 2 m/s^2
    up, and twice as much in one of twenty. Level in turbulence (ArduPlane) half of the means are below 1.2.
    """
    variance = dt * (MANOEUVRE_SQRT_S * manoeuvre(mean)) ** 2
    if len(a) == 3:
        (n0, e0, _), (n1, e1, _), (n2, e2, _) = a
        variance += STAYS * dt * dt * ((n2 - 2.0 * n1 + n0) ** 2 + (e2 - 2.0 * e1 + e0) ** 2) / 12.0
    return variance


def attitude_matrix(record: Attitude) -> Floats:
    """C_nb (3, 3) of roll, pitch and heading: Groves (2.22)."""
    sr, sp, sh = math.sin(record.roll), math.sin(record.pitch), math.sin(record.heading)
    cr, cp, ch = math.cos(record.roll), math.cos(record.pitch), math.cos(record.heading)
    return np.array(
        [
            [cp * ch, sr * sp * ch - cr * sh, cr * sp * ch + sr * sh],
            [cp * sh, sr * sp * sh + cr * ch, cr * sp * sh - sr * ch],
            [-sp, sr * cp, cr * cp],
        ]
    )


def _senseless(record: Imu) -> str:
    force, rate = max(map(abs, record.f_b)), max(map(abs, record.w_b))
    if not math.isfinite(sum(record.f_b) + sum(record.w_b)):
        return "it sends what is no number"
    if force > F_MAX:
        return f"its specific force of {force:.0f} m/s^2 is at the end of the range, {F_MAX:.0f} m/s^2"
    if rate > W_MAX:
        return f"its angular rate of {rate:.1f} rad/s is at the end of the range, {W_MAX:.1f} rad/s"
    return ""


def _unfit(s: Strap) -> str:
    """Why nothing can be made of the sample heard last, though it makes sense alone."""
    assert s.imu is not None
    silent = (s.imu.t_ns - s.attitude_pace.t_ns) * 1e-9
    if silent > STALE_S:
        return f"no attitude for {silent:.1f} s (limit {STALE_S:.1f} s)"
    if s.wrong_ns is not None and s.imu.t_ns - s.wrong_ns < WRONG_S * SECOND_NS:
        limit = math.degrees(TILTING_RAD_S)
        return f"the attitude is wrong: its tilt turns by more than {limit:.0f} deg/s against the gyros"
    if abs(s.down + G0) > VERTICAL * G0:
        return (
            f"its specific force upwards averages {-s.down:.1f} m/s^2 where gravity is 9.8: "
            "units or orientation are wrong"
        )
    return ""


def _slow(s: Strap) -> str:
    """Why too few samples or attitudes arrive to move the nominal trajectory."""
    if min(s.imu_pace.heard, s.attitude_pace.heard) <= FEW:
        return "the rates of IMU and attitude are not known yet"
    if s.imu_pace.hz < LEAST * IMU_HZ or s.attitude_pace.hz < LEAST * ATTITUDE_HZ:
        return (
            f"IMU at {s.imu_pace.hz:.1f} Hz and attitude at {s.attitude_pace.hz:.1f} Hz are too slow "
            f"(at least {LEAST * IMU_HZ:.1f} and {LEAST * ATTITUDE_HZ:.1f} Hz)"
        )
    return ""
