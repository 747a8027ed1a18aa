"""Autopilot output: solutions in, messages to its estimator out, by whichever link leads. No I/O.

Joins the gate, the encoders and the two commands with rules of their own (`position_reset`, `source_switch`).
Records from the autopilot are used for these rules only, never for a position: positions come from solutions;
only the steps in which a jump goes out begin at its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection

from msgspec import structs

from companion.config import Config
from companion.config.profiles import MESSAGES, PROFILES, RESET
from companion.link.dialect import Message, mavlink
from companion.navigator.fix_observations import beacon_sigmas
from companion.navigator.receiver_choice import ReceiverChoice
from companion.output.encode import CannotEncode, Receiver, encode
from companion.output.gate import (
    SIGMAS,
    STEP_M,
    Gate,
    LocalFrame,
    Position,
    WithholdingMonitor,
    distance,
)
from companion.output.gnss_fusion import GnssFusion
from companion.output.own_position_monitor import OwnPositionMonitor
from companion.output.position_reset import PositionReset
from companion.output.source_switch import SourceSwitch
from companion.output.source_table import BELIEVED, STEADY_S
from companion.records import (
    Event,
    FilterStatus,
    GlobalPosition,
    Gnss,
    RsbnFix,
    Solution,
    Stamped,
    SystemTime,
)
from companion.units import SECOND_NS

DISPLAY_NAMES = {RESET: "external position"}
SENDING_GAP_NS = 3 * SECOND_NS
NOT_FUSED = frozenset({RESET, MESSAGES["gps_input"]})
"""A reset is no series of measurements; a receiver's accuracy is judged by limits of its own."""


def _gate(config: Config) -> Gate:
    is_stepped = config.output.profile == "ardupilot" and config.output.method in ("odometry", "vision")
    return Gate(STEP_M) if is_stepped else Gate()


def _source_switch(config: Config) -> SourceSwitch:
    return GnssFusion() if config.output.profile == "px4" else SourceSwitch()


class AutopilotOutput:
    """Messages to the autopilot, by the last ones sent and by the state of its GPS and its time."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.unix_ns: int | None = None
        self._gate, self._local_frame, self._monitor = _gate(config), LocalFrame(), WithholdingMonitor()
        self._position_reset, self._source_switch = PositionReset(), _source_switch(config)
        self._receivers, self._own_monitor = ReceiverChoice(config), OwnPositionMonitor()
        self._sending_ns = 0, 0  # since when without a gap, and when last, a position was sent
        self._is_disarmed = False
        self._events: list[Event] = []

    @property
    def withheld(self) -> Counter[tuple[str, str]]:
        """How often each message was withheld, by name and reason."""
        return self._monitor.counts

    def tune(self, config: Config) -> None:
        """Go on with another configuration, of the same profile."""
        self.config, self._receivers = config, self._receivers.tuned(config)

    def receive(self, record: Stamped) -> None:
        """Process a record from the autopilot or a beacon."""
        if isinstance(record, SystemTime):
            if record.unix_ns is not None:
                self.unix_ns = record.unix_ns - record.t_ns
        elif isinstance(record, Gnss):
            if self._receivers.takes(record)[0]:
                self._position_reset.receive(record)
                self._source_switch.receive(record)
            elif self.config.uses_second_receiver:
                self._source_switch.note_other(record)
        elif isinstance(record, GlobalPosition | FilterStatus):
            self._position_reset.receive(record)
            if isinstance(record, GlobalPosition):
                self._source_switch.note_own(record)
        elif isinstance(record, RsbnFix):
            sigma_azimuth, sigma_range = beacon_sigmas(record, self.config.rsbn)
            self._source_switch.receive(
                structs.replace(record, sigma_azimuth=sigma_azimuth, sigma_range=sigma_range)
            )

    def handle_reboot(self) -> None:
        """Reset what was known of the autopilot; it has rebooted."""
        self._position_reset, self._source_switch = PositionReset(), _source_switch(self.config)
        self._local_frame = LocalFrame()

    def handle_acknowledgement(self, command: int, result: int, now_ns: int) -> None:
        """Process the autopilot's COMMAND_ACK of one of our commands."""
        self._source_switch.handle_acknowledgement(command, result, now_ns)
        if command == mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            self._add_event(self._position_reset.handle_acknowledgement(result, now_ns))

    def handle_message(self, message: Message, from_autopilot: bool, system: int, now_ns: int) -> None:
        """Process a message of another sender that may concern what autopilot `system` fuses."""
        if from_autopilot and message.get_type() == "HEARTBEAT":
            is_armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            self._is_disarmed = not is_armed
            self._source_switch.note_armed(is_armed)
        elif (by := self._source_switch.selected(message, from_autopilot, system)) is not None:
            self._source_switch.handle_selected(by, now_ns)

    def messages(self, solution: Solution, names: Collection[str], receiver: Receiver) -> list[Message]:
        """Return the messages among `names` that may be sent for `solution`, and the commands due."""
        now = solution.rx_ns
        own = self._position_reset.autopilot_place(now)
        position = self._gate.admit(solution, own)
        if isinstance(position, Position) and not (solution.contradicted or self.config.has_own_ins):
            self._add_event(self._own_monitor.update(own, position, lambda: self._why_far(now), now))
        encoded = dict[str, Message]()
        for name in names:
            reason = (
                position
                if isinstance(position, str)
                else self._withholding_reason(position, solution, name, receiver)
            )
            if isinstance(position, Position) and reason is None:
                try:
                    message = encode(position, receiver, name, self._rate_hz(name, position, solution))
                except CannotEncode as error:
                    reason = str(error)
                else:
                    reason = self._local_frame.withholding_reason(position, message)
                    if reason is None:
                        encoded[name] = message
            self._add_event(self._monitor.update(DISPLAY_NAMES.get(name, name), reason, now))
        if encoded:
            first_ns, last_ns = self._sending_ns
            self._sending_ns = first_ns if now - last_ns <= SENDING_GAP_NS else now, now
        elif isinstance(position, Position):
            self._gate.retract()
        switched = PROFILES[self.config.output.profile].switched
        if by_set := switched.intersection(names):
            hz = max(self.config.output.rates_hz[name] for name in switched)
            period_ns = round(SECOND_NS / hz) if hz > 0.0 else 0
            self._source_switch.note_output(solution, not by_set.isdisjoint(encoded), now, period_ns)
        return list(encoded.values())

    def poll(self, receiver: Receiver, now_ns: int, lack: str = "", is_lossy: bool = False) -> list[Message]:
        """Return the commands that are due; call it once a second and after every solution.

        An autopilot that was taken off GNSS is put back on it also once our positions are switched off.
        `lack`: why it cannot take them, empty if it can. `is_lossy`: much of what it sends does not arrive.
        """
        output = self.config.output
        is_to_return = output.switch_sources and self._source_switch.has_left_gnss
        if not (output.switches_sources or is_to_return) or not output.fits(receiver.autopilot):
            return []
        self._source_switch.update(now_ns, lack, is_lossy)
        return self._source_switch.to_send(receiver.system, now_ns)

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        taken, self._events = [*self._events, *self._source_switch.take_events()], []
        return taken

    def _why_far(self, now_ns: int) -> str:
        """Return what to look at where the autopilot's own position is far from ours."""
        if self._source_switch.is_on_companion:
            return "it does not follow ours"
        situation = self._source_switch.situation(now_ns)
        if situation.fix_s < 0.0:
            return "it flies by neither GNSS nor ours"
        is_doubted = (situation.gnss_false or 0.0) >= BELIEVED
        return "it flies by a GNSS in doubt" if is_doubted else "it does not fly by the GNSS in use"

    def _rate_hz(self, name: str, position: Position, solution: Solution) -> float:
        """Return how often a position goes out as a measurement; 0 for one that is no part of a series."""
        is_single = name in NOT_FUSED or self._is_drawn_off(position, solution)
        return 0.0 if is_single else self.config.output.rates_hz[name]

    def _is_drawn_off(self, position: Position, solution: Solution) -> bool:
        """Return whether the autopilot's own position is where a false GNSS has drawn it.

        Its filter is sure of that position. With our sigma as it is, it rejects ours, and is reset to it once
        it has rejected it for 7 s and GNSS is not fused: so it begins while GNSS is only in doubt.
        """
        own = self._position_reset.autopilot_place(position.t_ns)
        is_doubted = (solution.gnss_false or 0.0) >= BELIEVED
        if own is None or not (is_doubted or self._source_switch.is_on_companion):
            return False
        return distance(own, position.place) > SIGMAS * position.sigma

    def _withholding_reason(
        self, position: Position, solution: Solution, name: str, receiver: Receiver
    ) -> str | None:
        output = self.config.output
        if not output.fits(receiver.autopilot):
            return f"the autopilot is not {output.profile}: set output.profile"
        if solution.contradicted and not self._is_relied_on(solution.rx_ns):
            return "GNSS contradicts it"
        return self._position_reset.withholding_reason(position) if name == RESET else None

    def _is_relied_on(self, now_ns: int) -> bool:
        """Return whether an autopilot may fly by what has been sent: then it goes on until it is decided."""
        if self._is_disarmed:
            return False
        first_ns, last_ns = self._sending_ns
        return now_ns - last_ns <= SENDING_GAP_NS and last_ns - first_ns >= STEADY_S * SECOND_NS

    def _add_event(self, event: Event | None) -> None:
        if event is not None:
            self._events.append(event)
