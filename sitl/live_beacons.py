"""RSBN beacons that answer along a live truth: `sitl.beacon` one moment at a time. Sans-IO.

    for fix in answering.along(truth): ...              # with every sample of the truth
    for data in answering.due(now_ns, boot_ns, 1): ...  # no later than answering.deadline()

A receiver follows the few that are nearest to where it first was. `untimed` answers carry no time, for a link
on which no autopilot's clock is heard; they count as of their arrival, so they have no latency.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from companion.link import frame
from companion.nav.geometry import Geodetic, separation
from companion.records import RsbnFix, Truth
from sitl.beacon import Beacon, answers
from sitl.encode import Airframe, encode
from sitl.flight import Flight

SECOND = 1_000_000_000
EVERY = SECOND
NEAREST = 8
COMPONENT = 42
NEVER = 2**63 - 1


class Answering:
    """The beacons, and their answers on the way; the seed makes their noise."""

    def __init__(self, beacons: Sequence[Beacon], seed: int = 1, untimed: bool = False) -> None:
        self._beacons = list(beacons)
        self._rng = np.random.default_rng([seed, 7])
        self._untimed = untimed
        self._chosen = False
        self._next_at = 0
        self._late: list[tuple[int, int, RsbnFix]] = []  # due, order, answer
        self._made = 0

    def along(self, truth: Truth) -> list[RsbnFix]:
        """The answers that are made where the aircraft is now: once a second."""
        if truth.t_ns < self._next_at:
            return []
        regular = self._next_at + EVERY
        self._next_at = regular if regular > truth.t_ns else truth.t_ns + EVERY
        if not self._chosen:
            self._chosen = True
            self._beacons = sorted(self._beacons, key=lambda beacon: _distance(beacon, truth))[:NEAREST]
        t, three = np.zeros(1), np.zeros((1, 3))
        lat, lon, alt = (np.array([value]) for value in (truth.lat, truth.lon, truth.alt))
        flight = Flight(t, lat, lon, alt, three, three, three, three, three, t)
        made = []
        for beacon in self._beacons:
            for said in answers(beacon, flight, self._rng):
                fix = replace(said, t_ns=truth.t_ns)
                latency = 0 if self._untimed else said.rx_ns
                heapq.heappush(self._late, (truth.t_ns + latency, self._made, fix))
                self._made += 1
                made.append(fix)
        return made

    def due(self, now_ns: int, boot_ns: int | None, system: int) -> list[bytes]:
        """The frames of those that have arrived. `boot_ns`: the autopilot's boot on the same clock; as long
        as that is not known, none is sent.
        """
        frames = []
        while self._late and self._late[0][0] <= now_ns:
            _, number, fix = heapq.heappop(self._late)
            if boot_ns is None:
                continue
            message = encode(fix, Airframe("ardupilot", boot_ns))
            if self._untimed:
                message.time_usec = 0
            frames.append(frame.encode(message, number & 0xFF, system, COMPONENT))
        return frames

    def deadline(self) -> int:
        """When `due` next has something."""
        return self._late[0][0] if self._late else NEVER


def _distance(beacon: Beacon, truth: Truth) -> float:
    """Roughly, m."""
    there = Geodetic(math.radians(beacon.lat_deg), math.radians(beacon.lon_deg), truth.alt)
    north, east, _ = separation(Geodetic(truth.lat, truth.lon, truth.alt), there).tolist()
    return math.hypot(north, east)
