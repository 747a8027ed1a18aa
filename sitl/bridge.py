"""Between a real autopilot's simulator and the companion, without I/O: beacons, loss of GNSS, the truth.

    bridge.from_autopilot(data, now_ns)         # bytes of either side
    bridge.from_companion(data, now_ns)
    bridge.poll(now_ns)                         # no later than bridge.deadline()
    bridge.to_autopilot(), bridge.to_companion()    # after any of them: what each side must get
    bridge.take_told()                          # lines for people

It asks an ArduPilot or PX4 for its simulator's truth (SIM_STATE, HIL_STATE_QUATERNION), lets beacons answer
along it, has GNSS switched off and on by `gnss_switch`, and compares with the truth what the autopilot and
the companion each believe. It stands between the two: every frame goes on, the beacons' answers among them.
SIM_STATE has no time of its own: it counts as of its arrival, late by the link's delay.

`Way` tells how: `RELAY` as said; `BESIDE` where the companion has a link of its own to the autopilot, so that
it gets nothing but the answers; `SAME` where all speak on one link (a router), which carries the answers too.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from companion.analysis.error_statistics import beacon_fix
from companion.link import dialect, frame
from companion.link.clock import SECOND, BootClock
from companion.link.decode import MAKES, Sender, decode
from companion.link.session import LinkLost, LinkUp, MessageReceived, Rebooted, Session
from companion.nav.geometry import Geodetic, local_to_geodetic
from companion.records import GlobalPosition, Gnss, LocalOrigin, LocalPosition, Truth
from sitl.beacon import Beacon
from sitl.comparison import AFTER_S, Comparison, nearest
from sitl.gnss_switch import KNOBS, GnssSwitch
from sitl.live_beacons import Answering
from sitl.positions import CARRIERS, feeds, position_of

COMPONENT, AUTOPILOT_COMPONENT = 193, 1
RATES_HZ = {"SIM_STATE": 10.0, "HIL_STATE_QUATERNION": 10.0, "GLOBAL_POSITION_INT": 5.0}
ASK_ORIGIN_EVERY = 3 * SECOND
REQUEST_MESSAGE = 512  # MAV_CMD
TIMESYNC, NAVIGATION_STATUS = 111, dialect.type_named("NAVIGATION_STATUS").msgid
SILENT_AFTER = 3 * SECOND
AUTOPILOT, COMPANION, RSBN = "autopilot", "companion", "RSBN fix alone"


class Way(enum.Enum):
    """How the companion is reached."""

    RELAY = "relay"
    BESIDE = "beside"
    SAME = "same"


class Orders(NamedTuple):
    """GNSS off and on again so many seconds after the autopilot was first heard; None: never."""

    gnss_off_s: float | None = None
    gnss_on_s: float | None = None


NO_ORDERS = Orders()


class Loss(NamedTuple):
    """A loss of GNSS by the receiver's own word; `back_ns` None while it lasts."""

    lost_ns: int
    back_ns: int | None = None


class Bridge:
    """One attachment. `unaided`: the companion's positions are heard and withheld from the autopilot."""

    def __init__(
        self,
        beacons: Sequence[Beacon] = (),
        orders: Orders = NO_ORDERS,
        way: Way = Way.RELAY,
        unaided: bool = False,
        seed: int = 1,
    ) -> None:
        self.comparison = Comparison()
        self.losses: list[Loss] = []
        self.begun_ns: int | None = None  # when the autopilot was first heard
        self._way, self._unaided = way, unaided
        self._answering = Answering(beacons, seed, untimed=way is Way.BESIDE)
        self._session = Session(component=COMPONENT, rates_hz=RATES_HZ)
        self._sender = Sender(self._session.clock)
        self._readers = frame.Reader(), frame.Reader()
        self._outboxes: tuple[list[bytes], list[bytes]] = [], []
        self._switch: GnssSwitch | None = None
        self._due = [
            (round(at * 1e9), on)
            for at, on in ((orders.gnss_off_s, False), (orders.gnss_on_s, True))
            if at is not None
        ]
        self._origin: LocalOrigin | None = None
        self._origin_at = 0
        self._truth_ns: int | None = None
        self._global_at: int | None = None
        self._fixed = False
        self._marks: list[int] = []  # instants at which the errors are to be told
        self._companion_clock = BootClock()
        self._companion_at: int | None = None
        self._bound: tuple[int, float] | None = None  # the guaranteed one that it told last, m, and when
        self._told: list[str] = []
        self._uses: dict[type, Callable[[Any], None]] = {
            Truth: self._on_truth,
            GlobalPosition: self._on_global_position,
            LocalPosition: self._on_local_position,
            LocalOrigin: self._on_origin,
            Gnss: self._on_gnss,
        }

    # -- the sans-IO face ---------------------------------------------------------------------------------

    def from_autopilot(self, data: bytes, now_ns: int) -> None:
        """Take what came over the autopilot's link."""
        for found in self._readers[0].receive(data):
            if not isinstance(found, frame.Frame):
                continue
            if self._way is Way.RELAY:
                self._outboxes[1].append(found.raw)
            if found.msgid in CARRIERS and found.component != AUTOPILOT_COMPONENT:
                self._on_companion(found, now_ns)
            if found.msgid != TIMESYNC:  # the companion answers it: there must be one clock
                self._on_events(self._session.receive(found.raw, now_ns), now_ns)

    def from_companion(self, data: bytes, now_ns: int) -> None:
        """Take what came over the companion's link."""
        for found in self._readers[1].receive(data):
            if not isinstance(found, frame.Frame):
                continue
            if found.msgid in CARRIERS:
                self._on_companion(found, now_ns)
            elif found.msgid == NAVIGATION_STATUS:
                self._bound = now_ns, dialect.decode(found).bound_horizontal
            if self._way is Way.RELAY and not (self._unaided and feeds(dialect.decode(found))):
                self._outboxes[0].append(found.raw)

    def poll(self, now_ns: int) -> None:
        """Do what is due."""
        self._on_events(self._session.poll(now_ns), now_ns)
        if self._session.is_up and self._origin is None and now_ns >= self._origin_at:
            self._origin_at = now_ns + ASK_ORIGIN_EVERY
            self._ask_for_origin()
        while self._begun_and(self._due, now_ns):
            _, on = self._due.pop(0)
            self._tell(f"GNSS is to be switched {'on' if on else 'off'}")
            if self._switch is not None:
                self._switch.order(on)
        if self._switch is not None:
            self._told += self._switch.poll(now_ns)
            for message in self._switch.to_send():
                self._session.send(message)
        boot_ns, system = self._session.clock.offset(now_ns), self._session.system
        answers = self._answering.due(now_ns, boot_ns, system)
        self._outboxes[0 if self._way is Way.SAME else 1].extend(answers)
        while self._marks and self._marks[0] + SECOND <= now_ns:
            self._tell_errors(self._marks.pop(0))
        if self._companion_at is not None and now_ns - self._companion_at > SILENT_AFTER:
            self._companion_at = None
            self._tell("no position comes from the companion any more")

    def deadline(self) -> int:
        """When `poll` must be called at the latest."""
        due = [self._session.deadline(), self._answering.deadline()]
        if self._session.is_up and self._origin is None:
            due.append(self._origin_at)
        if self.begun_ns is not None and self._due:
            due.append(self.begun_ns + self._due[0][0])
        if self._switch is not None and (at := self._switch.deadline()) is not None:
            due.append(at)
        due += [self._marks[0] + SECOND] if self._marks else []
        return min(due)

    def to_autopilot(self) -> list[bytes]:
        """The frames for the autopilot's link, oldest first."""
        own = self._session.to_send()
        return [*self._take(0), *own]

    def to_companion(self) -> list[bytes]:
        """The frames for the companion's link."""
        return self._take(1)

    def finish(self, now_ns: int) -> None:
        """Leave GNSS on: `to_autopilot` has the last word to it."""
        if self._switch is not None and self._switch.is_off:
            self._switch.order(on=True)
            self._told += self._switch.poll(now_ns)
            for message in self._switch.to_send():
                self._session.send(message)

    def take_told(self) -> list[str]:
        """The lines since this was last asked."""
        taken, self._told = self._told, []
        return taken

    # -- what comes ---------------------------------------------------------------------------------------

    def _on_events(self, events: Sequence[Any], now_ns: int) -> None:
        for event in events:
            if isinstance(event, MessageReceived):
                if not event.from_autopilot:
                    continue
                if self._switch is not None:
                    self._told += self._switch.receive(event.message, event.frame)
                for record in decode(event.message, now_ns, self._sender):
                    if (use := self._uses.get(type(record))) is not None:
                        use(record)
            elif isinstance(event, LinkUp):
                self._on_up(event, now_ns)
            elif isinstance(event, LinkLost):
                self._tell("the autopilot is silent")
            elif isinstance(event, Rebooted):
                self._origin, self._global_at, self._truth_ns = None, None, None
                self._tell("the autopilot rebooted")

    def _on_up(self, event: LinkUp, now_ns: int) -> None:
        make = MAKES.get(event.autopilot, "other")
        self._sender = self._sender._replace(autopilot=make)
        self._tell(f"autopilot {event.system} is heard ({make})")
        if self.begun_ns is None:
            self.begun_ns = now_ns
            if self._due and make in KNOBS:
                self._switch = GnssSwitch(make, event.system)
            elif self._due:
                self._tell("how to switch GNSS in the simulator of such an autopilot is not known")

    def _on_truth(self, truth: Truth) -> None:
        if self._truth_ns is None:
            self._tell("its simulator's truth is heard")
        self._truth_ns = truth.t_ns
        self.comparison.truth(truth.t_ns, Geodetic(truth.lat, truth.lon, truth.alt))
        for fix in self._answering.along(truth):
            if (place := beacon_fix(fix, truth.alt)) is not None:
                self.comparison.estimate(fix.t_ns, RSBN, place)

    def _on_global_position(self, record: GlobalPosition) -> None:
        self._global_at = record.rx_ns
        self.comparison.estimate(record.t_ns, AUTOPILOT, Geodetic(record.lat, record.lon, record.alt_msl))

    def _on_local_position(self, record: LocalPosition) -> None:
        """The same estimate, where it is told locally alone."""
        heard = self._global_at is not None and record.rx_ns - self._global_at < SILENT_AFTER
        if heard or self._origin is None:
            return
        start = Geodetic(self._origin.lat, self._origin.lon, self._origin.alt_msl)
        place = local_to_geodetic(self._projection, start, record.x_n)
        self.comparison.estimate(record.t_ns, AUTOPILOT, place)

    def _on_origin(self, record: LocalOrigin) -> None:
        self._origin = record

    def _on_gnss(self, record: Gnss) -> None:
        if record.receiver != 0 or (record.fix >= 3) == self._fixed:
            return
        self._fixed = not self._fixed
        if self._fixed:
            if self.losses and self.losses[-1].back_ns is None:
                self.losses[-1] = self.losses[-1]._replace(back_ns=record.rx_ns)
                self._marks.clear()
            self._tell("the receiver has a fix")
        else:
            self.losses.append(Loss(record.rx_ns))
            self._marks = [record.rx_ns + s * SECOND for s in AFTER_S]
            self._tell("the receiver lost its fix")

    def _on_companion(self, found: frame.Frame, now_ns: int) -> None:
        said = position_of(dialect.decode(found), self._origin, self._sender.autopilot)
        if said is None:
            return
        if self._companion_at is None:
            self._tell("positions come from the companion")
        self._companion_at = now_ns
        if said.stamp_ns:
            self._companion_clock.heard(said.stamp_ns, now_ns)
        t_ns = self._companion_clock.local(said.stamp_ns, now_ns)
        bound = self._bound[1] if self._bound and now_ns - self._bound[0] < SILENT_AFTER else math.nan
        told = bound if math.isfinite(bound) else None
        self.comparison.estimate(t_ns - said.age_ns, COMPANION, said.place, said.sigma, told)

    # -- what goes ----------------------------------------------------------------------------------------

    @property
    def _projection(self) -> Any:
        return "px4" if self._sender.autopilot == "px4" else "ardupilot"

    def _ask_for_origin(self) -> None:
        self._session.send(
            dialect.new(
                "COMMAND_LONG",
                target_system=self._session.autopilot or 0,
                target_component=AUTOPILOT_COMPONENT,
                command=REQUEST_MESSAGE,
                param1=dialect.type_named("GPS_GLOBAL_ORIGIN").msgid,
            )
        )

    def _begun_and(self, due: list[tuple[int, bool]], now_ns: int) -> bool:
        return self.begun_ns is not None and bool(due) and now_ns >= self.begun_ns + due[0][0]

    def _tell_errors(self, mark_ns: int) -> None:
        seconds = round((mark_ns - self.losses[-1].lost_ns) * 1e-9)
        recent = [s for s in self.comparison.scored[-1000:] if s.t_ns > mark_ns - 5 * SECOND]
        said = []
        for source in (AUTOPILOT, COMPANION):
            if (found := nearest(recent, source, mark_ns)) is not None:
                bound = "" if found.bound is None else f" (guaranteed bound {found.bound:.0f} m)"
                said.append(f"{source} {found.error:.0f} m{bound}")
        self._tell(f"{seconds} s after the loss, off by: {', '.join(said) or 'nobody knows'}")

    def _take(self, side: int) -> list[bytes]:
        taken = self._outboxes[side][:]
        self._outboxes[side].clear()
        return taken

    def _tell(self, text: str) -> None:
        self._told.append(text)
