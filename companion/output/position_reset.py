"""Position reset: when MAV_CMD_EXTERNAL_POSITION_ESTIMATE may reset the autopilot's position. No I/O.

ArduPilot executes this command as a hard reset without a gate (it accepted 500 km, and flew there), so the
gate is here. A reset is allowed only while the autopilot has no GPS of its own, and only within its possible
drift. Since its last GPS fix or accepted reset it dead-reckons by airspeed and a constant wind, so its error
is at most the error of that wind times the elapsed time. A distance beyond that drift plus three of our
sigmas indicates a fault of ours: the reset is withheld.
"""

from __future__ import annotations

from companion.link.dialect import entry_name, mavlink
from companion.nav.geometry import Geodetic
from companion.output.gate import JUMP_MARGIN_M, SIGMAS, Position, distance, place_at
from companion.records import Event, FilterStatus, GlobalPosition, Gnss, Severity, Stamped
from companion.units import SECOND_NS

GPS_TIMEOUT_NS = 2 * SECOND_NS  # ArduPilot rejects the command for 1 s after a GPS fix
POSITION_TIMEOUT_NS = 2 * SECOND_NS
WIND_ERROR = 20.0  # [m/s], greatest error of its wind (7 m/s observed after a change)


class PositionReset:
    """State of the autopilot's own GPS and position."""

    def __init__(self) -> None:
        self._has_receiver = self._glitching = False
        self._fixed_ns: int | None = None  # when it last had GPS
        self._correct_ns: int | None = None  # when its position was last known to be correct
        self._autopilot_position: GlobalPosition | None = None
        self._answer: int | None = None

    def receive(self, record: Stamped) -> None:
        """Process a record from the autopilot."""
        if isinstance(record, FilterStatus):
            self._glitching = record.gnss_glitch
        elif isinstance(record, Gnss):
            self._has_receiver = True
            if record.has_3d_fix and not self._glitching:
                self._fixed_ns = self._correct_ns = record.rx_ns
        elif isinstance(record, GlobalPosition):
            self._autopilot_position = record
            if self._correct_ns is None:
                self._correct_ns = record.rx_ns

    def autopilot_place(self, now_ns: int) -> Geodetic | None:
        """Return the autopilot's own position, propagated to `now_ns`; None without a recent one."""
        own = self._autopilot_position
        if own is None or now_ns - own.rx_ns > POSITION_TIMEOUT_NS:
            return None
        return place_at(own, now_ns)

    def withholding_reason(self, position: Position) -> str | None:
        """Return why `position` must not be sent now; None if it may be sent."""
        now, there = position.t_ns, self.autopilot_place(position.t_ns)
        if not self._has_receiver:
            return "no GPS message received yet, so the autopilot may have a fix"
        if self._fixed_ns is not None and now - self._fixed_ns < GPS_TIMEOUT_NS:
            return "the autopilot has GPS"
        if there is None or self._correct_ns is None:
            return "no recent position received from the autopilot"
        drift = WIND_ERROR * (now - self._correct_ns) * 1e-9
        away = distance(there, position.place)
        if away > SIGMAS * position.sigma + drift + JUMP_MARGIN_M:
            return "further from the autopilot's position than its possible drift"
        return None

    def handle_acknowledgement(self, result: int, now_ns: int) -> Event | None:
        """Process the result of a reset; return an event if it differs from the previous result."""
        if result == mavlink.MAV_RESULT_ACCEPTED:
            self._correct_ns = now_ns
        news, self._answer = result != self._answer, result
        if not news:
            return None
        return Event(
            now_ns,
            now_ns,
            Severity.INFO if result == mavlink.MAV_RESULT_ACCEPTED else Severity.WARNING,
            f"external position {entry_name('MAV_RESULT', result)}",
        )
