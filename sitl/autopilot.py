"""Simulated autopilot without I/O: bytes and time in, MAVLink frames out. No clock, no socket.

    autopilot.receive(data, now_ns)         # bytes from the companion
    for data in autopilot.poll(now_ns): ... # every frame due; call it no later than autopilot.deadline()

It sends the records of a `World` as ArduPlane (system 1, component 1) or PX4 would: streams at 1 Hz until
SET_MESSAGE_INTERVAL requests another rate, the newest value repeated where a stream is faster than its
sensor, time since boot, TIMESYNC, commands. Receivers of
beacons and correctors, a component of their own, send each answer once.
Latency, jitter and faults of the link are applied between the two sides.

`now_ns` is the companion's clock; the flight starts at `start_ns` on it. Position and status messages of the
companion are recorded in `outputs`. Where the scenario has an `own_estimate` they correct the autopilot's own
position (`sitl.own_estimate`), which it sends and which its errors are seen in; the aircraft flies its plan.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from msgspec.structs import replace

from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.nav.geometry import displace, geodetic_to_local, local_to_geodetic
from companion.navigator.ground import FLYING_M_S
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    FilterStatus,
    GlobalPosition,
    Gnss,
    HomePosition,
    Imu,
    LocalOrigin,
    LocalPosition,
    Pressure,
    RsbnFix,
    Stamped,
    SystemTime,
    Truth,
)
from companion.units import SECOND_NS
from sitl.encode import SimulatedSender, encode
from sitl.faults import (
    AUTOPILOT_FAULTS,
    CONSUMER_FAULTS,
    LINK_FAULTS,
    Fault,
    TimedBytes,
    apply_link_faults,
    without_fix,
)
from sitl.own_estimate import OwnEstimate
from sitl.parameters import CAPABILITIES, FIRMWARE, VERSIONS, SimulatedParameters
from sitl.scenarios import Scenario
from sitl.world import BOOT_S, GEOID_M, World

NEVER = 2**63 - 1
MOST_UNREAD = 1024  # most frames that wait for a slow consumer
LATENCY_NS, JITTER_S = 4_000_000, 0.002  # of the link to the companion; the mean of an exponential jitter
SYSTEM, COMPONENT, RECEIVER_COMPONENT = 1, 1, 42
UNIX_AT_START_NS = 1_767_225_600 * SECOND_NS
"""The simulated date: 1 January 2026."""

_BASE_MODE = 0x1D  # MAV_MODE_FLAG of a plane in AUTO
_FLAGS_AIDED, _FLAGS_ALONE = 831, 303  # EKF_STATUS_REPORT.flags as ArduPlane has them
_ALONE_AFTER = 10 * SECOND_NS
_SLOW_HZ = 0.2

#: Messages of the companion that are recorded with their arrival time.
RECORDED_MESSAGES = frozenset(
    {"ODOMETRY", "GLOBAL_POSITION_SENSOR", "NAVIGATION_STATUS", "VISION_POSITION_ESTIMATE"}
)
LOCAL_MESSAGES = frozenset({"ODOMETRY", "VISION_POSITION_ESTIMATE"})

_SENSED: dict[str, type[Stamped]] = {
    "LOCAL_POSITION_NED": LocalPosition,
    "ATTITUDE": Attitude,
    "GPS_RAW_INT": Gnss,
    "VFR_HUD": AirData,
    "SCALED_PRESSURE": Pressure,
}
_BY_MAKE: dict[str, dict[str, type[Stamped]]] = {
    "ardupilot": {"RAW_IMU": Imu, "SIM_STATE": Truth},
    "px4": {"HIGHRES_IMU": Imu, "HIL_STATE_QUATERNION": Truth},
}


class SimulatedAutopilot:
    """Aircraft side of one link. `world` may be passed to share it; it must be the scenario's."""

    def __init__(self, scenario: Scenario, start_ns: int = 0, world: World | None = None) -> None:
        self.scenario = scenario
        self.world = world or World(scenario)
        self.outputs: list[tuple[int, Any]] = []
        self.estimate = OwnEstimate(self.world, FIRMWARE) if scenario.own_estimate else None
        self.is_armed = True
        self.end_ns = start_ns + round(scenario.duration_s * 1e9)
        self._start_ns = start_ns
        self._rng = np.random.default_rng([scenario.seed, 1])
        self._link_faults = [f for f in scenario.faults if f.name in LINK_FAULTS]
        self._link_losses = [f for f in self._link_faults if f.name == "link-loss"]
        self._own_faults = sorted(
            (f for f in scenario.faults if f.name in AUTOPILOT_FAULTS), key=lambda f: -f.start_s
        )
        self._slow = [f for f in scenario.faults if f.name == "slow-consumer"]
        self._unread: deque[bytes] = deque(maxlen=MOST_UNREAD)
        self._read_at = 0
        self._reader = frame.Reader()
        self._booting_until = 0  # end of the boot after a reboot
        self._local_origin = self.world.origin
        self._origin_shift = 0.0  # to the north and to the east, m
        self._commands: dict[str, Callable[[Any, int], None]] = {
            "TIMESYNC": self._on_timesync,
            "COMMAND_LONG": self._on_command,
            "COMMAND_INT": self._on_command,
            "PARAM_REQUEST_READ": self._on_parameter,
            "PARAM_SET": self._on_parameter,
        }
        sensed = {**_SENSED, **_BY_MAKE[scenario.autopilot]}
        self._streams = {_msgid(name): self.world.streams[kind] for name, kind in sensed.items()}
        # of receivers that are components of their own: each record is sent once
        self._answers = deque(
            heapq.merge(self.world.streams[RsbnFix], self.world.corrections, key=lambda record: record.rx_ns)
        )
        self.parameters = SimulatedParameters(scenario.autopilot)
        self._gnss_off_ns: int | None = None  # time at which the parameter switched GNSS off
        self._send_queue: list[tuple[int, int, bytes]] = []  # due, order, frame
        self._frames_sent = 0
        self._last_due = 0
        self._generators: dict[int, Callable[[int], Any]] = {
            _msgid("HEARTBEAT"): self._heartbeat,
            _msgid("SYS_STATUS"): self._system_status,
            _msgid("SYSTEM_TIME"): self._system_time,
            _msgid("GLOBAL_POSITION_INT"): self._global_position,
            _msgid("GPS_GLOBAL_ORIGIN"): self._origin,
            _msgid("HOME_POSITION"): self._home,
            _msgid("AUTOPILOT_VERSION"): self._version,
            _msgid(
                "ESTIMATOR_STATUS" if scenario.autopilot == "px4" else "EKF_STATUS_REPORT"
            ): self._filter_status,
        }
        self._boot(-round(BOOT_S * 1e9), 0)

    # -- sans-IO interface --------------------------------------------------------------------------------

    def receive(self, data: bytes, now_ns: int) -> None:
        """Receive bytes that the companion sent at `now_ns`; a lost link loses both directions."""
        t = now_ns - self._start_ns
        if t < self._booting_until or (
            self._link_losses
            and not apply_link_faults([TimedBytes(now_ns, data)], t, self._link_losses, self._rng)
        ):
            return
        for found in self._reader.receive(self._take_unread(data, t)):
            if isinstance(found, frame.Frame):
                name = dialect.TYPES[found.msgid].name
                if name in RECORDED_MESSAGES:
                    self.outputs.append((now_ns, message := dialect.decode(found)))
                    if self.estimate is not None and name in LOCAL_MESSAGES:
                        self.estimate.receive(message, self.origin_record(t), t)
                elif name in self._commands:
                    message = dialect.decode(found)
                    if getattr(message, "target_system", 0) in (0, SYSTEM):
                        self._commands[name](message, t + self._latency())

    def _take_unread(self, data: bytes, t: int) -> bytes:
        """Return the bytes to read now: a slow consumer reads seldom, and old frames are dropped."""
        self._unread.append(data)
        for fault in self._slow:
            size = CONSUMER_FAULTS[fault.name] if fault.size is None else fault.size
            if fault.covers(t) and t - self._read_at < size * SECOND_NS:
                return b""
        self._read_at = t
        data = b"".join(self._unread)
        self._unread.clear()
        return data

    def poll(self, now_ns: int) -> list[bytes]:
        """Return every frame that arrives at the companion up to `now_ns`, in order."""
        t = min(now_ns, self.end_ns) - self._start_ns
        while (next_t := self._next_emission()) <= t:
            self._emit(next_t)
        due = []
        while self._send_queue and self._send_queue[0][0] <= now_ns:
            due.append(heapq.heappop(self._send_queue)[2])
        return due

    def deadline(self) -> int:
        """Return the time of the next frame, `NEVER` after the flight."""
        sending = self._next_emission() + self._start_ns
        sending = sending if sending <= self.end_ns else NEVER
        return min(sending, self._send_queue[0][0] if self._send_queue else NEVER)

    def rates_hz(self) -> dict[str, float]:
        """Return the current rate of each active stream by message name."""
        return {dialect.TYPES[msgid].name: 1e9 / ns for msgid, ns in self._intervals.items() if ns}

    # -- streams ------------------------------------------------------------------------------------------

    def _boot(self, boot_ns: int, from_ns: int) -> None:
        """Boot: time since boot starts at `boot_ns`, every stream at its default rate at `from_ns`."""
        self._sender = SimulatedSender(self.scenario.autopilot, boot_ns)
        self._sequences = {COMPONENT: 0, RECEIVER_COMPONENT: 0}
        self._intervals: dict[int, int] = {}
        self._schedule: list[tuple[int, int]] = []
        self._newest = dict.fromkeys(self._streams, -1)
        for msgid in (*self._generators, *self._streams):
            self._set_rate(msgid, _default_hz(msgid), from_ns)

    def _set_rate(self, msgid: int, rate_hz: float, t: int) -> None:
        self._schedule = [entry for entry in self._schedule if entry[1] != msgid]
        heapq.heapify(self._schedule)
        self._intervals[msgid] = interval = round(1e9 / rate_hz) if rate_hz else 0
        if interval:
            heapq.heappush(self._schedule, (-(-t // interval) * interval, msgid))

    def _emit(self, t: int) -> None:
        """Send all frames due at `t` over the link."""
        if self._own_faults and self._own_faults[-1].start_s * 1e9 <= t:
            self._apply_own_fault(self._own_faults.pop())
            return
        frames = []
        while self._schedule and self._schedule[0][0] <= t:
            msgid = self._schedule[0][1]
            heapq.heapreplace(self._schedule, (t + self._intervals[msgid], msgid))
            message = self._message(msgid, t)
            if message is not None:
                frames.append(self._frame(message, COMPONENT))
        while self._answer_due() <= t:
            message = encode(self._answers.popleft(), self._sender)
            frames.append(self._frame(message, RECEIVER_COMPONENT))
        self._transmit(frames, t)

    def _next_emission(self) -> int:
        """Flight time of the next message of a stream or a receiver, `NEVER` without one."""
        return min(self._schedule[0][0] if self._schedule else NEVER, self._answer_due())

    def _answer_due(self) -> int:
        return self._answers[0].rx_ns if self._answers else NEVER

    def _message(self, msgid: int, t: int) -> Any:
        """The message of a stream at flight time `t`, None before its first record."""
        if msgid in self._generators:
            return self._generators[msgid](t)
        stream, index = self._streams[msgid], self._newest[msgid]
        while index + 1 < len(stream) and stream[index + 1].rx_ns <= t:
            index += 1
        self._newest[msgid] = index
        if index < 0:
            return None
        record = stream[index]
        if record.t_ns < self._sender.boot_ns:
            return None
        if isinstance(record, Gnss) and not self.parameters.gnss_is_on:
            record = without_fix(record)
        if isinstance(record, Gnss) and record.stamp_us:
            boot_shift = -round(BOOT_S * 1e6) - self._sender.boot_ns // 1000
            if boot_shift:
                record = replace(record, stamp_us=max(record.stamp_us + boot_shift, 1))
        if isinstance(record, LocalPosition):
            record = self._from_local_origin(self._local(t) if self.estimate is not None else record)
        return encode(record, self._sender)

    def _frame(self, message: Any, component: int) -> bytes:
        sequence = self._sequences[component]
        self._sequences[component] = sequence + 1 & 0xFF
        return frame.encode(message, sequence, SYSTEM, component)

    def _latency(self) -> int:
        return LATENCY_NS + int(self._rng.exponential(JITTER_S) * 1e9)

    def _transmit(self, frames: list[bytes], t: int) -> None:
        """Put frames sent at `t` on the link; their order is kept except under the fault "reordering"."""
        due = t + self._start_ns + self._latency()
        chunks = [TimedBytes(due, data) for data in frames]
        if self._link_faults:
            chunks = apply_link_faults(chunks, t, self._link_faults, self._rng)
        shuffled = any(f.name == "reordering" and f.covers(t) for f in self._link_faults)
        for due, data in chunks:
            if not shuffled:
                self._last_due = due = max(self._last_due, due)
            self._frames_sent += 1
            heapq.heappush(self._send_queue, (due, self._frames_sent, data))

    def _apply_own_fault(self, fault: Fault) -> None:
        """Start a fault of the autopilot, or end it by applying the opposite jump."""
        start = round(fault.start_s * 1e9)
        size = AUTOPILOT_FAULTS[fault.name] if fault.size is None else fault.size
        size_ns = round(size * 1e9)
        if fault.name == "reboot":
            self._booting_until = start + size_ns
            self._boot(start, self._booting_until)
            while self._answer_due() < self._booting_until:
                self._answers.popleft()
            return
        if fault.name == "clock-jump":
            self._sender = self._sender._replace(boot_ns=self._sender.boot_ns - size_ns)
        else:
            self._origin_shift += size * math.sqrt(0.5)
            self._local_origin = displace(*self.world.origin, self._origin_shift, self._origin_shift, 0.0)
        if math.isfinite(fault.end_s):
            back = Fault(fault.name, fault.end_s, math.inf, -size)
            self._own_faults = sorted([*self._own_faults, back], key=lambda f: -f.start_s)

    def _from_local_origin(self, record: LocalPosition) -> LocalPosition:
        """Refer the local position to the current origin instead of the world's."""
        if not math.isfinite(record.x_n[0]) or self._local_origin == self.world.origin:
            return record
        make = self.scenario.autopilot
        place = local_to_geodetic(make, self.world.origin, record.x_n)
        return replace(record, x_n=geodetic_to_local(make, self._local_origin, place))

    # -- messages without a sensor --------------------------------------------------------------------------

    def _heartbeat(self, t: int) -> Any:
        """PX4 is active once it is armed, ArduPlane while it flies."""
        px4, flight = self.scenario.autopilot == "px4", self.world.flight
        is_active = px4 or np.interp(t * 1e-9, flight.t, flight.airspeed) > FLYING_M_S
        return dialect.new(
            "HEARTBEAT",
            type=mavlink.MAV_TYPE_FIXED_WING,
            autopilot=mavlink.MAV_AUTOPILOT_PX4 if px4 else mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode=_BASE_MODE | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.is_armed else 0),
            custom_mode=10,
            system_status=mavlink.MAV_STATE_ACTIVE if is_active else mavlink.MAV_STATE_STANDBY,
            mavlink_version=3,
        )

    def _system_status(self, t: int) -> Any:
        return encode(AirspeedSensor(t, t, self.scenario.airspeed_sensor), self._sender)

    def _system_time(self, t: int) -> Any:
        boot_shift = -self._sender.boot_ns - round(BOOT_S * 1e9)
        jump = max(boot_shift, 0)  # a clock jump moves UNIX time too, a reboot does not
        record = SystemTime(t, t, boot_ns=t - self._sender.boot_ns, unix_ns=UNIX_AT_START_NS + t + jump)
        return encode(record, self._sender)

    def _origin(self, t: int) -> Any:
        return encode(self.origin_record(t), self._sender)

    def origin_record(self, t: int) -> LocalOrigin:
        """Return the origin of the local position."""
        lat, lon, alt = self._local_origin
        return LocalOrigin(t, t, lat, lon, alt - GEOID_M)

    def _home(self, t: int) -> Any:
        lat, lon, alt = self.world.origin
        return encode(HomePosition(t, t, lat, lon, alt - GEOID_M), self._sender)

    def _version(self, t: int) -> Any:
        make = self.scenario.autopilot
        return dialect.new(
            "AUTOPILOT_VERSION", capabilities=CAPABILITIES[make], flight_sw_version=VERSIONS[make]
        )

    def _newest_record(self, kind: type[Stamped], t: int) -> Any:
        """The newest record of the sensor at `t`, searched from the index of a regular stream."""
        stream = self.world.streams[kind]
        span = max(stream[-1].rx_ns, 1)
        index = min(len(stream) - 1, t * (len(stream) - 1) // span + 2)
        while index > 0 and stream[index].rx_ns > t:
            index -= 1
        return stream[index]

    def _local(self, t: int) -> LocalPosition:
        """The local position at `t` from the world's origin: of its own filter, else of the INS."""
        if self.estimate is None:
            newest: LocalPosition = self._newest_record(LocalPosition, t)
            return newest
        self.estimate.advance(t, self.parameters.gnss_is_on)
        return self.estimate.local_position()

    def _global_position(self, t: int) -> Any:
        local = self._local(t)
        if not math.isfinite(local.x_n[0]):
            return None
        place = local_to_geodetic(self.scenario.autopilot, self.world.origin, local.x_n)
        above = place.alt - self.world.origin.alt
        msl = place.alt - GEOID_M
        heading = self._newest_record(Attitude, t).heading
        record = GlobalPosition(t, t, place.lat, place.lon, msl, local.v_n, above, heading)
        return encode(record, self._sender)

    def _filter_status(self, t: int) -> Any:
        # the filter reports the loss of aiding ten seconds after the loss of the fix
        fixes = (self._newest_record(Gnss, max(t - ago, 0)) for ago in range(0, _ALONE_AFTER, SECOND_NS))
        switched_off = self._gnss_off_ns is not None and t - self._gnss_off_ns >= _ALONE_AFTER
        aided = not switched_off and any(fix.has_3d_fix for fix in fixes)
        flags = _FLAGS_AIDED if aided else _FLAGS_ALONE
        return encode(FilterStatus(t, t, flags, False, 0.05, 1.5 if aided else 50.0), self._sender)

    # -- requests of the companion --------------------------------------------------------------------------

    def _reply(self, name: str, t: int, **values: Any) -> None:
        self._transmit([self._frame(dialect.new(name, **values), COMPONENT)], t)

    def _on_timesync(self, message: Any, t: int) -> None:
        if message.tc1 == 0:
            self._reply("TIMESYNC", t, tc1=t - self._sender.boot_ns, ts1=message.ts1)

    def _on_parameter(self, message: Any, t: int) -> None:
        parameters = self.parameters
        ask = parameters.read if dialect.id_of(message) == _msgid("PARAM_REQUEST_READ") else parameters.set
        if (answer := ask(message)) is not None:
            since = t if self._gnss_off_ns is None else self._gnss_off_ns
            self._gnss_off_ns = None if parameters.gnss_is_on else since
            self._transmit([self._frame(answer, COMPONENT)], t)

    def _on_command(self, message: Any, t: int) -> None:
        command, result = message.command, mavlink.MAV_RESULT_UNSUPPORTED
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            msgid, interval_us = int(message.param1), float(message.param2)
            if msgid in self._intervals:
                result = mavlink.MAV_RESULT_ACCEPTED
                rate = 0.0 if interval_us < 0.0 else 1e6 / interval_us if interval_us else _default_hz(msgid)
                self._set_rate(msgid, rate, t)
        elif command == mavlink.MAV_CMD_REQUEST_MESSAGE and int(message.param1) in self._intervals:
            wanted = self._message(int(message.param1), t)
            result = mavlink.MAV_RESULT_DENIED if wanted is None else mavlink.MAV_RESULT_ACCEPTED
            if wanted is not None:
                self._transmit([self._frame(wanted, COMPONENT)], t)
        elif command == mavlink.MAV_CMD_SET_EKF_SOURCE_SET:
            result = mavlink.MAV_RESULT_ACCEPTED
            if self.estimate is not None:
                self.estimate.receive(message, self.origin_record(t), t)
        elif (
            command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE
            and dialect.id_of(message) == mavlink.MAVLINK_MSG_ID_COMMAND_INT
        ):
            self.outputs.append((t + self._start_ns, message))
            result = mavlink.MAV_RESULT_ACCEPTED
        who = {"target_system": message.get_srcSystem(), "target_component": message.get_srcComponent()}
        self._reply("COMMAND_ACK", t, command=command, result=result, **who)


def _msgid(name: str) -> int:
    return dialect.type_named(name).msgid


_DEFAULT_HZ = {
    "GPS_GLOBAL_ORIGIN": _SLOW_HZ,
    "HOME_POSITION": _SLOW_HZ,
    "AUTOPILOT_VERSION": 0.0,
    "SIM_STATE": 0.0,
    "HIL_STATE_QUATERNION": 0.0,
}


def _default_hz(msgid: int) -> float:
    return _DEFAULT_HZ.get(dialect.TYPES[msgid].name, 1.0)
