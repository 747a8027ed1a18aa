"""When the autopilot's position may be set by MAV_CMD_EXTERNAL_POSITION_ESTIMATE. Sans-IO.

For ArduPilot that command is a hard reset without a gate (it was seen to accept 500 km, and to fly there), so
the gate is here. It opens only while the autopilot has no GPS of its own, and only as far as it may have
drifted: since it last had GPS, or took a position of ours, it reckons by airspeed and a wind that it holds
for known, so it is wrong by no more than that wind may be wrong, times the time. A reset beyond that and
our own three sigmas is a fault of ours, and is withheld.
"""

from __future__ import annotations

from companion.nav.geometry import displace
from companion.output.gate import FREE_M, SIGMAS, Position, distance
from companion.records import Event, FilterStatus, GlobalPosition, Gnss, Stamped

SECOND = 1_000_000_000
GONE_NS = 2 * SECOND  # ArduPilot refuses while GPS passed under a second ago
FRESH_NS = 2 * SECOND
WIND_ERROR = 20.0  # [m/s], of a wind held for known: more than was ever seen (7 m/s after a change)
ACCEPTED = 0
RESULTS = ("accepted", "temporarily rejected", "denied", "unsupported", "failed")  # MAV_RESULT


class Resetting:
    """What is known of the autopilot's own position."""

    def __init__(self) -> None:
        self._has_receiver = self._glitching = False
        self._fixed_ns: int | None = None  # when it last had GPS
        self._sure_ns: int | None = None  # when its position was last known to be right
        self._own: GlobalPosition | None = None
        self._answer: int | None = None

    def heard(self, record: Stamped) -> None:
        """A record of the autopilot's."""
        if isinstance(record, FilterStatus):
            self._glitching = record.gnss_glitch
        elif isinstance(record, Gnss) and record.receiver == 0:
            self._has_receiver = True
            if record.fix >= 3 and not self._glitching:
                self._fixed_ns = self._sure_ns = record.rx_ns
        elif isinstance(record, GlobalPosition):
            self._own = record
            if self._sure_ns is None:
                self._sure_ns = record.rx_ns

    def forbids(self, position: Position) -> str | None:
        """Why `position` must not be sent now; None if it may."""
        now, own = position.t_ns, self._own
        if not self._has_receiver:
            return "the autopilot's GPS was never heard, so it may have a fix"
        if self._fixed_ns is not None and now - self._fixed_ns < GONE_NS:
            return "the autopilot has GPS"
        if own is None or self._sure_ns is None or now - own.rx_ns > FRESH_NS:
            return "the autopilot's own position is not heard"
        dt = (now - own.t_ns) * 1e-9
        there = displace(own.lat, own.lon, own.alt_msl, own.v_n[0] * dt, own.v_n[1] * dt, 0.0)
        drift = WIND_ERROR * (now - self._sure_ns) * 1e-9
        away = distance(there[:2], (position.lat, position.lon))
        if away > SIGMAS * position.sigma + drift + FREE_M:
            return "it is further from the autopilot's than that can have drifted"
        return None

    def acknowledged(self, result: int, now_ns: int) -> Event | None:
        """The autopilot's answer; what is to be told, if it is another than before."""
        if result == ACCEPTED:
            self._sure_ns = now_ns
        news, self._answer = result != self._answer, result
        if not news:
            return None
        name = RESULTS[result] if result < len(RESULTS) else f"MAV_RESULT {result}"
        return Event(now_ns, now_ns, 6 if result == ACCEPTED else 4, f"external position {name}")
