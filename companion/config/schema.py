"""Configuration schema: one frozen structure per section of the file, with the unit in every key.

The meaning of each key, and when to change it, is in `reference`.

Every number has a physical minimum and maximum, because ground stations may set it: whatever passes can be
computed with for hours of flight, and fits the messages that carry it. `validate` adds the limits that a
single interval cannot express.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Annotated, Literal, TypeAlias

import msgspec
from msgspec import Meta

from companion.config.profiles import MESSAGES, PROFILES, Name, Via

RateHz = Annotated[float, Meta(ge=0.0, le=400.0)]
OutputHz = Annotated[float, Meta(ge=-1.0, le=50.0)]
Sensor: TypeAlias = Literal["air_data", "imu"]
NodeId = Annotated[int, Meta(ge=1, le=255)]
HYPOTHESES_PER_JUMP = 22.5  # of the wind: by default the walk is that of a jump of 4 m/s an hour


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table of the file."""


class LinkConfig(Section, frozen=True):
    """Links to the autopilot, and our MAVLink identity."""

    connect: tuple[str, ...] = ("udpin:127.0.0.1:14550",)
    system_id: Annotated[int, Meta(ge=0, le=255)] = 0
    parameters_file: str = ""
    component_id: NodeId = 191


class RatesConfig(Section, frozen=True):
    """Stream rates requested from the autopilot by SET_MESSAGE_INTERVAL; 0 leaves a stream unchanged."""

    local_position_hz: RateHz = 10.0
    gnss_hz: RateHz = 5.0
    attitude_hz: RateHz = 10.0
    imu_hz: RateHz = 20.0
    air_data_hz: RateHz = 5.0
    status_hz: RateHz = 1.0
    truth_hz: RateHz = 0.0


class InertialConfig(Section, frozen=True):
    """The sensors that may be used, and the error model of an INS of its own (one standard deviation each).

    `source` "auto" allows "imu" (with the autopilot's attitude) and "air_data" (airspeed and attitude); each
    alone allows only that one. "local_position" is the velocity of LOCAL_POSITION_NED, which the autopilot's
    estimator has from the same sensors and the same GNSS: it is used alone, and not if a position is sent to
    the autopilot. With `independent`, LOCAL_POSITION_NED comes from an INS of its own that does not use our
    output, and that INS is corrected. The defaults of its error model are those of a navigation-grade unit
    (0.01 deg/h, 50 ug).
    """

    source: Literal["auto", "local_position", "air_data", "imu"] = "auto"
    independent: bool = False
    gyro_drift_deg_h: Annotated[float, Meta(ge=1e-05, le=1000.0)] = 0.01
    gyro_correlation_h: Annotated[float, Meta(ge=0.01, le=1000.0)] = 5.0
    angle_random_walk_deg_sqrt_h: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.002
    accelerometer_bias_ug: Annotated[float, Meta(ge=0.01, le=100000.0)] = 50.0
    accelerometer_correlation_h: Annotated[float, Meta(ge=0.01, le=1000.0)] = 1.0
    position_m: Annotated[float, Meta(ge=0.1, le=100000.0)] = 20.0
    velocity_m_s: Annotated[float, Meta(ge=0.001, le=100.0)] = 0.5
    tilt_arcsec: Annotated[float, Meta(ge=0.1, le=36000.0)] = 20.0
    heading_arcmin: Annotated[float, Meta(ge=0.01, le=10800.0)] = 3.0
    velocity_noise_m_s_sqrt_s: Annotated[float, Meta(ge=1e-6, le=10.0)] = 0.001
    gyro_scale_ppm: Annotated[float, Meta(ge=0.0, le=100000.0)] = 5.0
    accelerometer_scale_ppm: Annotated[float, Meta(ge=0.0, le=100000.0)] = 50.0
    height_sigma_m: Annotated[float, Meta(ge=0.1, le=10000.0)] = 20.0
    correctors: tuple[Literal["airspeed", "hyperbolic", "stars", "second_ins"], ...] = ()
    strapped_down: bool = True


class AirDataConfig(Section, frozen=True):
    """The error model of airspeed, heading and wind: one standard deviation each.

    The wind is a random walk of `wind_change_m_s_sqrt_s`, and now and then it jumps. `crab_deg` is the error
    of the heading, or the sideslip, that lasts seconds. The defaults are supported by recorded flights.
    Jumps are hypotheses, so many that a step is found early. Where they are none (in the guaranteed bound,
    beside an INS) the random walk stands for them, and one of 22 counts.

    A multirotor's accelerometers measure its drag, `rotor_drag_per_s` times its velocity through the air. It
    is estimated within 25 %, so that the default does for most; with 0 it is not used.
    """

    wind_m_s: Annotated[float, Meta(ge=0.1, le=100.0)] = 8.0
    wind_change_m_s_sqrt_s: Annotated[float, Meta(ge=0.0001, le=10.0)] = 0.05
    wind_jump_m_s: Annotated[float, Meta(ge=0.1, le=100.0)] = 6.0
    wind_jumps_per_hour: Annotated[float, Meta(ge=0.001, le=60.0)] = 10.0
    gust_m_s: Annotated[float, Meta(ge=0.01, le=50.0)] = 1.2
    gust_s: Annotated[float, Meta(ge=0.01, le=60.0)] = 1.0
    airspeed_percent: Annotated[float, Meta(ge=0.1, le=50.0)] = 3.0
    heading_deg: Annotated[float, Meta(ge=0.05, le=45.0)] = 1.5
    correlation_min: Annotated[float, Meta(ge=0.1, le=1000.0)] = 10.0
    crab_deg: Annotated[float, Meta(ge=0.05, le=45.0)] = 2.0
    crab_s: Annotated[float, Meta(ge=0.5, le=600.0)] = 20.0
    rotor_drag_per_s: Annotated[float, Meta(ge=0.0, le=5.0)] = 0.23

    @property
    def wind_walk_m_s_sqrt_s(self) -> float:
        """Random walk that stands for the wind's jumps too."""
        jumps = self.wind_jump_m_s**2 * self.wind_jumps_per_hour / 3600.0
        return math.sqrt(self.wind_change_m_s_sqrt_s**2 + jumps / HYPOTHESES_PER_JUMP)


class StrapdownConfig(Section, frozen=True):
    """The error model of the IMU turned by the autopilot's attitude: one standard deviation each.

    `tilt_deg` is the attitude error, correlated over `tilt_s`; in an unmodelled wind the autopilot's tilt is
    off by degrees. Vibration and buffet are measured by the scatter of the samples, and a manoeuvre adds
    noise; `velocity_noise_m_s_sqrt_s` is what neither shows.
    """

    imu: Annotated[int, Meta(ge=0, le=2)] = 0
    tilt_deg: Annotated[float, Meta(ge=0.01, le=30.0)] = 2.0
    tilt_s: Annotated[float, Meta(ge=1.0, le=3600.0)] = 30.0
    accelerometer_m_s2: Annotated[float, Meta(ge=0.0001, le=10.0)] = 0.1
    velocity_noise_m_s_sqrt_s: Annotated[float, Meta(ge=1e-6, le=10.0)] = 0.15


class GnssConfig(Section, frozen=True):
    """GNSS error model and use.

    The position error is a first-order Gauss-Markov process of `sigma_m` and `correlation_s`, estimated with
    the inertial errors, plus white noise of a third of that, or more if the receiver states more.
    """

    receiver: Annotated[int, Meta(ge=0, le=1)] = 0
    second_receiver: bool = True
    sigma_m: Annotated[float, Meta(ge=0.01, le=1000.0)] = 2.0
    sigma_velocity_m_s: Annotated[float, Meta(ge=0.001, le=100.0)] = 0.1
    correlation_s: Annotated[float, Meta(ge=1.0, le=10000.0)] = 60.0
    every_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 0.5
    use_velocity: bool = True
    latency_s: Annotated[float, Meta(ge=0.0, le=2.0)] = 0.0
    timeout_s: Annotated[float, Meta(ge=0.5, le=600.0)] = 3.0


class RsbnConfig(Section, frozen=True):
    """RSBN beacon error model: the greater of the stated sigma and these minimums."""

    sigma_azimuth_deg: Annotated[float, Meta(ge=0.001, le=20.0)] = 0.125
    sigma_range_m: Annotated[float, Meta(ge=0.1, le=10000.0)] = 100.0
    sigma_range_percent: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.015
    bias_azimuth_deg: Annotated[float, Meta(ge=0.001, le=20.0)] = 0.1
    bias_range_m: Annotated[float, Meta(ge=0.1, le=10000.0)] = 50.0
    timeout_s: Annotated[float, Meta(ge=0.5, le=600.0)] = 10.0


class PredictorConfig(Section, frozen=True):
    """The window of trusted fixes that the guaranteed prediction is fitted to, and its limit."""

    window_min: Annotated[float, Meta(ge=1.0, le=60.0)] = 25.0
    bin_s: Annotated[float, Meta(ge=0.1, le=60.0)] = 10.0
    ahead_min: tuple[Annotated[float, Meta(ge=0.1, le=120.0)], ...] = (1.0, 5.0, 10.0, 20.0)
    limit_m: Annotated[float, Meta(ge=1.0, le=1000000.0)] = 5000.0


class EstimatorConfig(Section, frozen=True):
    """The estimator of the output.

    The bank of hypotheses ("kalman", "auto") is used while fixes arrive. Without them `output` names the
    estimator: "minimax" and "restricted" without fixes of any source, "restrictive" without GNSS fixes.
    `scheme` "feedback" corrects the companion's own channel at every fix, "feedforward" only when its error
    is large, a number from 0 to 1 by that share of its error; an INS of its own cannot be corrected.
    `parallel` names filters that run beside the bank, for comparison.
    """

    output: Literal["auto", "minimax", "kalman", "restricted", "restrictive"] = "auto"
    parallel: tuple[Literal["minimax_filter", "restrictive"], ...] = ()
    scheme: Literal["feedforward", "feedback"] | Annotated[float, Meta(ge=0.0, le=1.0)] = "feedforward"
    late_s: Annotated[float, Meta(ge=0.0, le=30.0)] = 6.0

    @property
    def feedback(self) -> float:
        """Share of the estimated error that every fix takes off the companion's own channel."""
        named = {"feedforward": 0.0, "feedback": 1.0}
        return named[self.scheme] if isinstance(self.scheme, str) else self.scheme


class IntegrityConfig(Section, frozen=True):
    """Integrity risk.

    `risk` is the probability that the horizontal protection level is exceeded. Trust is normal while it is
    below `alert_m` and no source is suspect; it improves after `settle_s` without interruption.
    """

    rows: Annotated[int, Meta(ge=8, le=192)] = 96
    risk: Annotated[float, Meta(ge=1e-12, le=0.5)] = 1e-8  # below the prior of one onset
    alert_m: Annotated[float, Meta(ge=1.0, le=100000.0)] = 500.0
    settle_s: Annotated[float, Meta(ge=0.0, le=600.0)] = 10.0


class OutputConfig(Section, frozen=True):
    """The messages to the autopilot and their rates: see `companion.config.profiles`.

    `via` is the message that carries the position, "auto" the first of the profile. A rate set here overrides
    the profile's; -1 is the profile's rate, 0 is never.
    """

    profile: Name = "monitor"
    via: Literal["auto"] | Via = "auto"
    switch_sources: bool = True
    solution_hz: Annotated[float, Meta(ge=0.1, le=50.0)] = 5.0
    odometry_hz: OutputHz = -1.0
    vision_hz: OutputHz = -1.0
    gps_input_hz: OutputHz = -1.0
    global_position_sensor_hz: OutputHz = -1.0
    external_position_hz: Annotated[float, Meta(ge=-1.0, le=1.0)] = -1.0
    status_hz: RateHz = 1.0
    global_position_sensor_id: Annotated[int, Meta(ge=0, le=255)] = 1

    @property
    def method(self) -> Via | None:
        """The output method that `via` selects; None if the profile has none."""
        return next(iter(PROFILES[self.profile].methods), None) if self.via == "auto" else self.via

    @property
    def rates_hz(self) -> Mapping[str, float]:
        """The rate of each message, Hz; 0 if it is not sent."""
        return _rates_hz(self)

    @property
    def feeds_estimator(self) -> bool:
        """Whether a position is sent to the autopilot's estimator."""
        rates = _rates_hz(self)
        return any(rates[message] > 0.0 for message in MESSAGES.values())

    @property
    def switches_sources(self) -> bool:
        """Whether the companion selects the autopilot's EKF source set, or switches PX4's GNSS fusion."""
        switched = PROFILES[self.profile].switched
        return self.switch_sources and any(self.rates_hz[name] > 0.0 for name in switched)

    def fits(self, make: str) -> bool:
        """Whether the profile is for this make of autopilot."""
        return self.profile in ("monitor", "custom", make)

    @property
    def pace_hz(self) -> float:
        """The rate of solutions that the output needs, Hz."""
        return max(self.solution_hz, *_rates_hz(self).values())


@lru_cache(maxsize=8)
def _rates_hz(output: OutputConfig) -> Mapping[str, float]:
    methods, chosen = PROFILES[output.profile].methods, output.method
    rates = {}
    for via, message in MESSAGES.items():
        default = methods[via].rate_hz if via == chosen and via in methods else 0.0
        configured: float = getattr(output, f"{via}_hz")
        rates[message] = default if configured < 0.0 else configured
    return {**rates, "NAVIGATION_STATUS": output.status_hz}


class LogConfig(Section, frozen=True):
    """Flight logs."""

    folder: str = "logs"
    chunk_kib: Annotated[int, Meta(ge=64, le=256)] = 128
    minimum_free_mib: Annotated[int, Meta(ge=0)] = 512
    maximum_files: Annotated[int, Meta(ge=1)] = 100


class SigningConfig(Section, frozen=True):
    """MAVLink 2 signing; off without a key file (32 bytes or 64 hexadecimal digits, mode 0600)."""

    key_file: str = ""
    stamp_file: str = "signing.stamp"
    refuse_unsigned: bool = True
    always_accepted: tuple[int, ...] = (109,)  # RADIO_STATUS: the radio does not sign


class Config(Section, frozen=True):
    """The whole configuration."""

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
    def has_own_ins(self) -> bool:
        """Whether LOCAL_POSITION_NED is that of an INS of its own, which takes no part of what we send."""
        return self.inertial.independent and self.inertial.source in ("auto", "local_position")

    @property
    def uses_second_receiver(self) -> bool:
        """Whether the other GNSS receiver may be used; not the one that GPS_INPUT feeds."""
        return self.gnss.second_receiver and self.output.rates_hz["GPS_INPUT"] == 0.0

    @property
    def uses_local_velocity(self) -> bool:
        """Whether the own channel goes by the velocity of the autopilot's estimator."""
        return self.inertial.source == "local_position" and not self.has_own_ins

    def uses(self, sensor: Sensor) -> bool:
        """Whether the own channel may use a sensor: `inertial.source` allows both or one."""
        return self.inertial.source in ("auto", sensor)

    @property
    def leading_estimator(self) -> Literal["minimax", "kalman", "restricted", "restrictive"]:
        """The estimator that leads when fixes stop; "auto" is the bank's."""
        return "kalman" if self.estimator.output == "auto" else self.estimator.output


#: The type of each section, in the order of the file.
SECTIONS: Mapping[str, type[Section]] = {field.name: field.type for field in msgspec.structs.fields(Config)}
