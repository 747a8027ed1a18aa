"""Configuration schema: frozen structures, one per section of the file, with the unit in every key."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from companion.config.profiles import MESSAGES, PROFILES, Name, Via

Positive = Annotated[float, Meta(gt=0.0, lt=1e9)]
NotNegative = Annotated[float, Meta(ge=0.0, lt=1e9)]
Probability = Annotated[float, Meta(gt=0.0, lt=1.0)]
RateHz = Annotated[float, Meta(ge=0.0, le=400.0)]
OutputHz = Annotated[float, Meta(ge=-1.0, le=50.0)]
Channel: TypeAlias = Literal["local_position", "air_data", "strapdown"]
NodeId = Annotated[int, Meta(ge=1, le=255)]


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table of the file."""


class LinkConfig(Section, frozen=True):
    """Where the autopilot is, and who we are on its network."""

    connect: tuple[str, ...] = ("udpin:127.0.0.1:14550",)  # each link is one; see `companion run --help`
    system_id: Annotated[int, Meta(ge=0, le=255)] = 0  # 0: take the autopilot's own
    parameters_file: str = ""  # what ground stations set is kept here and read at the next start
    component_id: NodeId = 191  # MAV_COMP_ID_ONBOARD_COMPUTER; 197 is visual-inertial odometry


class RatesConfig(Section, frozen=True):
    """What is asked of the autopilot by SET_MESSAGE_INTERVAL; 0 leaves a stream as it is."""

    local_position_hz: RateHz = 10.0
    gnss_hz: RateHz = 5.0
    attitude_hz: RateHz = 10.0
    imu_hz: RateHz = 50.0
    air_data_hz: RateHz = 5.0
    status_hz: RateHz = 1.0
    truth_hz: RateHz = 0.0


class InertialConfig(Section, frozen=True):
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


class AirDataConfig(Section, frozen=True):
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


class StrapdownConfig(Section, frozen=True):
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


class GnssConfig(Section, frozen=True):
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


class RsbnConfig(Section, frozen=True):
    """How far a beacon is believed: the greater of what it states and these floors."""

    sigma_azimuth_deg: Positive = 0.125
    sigma_range_m: Positive = 100.0
    sigma_range_percent: NotNegative = 0.015
    bias_azimuth_deg: Positive = 0.1  # constant errors, learnt while other sources are heard
    bias_range_m: Positive = 50.0
    timeout_s: Positive = 10.0


class PredictorConfig(Section, frozen=True):
    """The window of trusted fixes that the guaranteed prediction learns from, and how far it is believed."""

    window_min: Annotated[float, Meta(gt=0.5, le=80.0)] = 25.0
    bin_s: Annotated[float, Meta(ge=0.1, le=60.0)] = 10.0
    learn_velocity: bool = False
    disturbance_ug: NotNegative = 20.0  # r.m.s. of specific force that the Schuler channel does not know of
    ahead_min: tuple[Annotated[float, Meta(gt=0.0, le=120.0)], ...] = (1.0, 5.0, 10.0, 20.0)
    limit_m: Positive = 5000.0  # a guaranteed bound beyond this is no position any more


class EstimatorConfig(Section, frozen=True):
    """Which estimator feeds the output, and the gate that fixes must pass.

    The error state ("kalman") leads while fixes come, and the one named here when they stop: "minimax" those
    of beacons too, "restrictive" those of GNSS. `scheme` "feedback" corrects a channel of our own with every
    fix, "feedforward" only where it is far off; the autopilot's own local position cannot be corrected.
    """

    output: Literal["auto", "minimax", "kalman", "restrictive"] = "auto"
    scheme: Literal["feedforward", "feedback"] = "feedforward"
    false_rejection: Probability = 1e-6
    late_s: Annotated[float, Meta(ge=0.0, le=30.0)] = 6.0


class IntegrityConfig(Section, frozen=True):
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


class OutputConfig(Section, frozen=True):
    """What goes back to the autopilot, and how often: see `companion.config.profiles`.

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
def _rates_hz(output: OutputConfig) -> Mapping[str, float]:
    ways, chosen = PROFILES[output.profile].ways, output.way
    rates = {}
    for via, message in MESSAGES.items():
        own = ways[via].rate_hz if via == chosen and via in ways else 0.0
        written: float = getattr(output, f"{via}_hz")
        rates[message] = own if written < 0.0 else written
    return {**rates, "NAVIGATION_STATUS": output.status_hz}


class LogConfig(Section, frozen=True):
    """Where flights are written."""

    folder: str = "logs"
    chunk_kib: Annotated[int, Meta(ge=64, le=256)] = 128
    minimum_free_mib: Annotated[int, Meta(ge=0)] = 512
    maximum_files: Annotated[int, Meta(ge=1)] = 100


class SigningConfig(Section, frozen=True):
    """MAVLink 2 signing; off while there is no key file (32 bytes or 64 hexadecimal digits, mode 0600)."""

    key_file: str = ""
    stamp_file: str = "signing.stamp"  # the last timestamp, so that a restart replays nothing
    refuse_unsigned: bool = True
    always_accepted: tuple[int, ...] = (109,)  # RADIO_STATUS comes from the radio itself


class Config(Section, frozen=True):
    """Everything."""

    link: LinkConfig = LinkConfig()
    rates: RatesConfig = RatesConfig()
    inertial: InertialConfig = InertialConfig()
    air_data: AirDataConfig = AirDataConfig()
    strapdown: StrapdownConfig = StrapdownConfig()
    gnss: GnssConfig = GnssConfig()
    rsbn: RsbnConfig = RsbnConfig()
    predictor: PredictorConfig = PredictorConfig()
    estimator: EstimatorConfig = EstimatorConfig()
    integrity: IntegrityConfig = IntegrityConfig()
    output: OutputConfig = OutputConfig()
    log: LogConfig = LogConfig()
    signing: SigningConfig = SigningConfig()

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
