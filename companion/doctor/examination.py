"""Examination of one link: autopilot, parameters and stream rates against the output profile. No I/O.

    examination.receive(data, now_ns)               # bytes of the link
    examination.poll(now_ns)                        # no later than examination.deadline()
    for data in examination.to_send(): ...          # after either
    examination.diagnosis(now_ns)                   # once is_done(now_ns): the findings

It uses the ids and rates of `companion run`, requests the autopilot's version and the required parameters,
and observes the link for `OBSERVE`. Only message rates are changed on the autopilot, unless `set_parameters`
is called.
"""

from __future__ import annotations

from typing import Any

from companion.config import Config
from companion.config.profiles import MESSAGES, FailsafeLimit, RequiredParameter
from companion.config.required_parameters import failsafe_limits, required_parameters
from companion.doctor.diagnosis import (
    SEVERAL,
    Diagnosis,
    Finding,
    Identity,
    ParameterFinding,
    check_airspeed,
    check_answers,
    check_arming,
    check_failsafe,
    check_feeders,
    check_fusion,
    check_profile,
    check_script,
    check_streams,
)
from companion.link import dialect, frame
from companion.link.decode import MAKES, MULTIROTORS, VTOLS, has_airspeed_sensor
from companion.link.dialect import mavlink, rsbn
from companion.link.firmware import firmware_of
from companion.link.parameter_client import Answer, ParameterClient, encoding_of, equal_real32
from companion.link.session import LinkUp, MessageReceived, NotUnderstood, SecondAutopilot
from companion.link.signing import Signing
from companion.output.source_switch import selected
from companion.printable import printable
from companion.runtime.links import open_session
from companion.units import SECOND_NS

REQUEST_INTERVAL = 1 * SECOND_NS
#: Wait for the autopilot's version; after that its make alone is used.
VERSION_TIMEOUT = 3 * SECOND_NS
#: Observation time, and observation time if something is not well.
OBSERVE, OBSERVE_LONGER = 6 * SECOND_NS, 14 * SECOND_NS
MAX_LOSS = 0.05
PREARM = "PreArm: "
#: Messages that an autopilot sends only when asked, or in answer.
ANSWERS = frozenset({"AUTOPILOT_VERSION", "COMMAND_ACK", "PARAM_VALUE"})
#: Messages by which another component may feed the same input.
FED = frozenset(MESSAGES.values()) - {MESSAGES["external_position"]}


class Examination:
    """One examination of the autopilot on one link."""

    def __init__(self, config: Config, signing: Signing | None = None) -> None:
        self._config = config
        self.session = open_session(config, signing)
        self.bad = 0  # chunks of bytes that are not frames
        self._reader = frame.Reader()  # for frames with our own id, which the session drops
        self._sent: set[bytes] = set()
        self._id_conflicts = 0
        self._start: int | None = None  # time of the first heartbeat
        self._next_request_ns = 0
        self._make_id = 0
        self._heartbeat = dialect.new("HEARTBEAT")
        self._version: Any = None
        self._origin: Any = None
        self._fusion: tuple[int, ...] = ()  # what PX4's estimator is set to fuse
        self._airspeed: bool | None = None  # whether the airspeed sensor is healthy
        self._has_script = False  # the source set script of deploy/ardupilot reports
        self._is_signing = False  # the autopilot signs its frames
        self._is_answering = False  # it answered one of our requests
        self._arming_checks: set[str] = set()  # that fail
        self._feeders: set[str] = set()  # others that send a position to it
        self._others: set[int] = set()
        self._beacons: set[int] = set()
        self._client: ParameterClient | None = None
        self._needed: tuple[RequiredParameter, ...] = ()
        self._limits: tuple[FailsafeLimit, ...] = ()
        self._answers: dict[str, Answer] = {}

    @property
    def is_connected(self) -> bool:
        """Whether an autopilot was found."""
        return self._start is not None

    @property
    def make(self) -> str:
        """The autopilot's make, as in the names of profiles."""
        return MAKES.get(self._make_id, "other")

    def receive(self, data: bytes, now_ns: int) -> None:
        """Process bytes received at `now_ns`."""
        for found in self._reader.receive(data):
            if isinstance(found, frame.Frame):
                ours = (found.system, found.component) == (self.session.system, self.session.component)
                self._id_conflicts += ours and found.raw not in self._sent
        for event in self.session.receive(data, now_ns):
            if isinstance(event, MessageReceived):
                self._on_message(event)
            elif isinstance(event, LinkUp):
                self._start = self._start or now_ns
                self._make_id = event.autopilot
            elif isinstance(event, NotUnderstood):
                self.bad += 1
            elif isinstance(event, SecondAutopilot):
                self._others.add(event.system)

    def poll(self, now_ns: int) -> None:
        """Make the requests that are due."""
        self.session.poll(now_ns)
        if self._start is None:
            return
        if now_ns >= self._next_request_ns:
            self._next_request_ns = now_ns + REQUEST_INTERVAL
            if self._version is None:
                self.session.request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            if self._origin is None:
                self.session.request_message(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            if self.make == "ardupilot" and not self._arming_checks and not self._identity().is_armed:
                self.session.send_command(mavlink.MAV_CMD_RUN_PREARM_CHECKS)
        if self._client is None and (self._version is not None or now_ns - self._start >= VERSION_TIMEOUT):
            self._begin_reading()
        if self._client is not None:
            self._answers |= {answer.name: answer for answer in self._client.poll(now_ns)}
            for message in self._client.to_send():
                self.session.send(message)

    def to_send(self) -> list[bytes]:
        """Return the frames to write now."""
        frames = self.session.to_send()
        self._sent.update(frames)
        return frames

    def deadline(self) -> int:
        """Return the latest time of the next `poll`, ns."""
        due = [self.session.deadline()]
        if self._start is not None:
            due.append(self._next_request_ns)
        if self._client is not None and (asking := self._client.deadline()) is not None:
            due.append(asking)
        return min(due)

    def is_done(self, now_ns: int) -> bool:
        """Whether all parameters are read and the observation time is over."""
        if self._start is None or not self.has_all_parameters:
            return False
        return now_ns - self._start >= (OBSERVE if self.diagnosis(now_ns).is_well else OBSERVE_LONGER)

    @property
    def has_all_parameters(self) -> bool:
        """Whether every parameter read or set was answered, or its retries are used up."""
        return self._client is not None and self._client.is_idle

    def set_parameters(self) -> None:
        """Set the wrong parameters that exist; `has_all_parameters` is true once they are read back."""
        assert self._client is not None
        for need in self._needed:
            answer = self._answers[need.name]
            if answer.value is not None and not equal_real32(answer.value, need.value):
                self._client.set(need.name, need.value)

    def diagnosis(self, now_ns: int) -> Diagnosis:
        """Return the findings up to now."""
        return Diagnosis(self._identity(), self._parameters(), tuple(self._findings(now_ns)))

    # -- input ----------------------------------------------------------------------------------------------

    def _on_message(self, event: MessageReceived) -> None:
        if event.frame.msgid == rsbn.MAVLINK_MSG_ID_RSBN_MEASUREMENT:
            self._beacons.add(event.message.beacon_id)
        if not event.from_autopilot:
            sender, autopilot = (event.frame.system, event.frame.component), self.session.autopilot
            # what the autopilot itself sends before its first HEARTBEAT is not known as such
            is_other = autopilot is not None and sender != (autopilot, mavlink.MAV_COMP_ID_AUTOPILOT1)
            if (name := event.message.get_type()) in FED and is_other:
                self._feeders.add("{} of {}/{}".format(name, *sender))
            return
        self._is_signing |= event.frame.signature is not None
        self._is_answering |= event.message.get_type() in ANSWERS
        if event.frame.msgid == mavlink.MAVLINK_MSG_ID_STATUSTEXT and event.message.text.startswith(PREARM):
            self._arming_checks.add(printable(event.message.text.removeprefix(PREARM)))
        elif event.frame.msgid == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            self._heartbeat = event.message
        elif event.frame.msgid == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            self._version = event.message
        elif event.frame.msgid == mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN:
            self._origin = event.message
        elif event.frame.msgid == rsbn.MAVLINK_MSG_ID_ESTIMATOR_SENSOR_FUSION_STATUS:
            self._fusion = tuple(event.message.intended)
        elif event.frame.msgid == mavlink.MAVLINK_MSG_ID_SYS_STATUS:
            self._airspeed = has_airspeed_sensor(event.message)
        elif (by := selected(event.message, event.from_autopilot, 0)) is not None and by.is_report:
            self._has_script = True
        if self._client is not None:
            answers = self._client.receive(event.message, event.frame)
            self._answers |= {answer.name: answer for answer in answers}

    def _begin_reading(self) -> None:
        capabilities = None if self._version is None else self._version.capabilities
        encoding = encoding_of(capabilities, self._heartbeat.autopilot)
        self._client = ParameterClient(self.session.autopilot or 0, mavlink.MAV_COMP_ID_AUTOPILOT1, encoding)
        if self._config.output.fits(self.make):
            self._needed = required_parameters(self._config, self.make)
            hovers = self._heartbeat.type in MULTIROTORS | VTOLS
            self._limits = failsafe_limits(self._config, self.make, hovers)
            self._client.read(p.name for p in self._needed)
            self._client.read(p.name for p in self._limits)

    # -- findings -------------------------------------------------------------------------------------------

    def _identity(self) -> Identity:
        kind = self._heartbeat.type
        vehicle = "VTOL with a wing" if kind in VTOLS else dialect.entry_name("MAV_TYPE", kind)
        firmware = None if self._version is None else firmware_of(self._version)
        version = "" if firmware is None else str(firmware)
        armed = bool(self._heartbeat.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        return Identity(self.session.autopilot or 0, self.make, vehicle, version, armed)

    def _parameters(self) -> tuple[ParameterFinding, ...]:
        found = []
        for need in self._needed:
            answer = self._answers.get(need.name, Answer(need.name, None, "not asked yet"))
            found.append(ParameterFinding(need, answer.value, answer.trouble))
        return tuple(found)

    def _has_parameters(self) -> bool:
        """Whether the autopilot has every required parameter as it must be."""
        return all(found.is_well for found in self._parameters())

    def _findings(self, now: int) -> list[Finding]:
        beacons = ", ".join(map(str, sorted(self._beacons)))
        return [
            *check_profile(self._config, self.make),
            *check_streams(self._config, self.make, self.session.stream_rates.rates(), self._is_answering),
            *check_airspeed(self._config, self._airspeed, self._heartbeat.type),
            *check_failsafe(self._limits, {name: answer.value for name, answer in self._answers.items()}),
            *check_script(self._config, self.make, self._has_script),
            *(check_fusion(self._config, self.make, self._fusion) if self._has_parameters() else ()),
            *check_arming(self.make, self._arming_checks, self._is_answering),
            *check_answers(self._is_answering, self._is_signing),
            *check_feeders(self._feeders),
            *self._check_link(now),
            Finding("RSBN beacons", beacons or "none", "", None),
        ]

    def _check_link(self, now: int) -> list[Finding]:
        session, found = self.session, list[Finding]()
        counts = session.reader.counts.get(
            (session.autopilot or 0, mavlink.MAV_COMP_ID_AUTOPILOT1), frame.Counts(0, 0)
        )
        loss = counts.lost / max(counts.lost + counts.received, 1)
        advice = "check line speed, cable length and common ground"
        found.append(
            Finding("frames lost", f"{loss:.1%}", f"at most {MAX_LOSS:.0%}", loss <= MAX_LOSS, advice)
        )
        half = session.clock.uncertainty(now)
        found.append(
            Finding(
                "TIMESYNC",
                "no answer" if half is None else f"{2e-6 * half:.1f} ms round trip",
                "answers",
                half is not None,
                "let TIMESYNC through the router; without it arrival times are used",
            )
        )
        if (rate := session.clock.rate) != 1.0:
            advice = "fly the simulation in real time: nothing of a clock that is too fast is used"
            found.append(Finding("clock", f"{rate:g} times as fast as ours", "real time", False, advice))
        place = "not known"
        if self._origin is not None:
            place = f"{self._origin.latitude * 1e-7:.5f}, {self._origin.longitude * 1e-7:.5f}"
        advice = "wait under an open sky for the first 3D fix"
        is_known = True if self._origin is not None else False if self._is_answering else None
        found.append(Finding("GPS_GLOBAL_ORIGIN", place, "known", is_known, advice))
        who = f"{session.system}/{session.component}"
        advice = "another component uses our id; stop `companion run` or set link.component_id"
        found.append(
            Finding(
                "our id",
                f"{who} {'used twice' if self._id_conflicts else 'free'}",
                "free",
                not self._id_conflicts,
                advice,
            )
        )
        if self._others:
            others = ", ".join(map(str, sorted({*self._others, session.autopilot or 0})))
            advice = "set link.system_id to the intended one"
            found.append(Finding(SEVERAL, others, "one", bool(self._config.link.system_id), advice))
        if refused := session.rejected.total():
            found.append(
                Finding(
                    "frames rejected",
                    str(refused),
                    "0",
                    False,
                    "let all senders sign with the key of signing.key_file",
                )
            )
        return found
