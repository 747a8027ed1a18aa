"""Local origin of the autopilot, cross-checked against its positions. No I/O.

ODOMETRY is sent in metres from the autopilot's origin, so a false GPS_GLOBAL_ORIGIN would move the aircraft
by the distance. LOCAL_POSITION_NED and GLOBAL_POSITION_INT of the same instant describe one point of one
estimator: their difference is the origin, to 0.2 m r.m.s. (`navigator.local_origin`). A stated origin is used
only if the last `PAIRS` pairs agree with it. Where they contradict the origin in use, it has changed: the
stated one replaces it if it agrees, else the origin of the pairs. Each replacement by more than `TOLERANCE_M`
is a reset (`resets`), which ODOMETRY reports in its reset_counter.

An EKF in constant position mode has no position, and no pairs come before it is given one: started without
GNSS it would wait for our positions, and we for its. While it states that mode, once in `RECENT_NS` at least,
its origin is used as stated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.link.dialect import mavlink
from companion.nav.geometry import Geodetic, separation
from companion.navigator.local_origin import LIVE_WINDOW_NS, infer_origin
from companion.records import (
    Event,
    FilterStatus,
    GlobalPosition,
    LocalOrigin,
    LocalPosition,
    Severity,
    Stamped,
)
from companion.units import SECOND_NS

TOLERANCE_M = 5.0
"""The inferred origin is in error by up to half a metre in a turn (the velocity is one loop old)."""
PAIRS = 3
PAIR_NS = SECOND_NS // 10
"""At most one pair in this time: PX4 sends GLOBAL_POSITION_INT at 50 Hz."""
RECENT_NS = 10 * SECOND_NS
"""Pairs older than this confirm nothing; nor is an older statement that there is no position used."""


class Pair(NamedTuple):
    """Origin inferred from one pair of simultaneous positions."""

    t_ns: int
    origin: LocalOrigin


class OriginCheck:
    """The confirmed local origin; None until pairs of positions confirm one.

    `has_pairs` is False where LOCAL_POSITION_NED is that of an INS of its own, and GLOBAL_POSITION_INT may be
    another estimator's: then the stated origin is used as it is.
    """

    def __init__(self, has_pairs: bool) -> None:
        self.origin: LocalOrigin | None = None
        self.resets = 0
        self._previous: LocalOrigin | None = None  # the last one in use: a reset is counted against it
        self._has_pairs = has_pairs
        self._stated: LocalOrigin | None = None
        self._local: LocalPosition | None = None
        self._known: GlobalPosition | None = None
        self._without_position_ns: int | None = None  # when the autopilot last stated so
        self._pairs: list[Pair] = []
        self._is_doubted = False  # the last pair contradicts the origin
        self._refused: tuple[float, float] | None = None  # a stated origin reported as false

    @property
    def undoubted(self) -> LocalOrigin | None:
        """The origin, unless the last pair contradicts it: it may have moved a moment ago."""
        return None if self._is_doubted else self.origin

    def forget(self) -> None:
        """Forget the origin: the autopilot rebooted, or its INS jumped; another one afterwards is a reset."""
        self.origin = self._stated = self._local = self._known = self._refused = None
        self._without_position_ns, self._is_doubted = None, False
        self._pairs.clear()

    def receive(self, record: Stamped) -> list[Event]:
        """Process a record of the autopilot; return what has changed."""
        if self._pairs and record.rx_ns - self._pairs[-1].t_ns > RECENT_NS:
            self._is_doubted = False
        if isinstance(record, LocalOrigin):
            self._stated = record
            is_without_position = self._is_without_position(record.rx_ns)
            is_judged = self._has_pairs and (self.origin is not None or not is_without_position)
            return [] if is_judged else self._replaced(record, record.rx_ns)
        if isinstance(record, LocalPosition):
            self._local = record
        elif isinstance(record, GlobalPosition):
            self._known = record
        elif isinstance(record, FilterStatus):
            is_constant = record.flags & mavlink.EKF_CONST_POS_MODE
            self._without_position_ns = record.rx_ns if is_constant else None
            return []
        else:
            return []
        return self._paired(record.rx_ns)

    def _is_without_position(self, now_ns: int) -> bool:
        """Whether the autopilot stated within `RECENT_NS` that it has no position."""
        return self._without_position_ns is not None and now_ns - self._without_position_ns <= RECENT_NS

    def _paired(self, now_ns: int) -> list[Event]:
        """Use the last two positions as a pair if they are of the same instant."""
        if self._stated is None or self._local is None or self._known is None or not self._has_pairs:
            return []
        if self._is_without_position(now_ns):
            return []
        if self._pairs and 0 <= now_ns - self._pairs[-1].t_ns < PAIR_NS:
            return []
        inferred = infer_origin(self._local, self._known, self._stated.projection, LIVE_WINDOW_NS)
        if inferred is None:
            return []
        self._known = None  # each global position is used once
        self._pairs = [*self._pairs[1 - PAIRS :], Pair(now_ns, inferred)]
        self._is_doubted = self.origin is not None and _apart(self.origin, inferred) > TOLERANCE_M
        return self._judge(now_ns)

    def _judge(self, now_ns: int) -> list[Event]:
        """Confirm or replace the origin in use by the last pairs."""
        pairs = [pair.origin for pair in self._pairs if now_ns - pair.t_ns <= RECENT_NS]
        if len(pairs) < PAIRS or any(_apart(a, pairs[-1]) > TOLERANCE_M for a in pairs):
            return []  # too few, or on both sides of a change
        inferred, stated, events = pairs[-1], self._stated, list[Event]()
        agrees = stated is not None and _apart(stated, inferred) <= TOLERANCE_M
        if stated is not None and not agrees and (stated.lat, stated.lon) != self._refused:
            self._refused = stated.lat, stated.lon
            off = f"{_apart(stated, inferred):.0f} m off the autopilot's positions"
            events.append(Event(now_ns, now_ns, Severity.WARNING, f"GPS_GLOBAL_ORIGIN {off}: not used"))
        if self.origin is not None and _apart(self.origin, inferred) <= TOLERANCE_M:
            return events
        return [*events, *self._replaced(stated if stated is not None and agrees else inferred, now_ns)]

    def _replaced(self, new: LocalOrigin, now_ns: int) -> list[Event]:
        """Use another origin; one that moved is a reset."""
        old, self.origin, self._previous = self._previous, new, new
        self._is_doubted = False
        moved = 0.0 if old is None else _apart(old, new)
        if moved <= TOLERANCE_M:
            return []
        self.resets += 1
        return [
            Event(now_ns, now_ns, Severity.NOTICE, f"local origin moved by {moved:.0f} m: position reset")
        ]


def _apart(a: LocalOrigin, b: LocalOrigin) -> float:
    """Return the horizontal distance of two origins, m."""
    north, east, _ = separation(Geodetic(a.lat, a.lon, a.alt_msl), Geodetic(b.lat, b.lon, b.alt_msl))
    return math.hypot(north, east)
