"""Bridge between a real autopilot's simulator and the companion, without I/O: beacons, GNSS loss, truth.

    bridge.from_autopilot(data, now_ns)         # bytes of either side
    bridge.from_companion(data, now_ns)
    bridge.poll(now_ns)                         # no later than bridge.deadline()
    bridge.to_autopilot(), bridge.to_companion()    # after any of them: the frames for each side
    bridge.take_reports()                       # lines for the user

It requests the simulator's truth from ArduPilot or PX4 (SIM_STATE, HIL_STATE_QUATERNION), simulates beacon
answers along it, switches GNSS off and on by `gnss_switch`, and compares the estimates of the autopilot and
of the companion with the truth. Every frame is relayed; the beacons' answers are added. SIM_STATE carries no
time: it is taken as of its arrival, late by the delay of the link.

`BridgeMode`: `RELAY` as above; `BESIDE` where the companion has a link of its own to the autopilot and
receives only the beacons' answers; `SAME` where all share one link (a router), which carries the answers too.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from companion.analysis.error_statistics import position_from_beacon
from companion.link import dialect, frame
from companion.link.clock import BootClock
from companion.link.decode import MAKES, Sender, decode
from companion.link.dialect import mavlink, rsbn
from companion.link.session import LinkLost, LinkUp, MessageReceived, Rebooted, Session
from companion.nav.geometry import Geodetic
from companion.navigator import inertial_track
from companion.records import GlobalPosition, Gnss, LocalOrigin, LocalPosition, Truth
from companion.units import SECOND_NS
from sitl.beacon import Beacon
from sitl.comparison import AFTER_S, Comparison, nearest_error
from sitl.gnss_switch import GNSS_PARAMETERS, GnssSwitch
from sitl.live_beacons import LiveBeacons
from sitl.positions import POSITION_MESSAGES, affects_estimator, position_of

COMPONENT = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER3
RATES_HZ = {"GLOBAL_POSITION_INT": 5.0, "GPS_RAW_INT": 2.0}
TRUTH = {"ardupilot": "SIM_STATE", "px4": "HIL_STATE_QUATERNION"}
TRUTH_HZ = 10.0
ASK_ORIGIN_EVERY = 3 * SECOND_NS
SILENT_AFTER = 3 * SECOND_NS
AUTOPILOT, COMPANION, RSBN = "autopilot", "companion", "RSBN fix alone"


class BridgeMode(enum.Enum):
    """How the companion is connected."""

    RELAY = "relay"
    BESIDE = "beside"
    SAME = "same"


class GnssSchedule(NamedTuple):
    """Times of switching GNSS off and on, s after the first connection to the autopilot; None: never."""

    gnss_off_s: float | None = None
    gnss_on_s: float | None = None


NO_SCHEDULE = GnssSchedule()


class GnssOutage(NamedTuple):
    """GNSS outage by the receiver's fix type; `regained_ns` is None while it lasts."""

    lost_ns: int
    regained_ns: int | None = None


class Bridge:
    """One bridge. `unaided`: the companion's positions are scored, but not relayed to the autopilot."""

    def __init__(
        self,
        beacons: Sequence[Beacon] = (),
        schedule: GnssSchedule = NO_SCHEDULE,
        mode: BridgeMode = BridgeMode.RELAY,
        unaided: bool = False,
        seed: int = 1,
    ) -> None:
        self.comparison = Comparison()
        self.outages: list[GnssOutage] = []
        self.connected_ns: int | None = None  # first connection to the autopilot
        self._mode, self._unaided = mode, unaided
        self._beacons = LiveBeacons(beacons, seed, untimed=mode is BridgeMode.BESIDE)
        self._session = Session(component=COMPONENT, rates_hz=RATES_HZ)
        self._sender = Sender(self._session.clock)
        self._readers = frame.Reader(), frame.Reader()
        self._send_queues: tuple[list[bytes], list[bytes]] = [], []
        self._switch: GnssSwitch | None = None
        self._due = [
            (round(at * 1e9), on)
            for at, on in ((schedule.gnss_off_s, False), (schedule.gnss_on_s, True))
            if at is not None
        ]
        self._origin: LocalOrigin | None = None
        self._origin_at = 0
        self._truth_ns: int | None = None
        self._global_ns: int | None = None
        self._has_fix = False
        self._error_report_times: list[int] = []  # times at which the errors are reported
        self._companion_clock = BootClock()
        self._companion_ns: int | None = None
        self._bound: tuple[int, float] | None = None  # time and value (m) of its last guaranteed bound
        self._reports: list[str] = []
        self._handlers: dict[type, Callable[[Any], None]] = {
            Truth: self._on_truth,
            GlobalPosition: self._on_global_position,
            LocalPosition: self._on_local_position,
            LocalOrigin: self._on_origin,
            Gnss: self._on_gnss,
        }

    # -- sans-IO interface --------------------------------------------------------------------------------

    def from_autopilot(self, data: bytes, now_ns: int) -> None:
        """Receive bytes from the autopilot's link."""
        for found in self._readers[0].receive(data):
            if not isinstance(found, frame.Frame):
                continue
            if self._mode is BridgeMode.RELAY:
                self._send_queues[1].append(found.raw)
            if found.msgid in POSITION_MESSAGES and found.component != mavlink.MAV_COMP_ID_AUTOPILOT1:
                self._on_companion(found, now_ns)
            # the companion answers the autopilot's TIMESYNC requests: there must be one clock
            if found.msgid != mavlink.MAVLINK_MSG_ID_TIMESYNC or dialect.decode(found).tc1:
                self._on_events(self._session.receive(found.raw, now_ns), now_ns)

    def from_companion(self, data: bytes, now_ns: int) -> None:
        """Receive bytes from the companion's link."""
        for found in self._readers[1].receive(data):
            if not isinstance(found, frame.Frame):
                continue
            if found.msgid in POSITION_MESSAGES:
                self._on_companion(found, now_ns)
            elif found.msgid == rsbn.MAVLINK_MSG_ID_NAVIGATION_STATUS:
                self._bound = now_ns, dialect.decode(found).bound_horizontal
            if self._mode is BridgeMode.RELAY and not (
                self._unaided and affects_estimator(dialect.decode(found))
            ):
                self._send_queues[0].append(found.raw)

    def poll(self, now_ns: int) -> None:
        """Do what is due."""
        self._on_events(self._session.poll(now_ns), now_ns)
        if self._session.is_up and self._origin is None and now_ns >= self._origin_at:
            self._origin_at = now_ns + ASK_ORIGIN_EVERY
            self._session.request_message(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
        while self.connected_ns is not None and self._due and now_ns >= self.connected_ns + self._due[0][0]:
            _, on = self._due.pop(0)
            self._report(f"switching GNSS {'on' if on else 'off'}")
            if self._switch is not None:
                self._switch.request(on)
        self._poll_switch(now_ns)
        boot_ns, system = self._session.clock.offset(now_ns), self._session.system
        answers = self._beacons.take_due(now_ns, boot_ns, system)
        self._send_queues[0 if self._mode is BridgeMode.SAME else 1].extend(answers)
        while self._error_report_times and self._error_report_times[0] + SECOND_NS <= now_ns:
            self._report_errors(self._error_report_times.pop(0))
        if self._companion_ns is not None and now_ns - self._companion_ns > SILENT_AFTER:
            self._companion_ns = None
            self._report(f"no position from the companion for {SILENT_AFTER / SECOND_NS:g} s")

    def deadline(self) -> int:
        """Return the latest time for the next `poll`."""
        due = [self._session.deadline(), self._beacons.deadline()]
        if self._session.is_up and self._origin is None:
            due.append(self._origin_at)
        if self.connected_ns is not None and self._due:
            due.append(self.connected_ns + self._due[0][0])
        if self._switch is not None and (at := self._switch.deadline()) is not None:
            due.append(at)
        due += [self._error_report_times[0] + SECOND_NS] if self._error_report_times else []
        return min(due)

    def to_autopilot(self) -> list[bytes]:
        """Return the frames for the autopilot's link, oldest first."""
        return [*self._take_frames(0), *self._session.to_send()]

    def to_companion(self) -> list[bytes]:
        """Return the frames for the companion's link."""
        return self._take_frames(1)

    def finish(self, now_ns: int) -> None:
        """Switch GNSS on again; `to_autopilot` returns the last frames."""
        if self._switch is not None and self._switch.is_off:
            self._switch.request(on=True)
            self._poll_switch(now_ns)

    def take_reports(self) -> list[str]:
        """Return the lines for the user since the last call."""
        taken, self._reports = self._reports, []
        return taken

    # -- received -----------------------------------------------------------------------------------------

    def _on_events(self, events: Sequence[Any], now_ns: int) -> None:
        for event in events:
            if isinstance(event, MessageReceived):
                if not event.from_autopilot:
                    continue
                if self._switch is not None:
                    self._reports += self._switch.receive(event.message, event.frame)
                for record in decode(event.message, now_ns, self._sender):
                    if (handler := self._handlers.get(type(record))) is not None:
                        handler(record)
            elif isinstance(event, LinkUp):
                self._on_up(event, now_ns)
            elif isinstance(event, LinkLost):
                self._report("the autopilot is silent")
            elif isinstance(event, Rebooted):
                self._origin, self._global_ns, self._truth_ns = None, None, None
                self._report("the autopilot rebooted")

    def _on_up(self, event: LinkUp, now_ns: int) -> None:
        make = MAKES.get(event.autopilot, "other")
        self._sender = self._sender._replace(autopilot=make)
        self._report(f"connected to autopilot {event.system} ({make})")
        # ArduPilot reports each request for a message that it does not have on every ground station
        truth = (TRUTH[make],) if make in TRUTH else TRUTH.values()
        self._session.set_rates({**RATES_HZ, **dict.fromkeys(truth, TRUTH_HZ)}, now_ns)
        if self.connected_ns is None:
            self.connected_ns = now_ns
            if self._due and make in GNSS_PARAMETERS:
                self._switch = GnssSwitch(make, event.system)
            elif self._due:
                self._report(f"GNSS of this autopilot's simulator ({make}) cannot be switched")

    def _on_truth(self, truth: Truth) -> None:
        if self._truth_ns is None:
            self._report("receiving the simulator's truth")
            if why := self._beacons.describe_unreached(truth):
                self._report(f"no beacon answers here: {why}")
        self._truth_ns = truth.t_ns
        self.comparison.add_truth(truth.t_ns, Geodetic(truth.lat, truth.lon, truth.alt))
        for fix in self._beacons.answers_to(truth):
            if (place := position_from_beacon(fix, truth.alt)) is not None:
                self.comparison.add_estimate(fix.t_ns, RSBN, place)

    def _on_global_position(self, record: GlobalPosition) -> None:
        self._global_ns = record.rx_ns
        self.comparison.add_estimate(record.t_ns, AUTOPILOT, Geodetic(record.lat, record.lon, record.alt_msl))

    def _on_local_position(self, record: LocalPosition) -> None:
        """The same estimate, where only LOCAL_POSITION_NED is sent."""
        is_global_recent = self._global_ns is not None and record.rx_ns - self._global_ns < SILENT_AFTER
        if is_global_recent or self._origin is None:
            return
        place = inertial_track.point(record, self._origin).position
        self.comparison.add_estimate(record.t_ns, AUTOPILOT, place)

    def _on_origin(self, record: LocalOrigin) -> None:
        self._origin = record

    def _on_gnss(self, record: Gnss) -> None:
        if record.receiver != 0 or record.has_3d_fix == self._has_fix:
            return
        self._has_fix = not self._has_fix
        if self._has_fix:
            if self.outages and self.outages[-1].regained_ns is None:
                self.outages[-1] = self.outages[-1]._replace(regained_ns=record.rx_ns)
                self._error_report_times.clear()
            self._report("the receiver has a fix")
        else:
            self.outages.append(GnssOutage(record.rx_ns))
            self._error_report_times = [record.rx_ns + s * SECOND_NS for s in AFTER_S]
            self._report("the receiver lost its fix")

    def _on_companion(self, found: frame.Frame, now_ns: int) -> None:
        reported = position_of(dialect.decode(found), self._origin, self._sender.autopilot)
        if reported is None:
            return
        if self._companion_ns is None:
            self._report("receiving positions from the companion")
        self._companion_ns = now_ns
        if reported.stamp_ns:
            self._companion_clock.update(reported.stamp_ns, now_ns)
        t_ns = self._companion_clock.local(reported.stamp_ns, now_ns)
        bound = self._bound[1] if self._bound and now_ns - self._bound[0] < SILENT_AFTER else math.nan
        stated_bound = bound if math.isfinite(bound) else None
        self.comparison.add_estimate(
            t_ns - reported.age_ns, COMPANION, reported.place, reported.sigma, stated_bound
        )

    # -- sent ---------------------------------------------------------------------------------------------

    def _poll_switch(self, now_ns: int) -> None:
        if self._switch is not None:
            self._reports += self._switch.poll(now_ns)
            for message in self._switch.to_send():
                self._session.send(message)

    def _report_errors(self, mark_ns: int) -> None:
        seconds = round((mark_ns - self.outages[-1].lost_ns) * 1e-9)
        recent = [s for s in self.comparison.errors[-1000:] if s.t_ns > mark_ns - 5 * SECOND_NS]
        reported = []
        for source in (AUTOPILOT, COMPANION):
            if (found := nearest_error(recent, source, mark_ns)) is not None:
                bound = "" if found.bound is None else f" (guaranteed bound {found.bound:.0f} m)"
                reported.append(f"{source} {found.error:.0f} m{bound}")
        self._report(f"{seconds} s after the loss, errors: {', '.join(reported) or 'not known'}")

    def _take_frames(self, side: int) -> list[bytes]:
        taken = self._send_queues[side][:]
        self._send_queues[side].clear()
        return taken

    def _report(self, text: str) -> None:
        self._reports.append(text)
