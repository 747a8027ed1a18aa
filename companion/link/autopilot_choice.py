"""Which of the vehicles on a link is our autopilot. No clock, no messages of its own.

    choice.receive(msgid, heartbeat, system, peer, now_ns)      # every frame of component 1
    choice.chosen                                               # the candidate in use, None before the first

A candidate is a system and the address it sends from (`peer`), with a HEARTBEAT of a vehicle's autopilot from
component 1. The first one is used at once, because an autopilot may send only HEARTBEAT until streams are
requested. It is confirmed by a stream of navigation messages:

- Without such a stream it is released for a candidate that has one, and else the next candidate is tried.
- A confirmed one is released only after a silence of RELEASE_AFTER, or of the time it was received if that is
  longer: a companion has one aircraft, and does not change to another when its own is silent.
- The same system from another address is taken over when the old address is silent (a router restarted).
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

from companion.link.dialect import Message, mavlink
from companion.units import SECOND_NS

#: HEARTBEAT types of peripherals and ground stations, whatever their autopilot field holds.
NOT_VEHICLES = frozenset(
    {
        mavlink.MAV_TYPE_ANTENNA_TRACKER,
        mavlink.MAV_TYPE_GCS,
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
        mavlink.MAV_TYPE_GIMBAL,
        mavlink.MAV_TYPE_ADSB,
        mavlink.MAV_TYPE_CAMERA,
        mavlink.MAV_TYPE_CHARGING_STATION,
        mavlink.MAV_TYPE_FLARM,
        mavlink.MAV_TYPE_SERVO,
        mavlink.MAV_TYPE_ODID,
        mavlink.MAV_TYPE_BATTERY,
        mavlink.MAV_TYPE_PARACHUTE,
        mavlink.MAV_TYPE_LOG,
        mavlink.MAV_TYPE_OSD,
        mavlink.MAV_TYPE_IMU,
        mavlink.MAV_TYPE_GPS,
        mavlink.MAV_TYPE_WINCH,
    }
)
#: Messages that an autopilot streams and a peripheral or a wrong sender does not.
NAVIGATION = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_GPS_RAW_INT,
        mavlink.MAVLINK_MSG_ID_RAW_IMU,
        mavlink.MAVLINK_MSG_ID_SCALED_IMU,
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_VFR_HUD,
    }
)
#: A stream: at least so many navigation messages, the last one so recent.
STREAM_MESSAGES, STREAM_NS = 10, 2 * SECOND_NS
#: A stream that lasts so long confirms a candidate.
CONFIRMED_AFTER = 5 * SECOND_NS
#: A candidate without a stream has this time before one with a stream, or just another one, is tried.
ANSWER_TIME, TRY_TIME = 3 * SECOND_NS, 10 * SECOND_NS
#: Silence after which the same system is accepted from another address.
TAKE_OVER_AFTER = 2 * SECOND_NS
#: Shortest silence after which a confirmed candidate is released for another system.
RELEASE_AFTER = 60 * SECOND_NS
MAX_CANDIDATES = 16
#: A candidate that is not used is forgotten after this silence if its place is needed.
FORGET_AFTER = 10 * SECOND_NS


@dataclass(slots=True)
class Candidate:
    """A vehicle as received from one address; `autopilot` is MAV_AUTOPILOT."""

    system: int
    peer: Hashable
    autopilot: int
    last_ns: int
    tried_ns: int = 0  # when it was chosen last
    stream_since_ns: int = 0
    navigation_ns: int = -STREAM_NS
    messages: int = 0  # of the stream
    confirmed_ns: int = 0  # longest stream

    def note_navigation(self, now_ns: int) -> None:
        """Count a navigation message."""
        if now_ns - self.navigation_ns > STREAM_NS:
            self.stream_since_ns, self.messages = now_ns, 0
        self.navigation_ns = now_ns
        self.messages += 1
        if self.messages >= STREAM_MESSAGES:
            self.confirmed_ns = max(self.confirmed_ns, now_ns - self.stream_since_ns)

    def streams(self, now_ns: int) -> bool:
        """Whether it streams navigation messages now."""
        return self.messages >= STREAM_MESSAGES and now_ns - self.navigation_ns <= STREAM_NS

    def is_promising(self, now_ns: int) -> bool:
        """Whether it is confirmed, streams, or was chosen too recently to judge."""
        return self.is_confirmed or self.streams(now_ns) or now_ns - self.tried_ns < TRY_TIME

    @property
    def is_confirmed(self) -> bool:
        """Whether it has streamed navigation messages long enough."""
        return self.confirmed_ns >= CONFIRMED_AFTER


class AutopilotChoice:
    """Candidates of one link and the one in use; `required_system` excludes all other systems."""

    def __init__(self, required_system: int | None = None) -> None:
        self.required_system = required_system
        self.locked_system: int | None = None  # by another link
        self.chosen: Candidate | None = None
        self._candidates: dict[tuple[int, Hashable], Candidate] = {}

    def is_candidate(self, system: int, peer: Hashable) -> bool:
        """Whether `system` at `peer` is a vehicle's autopilot."""
        return (system, peer) in self._candidates

    def is_rival(self, system: int, peer: Hashable) -> bool:
        """Whether frames of `system` from `peer` belong to another vehicle."""
        chosen = self.chosen
        return (chosen is None or chosen.system != system) and self.is_candidate(system, peer)

    def receive(
        self, msgid: int, heartbeat: Message | None, system: int, peer: Hashable, now_ns: int
    ) -> Candidate | None:
        """Process a frame of component 1; return the candidate that was used before, if the choice changed.

        `heartbeat` is the message if it is a HEARTBEAT. The first choice is no change.
        """
        candidate = self._candidates.get((system, peer))
        if heartbeat is not None and _is_vehicle(heartbeat):
            candidate = candidate or self._add(system, peer, now_ns)
            if candidate is not None:
                candidate.autopilot = heartbeat.autopilot
        if candidate is None:
            return None
        candidate.last_ns = now_ns
        if msgid in NAVIGATION:
            candidate.note_navigation(now_ns)
        before = self.chosen
        if candidate is before or not self._is_allowed(system):
            return None
        if before is None or self._yields(before, candidate, now_ns):
            self.chosen, candidate.tried_ns = candidate, now_ns
            return before
        return None

    def leave(self, peer: Hashable, now_ns: int) -> None:
        """Let the systems of `peer`, whose connection has ended, be taken over from another one at once."""
        for candidate in self._candidates.values():
            if candidate.peer == peer:
                candidate.last_ns = min(candidate.last_ns, now_ns - TAKE_OVER_AFTER)

    def lock(self, system: int | None) -> Candidate | None:
        """Accept no other system until the next call; return the candidate in use if that releases it."""
        self.locked_system = system
        if self.chosen is None or self._is_allowed(self.chosen.system):
            return None
        released, self.chosen = self.chosen, None
        return released

    def _is_allowed(self, system: int) -> bool:
        return self.required_system in (None, system) and self.locked_system in (None, system)

    def _yields(self, used: Candidate, other: Candidate, now_ns: int) -> bool:
        silence = now_ns - used.last_ns
        if other.system == used.system:
            return silence >= TAKE_OVER_AFTER
        if used.is_confirmed:
            return silence >= max(RELEASE_AFTER, used.confirmed_ns) and other.streams(now_ns)
        if used.streams(now_ns):
            return False
        waited = now_ns - max(used.tried_ns, used.navigation_ns)
        if other.streams(now_ns):
            return waited >= ANSWER_TIME
        return waited >= TRY_TIME and other.tried_ns <= min(
            one.tried_ns for one in self._candidates.values() if now_ns - one.last_ns < STREAM_NS
        )

    def _add(self, system: int, peer: Hashable, now_ns: int) -> Candidate | None:
        """Return a new candidate; None if there is no room."""
        if len(self._candidates) >= MAX_CANDIDATES:
            key, oldest = min(self._candidates.items(), key=lambda item: item[1].last_ns)
            if oldest is self.chosen or now_ns - oldest.last_ns < FORGET_AFTER:
                return None
            del self._candidates[key]
        new = Candidate(system, peer, mavlink.MAV_AUTOPILOT_INVALID, now_ns)
        self._candidates[system, peer] = new
        return new


def _is_vehicle(heartbeat: Message) -> bool:
    return heartbeat.autopilot != mavlink.MAV_AUTOPILOT_INVALID and heartbeat.type not in NOT_VEHICLES
