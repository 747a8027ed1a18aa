"""RSBN beacons along the truth of a live simulator: `sitl.beacon` sample by sample. Sans-IO.

    for fix in beacons.answers_to(truth): ...               # with every sample of the truth
    for data in beacons.take_due(now_ns, boot_ns, 1): ...   # no later than beacons.deadline()

The receiver follows the beacons nearest to its first position. `untimed` answers carry no time, for a link
without an autopilot's clock; they are valid at arrival, so they have no latency.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from companion.analysis import simulated_rsbn
from companion.link import frame
from companion.nav.geometry import Geodetic, separation
from companion.records import RsbnFix, Truth
from companion.units import SECOND_NS
from sitl.beacon import Beacon, simulate_answers
from sitl.encode import SimulatedSender, encode
from sitl.flight import Trajectory

INTERVAL_NS = SECOND_NS
NEAREST = 8
COMPONENT = 42
NEVER = 2**63 - 1


class LiveBeacons:
    """Beacons and their answers not yet delivered; the seed determines the noise."""

    def __init__(self, beacons: Sequence[Beacon], seed: int = 1, untimed: bool = False) -> None:
        self._beacons = list(beacons)
        self._rng = np.random.default_rng([seed, 7])
        self._untimed = untimed
        self._chosen = False
        self._next_at = 0
        self._pending: list[tuple[int, int, RsbnFix]] = []  # due, order, answer
        self._count = 0

    def answers_to(self, truth: Truth) -> list[RsbnFix]:
        """Return the answers at this position, once per second; they are also queued for `take_due`."""
        if truth.t_ns < self._next_at:
            return []
        regular = self._next_at + INTERVAL_NS
        self._next_at = regular if regular > truth.t_ns else truth.t_ns + INTERVAL_NS
        if not self._chosen:
            self._chosen = True
            self._beacons = sorted(self._beacons, key=lambda beacon: _distance(beacon, truth))[:NEAREST]
        t, three = np.zeros(1), np.zeros((1, 3))
        lat, lon, alt = (np.array([value]) for value in (truth.lat, truth.lon, truth.alt))
        flight = Trajectory(t, lat, lon, alt, three, three, three, three, three, t)
        fixes = []
        for beacon in self._beacons:
            for answer in simulate_answers(beacon, flight, self._rng):
                fix = replace(answer, t_ns=truth.t_ns)
                latency = 0 if self._untimed else answer.rx_ns
                heapq.heappush(self._pending, (truth.t_ns + latency, self._count, fix))
                self._count += 1
                fixes.append(fix)
        return fixes

    def describe_unreached(self, truth: Truth) -> str:
        """Describe the nearest beacon if it is out of reach at this position, else return nothing."""
        listed = [
            simulated_rsbn.ListedBeacon(
                beacon.number,
                math.radians(beacon.lat_deg),
                math.radians(beacon.lon_deg),
                beacon.alt,
                beacon.range_limit,
            )
            for beacon in self._beacons
        ]
        lat, lon, alt = (np.array([value]) for value in (truth.lat, truth.lon, truth.alt))
        here = simulated_rsbn.AircraftTrack(np.array([truth.t_ns]), lat, lon, alt, "")
        return simulated_rsbn.describe_unreached(listed, here)

    def take_due(self, now_ns: int, boot_ns: int | None, system: int) -> list[bytes]:
        """Return the frames of the answers due at `now_ns`.

        `boot_ns` is the autopilot's boot time on the same clock; while it is None, answers are dropped.
        """
        frames = []
        while self._pending and self._pending[0][0] <= now_ns:
            _, number, fix = heapq.heappop(self._pending)
            if boot_ns is None:
                continue
            message = encode(fix, SimulatedSender("ardupilot", boot_ns))
            if self._untimed:
                message.time_usec = 0
            frames.append(frame.encode(message, number & 0xFF, system, COMPONENT))
        return frames

    def deadline(self) -> int:
        """Return the time of the next answer, `NEVER` without one."""
        return self._pending[0][0] if self._pending else NEVER


def _distance(beacon: Beacon, truth: Truth) -> float:
    """Approximate horizontal distance, m."""
    there = Geodetic(math.radians(beacon.lat_deg), math.radians(beacon.lon_deg), truth.alt)
    north, east, _ = separation(Geodetic(truth.lat, truth.lon, truth.alt), there)
    return math.hypot(north, east)
