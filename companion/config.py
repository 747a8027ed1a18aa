"""What the operator may set: frozen structures with the unit in every key, and all of their validation.

Flags beat environment beat file. The file is TOML, one table a section; the environment variable of a key is
`COMPANION_SECTION__KEY`. A mistake is a `ConfigError`, one sentence that names where it stands, the key, and
the nearest right one; the service does not start on it (exit code 78, EX_CONFIG).
"""

from __future__ import annotations

import difflib
import os
import tomllib
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, TypeAlias, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta

from companion.conflicts import conflicts
from companion.profiles import MESSAGES, PROFILES, Name, Via

Positive = Annotated[float, Meta(gt=0.0, lt=1e9)]
NotNegative = Annotated[float, Meta(ge=0.0, lt=1e9)]
Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]
RateHz = Annotated[float, Meta(ge=0.0, le=400.0)]
OutputHz = Annotated[float, Meta(ge=-1.0, le=50.0)]
Channel: TypeAlias = Literal["local_position", "air_data", "strapdown"]
NodeId = Annotated[int, Meta(ge=1, le=255)]


PREFIX = "COMPANION_"  # of the environment variables that are ours, every one a key


class ConfigError(ValueError):
    """A configuration that cannot be meant; the text says where and what to write instead."""


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table of the file."""


class Link(Section, frozen=True):
    """Where the autopilot is, and who we are on its network."""

    connect: tuple[str, ...] = ("udpin:127.0.0.1:14550",)  # each link is one; see `companion run --help`
    system_id: Annotated[int, Meta(ge=0, le=255)] = 0  # 0: take the autopilot's own
    parameters_file: str = ""  # what ground stations set is kept here and read at the next start
    component_id: NodeId = 191  # MAV_COMP_ID_ONBOARD_COMPUTER; 197 is visual-inertial odometry


class Rates(Section, frozen=True):
    """What is asked of the autopilot by SET_MESSAGE_INTERVAL; 0 leaves a stream as it is."""

    local_position_hz: RateHz = 10.0
    gnss_hz: RateHz = 5.0
    attitude_hz: RateHz = 10.0
    imu_hz: RateHz = 50.0
    air_data_hz: RateHz = 5.0
    status_hz: RateHz = 1.0
    truth_hz: RateHz = 0.0


class Inertial(Section, frozen=True):
    """Which inertial channel is corrected, and the error model of an INS's: one standard deviation each.

    `source` "local_position" is LOCAL_POSITION_NED; "air_data" is dead reckoning of our own, by airspeed and
    attitude; "strapdown" by IMU and attitude; "auto" is air data wherever a position goes back to the
    autopilot. There local position is refused, unless it is `independent`: that of an INS of its own, which
    takes no part of what we send. The defaults of the error model are a navigation-grade unit (0.01 deg/h,
    50 ug).
    """

    source: Literal["auto", "local_position", "air_data", "strapdown"] = "auto"
    independent: bool = False
    gyro_drift_deg_h: Positive = 0.01
    gyro_correlation_h: Positive = 5.0
    angle_random_walk_deg_sqrt_h: NotNegative = 0.002
    accelerometer_bias_ug: Positive = 50.0
    accelerometer_correlation_h: Positive = 1.0
    position_m: Positive = 20.0
    velocity_m_s: Positive = 0.5
    tilt_arcsec: Positive = 20.0
    heading_arcmin: Positive = 3.0
    velocity_noise_m_s_sqrt_s: Positive = 0.001
    height_sigma_m: Positive = 20.0
    strapped_down: bool = True  # its sensors turn with the aircraft, not a gimballed platform's


class AirDataSection(Section, frozen=True):
    """The error model of air-data dead reckoning: one standard deviation each.

    Wind changes by `wind_change_m_s_sqrt_s` times the root of the seconds: 1.5 m/s a minute, 3 m/s in four.
    """

    wind_m_s: Positive = 10.0
    wind_change_m_s_sqrt_s: Positive = 0.2
    wind_jump_m_s: Positive = 4.0  # north and east, of the jumps in which it mostly changes
    gust_m_s: Positive = 0.6
    gust_s: Positive = 0.5
    airspeed_percent: Positive = 2.0
    heading_deg: Positive = 1.5
    correlation_min: Positive = 10.0  # of the errors of airspeed and heading
    wind_rate_m_s_min: Positive = 1.0  # r.m.s., for the guaranteed prediction


class Strapdown(Section, frozen=True):
    """The error model of strapdown by the autopilot's attitude: one standard deviation each.

    `tilt_deg` is the attitude's, correlated over `tilt_s`; an autopilot led astray by a wind it does not know
    of tilts by degrees. What vibration leaves when it is sampled so seldom is `vibration_m_s` in the velocity
    of an instant and `velocity_noise_m_s_sqrt_s` in its growth.
    """

    imu: Annotated[int, Meta(ge=0, le=2)] = 0  # which one of several
    tilt_deg: Positive = 1.5
    tilt_s: Positive = 30.0
    accelerometer_m_s2: Positive = 0.1  # with how it is mounted
    heading_deg: Positive = 2.0
    correlation_min: Positive = 10.0  # of the errors of accelerometers and heading
    vibration_m_s: Positive = 0.3
    velocity_noise_m_s_sqrt_s: Positive = 0.25
    velocity_m_s: Positive = 30.0  # at the first fix, where it tells none


class GnssSection(Section, frozen=True):
    """How far GNSS is believed. Its position error is a drift of `sigma_m` with `correlation_s`, estimated
    beside the inertial errors, and white noise of a third of that, more where the receiver states more.
    """

    receiver: Annotated[int, Meta(ge=0, le=1)] = (
        0  # GPS_RAW_INT is 0, GPS2_RAW 1; what we feed in is never one
    )
    sigma_m: Positive = 2.0
    sigma_velocity_m_s: Positive = 0.1
    correlation_s: Positive = 60.0
    every_s: NotNegative = 0.5  # fixes closer together than this are heard but not used
    use_velocity: bool = True
    latency_s: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.0  # age of a fix at the time it bears; reports tell
    timeout_s: Positive = 3.0


class Rsbn(Section, frozen=True):
    """How far a beacon is believed: the greater of what it states and these floors."""

    sigma_azimuth_deg: Positive = 0.125
    sigma_range_m: Positive = 100.0
    sigma_range_percent: NotNegative = 0.015
    bias_azimuth_deg: Positive = 0.1  # constant errors, learnt while other sources are heard
    bias_range_m: Positive = 50.0
    timeout_s: Positive = 10.0


class Predictor(Section, frozen=True):
    """The window of trusted fixes that the guaranteed prediction learns from, and how far it is believed."""

    window_min: Annotated[float, Meta(gt=0.5, le=80.0)] = 25.0
    bin_s: Annotated[float, Meta(ge=0.1, le=60.0)] = 10.0
    learn_velocity: bool = False
    disturbance_ug: NotNegative = 20.0  # r.m.s. of specific force that the Schuler channel does not know of
    ahead_min: tuple[Annotated[float, Meta(gt=0.0, le=120.0)], ...] = (1.0, 5.0, 10.0, 20.0)
    limit_m: Positive = 5000.0  # a guaranteed bound beyond this is no position any more


class Estimator(Section, frozen=True):
    """Which estimator feeds the output, and the gate that fixes must pass.

    The error state ("kalman") leads while fixes come, and the one named here when they stop: "minimax" those
    of beacons too, "restrictive" those of GNSS. `scheme` "feedback" corrects a channel of our own with every
    fix, "feedforward" only where it is far off; the autopilot's own local position cannot be corrected.
    """

    output: Literal["auto", "minimax", "kalman", "restrictive"] = "auto"
    scheme: Literal["feedforward", "feedback"] = "feedforward"
    false_rejection: Probability = 1e-6
    late_s: Annotated[float, Meta(ge=0.0, le=30.0)] = 6.0


class Integrity(Section, frozen=True):
    """What may go wrong: the horizontal protection level is passed unflagged with probability `risk`, a good
    source is excluded `alarms_per_hour` times an hour, and one that was excluded is refused with probability
    `refusal` though it errs no more than the guaranteed prediction allows.

    Trust is normal while the protection level is below `alert_m`, and gets better after `settle_s` without a
    break, as an excluded source is heard again.
    """

    risk: Probability = 1e-5
    alarms_per_hour: Positive = 1e-3
    refusal: Probability = 0.1
    alert_m: Positive = 500.0
    settle_s: NotNegative = 10.0


class Output(Section, frozen=True):
    """What goes back to the autopilot, and how often: see `companion.profiles`.

    `via` is the message by which a position is fed, "auto" the best of the profile. A rate written here beats
    the profile's; -1 is the profile's own, 0 never.
    """

    profile: Name = "monitor"
    via: Literal["auto"] | Via = "auto"
    switch_sources: bool = True  # profile ardupilot: EKF source set 2 while GNSS is lost, else 1
    solution_hz: Annotated[float, Meta(gt=0.0, le=50.0)] = 5.0  # at least; no less than the fastest message
    odometry_hz: OutputHz = -1.0
    vision_hz: OutputHz = -1.0
    gps_input_hz: OutputHz = -1.0
    global_position_sensor_hz: OutputHz = -1.0
    external_position_hz: Annotated[float, Meta(ge=-1.0, le=1.0)] = -1.0  # each is a reset of its estimator
    status_hz: RateHz = 1.0
    global_position_sensor_id: Annotated[int, Meta(ge=0, le=255)] = 1

    @property
    def way(self) -> Via | None:
        """The way that `via` means, None where the profile has none."""
        return next(iter(PROFILES[self.profile].ways), None) if self.via == "auto" else self.via

    @property
    def rates_hz(self) -> Mapping[str, float]:
        """The rate of each message that we may send, 0 where it does not go out."""
        return _rates_hz(self)

    @property
    def feeds_estimator(self) -> bool:
        """Whether a position of ours goes into the autopilot's own."""
        rates = _rates_hz(self)
        return any(rates[message] > 0.0 for message in MESSAGES.values())

    @property
    def switches_sources(self) -> bool:
        """Whether we tell the autopilot when to take its position from us."""
        return self.switch_sources and self.profile == "ardupilot"

    @property
    def pace_hz(self) -> float:
        """How often a solution is wanted."""
        return max(self.solution_hz, *_rates_hz(self).values())


@lru_cache(maxsize=8)
def _rates_hz(output: Output) -> Mapping[str, float]:
    ways, chosen = PROFILES[output.profile].ways, output.way
    rates = {}
    for via, message in MESSAGES.items():
        own = ways[via].rate_hz if via == chosen and via in ways else 0.0
        written: float = getattr(output, f"{via}_hz")
        rates[message] = own if written < 0.0 else written
    return {**rates, "NAVIGATION_STATUS": output.status_hz}


class Log(Section, frozen=True):
    """Where flights are written."""

    folder: str = "logs"
    chunk_kib: Annotated[int, Meta(ge=64, le=256)] = 128
    minimum_free_mib: Annotated[int, Meta(ge=0)] = 512
    maximum_files: Annotated[int, Meta(ge=1)] = 100


class Signing(Section, frozen=True):
    """MAVLink 2 signing; off while there is no key file (32 bytes or 64 hexadecimal digits, mode 0600)."""

    key_file: str = ""
    stamp_file: str = "signing.stamp"  # the last timestamp, so that a restart replays nothing
    refuse_unsigned: bool = True
    always_accepted: tuple[int, ...] = (109,)  # RADIO_STATUS comes from the radio itself


class Config(Section, frozen=True):
    """Everything."""

    link: Link = Link()
    rates: Rates = Rates()
    inertial: Inertial = Inertial()
    air_data: AirDataSection = AirDataSection()
    strapdown: Strapdown = Strapdown()
    gnss: GnssSection = GnssSection()
    rsbn: Rsbn = Rsbn()
    predictor: Predictor = Predictor()
    estimator: Estimator = Estimator()
    integrity: Integrity = Integrity()
    output: Output = Output()
    log: Log = Log()
    signing: Signing = Signing()

    @property
    def channel(self) -> Channel:
        """The inertial channel that `inertial.source` means, by what goes back to the autopilot."""
        if self.inertial.source != "auto":
            return self.inertial.source
        fed = self.output.feeds_estimator and not self.inertial.independent
        return "air_data" if fed else "local_position"

    @property
    def leading(self) -> Literal["minimax", "kalman", "restrictive"]:
        """The estimator that `estimator.output` means, "auto" by the channel. The restrictive one runs by air
        data only, and has neither jumps of the wind nor states for a turn.
        """
        if self.estimator.output == "auto":
            return "minimax" if self.channel == "local_position" else "kalman"
        return self.estimator.output


def load(
    path: Path | None = None,
    flags: Mapping[str, Any] | None = None,
    environment: Mapping[str, str] | None = None,
    pairs: Iterable[str] = (),
    tuned: Path | None = None,
) -> Config:
    """The configuration of file `path`, then environment, then `flags` (keys "section.key", None: unset),
    then `pairs` ("section.key=value", as typed). `tuned`, what ground stations set, beats `path` and no more.

    Raises `ConfigError` where a file cannot be read, a key is unknown or a value impossible.
    """
    tree: dict[str, dict[str, Any]] = {}
    origin: dict[tuple[str, str], str] = {}
    for source in (path, tuned):
        if source is not None:
            for section, table in _read(source).items():
                tree.setdefault(section, {}).update(table)
                origin |= {(section, key): str(source) for key in table}
    for name, text in (os.environ if environment is None else environment).items():
        if name.startswith(PREFIX):
            section, between, key = name.removeprefix(PREFIX).lower().partition("__")
            if not between:
                raise ConfigError(f"environment variable {name}: it names no key{_nearest_variable(name)}")
            _check_keys({section: {key: text}}, f"environment variable {name}")
            tree.setdefault(section, {})[key] = _parsed(text)
            origin[section, key] = f"environment variable {name}"
    for name, value in (flags or {}).items():
        if value is not None:
            section, key = name.split(".")
            tree.setdefault(section, {})[key] = value
            origin[section, key] = "command line"
    for pair in pairs:
        name, _, text = pair.partition("=")
        section, _, key = name.strip().partition(".")
        if not key or not text:
            raise ConfigError(f"--set {pair}: write it as SECTION.KEY=VALUE, for example gnss.sigma_m=3.0")
        _check_keys({section: {key: text}}, f"--set {pair}")
        tree.setdefault(section, {})[key] = _parsed(text.strip())
        origin[section, key] = f"--set {pair}"
    return _convert(tree, origin)


def parse(text: str, where: str) -> Config:
    """The configuration written in `text`; `where` names it in a `ConfigError`."""
    tree = _tree(text, where)
    _check_keys(tree, where)
    return _convert(tree, {(section, key): where for section, table in tree.items() for key in table})


def to_toml(config: Config) -> str:
    """The whole configuration as the TOML that `load` reads back."""
    lines = []
    for section in config.__struct_fields__:
        table = getattr(config, section)
        lines.append(f"[{section}]")
        # JSON's strings, numbers, booleans and lists are TOML's too
        lines += [
            f"{key} = {msgspec.json.encode(getattr(table, key)).decode()}" for key in table.__struct_fields__
        ]
        lines.append("")
    return "\n".join(lines)


def _read(path: Path) -> dict[str, dict[str, Any]]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; start from `companion check-config --defaults`") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from None
    tree = _tree(text, str(path))
    _check_keys(tree, str(path))
    return tree


def _tree(text: str, where: str) -> dict[str, dict[str, Any]]:
    try:
        tree = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # integers of thousands of digits are none of TOML's errors
        raise ConfigError(f"{where}: is no TOML: {error}") from None
    for section, table in tree.items():
        if not isinstance(table, dict) and section in Config.__struct_fields__:
            raise ConfigError(f"{where}: `{section}` is a section: write [{section}] and its keys below it")
    return {name: table if isinstance(table, dict) else {"": table} for name, table in tree.items()}


def _check_keys(tree: Mapping[str, Mapping[str, Any]], where: str) -> None:
    sections = Config.__struct_fields__
    for section, table in tree.items():
        if section not in sections:
            raise ConfigError(f"{where}: there is no section [{section}]{_nearest(section, sections)}")
        keys = type(getattr(Config(), section)).__struct_fields__
        for key in table:
            if key not in keys:
                raise ConfigError(f"{where}: section [{section}] has no key `{key}`{_nearest(key, keys)}")


def _nearest(name: str, known: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(name, known, 1, 0.4)
    return f"; did you mean `{close[0]}`?" if close else f"; it has {', '.join(known)}"


def _nearest_variable(name: str) -> str:
    tables = {section: type(getattr(Config(), section)) for section in Config.__struct_fields__}
    known = [f"{PREFIX}{s}__{key}".upper() for s, table in tables.items() for key in table.__struct_fields__]
    close = difflib.get_close_matches(name, known, 1, 0.6)
    return f"; did you mean `{close[0]}`?" if close else f"; write it as {PREFIX}SECTION__KEY"


def _parsed(text: str) -> Any:
    """An environment variable's text as TOML would read it, else as a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text


def _listed(value: Any, kind: Any) -> Any:
    """One value where a list is asked for is a list of one."""
    return [value] if get_origin(kind) is tuple and not isinstance(value, list | tuple) else value


def _choices(kind: Any) -> tuple[str, ...]:
    """The words that a key takes, where it takes nothing else."""
    if get_origin(kind) is Literal:
        return get_args(kind)
    if get_origin(kind) in (Union, UnionType):
        return tuple(word for one in get_args(kind) for word in _choices(one))
    return ()


def _convert(tree: Mapping[str, Mapping[str, Any]], origin: Mapping[tuple[str, str], str]) -> Config:
    sections: dict[str, Any] = {}
    for section, table in tree.items():
        kind = type(getattr(Config(), section))
        hints = get_type_hints(kind)
        table = {key: _listed(value, hints[key]) for key, value in table.items()}
        for key, value in table.items():
            try:
                msgspec.convert({key: value}, kind)
            except msgspec.ValidationError as error:
                reason = str(error).split(" - at ")[0].replace("`", "")
                where = origin[section, key]
                if choices := _choices(hints[key]):
                    close = difflib.get_close_matches(str(value), choices, 1, 0.4)
                    nearest = f"; did you mean `{close[0]}`?" if close else ""
                    raise ConfigError(
                        f"{where}: {section}.{key}: {value!r} is none of {', '.join(choices)}{nearest}"
                    ) from None
                raise ConfigError(
                    f"{where}: {section}.{key} = {value!r} is impossible: {reason[0].lower()}{reason[1:]}"
                ) from None
        sections[section] = msgspec.convert(table, kind)
    config = Config(**sections)
    for section, key, sentence in conflicts(config):
        raise ConfigError(f"{origin.get((section, key), 'configuration')}: {sentence}")
    return config
