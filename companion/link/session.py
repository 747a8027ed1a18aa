"""One MAVLink link, without its I/O: bytes and instants in, events and bytes out. No clock, no socket.

    events = session.receive(data, now_ns)      # whenever bytes came
    events = session.poll(now_ns)               # no later than session.deadline()
    for data in session.to_send(): ...          # after either, and after session.send(message)

It says HEARTBEAT, finds the one autopilot and takes its system id, tells when it comes, goes silent or
reboots, keeps its time on the companion's clock, answers TIMESYNC (so often and no more) and asks for the
wanted message rates until they come. All else a peer says is handed up as MessageReceived. What messages mean
is the business of `wire`.

A vehicle has one autopilot: component 1 of a system, with a HEARTBEAT of a real autopilot and not of a
ground station. The first one heard is kept; another is told once, then ignored altogether. Nothing a peer
sends raises.

With a `Signing` all that goes out is signed and what it refuses is told as Refused and goes no further.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from companion.link import dialect, frame
from companion.link.clock import JUMP, LATE, SECOND, BootClock, News
from companion.link.dialect import Message
from companion.link.frame import BadFrame, Frame, UnknownFrame
from companion.link.rate_limiter import Bucket
from companion.link.signing import Refusal, Signing
from companion.link.stream_rates import Streams

HEARTBEAT_EVERY = SECOND
TIMESYNC_EVERY = SECOND
#: Answers to TIMESYNC a second, and at once: whoever asks faster is no clock.
ANSWERS_HZ, ANSWERS_BURST = 20.0, 10
#: The autopilot is lost when nothing of it came for so long.
LOST_AFTER = 5 * SECOND

HEARTBEAT, SYSTEM_TIME, TIMESYNC = 0, 2, 111
SET_MESSAGE_INTERVAL = 511
AUTOPILOT_COMPONENT = 1
TYPE_ONBOARD_CONTROLLER = 18
AUTOPILOT_INVALID = 8
STATE_ACTIVE = 4
#: A link is late, or prompt again, once it was for so long: TIMESYNC has had its say by then.
LATE_FOR = 2 * SECOND
#: HEARTBEAT types that come from no autopilot, whatever their autopilot field says.
NOT_VEHICLES = frozenset({5, 6, 18, 26, 27, 30, 31, 32, 33, 34, 36, 37, 38, 39, 40, 41, 42})
#: Messages whose time_boot_ms is new in each: SYSTEM_TIME, ATTITUDE(_QUATERNION), LOCAL_ and GLOBAL_POSITION.
CLOCKED = frozenset({2, 30, 31, 32, 33})


class LinkUp(NamedTuple):
    """The autopilot is heard, first or again; `autopilot` is MAV_AUTOPILOT (3 ArduPilot, 12 PX4)."""

    at_ns: int
    system: int
    autopilot: int


class LinkLost(NamedTuple):
    """Nothing of the autopilot came since `heard_ns`."""

    at_ns: int
    system: int
    heard_ns: int


class Rebooted(NamedTuple):
    """The autopilot's boot time went back: its clock, origin and streams begin anew."""

    at_ns: int
    system: int


class ClockLeapt(NamedTuple):
    """The autopilot's clock was set: its times are mapped anew from here on, `by_ns` later than before."""

    at_ns: int
    system: int
    by_ns: int


class LinkLate(NamedTuple):
    """All that comes has come late for a while, `by_ns` now; 0: the link is prompt again."""

    at_ns: int
    system: int
    by_ns: int


class FalseTime(NamedTuple):
    """A TIMESYNC answer that is of another clock, and was not believed: `off_ns` from what arrivals tell."""

    at_ns: int
    system: int
    off_ns: int


class SecondAutopilot(NamedTuple):
    """Another autopilot is on the link and will be ignored; told once for each."""

    at_ns: int
    system: int
    kept: int


class MessageReceived(NamedTuple):
    """A message, the frame it came in, and whether the vehicle's autopilot sent it."""

    received_ns: int
    message: Message
    frame: Frame
    from_autopilot: bool


class NotUnderstood(NamedTuple):
    """Bytes that are no frame, or a frame of an unknown message."""

    received_ns: int
    what: BadFrame | UnknownFrame


class Refused(NamedTuple):
    """A frame that was not let in, being unsigned, forged or not of this time; its sender is a mere claim."""

    received_ns: int
    system: int
    component: int
    reason: Refusal


Event = (
    LinkUp
    | LinkLost
    | Rebooted
    | ClockLeapt
    | LinkLate
    | FalseTime
    | SecondAutopilot
    | MessageReceived
    | NotUnderstood
    | Refused
)


class Session:
    """One side of one link. All times are integer nanoseconds of the companion's clock."""

    def __init__(
        self,
        *,
        component: int = 191,
        system: int | None = None,
        autopilot_system: int | None = None,
        rates_hz: Mapping[str, float] | None = None,
        signing: Signing | None = None,
        link_id: int = 0,
    ) -> None:
        """`system`: our own id, if None the autopilot's (1 until it is heard).

        `autopilot_system`: heed no other. `rates_hz`: rates wanted of the autopilot by message name.
        `signing`: one for all links of a key, on which each signs with its own `link_id` (0-255).
        ValueError on ids outside 1-255, unknown names and impossible rates.
        """
        for name, value in (
            ("component", component),
            ("system", system),
            ("autopilot_system", autopilot_system),
        ):
            if value is not None and not 1 <= value <= 255:
                raise ValueError(f"{name} {value} is not a MAVLink id: give 1 to 255")
        if not 0 <= link_id <= 255:
            raise ValueError(f"link_id {link_id} does not fit a signature: give 0 to 255")
        self.component = component
        self.refused: Counter[Refusal] = Counter()
        self.state = STATE_ACTIVE
        self.reader = frame.Reader(counting=False)
        self.clock = BootClock()
        self.streams = Streams(_by_id(rates_hz or {}))
        self._system = system
        self._wanted = autopilot_system
        self._autopilot: int | None = None  # its system id
        self._kind = AUTOPILOT_INVALID
        self._heard = 0
        self._up = False
        self._late_told = False
        self._turned_at: int | None = None  # since when the link is not as late, or as prompt, as was told
        self._ignored: set[int] = set()
        self._sequence = 0
        self._outbox: list[bytes] = []
        self._signing = signing
        self._link_id = link_id
        self._now = 0  # the last instant handed in
        self._heartbeat_at = 0
        self._timesync_at = 0
        self._answers = Bucket(ANSWERS_HZ, ANSWERS_BURST)
        self._handlers = {HEARTBEAT: self._on_heartbeat, TIMESYNC: self._on_timesync}

    @property
    def system(self) -> int:
        """Our own system id."""
        return self._system or self._autopilot or 1

    @property
    def autopilot(self) -> int | None:
        """The autopilot's system id, None before it was heard."""
        return self._autopilot

    @property
    def kind(self) -> int:
        """The autopilot's MAV_AUTOPILOT, 8 (none) before it was heard."""
        return self._kind

    @property
    def is_up(self) -> bool:
        """Whether the autopilot is heard."""
        return self._up

    def heed(self, system: int) -> None:
        """Take no other autopilot than that of `system`, unless one was heard before."""
        self._wanted = self._wanted or system

    def want(self, rates_hz: Mapping[str, float], now_ns: int) -> None:
        """Ask the autopilot for these rates (Hz, by message name) from now on."""
        self.streams.want(_by_id(rates_hz), now_ns)

    def receive(self, data: bytes, now_ns: int) -> list[Event]:
        """Take bytes that arrived at `now_ns`; return what they mean, in order."""
        self._now = now_ns
        events: list[Event] = []
        for found in self.reader.receive(data):
            if isinstance(found, Frame):
                self._on_frame(found, now_ns, events)
            else:
                events.append(NotUnderstood(now_ns, found))
        return events

    def poll(self, now_ns: int) -> list[Event]:
        """Do what is due at `now_ns`; return what the passing of time means."""
        self._now = now_ns
        events: list[Event] = []
        if self._up and now_ns - self._heard >= LOST_AFTER:
            self._up = False
            self.streams.stop()
            events.append(LinkLost(now_ns, self._autopilot or 0, self._heard))
        if now_ns >= self._heartbeat_at:
            self._heartbeat_at = now_ns + HEARTBEAT_EVERY
            self.send(
                dialect.new(
                    "HEARTBEAT",
                    type=TYPE_ONBOARD_CONTROLLER,
                    autopilot=AUTOPILOT_INVALID,
                    system_status=self.state,
                    mavlink_version=3,
                )
            )
        if self._up and now_ns >= self._timesync_at:
            self._timesync_at = now_ns + TIMESYNC_EVERY
            self.send(dialect.new("TIMESYNC", ts1=self.clock.ask(now_ns)))
        for msgid, rate_hz in self.streams.due(now_ns):
            self._ask_for(msgid, rate_hz)
        return events

    def deadline(self) -> int:
        """Return the instant at which `poll` must be called at the latest."""
        due = [self._heartbeat_at]
        if self._up:
            due += [self._timesync_at, self._heard + LOST_AFTER]
        if (check := self.streams.deadline()) is not None:
            due.append(check)
        return min(due)

    def send(self, message: Message) -> None:
        """Queue a message for `to_send`. ValueError if a field does not fit its wire type."""
        sign = self._sign if self._signing else None
        self._outbox.append(frame.encode(message, self._sequence, self.system, self.component, sign))
        self._sequence = self._sequence + 1 & 0xFF

    def to_send(self) -> list[bytes]:
        """Return the frames to be written now, oldest first, and forget them."""
        sent, self._outbox = self._outbox, []
        return sent

    def to_local_ns(self, time_usec: int, received_ns: int) -> int:
        """Return the local time for which a message stamped `time_usec` (since boot, or UNIX) was valid.

        The arrival where the stamp is 0 or not to be mapped yet; for a time_boot_ms give 1000 times it.
        """
        return self.clock.local(time_usec * 1000, received_ns)

    def _sign(self, data: bytes) -> bytes:
        assert self._signing is not None
        return self._signing.sign(data, self._link_id, self._now)

    def _on_frame(self, found: Frame, now: int, events: list[Event]) -> None:
        if self._signing is not None and (reason := self._signing.judge(found, now)) is not None:
            self.refused[reason] += 1
            events.append(Refused(now, found.system, found.component, reason))
            return
        self.reader.count(found)
        if found.system in self._ignored:
            return
        if found.component == self.component and found.system == self.system:
            return  # our own, sent back by a router
        message = dialect.decode(found)
        if (handler := self._handlers.get(found.msgid)) is not None:
            handler(message, found, now, events)
            if found.system in self._ignored:
                return
        ours = found.system == self._autopilot and found.component == AUTOPILOT_COMPONENT
        if ours:
            self._on_autopilot(message, found, now, events)
        events.append(MessageReceived(now, message, found, ours))

    def _on_autopilot(self, message: Message, found: Frame, now: int, events: list[Event]) -> None:
        self._heard = now
        if not self._up:
            self._up = True
            self._timesync_at = now
            self.streams.start(now)
            events.append(LinkUp(now, found.system, self._kind))
        self.streams.heard(found.msgid)
        if found.msgid in CLOCKED and message.time_boot_ms:
            boot = message.time_boot_ms * 1_000_000
            before = self.clock.offset(now)
            news = self.clock.heard(boot, now)
            if news is News.REBOOTED:
                self.streams.start(now)
                events.append(Rebooted(now, found.system))
            elif news is News.SET:
                events.append(ClockLeapt(now, found.system, (before or 0) - (self.clock.offset(now) or 0)))
            if found.msgid == SYSTEM_TIME:
                self.clock.heard_unix(message.time_unix_usec * 1000, boot)
            self._tell_lateness(now, found.system, events)

    def _tell_lateness(self, now: int, system: int, events: list[Event]) -> None:
        late = self.clock.lateness(now)
        if (late > LATE) == self._late_told:
            self._turned_at = None
        elif self._turned_at is None:
            self._turned_at = now
        elif now - self._turned_at >= LATE_FOR:
            self._late_told, self._turned_at = not self._late_told, None
            events.append(LinkLate(now, system, late if self._late_told else 0))

    def _on_heartbeat(self, message: Message, found: Frame, now: int, events: list[Event]) -> None:
        if found.component != AUTOPILOT_COMPONENT or message.autopilot == AUTOPILOT_INVALID:
            return
        if message.type in NOT_VEHICLES:
            return
        if self._autopilot is None and self._wanted in (None, found.system):
            self._autopilot = found.system
        if found.system == self._autopilot:
            self._kind = message.autopilot
        else:
            self._ignored.add(found.system)
            events.append(SecondAutopilot(now, found.system, self._autopilot or self._wanted or 0))

    def _on_timesync(self, message: Message, found: Frame, now: int, events: list[Event]) -> None:
        if message.tc1 == 0:
            if self._answers.take(now):
                self.send(dialect.new("TIMESYNC", tc1=max(now, 1), ts1=message.ts1))
        elif found.system == self._autopilot and found.component == AUTOPILOT_COMPONENT:
            before = self.clock.offset(now)
            self.clock.answered(message.ts1, message.tc1, now)
            if (off := self.clock.outlier) is not None:
                events.append(FalseTime(now, found.system, off))
            elif before is not None and (by := before - (self.clock.offset(now) or 0)) < -JUMP:
                events.append(ClockLeapt(now, found.system, by))  # it stood still, or was set back

    def _ask_for(self, msgid: int, rate_hz: float) -> None:
        self.send(
            dialect.new(
                "COMMAND_LONG",
                target_system=self._autopilot or 0,
                target_component=AUTOPILOT_COMPONENT,
                command=SET_MESSAGE_INTERVAL,
                param1=msgid,
                param2=1e6 / rate_hz,
            )
        )


def _by_id(rates_hz: Mapping[str, float]) -> dict[int, float]:
    return {dialect.type_named(name).msgid: hz for name, hz in rates_hz.items()}
