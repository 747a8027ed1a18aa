"""One link: its session, what was received on it, and the streams that are requested. No I/O."""

from __future__ import annotations

import math
from collections import Counter, deque

from companion.config import Config
from companion.config.profiles import MESSAGES, RESET
from companion.link.decode import Sender
from companion.link.dialect import mavlink
from companion.link.firmware import Firmware
from companion.link.session import Session
from companion.link.signing import Signing
from companion.navigator.receiver_choice import RECEIVER_MESSAGES
from companion.output.pace import Pace
from companion.units import SECOND_NS

#: ATTITUDE replaces ATTITUDE_QUATERNION for so long.
ATTITUDE_NS = 2 * SECOND_NS
#: Rate of the GNSS receiver that is not used while the other has a fix.
STANDBY_HZ = 2.0
ATTITUDE, QUATERNION = mavlink.MAVLINK_MSG_ID_ATTITUDE, mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


class Link:
    """One link: its session, decoder state and counters."""

    def __init__(self, name: str, config: Config, number: int, signing: Signing | None) -> None:
        self.name = name
        self.session = open_session(config, signing, number)
        self.sender = Sender(self.session.clock)
        self._state_sigmas(config)
        self.pace = Pace()  # of what was asked for on this link
        self.is_open = True  # cleared by the service while the address cannot be opened
        self.has_bytes = False  # anything was received, MAVLink or not
        self.stations: set[int] = set()  # the ground stations received
        self.standing = 0  # how well it works: 2 in both directions, 1 from the autopilot, 0 it is quiet
        self.bad = 0
        self.not_sent: Counter[str] = Counter()  # messages that did not fit their wire format, by reason
        self.dropped = 0  # frames not sent because the line was too slow; set by the service
        self.origin_request_ns = 0  # when the local origin is requested next
        self.firmware: Firmware | None = None
        self.firmware_requests = 0
        self._frames = deque[tuple[int, int]](maxlen=4)  # received and lost, by the second
        self._euler_ns: int | None = None  # when ATTITUDE was last received

    def tune(self, config: Config, now_ns: int) -> None:
        """Go on with another configuration."""
        self.session.set_rates(requested_rates(config), now_ns)
        self._state_sigmas(config)

    def _state_sigmas(self, config: Config) -> None:
        """State the sigmas of beacon answers that have none."""
        sigma_azimuth, sigma_range = math.radians(config.rsbn.sigma_azimuth_deg), config.rsbn.sigma_range_m
        self.sender = self.sender._replace(sigma_azimuth=sigma_azimuth, sigma_range=sigma_range)

    def repeats_attitude(self, msgid: int, now_ns: int) -> bool:
        """Whether this is ATTITUDE_QUATERNION beside ATTITUDE: PX4 sends both, at 50 Hz."""
        if msgid == ATTITUDE:
            self._euler_ns = now_ns
        return msgid == QUATERNION and self._euler_ns is not None and now_ns - self._euler_ns < ATTITUDE_NS

    def note_frames(self) -> None:
        """Note how many frames arrived and were lost; call it once a second."""
        self._frames.append((self.received, self.lost))

    @property
    def is_lossy(self) -> bool:
        """Whether half of the frames of the last three seconds were lost, or none arrived."""
        received, lost = self._frames[0] if self._frames else (-1, 0)
        return self.lost - lost >= self.received - received

    @property
    def lost(self) -> int:
        """Frames lost by sequence number, all senders of this link."""
        return self.session.reader.lost

    @property
    def received(self) -> int:
        """Frames received from all senders of this link."""
        return self.session.reader.received


def open_session(config: Config, signing: Signing | None, number: int = 0) -> Session:
    """Open the session of a link, by its number: with the ids and the rates of the configuration."""
    return Session(
        component=config.link.component_id,
        autopilot_system=config.link.system_id or None,
        rates_hz=requested_rates(config),
        signing=signing,
        link_id=number,
    )


def requested_rates(config: Config) -> dict[str, float]:
    """Return the stream rates to request from the autopilot, Hz by message name."""
    rates, output_hz = config.rates, config.output.rates_hz
    standby_hz = min(rates.gnss_hz, STANDBY_HZ) * config.uses_second_receiver
    is_local = output_hz[MESSAGES["odometry"]] > 0.0 or output_hz[MESSAGES["vision"]] > 0.0
    rates_hz = {
        "LOCAL_POSITION_NED": rates.local_position_hz,
        RECEIVER_MESSAGES[config.gnss.receiver]: rates.gnss_hz,
        "ATTITUDE": rates.attitude_hz,
        "RAW_IMU": rates.imu_hz * (config.output.profile != "px4"),
        "HIGHRES_IMU": rates.imu_hz * (config.output.profile != "ardupilot"),
        "VFR_HUD": rates.air_data_hz,
        "SCALED_PRESSURE": 0.0 if config.has_own_ins else rates.air_data_hz,
        "EKF_STATUS_REPORT": rates.status_hz,
        "SYS_STATUS": 0.0 if config.has_own_ins else rates.status_hz,
        "EXTENDED_SYS_STATE": 0.0 if config.has_own_ins else rates.status_hz,
        "SYSTEM_TIME": float(output_hz["GPS_INPUT"] > 0.0),
        # for the check of the local origin, and for position resets
        "GLOBAL_POSITION_INT": 2.0 * (output_hz[RESET] > 0.0 or (is_local and not config.has_own_ins)),
        "SIM_STATE": rates.truth_hz,
        RECEIVER_MESSAGES[1 - config.gnss.receiver]: standby_hz,
    }
    paced = "LOCAL_POSITION_NED" if config.has_own_ins else "ATTITUDE"
    if 0.0 < rates_hz[paced] < config.output.pace_hz:  # one solution per message of the channel
        rates_hz[paced] = config.output.pace_hz
    return {name: hz for name, hz in rates_hz.items() if hz > 0.0}
