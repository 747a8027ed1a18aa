"""What an autopilot and the way to it lack for the configured output profile. No clock, no I/O.

    examination.receive(data, now_ns)               # bytes of the link
    examination.poll(now_ns)                        # no later than examination.deadline()
    for data in examination.to_send(): ...          # after either
    examination.diagnosis(now_ns)                   # once is_done(now_ns): what was found

It speaks with the ids and rates that `companion run` would, asks for what makes the autopilot known and for
the parameters that the profile needs, and watches for WATCHED what comes. Nothing is changed on the autopilot
but its message rates, unless `change` is called.
"""

from __future__ import annotations

from typing import Any

from companion.config import Config
from companion.config.profiles import Needed
from companion.config.required_parameters import needed
from companion.doctor.diagnosis import Diagnosis, Finding, Identity, ParameterFinding, of_profile, of_streams
from companion.link import dialect, frame
from companion.link.clock import SECOND
from companion.link.decode import MAKES
from companion.link.parameter_client import Answer, ParameterClient, encoding_of, same
from companion.link.session import (
    AUTOPILOT_COMPONENT,
    LinkUp,
    MessageReceived,
    NotUnderstood,
    SecondAutopilot,
    Session,
)
from companion.link.signing import Signing
from companion.runtime.core import wanted

HEARTBEAT, GPS_GLOBAL_ORIGIN, AUTOPILOT_VERSION = 0, 49, 148
RSBN_MEASUREMENT = dialect.type_named("RSBN_MEASUREMENT").msgid
REQUEST_MESSAGE = 512  # MAV_CMD
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
ASK_EVERY = 1 * SECOND
#: So long the autopilot may take to tell its version before its make alone is believed.
PATIENCE = 3 * SECOND
#: What comes is watched for so long, and where something is amiss for so long.
WATCHED, WATCHED_LONGER = 6 * SECOND, 14 * SECOND
GREATEST_LOSS = 0.05
STAGES = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}  # FIRMWARE_VERSION_TYPE


class Examination:
    """One look at the autopilot of one link."""

    def __init__(self, config: Config, signing: Signing | None = None) -> None:
        self._config = config
        self.session = Session(
            component=config.link.component_id,
            autopilot_system=config.link.system_id or None,
            rates_hz=wanted(config),
            signing=signing,
        )
        self.bad = 0  # chunks of bytes that are no frame
        self._reader = frame.Reader()  # for frames in our own name, which the session does not show
        self._sent: set[bytes] = set()
        self._doubles = 0
        self._begun: int | None = None  # when the autopilot was first heard
        self._asked_at = 0
        self._make_id = 0
        self._heartbeat = dialect.new("HEARTBEAT")
        self._version: Any = None
        self._origin: Any = None
        self._others: set[int] = set()
        self._beacons: set[int] = set()
        self._client: ParameterClient | None = None
        self._needed: tuple[Needed, ...] = ()
        self._answers: dict[str, Answer] = {}

    @property
    def is_heard(self) -> bool:
        """Whether the autopilot was heard."""
        return self._begun is not None

    @property
    def make(self) -> str:
        """The autopilot's make, as profiles are called."""
        return MAKES.get(self._make_id, "other")

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take bytes that came at `now_ns`."""
        for found in self._reader.receive(data):
            if isinstance(found, frame.Frame):
                ours = (found.system, found.component) == (self.session.system, self.session.component)
                self._doubles += ours and found.raw not in self._sent
        for event in self.session.receive(data, now_ns):
            if isinstance(event, MessageReceived):
                self._on_message(event)
            elif isinstance(event, LinkUp):
                self._begun = self._begun or now_ns
                self._make_id = event.autopilot
            elif isinstance(event, NotUnderstood):
                self.bad += 1
            elif isinstance(event, SecondAutopilot):
                self._others.add(event.system)

    def poll(self, now_ns: int) -> None:
        """Do what is due."""
        self.session.poll(now_ns)
        if self._begun is None:
            return
        if now_ns >= self._asked_at:
            self._asked_at = now_ns + ASK_EVERY
            if self._version is None:
                self._ask_for(AUTOPILOT_VERSION)
            if self._origin is None:
                self._ask_for(GPS_GLOBAL_ORIGIN)
        if self._client is None and (self._version is not None or now_ns - self._begun >= PATIENCE):
            self._begin_reading()
        if self._client is not None:
            self._answers |= {answer.name: answer for answer in self._client.poll(now_ns)}
            for message in self._client.to_send():
                self.session.send(message)

    def to_send(self) -> list[bytes]:
        """The frames to be written now."""
        frames = self.session.to_send()
        self._sent.update(frames)
        return frames

    def deadline(self) -> int:
        """When `poll` must be called at the latest."""
        due = [self.session.deadline()]
        if self._begun is not None:
            due.append(self._asked_at)
        if self._client is not None and (asking := self._client.deadline()) is not None:
            due.append(asking)
        return min(due)

    def is_done(self, now_ns: int) -> bool:
        """Whether everything was seen that there is to be seen."""
        if self._begun is None or not self.is_read:
            return False
        watched = now_ns - self._begun
        return watched >= (WATCHED if self.diagnosis(now_ns).is_well else WATCHED_LONGER)

    @property
    def is_read(self) -> bool:
        """Whether every parameter asked for, or changed, was answered or given up."""
        return self._client is not None and self._client.is_idle

    def change(self) -> None:
        """Set what is not as needed, as far as it is there; `is_done` tells when it is proved or refused."""
        assert self._client is not None
        for need in self._needed:
            answer = self._answers[need.name]
            if answer.value is not None and not same(answer.value, need.value):
                self._client.set(need.name, need.value)

    def diagnosis(self, now_ns: int) -> Diagnosis:
        """What was found up to now."""
        return Diagnosis(self._identity(), self._parameters(), tuple(self._findings(now_ns)))

    # -- what is heard --------------------------------------------------------------------------------------

    def _on_message(self, event: MessageReceived) -> None:
        if event.frame.msgid == RSBN_MEASUREMENT:
            self._beacons.add(event.message.beacon_id)
        if not event.from_autopilot:
            return
        if event.frame.msgid == HEARTBEAT:
            self._heartbeat = event.message
        elif event.frame.msgid == AUTOPILOT_VERSION:
            self._version = event.message
        elif event.frame.msgid == GPS_GLOBAL_ORIGIN:
            self._origin = event.message
        if self._client is not None:
            answers = self._client.receive(event.message, event.frame)
            self._answers |= {answer.name: answer for answer in answers}

    def _begin_reading(self) -> None:
        capabilities = None if self._version is None else self._version.capabilities
        encoding = encoding_of(capabilities, self._heartbeat.autopilot)
        self._client = ParameterClient(self.session.autopilot or 0, AUTOPILOT_COMPONENT, encoding)
        if self._is_its_profile:
            self._needed = needed(self._config, self.make)
            self._client.read(need.name for need in self._needed)

    def _ask_for(self, msgid: int) -> None:
        self.session.send(
            dialect.new(
                "COMMAND_LONG",
                target_system=self.session.autopilot or 0,
                target_component=AUTOPILOT_COMPONENT,
                command=REQUEST_MESSAGE,
                param1=msgid,
            )
        )

    # -- what it means --------------------------------------------------------------------------------------

    @property
    def _is_its_profile(self) -> bool:
        return not of_profile(self._config, self.make)

    def _identity(self) -> Identity:
        kind = dialect.mavlink.enums["MAV_TYPE"].get(self._heartbeat.type)
        vehicle = kind.name.removeprefix("MAV_TYPE_").replace("_", " ").lower() if kind else "vehicle"
        version = ""
        if self._version is not None:
            stated = self._version.flight_sw_version
            major, minor, patch, stage = (stated >> shift & 255 for shift in (24, 16, 8, 0))
            version = f"{major}.{minor}.{patch}{STAGES.get(stage, '')}"
        armed = bool(self._heartbeat.base_mode & ARMED)
        return Identity(self.session.autopilot or 0, self.make, vehicle, version, armed)

    def _parameters(self) -> tuple[ParameterFinding, ...]:
        found = []
        for need in self._needed:
            answer = self._answers.get(need.name, Answer(need.name, None, "not asked yet"))
            found.append(ParameterFinding(need, answer.value, answer.trouble))
        return tuple(found)

    def _findings(self, now: int) -> list[Finding]:
        heard = ", ".join(map(str, sorted(self._beacons)))
        return [
            *of_profile(self._config, self.make),
            *of_streams(self._config, self.make, self.session.streams.rates()),
            *self._of_link(now),
            Finding("RSBN beacons", heard or "none", "", None),
        ]

    def _of_link(self, now: int) -> list[Finding]:
        session, found = self.session, list[Finding]()
        counts = session.reader.counts.get((session.autopilot or 0, AUTOPILOT_COMPONENT), frame.Counts(0, 0))
        loss = counts.lost / max(counts.lost + counts.received, 1)
        advice = "too slow or too long a line, or no common ground"
        found.append(
            Finding(
                "frames lost", f"{loss:.1%}", f"at most {GREATEST_LOSS:.0%}", loss <= GREATEST_LOSS, advice
            )
        )
        half = session.clock.uncertainty(now)
        found.append(
            Finding(
                "TIMESYNC",
                "no answer" if half is None else f"{2e-6 * half:.1f} ms there and back",
                "answers",
                half is not None,
                "without it times are those of arrival; let it through the router",
            )
        )
        place = "not known"
        if self._origin is not None:
            place = f"{self._origin.latitude * 1e-7:.5f}, {self._origin.longitude * 1e-7:.5f}"
        advice = "it comes with the first 3D fix; wait under an open sky"
        found.append(Finding("GPS_GLOBAL_ORIGIN", place, "known", self._origin is not None, advice))
        who = f"{session.system}/{session.component}"
        advice = "another speaks in our name; set link.component_id, unless it is `companion run`"
        found.append(
            Finding(
                "our id", f"{who} {'twice' if self._doubles else 'free'}", "free", not self._doubles, advice
            )
        )
        if self._others:
            others = ", ".join(map(str, sorted({*self._others, session.autopilot or 0})))
            advice = "set link.system_id to the one that is meant"
            found.append(Finding("autopilots", others, "one", bool(self._config.link.system_id), advice))
        if refused := session.refused.total():
            found.append(
                Finding(
                    "frames refused",
                    str(refused),
                    "0",
                    False,
                    "have all sign with the key of signing.key_file",
                )
            )
        return found
