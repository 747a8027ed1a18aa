"""Companion core: link sessions, navigator, autopilot output and log joined. No I/O and no clock.

    core.receive(link, data, now_ns)     # bytes received on a link
    core.poll(now_ns)                    # no later than core.deadline()
    core.to_send(link, now_ns)           # after either: the frames to write to a link
    core.settle()                        # then, if there is time: deferred work
    core.bear()                          # and births of hypotheses, twice if core.births_due

The asyncio service and the virtual-time loopback drive the same object. It holds no navigation state. It
decides which senders are accepted (one autopilot, any beacon receiver), what is logged and when a solution is
sent. If several links receive the autopilot, the first one in configuration order that works in both
directions leads: what the autopilot sends on the others is only logged, and positions, texts and values are
sent on the leading link only. What is known of the autopilot and of what it was sent is the same whichever
link leads.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from typing import Any

import msgspec

from companion.config import Config, ConfigError, to_toml
from companion.config.profiles import RESET
from companion.config.validate import find_conflicts
from companion.link.beacon_answers import TURN_REASON, BeaconAnswers
from companion.link.clock import MAX_LATENESS
from companion.link.decode import DECODED, MAKES, decode
from companion.link.dialect import MEASUREMENTS, mavlink, rsbn
from companion.link.firmware import firmware_of
from companion.link.rate_limiter import RateLimiter
from companion.link.session import (
    AutopilotReleased,
    ClockJump,
    ClockRate,
    FrameRejected,
    LinkLate,
    LinkLost,
    LinkUp,
    MappingStepped,
    MessageReceived,
    NotSent,
    NotUnderstood,
    Rebooted,
    SecondAutopilot,
    TimesyncOutlier,
)
from companion.link.signing import Signing
from companion.navigator import Navigator, kept_state
from companion.output.autopilot_output import AutopilotOutput
from companion.output.encode import Receiver, named_values, navigation_status
from companion.output.pace import Pace
from companion.printable import printable
from companion.records import (
    INPUTS,
    Event,
    LinkState,
    LocalPosition,
    Mode,
    Reboot,
    Rejection,
    Reset,
    Resumed,
    RsbnFix,
    Severity,
    Solution,
    Stamped,
    TimeStep,
    Trust,
    Tuning,
)
from companion.runtime.ground_station_services import STATUS, GroundStationServices, feed_periods_ns
from companion.runtime.input_monitor import InputMonitor
from companion.runtime.kept_run import Flown
from companion.runtime.links import Link
from companion.runtime.origin import OriginCheck
from companion.runtime.parameter_check import ParameterCheck
from companion.runtime.status import Status
from companion.storage.deferred_log import Log
from companion.transport.peers import Rank
from companion.units import SECOND_NS

ORIGIN_REQUEST_INTERVAL = 3 * SECOND_NS
FIRMWARE_REQUESTS = 10
STALE_AFTER = 2 * SECOND_NS
SAME_BOOT_NS = 3 * SECOND_NS  # of an autopilot's clock beside ours, before a restart and after it
REPORT_INTERVAL = 10 * SECOND_NS
#: Bytes per second, at once and in all of frames that are logged though they are not used: those of stations,
#: other vehicles and strangers. A flood must not fill the disk with them.
UNUSED_LOG_HZ, UNUSED_LOG_BURST, UNUSED_LOG_TOTAL = 20_000.0, 1 << 18, 1 << 26
#: Messages of ground stations that the companion answers.
REQUESTS = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_COMMAND_INT,
        mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_READ,
        mavlink.MAVLINK_MSG_ID_PARAM_REQUEST_LIST,
        mavlink.MAVLINK_MSG_ID_PARAM_SET,
        mavlink.MAVLINK_MSG_ID_MISSION_REQUEST_LIST,
        mavlink.MAVLINK_MSG_ID_PING,
        mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL,
    }
)
#: Messages that may report that somebody else selected an EKF source set.
ABOUT_SOURCE_SET = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_COMMAND_INT,
        mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
        mavlink.MAVLINK_MSG_ID_HEARTBEAT,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT,
        mavlink.MAVLINK_MSG_ID_NAMED_VALUE_FLOAT,
        rsbn.MAVLINK_MSG_ID_ESTIMATOR_SENSOR_FUSION_STATUS,
    }
)
#: Answers to the parameter check.
PARAMETERS = frozenset({mavlink.MAVLINK_MSG_ID_PARAM_VALUE, mavlink.MAVLINK_MSG_ID_PARAM_ERROR})
#: All messages that the core handles; others are logged only.
HANDLED = (
    REQUESTS
    | ABOUT_SOURCE_SET
    | PARAMETERS
    | DECODED
    | {mavlink.MAVLINK_MSG_ID_COMMAND_ACK, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION}
)

ABOUT_TIME = (ClockJump, MappingStepped, ClockRate, LinkLate, TimesyncOutlier)


class CompanionCore:
    """Everything between the bytes of the links and the log."""

    def __init__(
        self,
        config: Config,
        log: Log,
        links: Iterable[str] = ("main",),
        signing: Signing | None = None,
        save: Callable[[str], None] = lambda text: None,
        base: Config | None = None,
        flown: Flown | None = None,
    ) -> None:
        """Raises ConfigError for an invalid configuration, such as feeding back the autopilot's own position.

        `save` stores the TOML of the values that ground stations set beyond `base`; it may raise OSError.
        `flown` is what the run before left: it is gone on with if the autopilot has not booted since.
        """
        for *_, sentence in find_conflicts(config):
            raise ConfigError(sentence)
        self._config = config
        self._log = log
        self._navigator, self._flown = Navigator(config), flown
        self.links = {name: Link(name, config, number, signing) for number, name in enumerate(links)}
        self._output = AutopilotOutput(config)
        self._services = GroundStationServices(config, {STATUS: self._latest_status}, save, base)
        self._solution: Solution | None = None
        self._events: list[Event] = []
        self.rejected: Counter[str] = Counter()
        self._origin = OriginCheck(has_pairs=not config.has_own_ins)
        self._led: Link | None = None  # the leading link of the last poll
        self._last_used: Link | None = None  # whose autopilot's records were used last
        self._booted_ns, self._reboot_seen_on = 0, set[str]()  # the last reboot
        self._pace = Pace(at_least=frozenset({RESET}))
        self._answers = BeaconAnswers()
        self._unused_log = RateLimiter(UNUSED_LOG_HZ, UNUSED_LOG_BURST)
        self._unused_logged = 0
        self.not_logged = 0  # frames
        self._excess_reported_ns: dict[str, int] = {}
        self._next_state_ns = 0
        self._stale = False  # no recent solution
        self._inputs = InputMonitor()
        self._parameter_check = ParameterCheck()

    def receive(self, link: str, data: bytes, now_ns: int, peer: Hashable = None) -> Rank:
        """Process bytes received on `link` from `peer`; return how much their sender matters."""
        self.links[link].has_bytes |= bool(data)
        session = self.links[link].session
        events = session.receive(data, now_ns, peer)
        self._on_events(self.links[link], events, now_ns)
        rank = Rank.UNKNOWN
        for event in events:
            if isinstance(event, MessageReceived) and session.is_proof(event.frame):
                if event.from_autopilot:
                    return Rank.AUTOPILOT
                rank = Rank.ACCEPTED
        return rank

    @property
    def leading_link(self) -> Link | None:
        """The link whose messages are used and that carries the position messages."""
        best, best_rank = None, -1
        for link in self.links.values():  # called for every message: cheaper than max()
            if link.session.is_up and (rank := link.standing + 3 * link.session.is_confirmed) > best_rank:
                best, best_rank = link, rank
        return best

    @property
    def config(self) -> Config:
        """The configuration in effect, with the values set by ground stations."""
        return self._config

    @property
    def has_solution(self) -> bool:
        """Whether a solution was computed within the last seconds."""
        return self._solution is not None and not self._stale

    def flown(self, now_ns: int) -> Flown | None:
        """Return what the next run needs to go on with this flight; None without a recent solution."""
        link = self._last_used
        if link is None or not self.has_solution:
            return None
        system, booted_ns = link.session.autopilot, link.session.clock.offset(now_ns)
        if system is None or booted_ns is None:
            return None
        return Flown(system, booted_ns, to_toml(self._config), kept_state.encode(self._navigator.state))

    def settle(self) -> None:
        """Run deferred work after the output has been sent; otherwise the next record runs it."""
        self._navigator.settle()

    @property
    def births_due(self) -> bool:
        """Whether `bear` has anything to do."""
        return self._navigator.births_due

    def bear(self) -> None:
        """Ready half of the births of hypotheses while nothing arrives; else the next measurement does it."""
        self._navigator.bear()

    def poll(self, now_ns: int) -> None:
        """Do the periodic work that is due."""
        self._lock_links(now_ns)
        for link in self.links.values():
            self._on_events(link, link.session.poll(now_ns), now_ns)
            is_quiet = link.session.is_quiet(now_ns)
            link.standing = 0 if is_quiet else 1 + link.session.is_answered(now_ns)
            if link is self.leading_link and self._origin.origin is None and now_ns >= link.origin_request_ns:
                link.origin_request_ns = now_ns + ORIGIN_REQUEST_INTERVAL
                link.session.request_message(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        self._report_change_of_lead(now_ns)
        if (leading := self.leading_link) is not None:
            for event in self._parameter_check.poll(now_ns):
                self.report(event.severity, f"{leading.name}: {event.text}", now_ns)
            for message in self._parameter_check.to_send():
                leading.session.send(message)
        if now_ns >= self._next_state_ns:
            self._next_state_ns = now_ns + SECOND_NS
            self._request_firmware()
            self._report_staleness(now_ns)
            for link in self.links.values():
                link.note_frames()
            if leading is not None:
                self._steer(leading, now_ns)
            self._report_missing_inputs(now_ns)
            if self._config.output.status_hz > 0.0:
                status = self._latest_status() if self.has_solution else None
                for message in named_values(status, now_ns):
                    self._broadcast(message)
            for link in self.links.values():
                link.session.state = self._system_state()
                self._log.record(self._link_state(link, now_ns))

    def _lock_links(self, now_ns: int) -> None:
        """Keep all links on one aircraft: the confirmed one, else one that may become so."""
        links = self.links.values()
        holder = next((link for link in links if link.session.is_confirmed), None)
        if holder is None:
            holder = next((link for link in links if link.session.is_promising(now_ns)), None)
        locked = None if holder is None else holder.session.autopilot
        for link in links:
            if link is not holder:
                self._on_events(link, link.session.lock_to_system(locked, now_ns), now_ns)

    def deadline(self) -> int:
        """Return the latest time of the next `poll`, ns."""
        due = [self._next_state_ns, *(link.session.deadline() for link in self.links.values())]
        if (services_due := self._services.deadline()) is not None:
            due.append(services_due)
        return min(due)

    def to_send(self, link: str, now_ns: int) -> list[bytes]:
        """Return the frames to write to `link` now; they are logged as sent."""
        for message in self._services.to_send(now_ns):
            self._broadcast(message)
        frames = self.links[link].session.to_send()
        for data in frames:
            self._log.frame(link, True, data, now_ns)
        return frames

    def take_events(self) -> list[Event]:
        """Return the events since the last call."""
        taken, self._events = self._events, []
        return taken

    def report(self, severity: int, text: str, now_ns: int) -> None:
        """Log an event and report it to the ground stations."""
        self._emit(Event(now_ns, now_ns, severity, text), "/link/Event")

    def _on_events(self, link: Link, events: list[Any], now_ns: int) -> None:
        for event in events:
            if isinstance(event, MessageReceived):
                self._on_message(link, event)
            elif isinstance(event, NotUnderstood):
                link.bad += 1
            elif isinstance(event, LinkUp):
                link.sender = link.sender._replace(autopilot=MAKES.get(event.autopilot, "other"))
                text = f"{link.name}: autopilot {event.system} connected ({link.sender.autopilot})"
                self.report(Severity.INFO, text + self._leading_link_note(link), now_ns)
                if not self._is_received_elsewhere(link):
                    self._parameter_check.start(self._config, event.system, event.autopilot)
                self._lock_links(now_ns)
                # the origin may have changed during the silence
                if link is self.leading_link and self._origin.origin is not None:
                    link.session.request_message(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
            elif isinstance(event, LinkLost):
                silence_s = (now_ns - event.last_received_ns) / SECOND_NS
                text = f"{link.name}: autopilot {event.system} silent for {silence_s:.0f} s"
                self.report(Severity.WARNING, text + self._leading_link_note(link), now_ns)
            elif isinstance(event, AutopilotReleased):
                link.firmware, link.firmware_requests = None, 0
                by = "no other one yet" if event.by is None else f"autopilot {event.by} is used"
                text = f"{link.name}: autopilot {event.system} released: no navigation messages; {by}"
                self.report(Severity.WARNING, text, now_ns)
                if link is self._last_used:
                    self._restart(event.system, now_ns)
            elif isinstance(event, Rebooted):
                link.firmware, link.firmware_requests = None, 0  # a reboot may follow an update
                if self._is_new_reboot(link, now_ns):
                    self._parameter_check.start(self._config, event.system, link.session.autopilot_type)
                    self.report(Severity.WARNING, f"{link.name}: autopilot {event.system} rebooted", now_ns)
                    self._restart(event.system, now_ns)
            elif isinstance(event, ABOUT_TIME):
                self._on_time(link, event, now_ns)
            elif isinstance(event, FrameRejected):
                self.rejected[f"{link.name}: {event.reason.name.lower()} frame"] += 1
            elif isinstance(event, NotSent):
                link.not_sent[event.why] += 1
                if link.not_sent[event.why] == 1:
                    self.report(Severity.ERROR, f"{link.name}: not sent: {event.why}", now_ns)
            elif isinstance(event, SecondAutopilot):
                same = " from another address" if event.system == event.kept else ""
                text = (
                    f"{link.name}: second autopilot {event.system}{same} ignored; connected to {event.kept}"
                )
                self.report(Severity.WARNING, text, now_ns)

    def _on_time(self, link: Link, event: Any, now_ns: int) -> None:
        """Process what a session found about the autopilot's clock and the delay of its link."""
        who, rate = f"{link.name}: the clock of autopilot {event.system}", link.session.clock.rate
        if isinstance(event, ClockJump):
            if rate == 1.0:
                self.report(Severity.WARNING, f"{who} jumped by {event.by_ns / SECOND_NS:.1f} s", now_ns)
        elif isinstance(event, MappingStepped):
            if link is self._last_used and rate <= 1.0:
                self._on_record(TimeStep(now_ns, now_ns, event.system, event.by_ns / SECOND_NS))
        elif isinstance(event, ClockRate):
            severity = Severity.NOTICE if event.rate == 1.0 else Severity.ERROR
            self.report(severity, f"{who} {_rate_text(event.rate)}", now_ns)
        elif isinstance(event, LinkLate):
            text = f"late by {event.by_ns / SECOND_NS:.1f} s" if event.by_ns else "no longer late"
            severity = Severity.WARNING if event.by_ns else Severity.NOTICE
            self.report(severity, f"{link.name}: the link is {text}", now_ns)
        else:
            why = "TIMESYNC reply of another clock"
            self._on_record(Rejection(now_ns, now_ns, "timesync", why, event.error_ns / SECOND_NS))

    def _is_new_reboot(self, link: Link, now_ns: int) -> bool:
        """Note the autopilot's reboot as seen on `link`; return whether another link has not reported it."""
        booted_ns = link.session.clock.offset(now_ns) or now_ns
        if abs(booted_ns - self._booted_ns) > MAX_LATENESS or link.name in self._reboot_seen_on:
            self._booted_ns, self._reboot_seen_on = booted_ns, set()
        self._reboot_seen_on.add(link.name)
        return len(self._reboot_seen_on) == 1

    def _restart(self, system: int, now_ns: int) -> None:
        """Restart with an autopilot of which nothing is known: it rebooted, or is another one."""
        self._origin.forget()
        self._output.handle_reboot()
        self._on_record(Reboot(now_ns, now_ns, system))

    def _on_message(self, link: Link, event: MessageReceived) -> None:
        msgid, is_used = event.frame.msgid, event.from_autopilot
        if msgid in MEASUREMENTS:
            is_used = self._is_answer_used(link, event)
        if is_used or self._may_log_unused(link, event):
            self._log.frame(link.name, False, event.frame.raw, event.received_ns)
        if msgid not in HANDLED:  # most of a stock stream: never decoded
            return
        if msgid == mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            if event.message.type == mavlink.MAV_TYPE_GCS:
                link.stations.add(event.frame.system)
        elif msgid in REQUESTS:
            link.stations.add(event.frame.system)
            is_fed = link.session.is_up
            replies, changes = self._services.receive(event, link.session.system, link.name, is_fed)
            for reply in replies:
                link.session.send(reply)
            for _, parameter, old, new in changes:
                if new != old:
                    text = f"{parameter.name} set from {old:g} to {new:g} by {event.frame.system}"
                    self.report(Severity.NOTICE, text, event.received_ns)
            if changes:
                config = self._config = changes[-1].config
                self._output.tune(config)
                for each in self.links.values():
                    each.tune(config, event.received_ns)
                self._on_record(Tuning(event.received_ns, event.received_ns, to_toml(config)))
        is_duplicate = self._is_duplicate(link) and msgid not in MEASUREMENTS
        if msgid in ABOUT_SOURCE_SET and link.session.is_up and not (event.from_autopilot and is_duplicate):
            system = link.session.autopilot or 0
            self._output.handle_message(event.message, event.from_autopilot, system, event.received_ns)
            self._emit_output_events()
        if not is_used:
            return
        if msgid == mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            link.firmware = firmware_of(event.message)
        if is_duplicate:
            return
        if msgid in PARAMETERS:
            self._parameter_check.receive(event.message, event.frame)
        ours = (0, self._config.link.component_id)  # 0: the sender states no target
        if msgid == mavlink.MAVLINK_MSG_ID_COMMAND_ACK and event.message.target_component in ours:
            command, result = event.message.command, event.message.result
            self._output.handle_acknowledgement(command, result, event.received_ns)
            self._emit_output_events()
        if msgid not in DECODED or link.repeats_attitude(msgid, event.received_ns):
            return
        records = decode(event.message, event.received_ns, link.sender)
        if self._flown is not None:
            self._resume(self._flown, link, event.received_ns)
        for record in records:
            self._output.receive(record)
            if link.session.clock.rate > 1.0:
                continue
            self._last_used = link if event.from_autopilot else self._last_used
            is_rejected = self._on_record(record)
            if is_rejected and msgid in MEASUREMENTS:
                self._answers.note_rejected(_receiver_of(link, event), event.received_ns)

    def _resume(self, flown: Flown, link: Link, now_ns: int) -> None:
        """Go on with the flight of the run before, once the autopilot shows that it has not booted since."""
        booted_ns = link.session.clock.offset(now_ns)
        if booted_ns is None or link.session.autopilot != flown.system:
            return
        self._flown = None
        if abs(booted_ns - flown.booted_ns) <= SAME_BOOT_NS:
            self._on_record(Resumed(now_ns, now_ns, flown.toml, flown.state))

    def _is_received_elsewhere(self, link: Link) -> bool:
        """Whether another link receives the same autopilot."""
        system = link.session.autopilot
        return any(
            other is not link and other.session.is_up and other.session.autopilot == system
            for other in self.links.values()
        )

    def _is_duplicate(self, link: Link) -> bool:
        """Whether the leading link receives the same messages."""
        return link.session.is_up and link is not self.leading_link

    def _is_answer_used(self, link: Link, event: MessageReceived) -> bool:
        name = MEASUREMENTS[event.frame.msgid]
        source = f"{name.removesuffix('_id')} {getattr(event.message, name)}"
        receiver = _receiver_of(link, event)
        followed: Any = self._answers.followed(source, event.received_ns)
        if followed is not None and followed[0] != link.name and followed[2:] == receiver[2:]:
            return False  # the same answers on a second link
        why = self._answers.refusal(receiver, source, event.received_ns)
        if why is not None:
            self.rejected["beacon answers not used"] += 1
            if why != TURN_REASON:
                sender = f"{event.frame.system}/{event.frame.component}"
                text = f"{link.name}: beacon answers of {sender} not used: {why}"
                self._report_excess(text, "answers", event.received_ns)
        return why is None

    def _may_log_unused(self, link: Link, event: MessageReceived) -> bool:
        size, now = len(event.frame.raw), event.received_ns
        if self._unused_logged < UNUSED_LOG_TOTAL and self._unused_log.take(now, size):
            self._unused_logged += size
            return True
        self.not_logged += 1
        text = (
            f"{link.name}: {self.not_logged} frames of other senders not logged: more than "
            f"{UNUSED_LOG_HZ / 1e3:g} kB/s, or {UNUSED_LOG_TOTAL >> 20} MiB in all"
        )
        self._report_excess(text, "log", now)
        return False

    def _report_excess(self, text: str, what: str, now: int) -> None:
        last = self._excess_reported_ns.get(what)
        if last is None or now - last >= REPORT_INTERVAL:
            self._excess_reported_ns[what] = now
            self.report(Severity.WARNING, text, now)

    def _on_record(self, record: Stamped) -> bool:
        """Log a record and let the navigator use it; return whether it was rejected."""
        is_rejected = isinstance(record, Rejection)
        if not isinstance(record, INPUTS):  # truth, or a rejection by the decoder: only logged
            self._emit(record, "/link/Rejection" if is_rejected else None)
            return is_rejected
        self._log.record(record)
        for event in self._origin.receive(record):
            self._emit(event, "/link/Event")
        for output in self._navigator.handle(record):
            if isinstance(output, Solution):
                self._send(output, early=isinstance(record, RsbnFix))
            elif isinstance(output, Reset) and isinstance(record, LocalPosition):
                self._origin.forget()  # it may have moved: do not use it until received again
            # a late record folded again in this call is not this sender's
            is_rejected |= isinstance(output, Rejection) and output.rx_ns == record.rx_ns
            self._emit(output)
        return is_rejected

    def _emit(self, record: Stamped, channel: str | None = None) -> None:
        self._log.record(record, channel)
        if isinstance(record, Event):
            self._events.append(record)
            # without a receiver it would use up the rate of those that follow
            if self.leading_link is not None or any(link.stations for link in self.links.values()):
                text = self._without_link_names(printable(record.text))
                self._services.report(msgspec.structs.replace(record, text=text), record.rx_ns)
        elif isinstance(record, Rejection):
            self.rejected[record.source] += 1

    def _without_link_names(self, text: str) -> str:
        """Return a text for the 50 characters of STATUSTEXT: addresses of links mean nothing to a pilot."""
        for name in self.links:
            text = text.replace(f"{name}: ", "").replace(name, "another link")
        return text

    def _send(self, solution: Solution, early: bool) -> None:
        """Send the messages that are due; `early`: positions may leave earlier, after a beacon fix."""
        self._solution = solution
        periods = feed_periods_ns(self._config.output)
        due = self._pace.due(periods, solution.t_ns, periods.keys() - {RESET} if early else ())
        fed, leading = dict[str, Any](), self.leading_link
        if due and leading is not None:
            for message in self._output.messages(solution, due, self._receiver(leading)):
                leading.session.send(message)
                fed[message.get_type()] = message
            self._steer(leading, solution.rx_ns)
        for link in self.links.values():
            if link.session.is_up or link.stations:
                self._send_streams(link, {} if link.session.is_up else fed, solution.t_ns)

    def _send_streams(self, link: Link, fed: dict[str, Any], t_ns: int) -> None:
        """Send what is due of the status, and of copies of the messages `fed`, as asked for on the link."""
        streams = self._services.streams_ns(link.name)
        ready = {name: period for name, period in streams.items() if name == STATUS or name in fed}
        for name in link.pace.due(ready, t_ns, ()):
            link.session.send(self._latest_status() if name == STATUS else fed[name])

    def _broadcast(self, message: Any) -> None:
        """Send to the autopilot, which forwards it, and to the ground stations that it does not reach."""
        leading = self.leading_link
        reached = set[int]() if leading is None else leading.stations
        for link in self.links.values():
            if link is leading or (link.stations - reached if link.session.is_up else link.stations):
                link.session.send(message)

    def _steer(self, link: Link, now_ns: int) -> None:
        """Request the EKF source set that must lead, with or without a solution."""
        lack, is_lossy = self._parameter_check.lack, link.is_lossy
        for message in self._output.poll(self._receiver(link), now_ns, lack, is_lossy):
            link.session.send(message)
        self._emit_output_events()

    def _emit_output_events(self) -> None:
        """Log and report the events of the autopilot output."""
        for event in self._output.take_events():
            self._emit(event, "/link/Event")

    def _receiver(self, link: Link) -> Receiver:
        return Receiver(
            link.sender.autopilot,
            link.session.autopilot or 0,
            origin=self._origin.undoubted,
            origin_resets=self._origin.resets,
            sensor_id=self._config.output.global_position_sensor_id,
            unix_ns=self._output.unix_ns,
            firmware=link.firmware,
            rejected=self.rejected.total(),
        )

    def _latest_status(self) -> Any:
        """Return NAVIGATION_STATUS for a request; None before the first solution."""
        if self._solution is None:
            return None
        link = next(iter(self.links.values()))
        return navigation_status(self._solution, self._receiver(link))

    def _system_state(self) -> int:
        """Return MAV_STATE for our heartbeat: ACTIVE only while solutions are recent and trusted."""
        if self._solution is None:
            return int(mavlink.MAV_STATE_STANDBY)
        untrusted = self._solution.mode is Mode.UNTRUSTED or self._solution.trust is Trust.UNTRUSTED
        return int(mavlink.MAV_STATE_CRITICAL if self._stale or untrusted else mavlink.MAV_STATE_ACTIVE)

    def _report_staleness(self, now_ns: int) -> None:
        """Report when solutions stop and resume: the channel stopped, or no fix begins the estimate again."""
        if self._solution is None:
            return
        age = now_ns - self._solution.rx_ns
        if (age > STALE_AFTER) == self._stale:
            return
        self._stale = not self._stale
        if self._stale:
            has_begun = self._navigator.state.fixed
            why = "no data from the inertial channel" if has_begun else "no fix to begin again from"
            self.report(Severity.ERROR, f"no solution for {age / SECOND_NS:.0f} s: {why}", now_ns)
        else:
            self.report(Severity.NOTICE, "solutions resumed", now_ns)

    def _report_missing_inputs(self, now_ns: int) -> None:
        """Report inputs that never arrived, are slow or have stopped, and an autopilot that never came."""
        leading = self.leading_link
        if leading is not None:
            events = self._inputs.update(leading.session, self._config, leading.sender.autopilot, now_ns)
        else:
            silent = [
                (name, link.session, link.has_bytes)
                for name, link in self.links.items()
                if link.is_open and not link.stations
            ]
            events = self._inputs.report_silence(silent, now_ns)
        for event in events:
            self._emit(event, "/link/Event")

    def status(self) -> Status:
        """Return the state for the status line."""
        connected = self.leading_link is not None
        return Status.of(self._solution, connected, self._stale, self._inputs.missing, self._inputs.slow)

    def _report_change_of_lead(self, now_ns: int) -> None:
        """Report that another link leads; lost and regained autopilots are reported as such."""
        before, leading = self._led, self.leading_link
        self._led = leading
        if before is None or leading in (None, before) or not before.session.is_up:
            return
        is_deaf = leading.standing > before.standing > 0
        severity = Severity.WARNING if is_deaf else Severity.DEBUG
        why = f": the autopilot does not answer on {before.name}" if is_deaf else ""
        self.report(severity, f"{leading.name} leads{why}", now_ns)

    def _leading_link_note(self, link: Link) -> str:
        leading = self.leading_link
        return "" if leading in (None, link) else f"; {leading.name} leads"

    def _request_firmware(self) -> None:
        """Request the version of an autopilot that has not stated it, a few times."""
        for link in self.links.values():
            if link.session.is_up and link.firmware is None and link.firmware_requests < FIRMWARE_REQUESTS:
                link.firmware_requests += 1
                link.session.request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)

    def _link_state(self, link: Link, now_ns: int) -> LinkState:
        clock = link.session.clock
        offset, uncertainty = clock.offset(now_ns), clock.uncertainty(now_ns)
        return LinkState(
            now_ns,
            now_ns,
            link.name,
            link.session.is_up,
            link.received,
            link.lost,
            link.bad,
            link.dropped,
            offset,
            None if uncertainty is None else 2 * uncertainty,
        )


def _rate_text(rate: float) -> str:
    """What the user must know of an autopilot's clock that runs `rate` times as fast as ours."""
    if rate == 1.0:
        return "runs as ours again"
    if rate > 1.0:
        return f"runs {rate:g} times as fast as ours: nothing of it is used; fly the simulation in real time"
    return f"runs {rate:g} times as fast as ours: the simulation is too slow for its computer"


def _receiver_of(link: Link, event: MessageReceived) -> tuple[str, Hashable, int, int]:
    """Return the RSBN receiver that sent a message, with its way to us."""
    return link.name, event.peer, event.frame.system, event.frame.component
