"""Reference of all keys: meaning and when to change it, joined with unit, range and default of the schema.

    commented_toml(config)      # the text of `companion check-config --defaults`
    markdown()                  # docs/configuration.md: make docs/configuration.md

Meaning and advice stand in `TEXTS`; unit, range and default come from `schema`. Not imported in flight.
"""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from typing import Annotated, Any, NamedTuple, get_args, get_origin, get_type_hints

import msgspec

from companion.config.load import choices
from companion.config.presets import PRESETS
from companion.config.schema import SECTIONS, Config

WIDTH = 100
#: Advice for a value that follows from a data sheet or a recorded flight.
_SHEET = "your INS is of another grade: take it from the data sheet"
_MEASURED = "recorded flights show another value"

TEXTS: dict[str, dict[str, tuple[str, str]]] = {
    "link": {
        "connect": (
            "Addresses of the links, the leading one first: serial:DEVICE:BAUD, udpin:HOST:PORT, "
            "udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT.",
            "always: state how the autopilot is wired; add one for a ground station",
        ),
        "system_id": (
            "System id of the vehicle; 0: that of the first autopilot received.",
            "several vehicles share a network",
        ),
        "parameters_file": (
            "File of the values that ground stations set, loaded at the next start; empty: they are lost.",
            "values set from the ground station have to outlive a restart",
        ),
        "component_id": (
            "Our component id; 191 is an onboard computer, 197 visual-inertial odometry.",
            "another component of the vehicle has the same id",
        ),
    },
    "rates": {
        "local_position_hz": ("LOCAL_POSITION_NED.", "the line is slow"),
        "gnss_hz": ("GPS_RAW_INT.", "the receiver is faster or the line is slow"),
        "attitude_hz": ("ATTITUDE.", "the line is slow, but not below output.solution_hz"),
        "imu_hz": (
            "RAW_IMU (ArduPilot) or HIGHRES_IMU (PX4). ArduPilot grants at most 0.8 of SCHED_LOOP_RATE, "
            "which is 50 on planes.",
            "the line is slow, but not below 4 Hz",
        ),
        "air_data_hz": ("VFR_HUD and SCALED_PRESSURE.", "the line is slow"),
        "status_hz": ("EKF_STATUS_REPORT, SYS_STATUS and EXTENDED_SYS_STATE.", "the line is slow"),
        "truth_hz": ("SIM_STATE: the true position of ArduPilot's SITL, for reports.", "in SITL: 10"),
    },
    "inertial": {
        "source": (
            "Sensors that may be used: IMU and airspeed (auto), only the one named, or only the velocity of "
            "LOCAL_POSITION_NED. The last depends on the autopilot's own GNSS, and cannot be used if a "
            "position is sent to the autopilot.",
            "one of the sensors must not be used, or a log has neither",
        ),
        "independent": (
            "LOCAL_POSITION_NED comes from an INS of its own that does not use our output. Never true for "
            "the position of a stock autopilot: it would be fed its own position.",
            "the aircraft has an INS of its own",
        ),
        "gyro_drift_deg_h": ("Gyro drift of the INS of its own.", _SHEET),
        "gyro_correlation_h": ("Correlation time of the gyro drift.", _SHEET),
        "angle_random_walk_deg_sqrt_h": ("Angle random walk.", _SHEET),
        "accelerometer_bias_ug": ("Accelerometer bias.", _SHEET),
        "accelerometer_correlation_h": ("Correlation time of the accelerometer bias.", _SHEET),
        "position_m": ("Position error after alignment.", "it is aligned in another way"),
        "velocity_m_s": ("Velocity error after alignment.", "it is aligned in another way"),
        "tilt_arcsec": ("Tilt error after alignment.", _SHEET),
        "heading_arcmin": ("Heading error after alignment.", _SHEET),
        "velocity_noise_m_s_sqrt_s": ("Velocity random walk.", _SHEET),
        "gyro_scale_ppm": ("Scale error of the gyros, for the guaranteed bound.", _SHEET),
        "accelerometer_scale_ppm": ("Scale error of the accelerometers, for the guaranteed bound.", _SHEET),
        "height_sigma_m": (
            "Error of the height without GNSS, for the slant range of beacons.",
            "the pressure altitude is corrected, or is known to be worse",
        ),
        "correctors": (
            "Correctors of an INS of its own: airspeed, hyperbolic (lines of position), stars, second_ins.",
            "the aircraft has one of them and its records are received",
        ),
        "strapped_down": (
            "The sensors turn with the aircraft; false: gimballed platform.",
            "the INS is gimballed",
        ),
    },
    "air_data": {
        "wind_m_s": ("Wind before it is estimated.", "the climate is calmer or stormier"),
        "wind_change_m_s_sqrt_s": ("Random walk of the wind.", _MEASURED),
        "wind_jump_m_s": ("Size of wind jumps, north and east.", "you fly among mountains or near fronts"),
        "wind_jumps_per_hour": ("Frequency of wind jumps.", "you fly among mountains or near fronts"),
        "gust_m_s": ("Gusts.", _MEASURED),
        "gust_s": ("Correlation time of gusts.", _MEASURED),
        "airspeed_percent": ("Scale error of the airspeed.", "the pitot is calibrated, or is not"),
        "heading_deg": (
            "Lasting error of the heading.",
            "the compass is poor, or heading is by two antennas",
        ),
        "correlation_min": ("Correlation time of airspeed and heading errors.", _MEASURED),
        "crab_deg": ("Heading error or sideslip that lasts seconds.", "the aircraft flies with sideslip"),
        "crab_s": ("How long it lasts.", _MEASURED),
        "rotor_drag_per_s": (
            "A multirotor's drag per velocity through the air, to 25 %; 0: not used.",
            "`companion study rotor-drag` measures another; its motors are tilted to push sideways: 0",
        ),
    },
    "strapdown": {
        "imu": ("Index of the IMU: 0 is RAW_IMU.", "another IMU of the autopilot is better"),
        "tilt_deg": (
            "Error of the autopilot's attitude; degrees in a wind that it does not model.",
            _MEASURED,
        ),
        "tilt_s": ("Correlation time of the attitude error.", _MEASURED),
        "accelerometer_m_s2": ("Accelerometer error, misalignment included.", _MEASURED),
        "velocity_noise_m_s_sqrt_s": ("Noise that the scatter of the samples does not show.", _MEASURED),
    },
    "gnss": {
        "receiver": (
            "0: GPS_RAW_INT, 1: GPS2_RAW. The receiver that GPS_INPUT feeds is not allowed.",
            "the second receiver is the better one",
        ),
        "second_receiver": (
            "The other receiver is used while this one has no fix; never the one that GPS_INPUT feeds.",
            "the other one is no GNSS receiver",
        ),
        "sigma_m": ("Horizontal position error, correlated.", "the receiver is RTK or DGNSS, or is poor"),
        "sigma_velocity_m_s": ("Velocity error.", "the receiver's data sheet states another"),
        "correlation_s": ("Correlation time of the position error.", _MEASURED),
        "every_s": ("Shortest interval between fixes that are used.", "the computer is slow"),
        "use_velocity": ("Use the velocity of the receiver.", "its velocity is filtered or late"),
        "latency_s": (
            "Age of a fix at its timestamp; `companion report` estimates it.",
            "a report states a latency",
        ),
        "timeout_s": ("GNSS counts as absent after this time without a fix.", "rates.gnss_hz is below 1"),
    },
    "rsbn": {
        "sigma_azimuth_deg": (
            "Least azimuth error; a greater stated sigma is used.",
            "the beacon's data sheet states another",
        ),
        "sigma_range_m": (
            "Least slant range error; a greater stated sigma is used.",
            "the beacon's data sheet states another",
        ),
        "sigma_range_percent": (
            "Least slant range error, of the range.",
            "the beacon's data sheet states another",
        ),
        "bias_azimuth_deg": (
            "Constant azimuth error of each beacon, estimated while other sources are available.",
            "beacons are surveyed better or worse",
        ),
        "bias_range_m": ("Constant range error of each beacon, estimated likewise.", "as above"),
        "timeout_s": ("A beacon counts as absent after this time.", "beacons answer less often"),
    },
    "predictor": {
        "window_min": ("Fixes of this time are fitted.", "the Schuler phase is known for longer or shorter"),
        "bin_s": ("Fixes are averaged over this time.", "the computer is slow: greater"),
        "ahead_min": ("Times ahead for which the guaranteed radius is stated.", "the mission needs others"),
        "limit_m": (
            "With a greater guaranteed radius the position is untrusted.",
            "the mission tolerates more, or less",
        ),
    },
    "estimator": {
        "output": (
            "Estimator that leads without fixes; the bank of hypotheses leads while fixes arrive. "
            "kalman and auto: the bank always. restricted has the least expected error among those whose "
            "guaranteed bound is near the least. restrictive needs inertial.source = 'air_data'.",
            "you study another estimator",
        ),
        "parallel": (
            "Filters that run beside the bank and are logged, reported and never sent: the minimax Kalman "
            "filter, and the restrictive filter R1. They need airspeed.",
            "you compare estimators",
        ),
        "scheme": (
            "feedforward corrects the own channel when its error is large, feedback at every fix; a number "
            "from 0 to 1 corrects that share of the error at every fix.",
            "you study the schemes",
        ),
        "late_s": (
            "A measurement that arrives later than this is not used; older ones go to their own time.",
            "a beacon's answers take longer",
        ),
    },
    "integrity": {
        "rows": (
            "Hypotheses followed at once. With too few a slow spoofer, or an INS's right grade, is lost.",
            "the computer is slow: fewer",
        ),
        "risk": ("Probability that the protection level is exceeded.", "the mission states its risk"),
        "alert_m": ("Trust is normal only while the protection level is below.", "the mission needs better"),
        "settle_s": ("Trust improves after this time without interruption.", "trust changes too often"),
    },
    "output": {
        "profile": (
            "What is sent to the autopilot. monitor: nothing that it could use.",
            "after a flight with monitor: the make of the autopilot",
        ),
        "via": (
            "Message that carries the position; auto: the first of the profile.",
            "the autopilot is set up for another: docs/outputs.md",
        ),
        "switch_sources": (
            "ardupilot: EKF source set 2 while GNSS is lost; px4: GNSS fusion off while GNSS is false.",
            "the pilot alone switches: false",
        ),
        "solution_hz": ("Least rate of solutions.", "the log needs more"),
        "odometry_hz": ("ODOMETRY; -1: the profile's rate, 0: never.", "profile custom"),
        "vision_hz": ("VISION_POSITION_ESTIMATE; likewise.", "profile custom"),
        "gps_input_hz": ("GPS_INPUT; likewise.", "profile custom"),
        "global_position_sensor_hz": ("GLOBAL_POSITION_SENSOR; likewise.", "profile custom"),
        "external_position_hz": (
            "MAV_CMD_EXTERNAL_POSITION_ESTIMATE; likewise. Each one resets the autopilot's estimator.",
            "profile custom",
        ),
        "status_hz": (
            "NAVIGATION_STATUS to every link.",
            "the line is slow: 0, or a display needs more",
        ),
        "global_position_sensor_id": (
            "`id` of GLOBAL_POSITION_SENSOR; 0 is none to PX4.",
            "EKF2_AGP0_ID of PX4 is another",
        ),
    },
    "log": {
        "folder": ("Folder of the flight logs.", "logs go to another disk"),
        "chunk_kib": ("Size of a chunk; a crash loses the open one, at most a second.", "never"),
        "minimum_free_mib": (
            "Space left free: the oldest logs are deleted for it.",
            "other programs need the disk",
        ),
        "maximum_files": ("Logs kept; the oldest is deleted.", "you keep more flights"),
    },
    "signing": {
        "key_file": (
            "File of the MAVLink 2 signing key: 32 bytes or 64 hexadecimal digits, mode 0600. Empty: off.",
            "the link is by radio or a network with others in it",
        ),
        "stamp_file": (
            "File of the last timestamp: prevents replay after a restart.",
            "the working directory is not writable",
        ),
        "refuse_unsigned": ("Reject unsigned frames.", "a sender cannot sign"),
        "always_accepted": (
            "Message ids accepted unsigned; 109 is RADIO_STATUS: the radio does not sign.",
            "another device cannot sign",
        ),
    },
}

#: Ends of keys and their units, the longest first.
UNITS = {
    "_deg_sqrt_h": "deg/sqrt(h)",
    "_m_s_sqrt_s": "m/s/sqrt(s)",
    "_per_hour": "1/h",
    "_per_s": "1/s",
    "_percent": "%",
    "_arcsec": "arcsec",
    "_arcmin": "arcmin",
    "_deg_h": "deg/h",
    "_m_s2": "m/s^2",
    "_m_s": "m/s",
    "_deg": "deg",
    "_min": "min",
    "_kib": "KiB",
    "_mib": "MiB",
    "_ug": "ug",
    "_ppm": "ppm",
    "_hz": "Hz",
    "_m": "m",
    "_s": "s",
    "_h": "h",
}


class Key(NamedTuple):
    """One key: default, unit ("" without one), range or choices, limits, meaning, when to change it."""

    section: str
    name: str
    default: Any
    unit: str
    allowed: str
    limits: tuple[float | None, float | None]
    text: str
    change: str


def keys() -> Iterator[Key]:
    """Yield all keys in the order of the file."""
    for section, kind in SECTIONS.items():
        hints = get_type_hints(kind, include_extras=True)
        for field in msgspec.structs.fields(kind):
            unit = next((unit for end, unit in UNITS.items() if field.name.endswith(end)), "")
            text, change = TEXTS[section][field.name]
            hint = hints[field.name]
            limits = _limits(hint)
            yield Key(section, field.name, field.default, unit, _allowed(hint), limits, text, change)


def section_summary(section: str) -> str:
    """Return the first paragraph of a section's docstring, on one line."""
    doc = inspect.getdoc(SECTIONS[section]) or ""
    return " ".join(doc.partition("\n\n")[0].split())


def commented_toml(config: Config) -> str:
    """Format `config` as TOML with a comment at every key."""
    lines = ["# Configuration of `companion run`. Delete what stays at its default."]
    section = None
    for key in keys():
        if key.section != section:
            section = key.section
            lines += ["", *_comment(section_summary(section)), f"[{section}]"]
        details = "; ".join(part for part in (key.unit, key.allowed, f"default {_toml(key.default)}") if part)
        lines += ["", *_comment(f"{key.text} [{details}]"), *_comment(f"When to change: {key.change}.")]
        lines.append(f"{key.name} = {_toml(getattr(getattr(config, section), key.name))}")
    return "\n".join(lines) + "\n"


_HEAD = """# Configuration

Written by `make docs/configuration.md` from `companion/config`. `companion check-config --defaults` prints
the same as a file to start from.

One TOML file, `companion run --config FILE`. An environment variable `COMPANION_SECTION__KEY` overrides the
file, and `--set SECTION.KEY=VALUE` overrides both. The unit of a number is the end of its name. A mistake is
reported in one sentence with the nearest valid key, and the service does not start (exit code 78).

## Presets

The commands `run`, `check-config`, `doctor`, `signing init`, `loopback`, `study outages`,
`study rotor-drag` and `study wrong-sensors` have `--preset NAME` and `--set`. A preset sets the keys below;
everything else, the file included, overrides it; a file that overrides the first of them is rejected.
`companion doctor` recommends one. `companion check-config --defaults --preset NAME` writes a file with it.
"""


def markdown() -> str:
    """Return docs/configuration.md."""
    lines = [_HEAD, "| preset | for | sets |", "|---|---|---|"]
    for name, preset in PRESETS.items():
        values = ", ".join(f"`{key} = {_toml(value)}`" for key, value in preset.values.items())
        lines.append(f"| `{name}` | {preset.text} | {values} |")
    section = None
    for key in keys():
        if key.section != section:
            section = key.section
            doc = inspect.getdoc(SECTIONS[section]) or ""
            lines += ["", f"## {section}", "", doc, ""]
            lines += ["| key | default | unit, range | meaning | when to change |", "|---|---|---|---|---|"]
        allowed = ", ".join(part for part in (key.unit, key.allowed) if part)
        cells = (f"`{key.name}`", f"`{_toml(key.default)}`", allowed, key.text, key.change)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)


def _toml(value: Any) -> str:
    return msgspec.json.encode(value).decode()


def _allowed(kind: Any) -> str:
    """Describe the values that a type accepts, without its unit."""
    if get_origin(kind) is Annotated:
        low, high = _limits(kind)
        return f"at least {low:g}" if high is None else f"{low:g} to {high:g}"
    if get_origin(kind) is tuple:
        inner = _allowed(get_args(kind)[0])
        return f"list{f', each {inner}' if inner else ''}"
    if words := choices(kind):
        return ", ".join(words)
    return {bool: "true or false", str: "text"}.get(kind, "")


def _limits(kind: Any) -> tuple[float | None, float | None]:
    """Return the least and the greatest value of a number."""
    if kind is bool:
        return 0.0, 1.0
    (limit,) = getattr(kind, "__metadata__", (msgspec.Meta(),))
    return limit.ge, limit.le


if __name__ == "__main__":
    print(markdown(), end="")
