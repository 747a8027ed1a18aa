"""The companion without its I/O: sessions, one navigator and one log joined; bytes and instants in, bytes
out.

    onboard.receive(link, data, now_ns)     # bytes of one link
    onboard.poll(now_ns)                    # no later than onboard.deadline()
    onboard.to_send(link)                   # after either: what that link must carry
    onboard.settle()                        # then, if there is time: what no answer waits for

The asyncio service and the virtual-time loopback drive this same object. It holds no state of navigation; it
decides who is believed (the one autopilot, and any beacon receiver), what is logged, and when a solution goes
out. Of several links that hear the autopilot the first, in the order given, leads: frames that come over the
others are logged and no more, and what steers goes out over that one alone.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any

from companion.config import Config, ConfigError, to_toml
from companion.config.profiles import RESET
from companion.config.validate import conflicts
from companion.link import dialect
from companion.link.decode import MAKES, Sender, decode
from companion.link.session import (
    ClockLeapt,
    FalseTime,
    LinkLate,
    LinkLost,
    LinkUp,
    MessageReceived,
    NotUnderstood,
    Rebooted,
    Refused,
    SecondAutopilot,
    Session,
)
from companion.link.signing import Signing
from companion.navigator import Navigator
from companion.output.autopilot_output import Feed
from companion.output.encode import Receiver, navigation_status
from companion.records import (
    INPUTS,
    Event,
    LinkState,
    LocalOrigin,
    LocalPosition,
    Mode,
    Reboot,
    Rejection,
    Reset,
    RsbnFix,
    Solution,
    Stamped,
    Trust,
    Tuning,
)
from companion.runtime.ground_station_services import Dialogue
from companion.runtime.parameter_check import Checkup
from companion.storage.deferred_log import Log

SECOND = 1_000_000_000
RSBN = dialect.type_named("RSBN_MEASUREMENT").msgid
GPS_GLOBAL_ORIGIN = dialect.type_named("GPS_GLOBAL_ORIGIN").msgid
COMMAND_ACK = dialect.type_named("COMMAND_ACK").msgid
STATUS = "NAVIGATION_STATUS"
REQUEST_MESSAGE = 512  # MAV_CMD
ASK_ORIGIN_EVERY = 3 * SECOND
STALE_AFTER = 2 * SECOND
STANDBY, ACTIVE, CRITICAL = 3, 4, 5  # MAV_STATE
#: COMMAND_INT and _LONG, PARAM_REQUEST_READ, PARAM_REQUEST_LIST, PARAM_SET.
ASKING = frozenset({75, 76, 20, 21, 23})


class Link:
    """One link: its session, and how its autopilot's messages are read."""

    def __init__(self, name: str, config: Config, number: int, signing: Signing | None) -> None:
        self.name = name
        self.session = Session(
            component=config.link.component_id,
            autopilot_system=config.link.system_id or None,
            rates_hz=wanted(config),
            signing=signing,
            link_id=number,
        )
        self.sender = Sender(self.session.clock)
        self.feed = Feed(config)
        self.checkup = Checkup()
        self.bad = 0
        self.dropped = 0  # frames that the line did not take, told by who carries them
        self.origin_at = 0  # when the local origin is next asked for

    @property
    def lost(self) -> int:
        """Frames missed, by their sequence numbers, over all who speak here."""
        return self.session.reader.lost

    @property
    def received(self) -> int:
        """Frames received of all who speak here."""
        return self.session.reader.received


def wanted(config: Config) -> dict[str, float]:
    """The rates to ask for, by message."""
    rates = config.rates
    asked = {
        "LOCAL_POSITION_NED": rates.local_position_hz,
        "GPS_RAW_INT": rates.gnss_hz,
        "ATTITUDE": rates.attitude_hz,
        "RAW_IMU": rates.imu_hz,
        "HIGHRES_IMU": rates.imu_hz,
        "VFR_HUD": rates.air_data_hz,
        "SCALED_PRESSURE": 0.0 if config.channel == "local_position" else rates.air_data_hz,
        "EKF_STATUS_REPORT": rates.status_hz,
        "SYSTEM_TIME": float(config.output.rates_hz["GPS_INPUT"] > 0.0),
        "GLOBAL_POSITION_INT": 2.0 * (config.output.rates_hz[RESET] > 0.0),
        "SIM_STATE": rates.truth_hz,
    }
    paced_by = {"air_data": ["VFR_HUD"], "strapdown": ["RAW_IMU", "HIGHRES_IMU"]}
    for name in paced_by.get(config.channel, ["LOCAL_POSITION_NED"]):
        if 0.0 < asked[name] < config.output.pace_hz:  # a solution comes with a point of the channel
            asked[name] = config.output.pace_hz
    return {name: hz for name, hz in asked.items() if hz > 0.0}


class Onboard:
    """Everything between the links' bytes and the log."""

    def __init__(
        self,
        config: Config,
        log: Log,
        links: Iterable[str] = ("main",),
        signing: Signing | None = None,
        save: Callable[[str], None] = lambda text: None,
        base: Config | None = None,
    ) -> None:
        """`save` keeps the TOML of what ground stations set beyond `base`; it may raise OSError. Raises
        ConfigError for what cannot be meant, such as feeding the autopilot its own position.
        """
        for *_, sentence in conflicts(config):
            raise ConfigError(sentence)
        self._config = config
        self._log = log
        self._navigator = Navigator(config)
        self.links = {name: Link(name, config, number, signing) for number, name in enumerate(links)}
        self._dialogue = Dialogue(config, {STATUS: self._status}, save, base)
        self._solution: Solution | None = None
        self._events: list[Event] = []
        self.rejected: Counter[str] = Counter()
        self._origin: LocalOrigin | None = None
        self._paced: dict[str, int] = {}  # from when the period of each message is counted
        self._state_at = 0
        self._stale = False  # solutions have ceased

    def receive(self, link: str, data: bytes, now_ns: int) -> None:
        """Take bytes that came over `link`."""
        self._on_events(self.links[link], self.links[link].session.receive(data, now_ns), now_ns)

    @property
    def leading(self) -> Link | None:
        """The link over which the autopilot is listened to and steered."""
        for link in self.links.values():  # asked for every message: cheaper than a generator
            if link.session.is_up:
                return link
        return None

    def settle(self) -> None:
        """Do what no answer waits for, once the answers are out; left undone, the next record does it."""
        self._navigator.settle()

    def poll(self, now_ns: int) -> None:
        """Do what is due."""
        for link in self.links.values():
            self._on_events(link, link.session.poll(now_ns), now_ns)
            if link is self.leading and self._origin is None and now_ns >= link.origin_at:
                link.origin_at = now_ns + ASK_ORIGIN_EVERY
                self._ask_for(link, GPS_GLOBAL_ORIGIN)
            for event in link.checkup.poll(now_ns):
                self.note(event.severity, f"{link.name}: {event.text}", now_ns)
            for message in link.checkup.to_send():
                link.session.send(message)
        if now_ns >= self._state_at:
            self._state_at = now_ns + SECOND
            self._tell_if_stale(now_ns)
            for link in self.links.values():
                link.session.state = self._system_state(now_ns)
                self._log.record(self._state(link, now_ns))

    def deadline(self) -> int:
        """When `poll` must be called at the latest."""
        due = [self._state_at, *(link.session.deadline() for link in self.links.values())]
        if (news := self._dialogue.deadline()) is not None:
            due.append(news)
        return min(due)

    def to_send(self, link: str, now_ns: int) -> list[bytes]:
        """The frames that `link` must carry now; they are logged as sent."""
        for message in self._dialogue.to_send(now_ns):
            for each in self.links.values():
                if each.session.is_up:
                    each.session.send(message)
        frames = self.links[link].session.to_send()
        for data in frames:
            self._log.frame(link, True, data, now_ns)
        return frames

    def take_events(self) -> list[Event]:
        """The changes of state since this was last asked."""
        taken, self._events = self._events, []
        return taken

    def note(self, severity: int, text: str, now_ns: int) -> None:
        """Log and tell a change of state."""
        self._emit(Event(now_ns, now_ns, severity, text), "/link/Event")

    def _on_events(self, link: Link, events: list[Any], now_ns: int) -> None:
        for event in events:
            if isinstance(event, MessageReceived):
                self._on_message(link, event)
            elif isinstance(event, NotUnderstood):
                link.bad += 1
            elif isinstance(event, LinkUp):
                link.sender = link.sender._replace(autopilot=MAKES.get(event.autopilot, "other"))
                text = f"{link.name}: autopilot {event.system} heard ({link.sender.autopilot})"
                self.note(6, text + self._over_another(link), now_ns)
                link.checkup.begin(self._config, event.system, event.autopilot)
                for each in self.links.values():
                    each.session.heed(event.system)  # there is one aircraft
                if link is self.leading and self._origin is not None:  # it may have moved in the silence
                    self._ask_for(link, GPS_GLOBAL_ORIGIN)
            elif isinstance(event, LinkLost):
                silent = (now_ns - event.heard_ns) / SECOND
                text = f"{link.name}: autopilot {event.system} silent for {silent:.0f} s"
                self.note(4, text + self._over_another(link), now_ns)
            elif isinstance(event, Rebooted):
                self._origin = None
                link.feed.rebooted()
                link.checkup.begin(self._config, event.system, link.session.kind)
                self.note(4, f"{link.name}: autopilot {event.system} rebooted", now_ns)
                self._on_record(Reboot(now_ns, now_ns, event.system))
            elif isinstance(event, ClockLeapt):
                leap = event.by_ns / SECOND
                self.note(
                    4, f"{link.name}: the clock of autopilot {event.system} leapt by {leap:.1f} s", now_ns
                )
            elif isinstance(event, LinkLate):
                text = f"late by {event.by_ns / SECOND:.1f} s" if event.by_ns else "prompt again"
                self.note(4 if event.by_ns else 5, f"{link.name}: the link is {text}", now_ns)
            elif isinstance(event, FalseTime):
                why = "a TIMESYNC answer of another clock"
                self._on_record(Rejection(now_ns, now_ns, "timesync", why, event.off_ns / SECOND))
            elif isinstance(event, Refused):
                self.rejected[f"{link.name}: {event.reason.name.lower()} frame"] += 1
            elif isinstance(event, SecondAutopilot):
                text = (
                    f"{link.name}: a second autopilot, {event.system}, is ignored; we listen to {event.kept}"
                )
                self.note(4, text, now_ns)

    def _on_message(self, link: Link, event: MessageReceived) -> None:
        self._log.frame(link.name, False, event.frame.raw, event.received_ns)
        if event.frame.msgid in ASKING:
            replies, config = self._dialogue.receive(event, link.session.system)
            for reply in replies:
                link.session.send(reply)
            if config is not None:
                self._config = config
                for each in self.links.values():
                    each.feed.config = config
                    each.session.want(wanted(config), event.received_ns)
                self._on_record(Tuning(event.received_ns, event.received_ns, to_toml(config)))
        if not (event.from_autopilot or event.frame.msgid == RSBN):
            return
        ours = (0, self._config.link.component_id)  # 0: of a sender that names nobody
        if event.frame.msgid == COMMAND_ACK and event.message.target_component in ours:
            link.feed.acknowledged(event.message.command, event.message.result, event.received_ns)
            self._tell(link)
        link.checkup.receive(event.message, event.frame)
        again = link.session.is_up and link is not self.leading  # what the leading link brings too
        for record in decode(event.message, event.received_ns, link.sender):
            link.feed.heard(record)
            if not again:
                self._on_record(record)

    def _on_record(self, record: Stamped) -> None:
        if not isinstance(record, INPUTS):  # truth, or a rejection by `wire`: logged, and no further
            self._emit(record, "/link/Rejection" if isinstance(record, Rejection) else None)
            return
        self._log.record(record)
        if isinstance(record, LocalOrigin):
            self._origin = record
        for output in self._navigator.handle(record):  # type: ignore[arg-type]
            if isinstance(output, Solution):
                self._send(output, news=isinstance(record, RsbnFix))
            elif isinstance(output, Reset) and isinstance(record, LocalPosition):
                self._origin = None  # perhaps that is what moved: nothing is counted from it till told
            self._emit(output)

    def _emit(self, record: Stamped, channel: str | None = None) -> None:
        self._log.record(record, channel)
        if isinstance(record, Event):
            self._events.append(record)
            self._dialogue.tell(record, record.rx_ns)
        elif isinstance(record, Rejection):
            self.rejected[record.source] += 1

    def _send(self, solution: Solution, news: bool) -> None:
        """The messages that are due, and on the news of a beacon's fix all that steer, to the autopilot."""
        self._solution = solution
        periods, t_ns = self._dialogue.periods_ns, solution.t_ns
        next_ns = {name: self._paced.get(name, t_ns - period) + period for name, period in periods.items()}
        due = [n for n in periods if (news and n not in (RESET, STATUS)) or t_ns >= next_ns[n]]
        for name in due:
            self._paced[name] = max(next_ns[name], t_ns if name == RESET else t_ns - periods[name])
        feeding = [name for name in due if name != STATUS]
        if feeding and (leading := self.leading) is not None:
            for message in leading.feed.messages(solution, feeding, self._receiver(leading)):
                leading.session.send(message)
            self._tell(leading)
        for link in self.links.values() if STATUS in due else ():
            if link.session.is_up:
                link.session.send(navigation_status(solution, self._receiver(link)))

    def _tell(self, link: Link) -> None:
        """What there is to tell of what goes out."""
        for event in link.feed.take_events():
            self._emit(event, "/link/Event")

    def _receiver(self, link: Link) -> Receiver:
        return Receiver(
            link.sender.autopilot,
            link.session.autopilot or 0,
            origin=self._origin,
            sensor_id=self._config.output.global_position_sensor_id,
            unix_ns=link.feed.unix_ns,
            rejected=self.rejected.total(),
        )

    def _status(self) -> Any:
        """NAVIGATION_STATUS for who asks for it, None before the first solution."""
        if self._solution is None:
            return None
        link = next(iter(self.links.values()))
        return navigation_status(self._solution, self._receiver(link))

    def _system_state(self, now_ns: int) -> int:
        """MAV_STATE for our heartbeat: ACTIVE only while solutions come and can be trusted."""
        if self._solution is None:
            return STANDBY
        untrusted = self._solution.mode is Mode.UNTRUSTED or self._solution.trust is Trust.UNTRUSTED
        return CRITICAL if self._stale or untrusted else ACTIVE

    def _tell_if_stale(self, now_ns: int) -> None:
        """When solutions cease, and when they come again: the inertial channel fell silent, or froze."""
        if self._solution is None:
            return
        age = now_ns - self._solution.rx_ns
        if (age > STALE_AFTER) != self._stale:
            self._stale = not self._stale
            ceased = f"no solution for {age / SECOND:.0f} s: the inertial channel gives nothing"
            self.note(3 if self._stale else 5, ceased if self._stale else "solutions again", now_ns)

    def _over_another(self, link: Link) -> str:
        leading = self.leading
        return "" if leading in (None, link) else f"; it is listened to over {leading.name}"

    def _ask_for(self, link: Link, msgid: int) -> None:
        link.session.send(
            dialect.new(
                "COMMAND_LONG",
                target_system=link.session.autopilot or 0,
                target_component=1,
                command=REQUEST_MESSAGE,
                param1=msgid,
            )
        )

    def _state(self, link: Link, now_ns: int) -> LinkState:
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
