"""Air data: attitude, true airspeed and pressure altitude from what the autopilot sends.

It uses of the autopilot only attitude, airspeed and static pressure: no position and no velocity of its own
estimator comes back through here. Heights are pressure altitudes of the standard atmosphere; `height_error`
estimates how far off they are. Sideslip and the angle of attack are taken as zero: five degrees of either are
0.4 % of the speed along, and across they look like wind.
"""

from __future__ import annotations

import math

from msgspec import Struct, structs

from companion.nav.geometry import Geodetic
from companion.navigator.fix_observations import place
from companion.navigator.height_error import greatest_change
from companion.records import AirData, Attitude, Gnss, Pressure, Rejection, RsbnFix

P0 = 101_325.0  # [Pa] of the standard atmosphere at sea level
LAPSE, T0 = 0.0065, 288.15  # [K/m], [K]
TROPOPAUSE = 11_000.0  # [m], where the lapse ends
P1, T1, SCALE_M = 22_632.06, 216.65, 6341.62  # there [Pa], [K]; above, the pressure falls to 1 / e in [m]
HEIGHT_EXPONENT = 0.190263  # R L / (g M): T / T0 = (p / P0)^0.19
DENSITY_EXPONENT = 1.0 - HEIGHT_EXPONENT  # rho / rho0 = (p / P0) / (T / T0)
CLIMB_S = 0.7  # time constant of the climb taken from the pressure altitude
CLIMB_NS = 2_000_000_000  # heights farther apart, of pressure or of GNSS, show no climb
STEP_S = 10.0  # a pressure that stepped and stays is used again after so long


class Reckoner(Struct, frozen=True):
    """What is needed to go on: last attitude, airspeed and pressure (Pa) with its time, None before one.

    `climb` is the rate of the pressure altitude (m/s).
    """

    attitude: Attitude | None = None
    air: AirData | None = None
    static: float | None = None
    static_ns: int = -5 * CLIMB_NS
    climb: float = 0.0

    def climb_at(self, t_ns: int) -> float:
        """The climb (m/s) at `t_ns`: none once the pressure is silent."""
        return self.climb if t_ns - self.static_ns <= CLIMB_NS else 0.0


def sense(r: Reckoner, record: Attitude | AirData | Pressure) -> Reckoner:
    """With one more attitude, airspeed or static pressure."""
    if isinstance(record, Attitude):
        return structs.replace(r, attitude=record)
    if isinstance(record, AirData):
        return structs.replace(r, air=record)
    if not _is_static(record):
        return r
    gap_s, climb = (record.t_ns - r.static_ns) * 1e-9, 0.0
    if r.static is not None and record.t_ns - r.static_ns <= CLIMB_NS:
        up = pressure_altitude(record.static) - pressure_altitude(r.static)
        climb = r.climb + (up - r.climb * gap_s) / (CLIMB_S + gap_s)
    return structs.replace(r, static=record.static, static_ns=record.t_ns, climb=climb)


def step(r: Reckoner, record: Pressure, climb: float) -> Rejection | None:
    """Reject a pressure whose altitude no aircraft reaches since the last one used, nor one that climbs as
    GNSS does, at `climb` (m/s): two sensors that agree are believed.
    """
    if r.static is None or not _is_static(record):
        return None
    gap_s = (record.t_ns - r.static_ns) * 1e-9
    up = pressure_altitude(record.static) - pressure_altitude(r.static)
    change = min(abs(up), abs(up - climb * gap_s))
    limit = greatest_change(gap_s)
    if change <= limit or gap_s > STEP_S:
        return None
    return Rejection(record.t_ns, record.rx_ns, "pressure", "its altitude steps: not used", change, limit)


def _is_static(record: Pressure) -> bool:
    return 1e3 < record.static < 2e5


def first_place(fix: Gnss | RsbnFix, static: float | None) -> Geodetic | None:
    """The position that a fix alone gives, at the height of the pressure (Pa) if it is known; else None."""
    if isinstance(fix, RsbnFix):
        return place(fix, pressure_altitude(static) if static else fix.alt)
    alt = pressure_altitude(static) if static else fix.alt_msl
    return Geodetic(fix.lat, fix.lon, alt) if fix.has_3d_fix else None


def true_airspeed(record: AirData, static: float | None, alt: float) -> float:
    """True airspeed (m/s): equivalent airspeed times sqrt(rho0 / rho) of the standard atmosphere.

    The density is that of the pressure, or of the height (m) where no pressure is known; what a day warmer or
    colder than the standard makes of it, 1.7 % for 10 K, is one more error of scale.
    """
    if record.true:
        return record.airspeed
    ratio = static / P0 if static else (1.0 - LAPSE * min(alt, TROPOPAUSE) / T0) ** (1.0 / HEIGHT_EXPONENT)
    density = ratio**DENSITY_EXPONENT if not static or static >= P1 else ratio * T0 / T1
    return float(record.airspeed / math.sqrt(density))


def pressure_altitude(static: float) -> float:
    """Height (m) at which the standard atmosphere has this pressure (Pa)."""
    if static < P1:
        return TROPOPAUSE - SCALE_M * math.log(static / P1)
    return float(T0 / LAPSE * (1.0 - (static / P0) ** HEIGHT_EXPONENT))
