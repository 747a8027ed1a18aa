"""State of one MAVLink link without its I/O: bytes and times in, events and bytes out. No clock, no socket.

    events = session.receive(data, now_ns)      # whenever bytes arrived
    events = session.poll(now_ns)               # no later than session.deadline()
    for data in session.to_send(): ...          # after either, and after session.send(message)

A session sends HEARTBEAT, finds the autopilot and adopts its system id, reports when it appears, is lost or
reboots, maps its time to the companion's clock, answers TIMESYNC (rate-limited) and requests the configured
message rates until they arrive. Every other message is passed up as MessageReceived; `companion.link.decode`
interprets it.

A vehicle has one autopilot: component 1 of a system, at one address; `autopilot_choice` decides which. Any
other is reported once, then ignored. No input of a peer raises.

`peer` is the address that bytes came from, on links that have several (UDP). Each peer has a frame reader of
its own, so that no sender's bytes can swallow another's.

With a `Signing`, every sent frame is signed; received frames that it rejects are reported as FrameRejected
and not processed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping
from typing import NamedTuple

from companion.link import dialect, frame
from companion.link.autopilot_choice import AutopilotChoice, Candidate
from companion.link.clock import JUMP, LATE, BootClock, ClockChange
from companion.link.dialect import Message, mavlink
from companion.link.frame import BadFrame, Frame, UnknownFrame
from companion.link.rate_limiter import RateLimiter
from companion.link.signing import SignatureFault, Signing
from companion.link.stream_rates import StreamRates
from companion.units import SECOND_NS

HEARTBEAT_INTERVAL = SECOND_NS
TIMESYNC_INTERVAL = SECOND_NS
#: TIMESYNC answers per second, and at once: to the autopilot, and to all others together.
AUTOPILOT_ANSWERS_HZ, ANSWERS_HZ, ANSWERS_BURST = 50.0, 20.0, 10
#: Peers with a reader of their own; datagrams of further ones are parsed by themselves.
MAX_READERS = 16
#: A peer is forgotten after this time without an accepted frame, if its place is needed.
FORGET_AFTER = 30 * SECOND_NS
#: Other vehicles reported on a link.
MAX_REPORTED = 16
#: The autopilot is lost when nothing was received from it for this time.
LOST_AFTER = 5 * SECOND_NS
#: One of several links does not lead while nothing arrives on it for the first, or no answer for the second.
QUIET_AFTER, UNANSWERED_AFTER = SECOND_NS, 10 * SECOND_NS
#: A link is reported late, or prompt again, after this time: TIMESYNC has been answered by then.
LATE_FOR = 2 * SECOND_NS
STEP = SECOND_NS // 10  # a smaller step of the mapping is that of TIMESYNC on a slow link
#: Messages stamped with time_boot_ms when they are sent.
STAMPED_WHEN_SENT = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_SYSTEM_TIME,
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
    }
)
#: Messages that the session reads itself.
READ_HERE = STAMPED_WHEN_SENT | {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT,
    mavlink.MAVLINK_MSG_ID_TIMESYNC,
    mavlink.MAVLINK_MSG_ID_COMMAND_ACK,
}
_AUTOPILOT_COMPONENT: int = mavlink.MAV_COMP_ID_AUTOPILOT1
_SYSTEM_TIME: int = mavlink.MAVLINK_MSG_ID_SYSTEM_TIME


class LinkUp(NamedTuple):
    """The autopilot was received, for the first time or again; `autopilot` is MAV_AUTOPILOT."""

    at_ns: int
    system: int
    autopilot: int


class LinkLost(NamedTuple):
    """Nothing was received from the autopilot since `last_received_ns`."""

    at_ns: int
    system: int
    last_received_ns: int


class Rebooted(NamedTuple):
    """The autopilot's boot time went back: its clock, origin and streams are reset."""

    at_ns: int
    system: int


class ClockJump(NamedTuple):
    """The autopilot's clock was set forward by `by_ns`; negative: it was set back, or stood still."""

    at_ns: int
    system: int
    by_ns: int


class MappingStepped(NamedTuple):
    """The autopilot's times map `by_ns` later than before, at once, though its clock was not set."""

    at_ns: int
    system: int
    by_ns: int


class ClockRate(NamedTuple):
    """The autopilot's clock runs `rate` times as fast as ours, for seconds; 1: it runs as ours again."""

    at_ns: int
    system: int
    rate: float


class LinkLate(NamedTuple):
    """Messages have arrived late for LATE_FOR, by `by_ns` now; 0: the link is prompt again."""

    at_ns: int
    system: int
    by_ns: int


class TimesyncOutlier(NamedTuple):
    """A TIMESYNC answer of another clock, not used: `error_ns` from the time estimated by arrivals."""

    at_ns: int
    system: int
    error_ns: int


class AutopilotReleased(NamedTuple):
    """The autopilot in use was released: it streams no navigation messages, or has been silent for long."""

    at_ns: int
    system: int
    by: int | None  # the system in use now


class SecondAutopilot(NamedTuple):
    """Another autopilot, or the same from another address, is ignored; reported once for each."""

    at_ns: int
    system: int
    kept: int


class MessageReceived:
    """A frame, whether the vehicle's autopilot sent it, and its address; decoded when `message` is read."""

    __slots__ = ("_message", "frame", "from_autopilot", "peer", "received_ns")

    def __init__(
        self, received_ns: int, message: Message | None, frame: Frame, from_autopilot: bool, peer: Hashable
    ) -> None:
        self.received_ns, self._message, self.frame = received_ns, message, frame
        self.from_autopilot, self.peer = from_autopilot, peer

    @property
    def message(self) -> Message:
        """The message of the frame."""
        if self._message is None:
            self._message = dialect.decode(self.frame)
        return self._message


class NotUnderstood(NamedTuple):
    """Bytes that are not a frame, or a frame of an unknown message."""

    received_ns: int
    what: BadFrame | UnknownFrame


class FrameRejected(NamedTuple):
    """A frame rejected by `Signing`; its sender ids are not verified."""

    received_ns: int
    system: int
    component: int
    reason: SignatureFault


class NotSent(NamedTuple):
    """A message of ours that does not fit its wire format and was not sent; `why` names the field's type."""

    at_ns: int
    why: str


Event = (
    LinkUp
    | LinkLost
    | Rebooted
    | ClockJump
    | MappingStepped
    | ClockRate
    | LinkLate
    | TimesyncOutlier
    | AutopilotReleased
    | SecondAutopilot
    | MessageReceived
    | NotUnderstood
    | FrameRejected
    | NotSent
)


class Session:
    """One side of one link. All times are integer nanoseconds of the companion's clock."""

    def __init__(
        self,
        *,
        component: int = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER,
        autopilot_system: int | None = None,
        rates_hz: Mapping[str, float] | None = None,
        signing: Signing | None = None,
        link_id: int = 0,
    ) -> None:
        """Create a session.

        Parameters
        ----------
        component
            Our component id.
        autopilot_system
            If given, any other autopilot is ignored.
        rates_hz
            Rates to request from the autopilot, by message name.
        signing
            One object for all links that share a key.
        link_id
            Link id (0-255) in the signatures of this link.

        Raises
        ------
        ValueError
            For ids outside 1-255, unknown message names and rates out of range.
        """
        for name, value in (("component", component), ("autopilot_system", autopilot_system)):
            if value is not None and not 1 <= value <= 255:
                raise ValueError(f"{name} {value} is not a MAVLink id: give 1 to 255")
        if not 0 <= link_id <= 255:
            raise ValueError(f"link_id {link_id} does not fit a signature: give 0 to 255")
        self.component = component
        self.rejected: Counter[SignatureFault] = Counter()
        self.state: int = mavlink.MAV_STATE_ACTIVE  # for our heartbeat
        self.reader = frame.Reader(counting=False)
        self.clock = BootClock()
        self.stream_rates = StreamRates(_by_id(rates_hz or {}))
        self._unanswered: list[int] = []  # rates requested last: answers come in order and name no message
        self._choice = AutopilotChoice(autopilot_system)
        self._readers: dict[Hashable, tuple[frame.Reader, int]] = {}  # by peer, and its last accepted frame
        self._last_received = 0  # from the autopilot
        self._answered = -UNANSWERED_AFTER  # when the autopilot last answered a TIMESYNC
        self._up = False
        self._reported_late = False
        self._changed_at: int | None = None  # since when the lateness differs from the reported one
        self._reported: set[tuple[int, Hashable]] = set()  # other autopilots
        self._sequence = 0
        self._send_queue: list[bytes] = []
        self._not_sent: list[Event] = []
        self._signing = signing
        self._link_id = link_id
        self._now = 0  # the last time supplied
        self._heartbeat_at = 0
        self._timesync_at = 0
        self._answer_limiter = RateLimiter(ANSWERS_HZ, ANSWERS_BURST)
        self._autopilot_answer_limiter = RateLimiter(AUTOPILOT_ANSWERS_HZ, ANSWERS_BURST)

    @property
    def system(self) -> int:
        """Our own system id: the autopilot's, 1 until it is known."""
        return self.autopilot or self.required_system or 1

    @property
    def autopilot(self) -> int | None:
        """The autopilot's system id, None before it was received."""
        return self._choice.chosen.system if self._choice.chosen else None

    @property
    def required_system(self) -> int | None:
        """The only system id that an autopilot of ours may have; None: any."""
        return self._choice.required_system

    @property
    def autopilot_type(self) -> int:
        """The autopilot's MAV_AUTOPILOT, MAV_AUTOPILOT_INVALID before it was received."""
        chosen = self._choice.chosen
        return chosen.autopilot if chosen else int(mavlink.MAV_AUTOPILOT_INVALID)

    @property
    def is_up(self) -> bool:
        """Whether the autopilot is received."""
        return self._up

    @property
    def is_confirmed(self) -> bool:
        """Whether the autopilot has streamed navigation messages for some seconds."""
        return self._choice.chosen is not None and self._choice.chosen.is_confirmed

    def is_quiet(self, now_ns: int) -> bool:
        """Whether nothing of the autopilot arrived for a second."""
        return now_ns - self._last_received >= QUIET_AFTER

    def is_answered(self, now_ns: int) -> bool:
        """Whether the autopilot receives us: it answered a TIMESYNC of the last seconds."""
        return now_ns - self._answered < UNANSWERED_AFTER

    def is_promising(self, now_ns: int) -> bool:
        """Whether the autopilot streams navigation messages, or was found too recently to judge."""
        chosen = self._choice.chosen
        return self._up and chosen is not None and chosen.is_promising(now_ns)

    def lock_to_system(self, system: int | None, now_ns: int) -> list[Event]:
        """Accept no autopilot but that of `system` (None: any), which another link has confirmed."""
        events: list[Event] = []
        if (released := self._choice.lock(system)) is not None:
            self._release(released, now_ns, events)
        return events

    def set_rates(self, rates_hz: Mapping[str, float], now_ns: int) -> None:
        """Request these rates (Hz, by message name) from the autopilot from now on."""
        self.stream_rates.set_rates(_by_id(rates_hz), now_ns)

    def receive(self, data: bytes, now_ns: int, peer: Hashable = None) -> list[Event]:
        """Process bytes that arrived at `now_ns` from `peer`; return the events in order.

        No bytes: the stream of `peer` has ended.
        """
        self._now = now_ns
        events, self._not_sent = self._not_sent, []
        if peer is None:
            self._on_found(self.reader.receive(data), peer, now_ns, events)
        elif not data:
            self._readers.pop(peer, None)
            self._choice.leave(peer, now_ns)
        else:
            known = self._readers.get(peer)
            reader = known[0] if known else frame.Reader(counting=False)
            if self._on_found(reader.receive(data), peer, now_ns, events):
                self._keep_reader(peer, reader, now_ns)
            if peer not in self._readers and self._on_found(reader.close(), peer, now_ns, events):
                self._keep_reader(peer, reader, now_ns)
        return events

    def receive_frame(self, found: Frame, now_ns: int) -> list[Event]:
        """Process a frame that is parsed already, as `receive` does its bytes; return the events in order."""
        self._now = now_ns
        events, self._not_sent = self._not_sent, []
        self._on_frame(found, None, now_ns, events)
        return events

    def judge(self) -> Callable[[bytes, int], bool]:
        """Return a function of the next bytes of a new sender: whether a frame of them proves it."""
        reader = frame.Reader(counting=False)

        def is_proven(data: bytes, now_ns: int) -> bool:
            return any(
                isinstance(found, Frame)
                and self.is_proof(found)
                and (self._signing is None or self._signing.examine(found, now_ns) is None)
                for found in reader.receive(data)
            )

        return is_proven

    def is_proof(self, found: Frame) -> bool:
        """Whether an accepted frame proves its sender; on a signed link RADIO_STATUS does not."""
        return self._signing is None or found.signature is not None or not self._signing.refuse_unsigned

    def _on_found(self, items: list[frame.Event], peer: Hashable, now: int, events: list[Event]) -> bool:
        """Process what a reader found; return whether a frame is accepted and proves its sender."""
        is_accepted = False
        for found in items:
            if isinstance(found, Frame):
                is_accepted |= self._on_frame(found, peer, now, events)
            else:
                if isinstance(found, UnknownFrame):
                    self.reader.skip(found)
                events.append(NotUnderstood(now, found))
        return is_accepted

    def _keep_reader(self, peer: Hashable, reader: frame.Reader, now: int) -> None:
        """Keep the reader of a peer with an accepted frame, so that its frames may span datagrams."""
        if peer not in self._readers and len(self._readers) >= MAX_READERS:
            oldest = min(self._readers, key=lambda one: self._readers[one][1])
            if now - self._readers[oldest][1] < FORGET_AFTER:
                return
            del self._readers[oldest]
        self._readers[peer] = reader, now

    def poll(self, now_ns: int) -> list[Event]:
        """Do what is due at `now_ns`; return the events caused by the elapsed time."""
        self._now = now_ns
        events, self._not_sent = self._not_sent, []
        if self._up and now_ns - self._last_received >= LOST_AFTER:
            self._up = False
            self.stream_rates.stop()
            events.append(LinkLost(now_ns, self.autopilot or 0, self._last_received))
        if now_ns >= self._heartbeat_at:
            self._heartbeat_at = now_ns + HEARTBEAT_INTERVAL
            self.send(
                dialect.new(
                    "HEARTBEAT",
                    type=mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                    autopilot=mavlink.MAV_AUTOPILOT_INVALID,
                    system_status=self.state,
                    mavlink_version=3,
                )
            )
        if self._up and now_ns >= self._timesync_at:
            self._timesync_at = now_ns + TIMESYNC_INTERVAL
            self.send(dialect.new("TIMESYNC", ts1=self.clock.request(now_ns)))
        if due := self.stream_rates.due(now_ns):
            self._unanswered = [msgid for msgid, _ in due]
        for msgid, rate_hz in due:
            parameters = {"param1": msgid, "param2": 1e6 / rate_hz}
            self.send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, **parameters)
        return events

    def deadline(self) -> int:
        """Return when `poll` must be called at the latest."""
        due = [self._heartbeat_at]
        if self._up:
            due += [self._timesync_at, self._last_received + LOST_AFTER]
        if (check := self.stream_rates.deadline()) is not None:
            due.append(check)
        return min(due)

    def send(self, message: Message) -> None:
        """Queue a message for `to_send`; if a field does not fit its wire type, report NotSent instead."""
        sign = self._sign if self._signing else None
        try:
            data = frame.encode(message, self._sequence, self.system, self.component, sign)
        except ValueError as error:
            self._not_sent.append(NotSent(self._now, str(error)))
            return
        self._send_queue.append(data)
        self._sequence = self._sequence + 1 & 0xFF

    def send_command(self, command: int, **parameters: float) -> None:
        """Queue COMMAND_LONG to the autopilot."""
        self.send(dialect.command_long(self.autopilot or 0, command, **parameters))

    def request_message(self, msgid: int) -> None:
        """Queue a request to the autopilot to send a message once."""
        self.send_command(mavlink.MAV_CMD_REQUEST_MESSAGE, param1=msgid)

    def to_send(self) -> list[bytes]:
        """Return and clear the queued frames, oldest first."""
        sent, self._send_queue = self._send_queue, []
        return sent

    def _sign(self, data: bytes) -> bytes:
        assert self._signing is not None
        return self._signing.sign(data, self._link_id, self._now)

    def _on_frame(self, found: Frame, peer: Hashable, now: int, events: list[Event]) -> bool:
        """Process a frame; return whether it is accepted and proves its sender."""
        if self._signing is not None and (reason := self._signing.verify(found, now)) is not None:
            self.rejected[reason] += 1
            events.append(FrameRejected(now, found.system, found.component, reason))
            return False
        self.reader.count(found)
        if found.component == self.component and found.system == self.system:
            return False  # our own frame, sent back by a router
        is_proof = self.is_proof(found)
        message = dialect.decode(found) if found.msgid in READ_HERE else None
        if found.component == _AUTOPILOT_COMPONENT and is_proof:
            self._choose(message, found, peer, now, events)
        if self._choice.is_rival(found.system, peer):
            return is_proof
        chosen = self._choice.chosen
        from_autopilot = (
            chosen is not None
            and is_proof
            and found.system == chosen.system
            and found.component == _AUTOPILOT_COMPONENT
            and peer == chosen.peer
        )
        if found.msgid == mavlink.MAVLINK_MSG_ID_TIMESYNC:
            self._on_timesync(message, found, from_autopilot, now, events)
        elif found.msgid == mavlink.MAVLINK_MSG_ID_COMMAND_ACK and from_autopilot:
            self._on_acknowledgement(message)
        if from_autopilot:
            self._on_autopilot(message, found, now, events)
        events.append(MessageReceived(now, message, found, from_autopilot, peer))
        return is_proof

    def _choose(self, message: Message, found: Frame, peer: Hashable, now: int, events: list[Event]) -> None:
        """Let a frame of an autopilot's component decide which autopilot is used."""
        heartbeat = message if found.msgid == mavlink.MAVLINK_MSG_ID_HEARTBEAT else None
        choice = self._choice
        before = choice.receive(found.msgid, heartbeat, found.system, peer, now)
        if before is not None and choice.chosen is not None and before.system != choice.chosen.system:
            self._release(before, now, events)
        key = found.system, peer
        is_other = (
            choice.chosen is None or (choice.chosen.system, choice.chosen.peer) != key
        ) and choice.is_candidate(*key)
        if is_other and key not in self._reported and len(self._reported) < MAX_REPORTED:
            self._reported.add(key)
            events.append(SecondAutopilot(now, found.system, self.autopilot or choice.locked_system or 0))

    def _release(self, before: Candidate, now: int, events: list[Event]) -> None:
        self._up = False
        self._answered = -UNANSWERED_AFTER
        self.clock.reset()
        self.stream_rates.stop()
        events.append(AutopilotReleased(now, before.system, self.autopilot))

    def _on_autopilot(self, message: Message, found: Frame, now: int, events: list[Event]) -> None:
        self._last_received = now
        if not self._up:
            self._up = True
            self._timesync_at = now
            self.stream_rates.start(now)
            events.append(LinkUp(now, found.system, self.autopilot_type))
        self.stream_rates.count(found.msgid)
        if found.msgid in STAMPED_WHEN_SENT and message.time_boot_ms:
            boot = message.time_boot_ms * 1_000_000
            before = self.clock.offset(now)
            change = self.clock.update(boot, now)
            if change is ClockChange.REBOOTED:
                self.stream_rates.start(now)
                events.append(Rebooted(now, found.system))
            elif change is ClockChange.SET:
                events.append(ClockJump(now, found.system, -self._later_by(before, now)))
            elif abs(by := self._later_by(before, now)) > STEP:
                events.append(MappingStepped(now, found.system, by))
            if found.msgid == _SYSTEM_TIME:
                self.clock.update_unix(message.time_unix_usec * 1000, boot)
            self._report_lateness(now, found.system, events)

    def _later_by(self, before: int | None, now: int) -> int:
        """How much later the autopilot's times map now than by the offset `before`; 0 if it had none."""
        after = self.clock.offset(now)
        return 0 if before is None or after is None else after - before

    def _report_lateness(self, now: int, system: int, events: list[Event]) -> None:
        late = self.clock.lateness(now)
        if (late > LATE) == self._reported_late:
            self._changed_at = None
        elif self._changed_at is None:
            self._changed_at = now
        elif now - self._changed_at >= LATE_FOR:
            self._reported_late, self._changed_at = not self._reported_late, None
            events.append(LinkLate(now, system, late if self._reported_late else 0))

    def _on_acknowledgement(self, message: Message) -> None:
        """Match the answer to a requested rate with its message, by the order of the requests."""
        is_rate = message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        if is_rate and self._unanswered and message.target_component in (0, self.component):
            msgid = self._unanswered.pop(0)
            if message.result != mavlink.MAV_RESULT_ACCEPTED:
                self.stream_rates.refuse(msgid)

    def _on_timesync(
        self, message: Message, found: Frame, from_autopilot: bool, now: int, events: list[Event]
    ) -> None:
        if message.tc1 == 0:
            limiter = self._autopilot_answer_limiter if from_autopilot else self._answer_limiter
            if limiter.take(now):
                self.send(dialect.new("TIMESYNC", tc1=max(now, 1), ts1=message.ts1))
        elif from_autopilot:
            if self.clock.has_requested(message.ts1):  # else the answer to another station
                self._answered = now
            before, rate = self.clock.offset(now), self.clock.rate
            self.clock.update_timesync(message.ts1, message.tc1, now)
            if self.clock.rate != rate:
                events.append(ClockRate(now, found.system, self.clock.rate))
            if abs(by := self._later_by(before, now)) > STEP:
                events.append(MappingStepped(now, found.system, by))
            if (error := self.clock.outlier) is not None:
                events.append(TimesyncOutlier(now, found.system, error))
            elif by > JUMP:
                events.append(ClockJump(now, found.system, -by))  # the clock stopped, or was set back


def _by_id(rates_hz: Mapping[str, float]) -> dict[int, float]:
    return {dialect.type_named(name).msgid: hz for name, hz in rates_hz.items()}
