"""Input monitor: which inputs never arrived, are slow or have stopped, and what to do. No I/O, no clock.

    for event in monitor.update(link, config, now_ns): ...    # once a second
    monitor.missing, monitor.slow                             # names for the status line

Only what the navigator uses is reported, once when it has been missing for `PATIENCE`, and once when it is
back. The table of used streams serves `companion doctor` too.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from functools import lru_cache
from typing import NamedTuple

from companion.config import Config, Sensor
from companion.link.dialect import TYPES
from companion.link.session import Session
from companion.link.stream_rates import ENOUGH
from companion.navigator.receiver_choice import RECEIVER_MESSAGES
from companion.navigator.state import Settings
from companion.navigator.step import uses
from companion.records import (
    AirData,
    AirspeedSensor,
    Attitude,
    Event,
    GlobalPosition,
    Gnss,
    Imu,
    LocalPosition,
    Pressure,
    Severity,
    SystemTime,
)
from companion.units import SECOND_NS

#: A lost request is repeated after 5 s and measured for 5 s: report only what is missing for longer.
PATIENCE = 12 * SECOND_NS
#: First report that no autopilot is received.
NO_AUTOPILOT_AFTER = 5 * SECOND_NS
#: Messages that a make does not send; it has others with the same content.
MISSING_MESSAGES = {
    "ardupilot": frozenset({"HIGHRES_IMU"}),
    "px4": frozenset({"RAW_IMU", "EKF_STATUS_REPORT", "SIM_STATE"}),
}
#: Sensor of `inertial.source` that a record belongs to; the others are always used.
SENSORS: Mapping[type, Sensor] = {Imu: "imu", AirData: "air_data", AirspeedSensor: "air_data"}


class Stream(NamedTuple):
    """What a stream carries, in words and as a record, and the key of `rates` that requests it.

    Without a key the output requests it, at a rate of its own, and needs it whatever the navigator uses.
    """

    what: str
    record: type | None
    key: str | None


STREAMS: Mapping[str, Stream] = {
    "LOCAL_POSITION_NED": Stream("local position", LocalPosition, "local_position_hz"),
    "GPS_RAW_INT": Stream("GNSS", Gnss, "gnss_hz"),
    "GPS2_RAW": Stream("second GNSS", Gnss, "gnss_hz"),
    "ATTITUDE": Stream("attitude", Attitude, "attitude_hz"),
    "RAW_IMU": Stream("IMU", Imu, "imu_hz"),
    "HIGHRES_IMU": Stream("IMU", Imu, "imu_hz"),
    "VFR_HUD": Stream("airspeed", AirData, "air_data_hz"),
    "SCALED_PRESSURE": Stream("pressure", Pressure, "air_data_hz"),
    "SYS_STATUS": Stream("sensor health", AirspeedSensor, "status_hz"),
    "GLOBAL_POSITION_INT": Stream("EKF position", GlobalPosition, None),
    "SYSTEM_TIME": Stream("time of day", SystemTime, None),
    # not missed: only multirotors need it, or only logged
    "EXTENDED_SYS_STATE": Stream("landed or flying", None, "status_hz"),
    "EKF_STATUS_REPORT": Stream("state of the EKF", None, "status_hz"),
    "SIM_STATE": Stream("truth", None, "truth_hz"),
}


class StreamState(NamedTuple):
    """Requested and measured rate of a stream, Hz; `measured` None before the first measurement."""

    name: str
    requested: float
    measured: float | None
    is_used: bool

    @property
    def is_enough(self) -> bool:
        """Whether it arrives often enough."""
        return (self.measured or 0.0) >= ENOUGH * self.requested


def stream_states(
    config: Config, make: str, rates: Mapping[int, tuple[float, float | None]]
) -> Iterator[StreamState]:
    """Yield the state of each requested stream that the make sends; `rates` by message id, Hz."""
    used, second = _used_records(config), RECEIVER_MESSAGES[1 - config.gnss.receiver]
    for msgid, (requested, measured) in rates.items():
        name = TYPES[msgid].name
        is_absent = name == second and not measured  # few have a second one
        if name not in MISSING_MESSAGES.get(make, ()) and not is_absent:
            stream = STREAMS[name]
            yield StreamState(name, requested, measured, stream.key is None or stream.record in used)


@lru_cache(maxsize=4)
def _used_records(config: Config) -> frozenset[type]:
    kinds = uses(Settings.of(config))
    return frozenset(kind for kind in kinds if kind not in SENSORS or config.uses(SENSORS[kind]))


#: What to do where nothing arrives, by the kind of the link.
NOTHING_ARRIVES = {
    "serial": "check the wiring (TX to RX), the baud rate and the port's MAVLink protocol",
    "udpin": "check that the autopilot or router sends to this address and port, and the firewall",
    "tcpin": "check that the autopilot or router connects to this address and port, and the firewall",
}


def describe_silence(link: str, session: Session, has_bytes: bool) -> str:
    """Return what was received on a link without an autopilot, and what to check."""
    if session.rejected:
        reasons = ", ".join(reason.name.lower() for reason in session.rejected)
        return f"frames rejected ({reasons}); let it sign with the key of signing.key_file"
    if senders := [f"{system}/{component}" for system, component in session.reader.counts]:
        advice = "check the autopilot's connection"
        if session.required_system is not None:
            advice += f"; link.system_id = {session.required_system} must be its system id, or 0 for any"
        return f"received only {', '.join(senders)}; {advice}"
    if has_bytes:
        return "bytes but no MAVLink received; check that the other side sends MAVLink, at the same baud rate"
    advice = NOTHING_ARRIVES.get(link.split(":")[0], "check the address, and that the other side runs")
    if link.startswith(("udpin:127.", "tcpin:127.")):
        advice += "; a loopback address is reached from this computer only"
    return f"no data received; {advice}"


class InputMonitor:
    """Reports of missing inputs on the link that leads."""

    def __init__(self) -> None:
        self.missing: tuple[str, ...] = ()
        self.slow: tuple[str, ...] = ()
        self._arrived: set[str] = set()
        self._bad_since: dict[str, int] = {}
        self._reported: set[str] = set()
        self._was_connected = False
        self._open_since: dict[str, int] = {}
        self._silence_since: dict[tuple[str, bool, bool, bool], int] = {}
        self._silence_reported: set[tuple[str, bool, bool, bool]] = set()

    def update(self, session: Session, config: Config, make: str, now_ns: int) -> list[Event]:
        """Return what went missing or came back on a link whose autopilot is received."""
        self._was_connected = True  # a link lost later is an event of its own
        events, missing, slow = list[Event](), list[str](), list[str]()
        for state in stream_states(config, make, session.stream_rates.rates()):
            if not state.is_used or state.measured is None:
                continue
            stream = STREAMS[state.name]
            if state.is_enough:
                self._arrived.add(state.name)
                self._bad_since.pop(state.name, None)
                if state.name in self._reported:
                    self._reported.discard(state.name)
                    text = f"{stream.what} ({state.name}) arrives again at {state.measured:.1f} Hz"
                    events.append(Event(now_ns, now_ns, Severity.NOTICE, text))
                continue
            if now_ns - self._bad_since.setdefault(state.name, now_ns) < PATIENCE:
                continue
            (slow if state.measured else missing).append(stream.what)
            if state.name not in self._reported:
                self._reported.add(state.name)
                text = f"{stream.what} ({state.name}) {self._trouble(state, stream)}"
                events.append(Event(now_ns, now_ns, Severity.WARNING, text))
        self.missing, self.slow = tuple(dict.fromkeys(missing)), tuple(dict.fromkeys(slow))
        return events

    def report_silence(self, sessions: Collection[tuple[str, Session, bool]], now_ns: int) -> list[Event]:
        """Return why an open link has no autopilot, again when something else arrives on it for five seconds.

        `sessions` has the name and session of each open link, and whether bytes arrived.
        """
        if self._was_connected:
            return []
        events = list[Event]()
        for name, session, has_bytes in sessions:
            open_ns = self._open_since.setdefault(name, now_ns)
            state = (name, bool(session.rejected), bool(session.reader.counts), has_bytes)
            since_ns = self._silence_since.setdefault(state, now_ns)
            if state in self._silence_reported or now_ns - since_ns < NO_AUTOPILOT_AFTER:
                continue
            self._silence_reported.add(state)
            seconds = (now_ns - open_ns) / SECOND_NS
            what = describe_silence(name, session, has_bytes)
            text = f"{name}: no autopilot in {seconds:.0f} s: {what}"
            events.append(Event(now_ns, now_ns, Severity.WARNING, text))
        return events

    def _trouble(self, state: StreamState, stream: Stream) -> str:
        if state.measured:
            advice = "use a faster line" + (f", or lower rates.{stream.key}" if stream.key else "")
            return f"is slow: {state.measured:.1f} of {state.requested:g} Hz; {advice}"
        if state.name in self._arrived:
            return "has stopped; check its sensor and the line"
        return "never arrived; does the autopilot have the sensor, and does a router pass this message?"
