"""Presets: keys for a kind of inertial system or autopilot, overridden by everything else.

The error models of the INS presets are one standard deviation of a unit of that class after alignment and
calibration in flight (Groves 2013, table 4.1 and section 4.4); the simulator's have the same gyros and
accelerometers.
The bank of hypotheses corrects a grade that is up to 64 times better than the truth, not one that is worse.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Preset(NamedTuple):
    """What a preset is for, and its values by "section.key": without the first it is for nothing."""

    text: str
    values: Mapping[str, Any]


PRESETS: Mapping[str, Preset] = {
    "navigation-ins": Preset(
        "an INS of its own of navigation grade (ring laser, 1 nautical mile per hour)",
        {"inertial.independent": True},
    ),
    "tactical-ins": Preset(
        "an INS of its own of tactical grade (fibre-optic gyros, 1 deg/h before calibration)",
        {
            "inertial.independent": True,
            "inertial.gyro_drift_deg_h": 0.1,
            "inertial.gyro_correlation_h": 0.5,
            "inertial.angle_random_walk_deg_sqrt_h": 0.07,
            "inertial.accelerometer_bias_ug": 200.0,
            "inertial.accelerometer_correlation_h": 0.5,
            "inertial.tilt_arcsec": 40.0,
            "inertial.heading_arcmin": 12.0,
            "inertial.gyro_scale_ppm": 100.0,
            "inertial.accelerometer_scale_ppm": 300.0,
        },
    ),
    "mems": Preset(
        "an INS of its own with good MEMS sensors, calibrated in flight",
        {
            "inertial.independent": True,
            "inertial.gyro_drift_deg_h": 1.0,
            "inertial.gyro_correlation_h": 0.17,
            "inertial.angle_random_walk_deg_sqrt_h": 0.15,
            "inertial.accelerometer_bias_ug": 500.0,
            "inertial.accelerometer_correlation_h": 0.17,
            "inertial.tilt_arcsec": 120.0,
            "inertial.heading_arcmin": 60.0,
            "inertial.velocity_noise_m_s_sqrt_s": 0.002,
            "inertial.gyro_scale_ppm": 500.0,
            "inertial.accelerometer_scale_ppm": 1000.0,
        },
    ),
    "stock-autopilot": Preset(
        "ArduPilot without another INS: it gets a position, and is asked to use it while GNSS is lost",
        {"output.profile": "ardupilot"},
    ),
    "px4": Preset(
        "PX4 without another INS: it gets a position; its attitude stays right without GNSS",
        {"output.profile": "px4", "strapdown.tilt_deg": 0.5},
    ),
}


def recommend_preset(make: str) -> str | None:
    """Return the preset for an autopilot ("ardupilot", "px4") without an INS of its own; None for others."""
    return next((name for name, p in PRESETS.items() if p.values.get("output.profile") == make), None)
