"""Configuration checks across keys: combinations that are invalid, each with a sentence on how to fix it.

The most important check: the autopilot must never receive its own position back. A profile that feeds its
estimator cannot be combined with its local position as the inertial channel, unless the operator sets
`inertial.independent`. The checks run on every new configuration: read from a file, set by a ground station
or passed to `CompanionCore`.
"""

from __future__ import annotations

from collections.abc import Iterator

from companion.config.profiles import MESSAGES, PROFILES
from companion.config.schema import Config

#: Lowest rate of a message that is sent or requested: its interval fits 31 bits of microseconds.
MIN_RATE_HZ = 0.01
MIN_ODOMETRY_HZ = 4.0  # ArduPilot's health check of VISO_TYPE = 1
#: Most bins of the predictor's window: a greater linear program delays the solutions.
MAX_BINS = 600
AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
MAX_MESSAGE_ID = (1 << 24) - 1
#: Keys that hold a path.
PATHS = (("link", "parameters_file"), ("log", "folder"), ("signing", "key_file"), ("signing", "stamp_file"))


def find_conflicts(config: Config) -> Iterator[tuple[str, str, str]]:
    """Yield the section and key of each invalid combination, and a sentence that states how to fix it."""
    output, rates = config.output, config.output.rates_hz
    methods = PROFILES[output.profile].methods
    if output.via != "auto" and output.via not in methods:
        choice = f"choose {', '.join(methods)} or auto" if methods else "remove this key"
        yield (
            "output",
            "via",
            f"output.via = '{output.via}' is not available in profile '{output.profile}': {choice}",
        )
    for via, message in MESSAGES.items():
        key = f"{via}_hz"
        if rates[message] > 0.0 and via not in methods and output.profile != "custom":
            why = (
                "never feeds an autopilot: set output.profile"
                if output.profile == "monitor"
                else f"does not support it: its autopilot accepts {', '.join(methods)}"
            )
            yield "output", key, f"output.{key} = {rates[message]:g}, but profile '{output.profile}' {why}"
    if (
        config.inertial.source == "local_position"
        and output.feeds_estimator
        and not config.inertial.independent
    ):
        yield (
            "inertial",
            "source",
            f"inertial.source = 'local_position' would feed the autopilot its own position back (profile "
            f"'{output.profile}' feeds its estimator): set inertial.source = 'auto', or inertial.independent "
            "= true if LOCAL_POSITION_NED comes from a separate INS that does not use our output",
        )
    if rates["GPS_INPUT"] > 0.0 and config.gnss.receiver == 1:
        yield (
            "gnss",
            "receiver",
            "gnss.receiver = 1 is the receiver that GPS_INPUT feeds, so our own position would come back as "
            "a fix: set gnss.receiver = 0",
        )
    if config.estimator.feedback > 0.0 and config.has_own_ins:
        yield (
            "estimator",
            "scheme",
            f"estimator.scheme = {config.estimator.scheme!r} needs an inertial channel computed by the "
            "companion: set inertial.source = 'air_data' or 'imu'",
        )
    if config.leading_estimator == "restrictive" and config.inertial.source != "air_data":
        yield (
            "estimator",
            "output",
            "estimator.output = 'restrictive' runs on air data only: set inertial.source = 'air_data'",
        )
    beside_ins = config.has_own_ins and "airspeed" in config.inertial.correctors
    if config.estimator.parallel and config.inertial.source != "air_data" and not beside_ins:
        yield (
            "estimator",
            "parallel",
            f"estimator.parallel = {list(config.estimator.parallel)} bounds the change of the wind, so it "
            "needs airspeed: set inertial.source = 'air_data', or with an INS of its own "
            "inertial.correctors = ['airspeed']",
        )
    yield from _invalid_rates(config)
    bins = 60.0 * config.predictor.window_min / config.predictor.bin_s
    if bins > MAX_BINS:
        yield (
            "predictor",
            "bin_s",
            f"predictor.window_min and predictor.bin_s make {bins:.0f} bins (limit {MAX_BINS}): "
            f"set predictor.bin_s = {60.0 * config.predictor.window_min / MAX_BINS:.3g} or more",
        )


def find_mistakes(config: Config) -> Iterator[tuple[str, str, str]]:
    """Yield section, key and sentence, as `find_conflicts`, of what has no effect or cannot be meant.

    For a configuration that somebody writes now: an old log was flown with it, and can be replayed.
    """
    link, ahead = config.link, config.predictor.ahead_min
    if not link.connect:
        yield (
            "link",
            "connect",
            "link.connect = [] names no link: give one, for example udpin:127.0.0.1:14550",
        )
    if link.component_id == AUTOPILOT_COMPONENT:
        yield (
            "link",
            "component_id",
            "link.component_id = 1 is the component of the autopilot: give another, for example 191",
        )
    is_sent = config.output.rates_hz[MESSAGES["global_position_sensor"]] > 0.0
    if is_sent and config.output.global_position_sensor_id == 0:
        yield (
            "output",
            "global_position_sensor_id",
            "output.global_position_sensor_id = 0: EKF2_AGP0_ID = 0 is PX4's for no sensor; give 1 to 255",
        )
    if list(ahead) != (ascending := sorted(set(ahead))):
        yield (
            "predictor",
            "ahead_min",
            f"predictor.ahead_min = {list(ahead)} is not in ascending order: write {ascending}",
        )
    if not config.log.folder.strip():
        yield (
            "log",
            "folder",
            f"log.folder = {config.log.folder!r} names no folder: give one, for example logs",
        )
    odometry_hz = config.output.rates_hz[MESSAGES["odometry"]]
    if config.output.profile == "ardupilot" and 0.0 < odometry_hz < MIN_ODOMETRY_HZ:
        yield (
            "output",
            "odometry_hz",
            f"output.odometry_hz = {odometry_hz:g}: ArduPilot does not arm with less than "
            f"{MIN_ODOMETRY_HZ:g} Hz; set {MIN_ODOMETRY_HZ:g} or more, or -1 (the profile's rate)",
        )
    for section, key in PATHS:
        if "\0" in (path := getattr(getattr(config, section), key)):
            yield section, key, f"{section}.{key} = {path!r} has a null character: remove it"
        elif path.encode(errors="replace").decode() != path:  # bytes of a command line
            yield section, key, f"{section}.{key} = {path!r} is not UTF-8: give another name"
        elif path.startswith("~"):
            yield section, key, f"{section}.{key} = {path!r}: ~ is not expanded; write the whole path"
    gnss, hz = config.gnss, config.rates.gnss_hz
    for section, key, value, spacing in (
        ("gnss", "every_s", gnss.every_s, gnss.every_s),
        ("rates", "gnss_hz", hz, 1.0 / hz if hz else 0.0),
    ):
        if spacing > gnss.timeout_s:
            yield (
                section,
                key,
                f"{section}.{key} = {value:g} leaves {spacing:.3g} s between fixes, and GNSS counts as "
                f"absent after gnss.timeout_s = {gnss.timeout_s:g} s: set gnss.timeout_s above {spacing:.3g}",
            )
    for msgid in config.signing.always_accepted:
        if not 0 <= msgid <= MAX_MESSAGE_ID:
            yield (
                "signing",
                "always_accepted",
                f"signing.always_accepted has {msgid}: give message ids from 0 to {MAX_MESSAGE_ID}",
            )
    if config.inertial.correctors and not config.has_own_ins:
        yield (
            "inertial",
            "correctors",
            f"inertial.correctors = {list(config.inertial.correctors)} has an effect only with an INS of "
            "its own: set inertial.independent = true and inertial.source = 'auto', or "
            "inertial.correctors = []",
        )


def _invalid_rates(config: Config) -> Iterator[tuple[str, str, str]]:
    for section in ("rates", "output"):
        table = getattr(config, section)
        for key in table.__struct_fields__:
            if not key.endswith("_hz"):
                continue
            hz = getattr(table, key)
            if 0.0 < hz < MIN_RATE_HZ:
                yield section, key, f"{section}.{key} = {hz:g}: set 0, or at least {MIN_RATE_HZ:g} Hz"
            elif -1.0 < hz < 0.0:
                yield (
                    section,
                    key,
                    f"{section}.{key} = {hz:g}: set -1 (the profile's rate), 0 (never), or at least "
                    f"{MIN_RATE_HZ:g} Hz",
                )
