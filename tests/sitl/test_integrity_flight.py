"""The watch over the sources on whole simulated flights: INS, GNSS and one beacon 60 km away."""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Iterator
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import pytest

from companion.config import Config
from companion.estimate import integrity, monitor
from companion.estimate.fusion import Azimuth
from companion.estimate.integrity import Measurement
from companion.estimate.monitor import Allotment, Exclusion, Monitor
from companion.nav.geometry import Geodetic, displace, separation
from companion.navigator import errorstate, inertial, radio
from companion.records import Gnss, LocalOrigin, LocalPosition, RsbnFix
from sitl.faults import Fault
from sitl.trial import SCENARIOS
from sitl.world import World

NS = 1_000_000_000
CONFIG = Config()
UNIT = errorstate.grade(CONFIG.inertial, CONFIG.gnss)
K = len(UNIT.sigma0)
LOOSE = np.zeros(K)
LOOSE[2:4] = 0.05**2  # m^2/s^3: an inertial channel that is not believed beyond a minute
BIAS = {Azimuth: math.radians(0.1)}  # of ranges: 50 m
ALLOTMENT = Allotment()
LEVEL_RISK = 1e-5


class Second(NamedTuple):
    """Once a second: error and protection level (m), what was excluded, the watch."""

    t: float
    error: float
    level: float
    exclusions: list[Exclusion]
    watch: Monitor


def advanced(watch: Monitor, track: inertial.Track, p: inertial.Point) -> Monitor:
    bank, dt = watch.bank, (p.t_ns - watch.bank.t_ns) * 1e-9
    if dt <= 0.0:
        return watch
    system = UNIT.system(p.position.lat, p.v_n, inertial.acceleration(track))
    Phi, Q = errorstate.transition(dt, system)
    still = np.zeros(len(bank.biases))
    return watch._replace(bank=integrity.carry(bank, p.t_ns, Phi, Q, LOOSE * dt, still))


def from_gnss(record: Gnss, p: inertial.Point) -> Measurement:
    """Position and velocity, the receiver's slow drift being a state."""
    assert record.v_n is not None
    north, east, _ = separation(p.position, Geodetic(record.lat, record.lon, record.alt_msl))
    z = np.array([north, east, p.v_n[0] - record.v_n[0], p.v_n[1] - record.v_n[1]])
    H = np.eye(4, K)
    H[:2] -= np.eye(2, K, K - 2)
    white, sigma_v = CONFIG.gnss.sigma_m / 3.0, CONFIG.gnss.sigma_velocity_m_s
    return Measurement("gnss", z, H, np.diag([white**2, white**2, sigma_v**2, sigma_v**2]))


def heard(watch: Monitor, record: Gnss | RsbnFix, p: inertial.Point) -> Monitor:
    if isinstance(record, Gnss):
        return monitor.hear(watch, from_gnss(record, p), ALLOTMENT)[0]
    for z in radio.from_rsbn(record, p, CONFIG.rsbn).observations:
        name = f"rsbn {record.beacon} {type(z).__name__.lower()}"
        if name not in watch.bank.sources:
            watch = watch._replace(bank=integrity.join(watch.bank, name, BIAS.get(type(z), 50.0)))
        sight = integrity.sighted(name, z, watch.bank.x[0], K)  # type: ignore[arg-type]
        if sight is not None:
            watch = monitor.hear(watch, sight, ALLOTMENT)[0]
    return watch


def watched(world: World) -> Iterator[Second]:
    o = world.origin
    origin = LocalOrigin(0, 0, o.lat, o.lon, o.alt - 16.0, "ardupilot")
    bank = integrity.begin(0, np.zeros(K), np.diag(UNIT.sigma0**2))
    bank = integrity.join(integrity.join(bank, integrity.INERTIAL), "gnss", forks=2)
    watch, track, last, due = Monitor(bank), inertial.Track(), -NS, NS
    streams = (world.streams[kind] for kind in (LocalPosition, Gnss, RsbnFix))
    for record in heapq.merge(*streams, key=attrgetter("rx_ns")):
        if isinstance(record, LocalPosition):
            track = inertial.extend(track, inertial.point(record, origin))
            continue
        p = inertial.at(track, record.t_ns)
        assert isinstance(record, Gnss | RsbnFix)
        if p is None or (isinstance(record, Gnss) and (record.fix < 3 or record.t_ns - last < NS // 2)):
            continue
        last = record.t_ns if isinstance(record, Gnss) else last
        watch = heard(advanced(watch, track, p), record, p)
        if watch.bank.t_ns >= due:
            due = watch.bank.t_ns + NS
            watch, exclusions = monitor.watch(watch, ALLOTMENT)
            now = inertial.at(track, watch.bank.t_ns)
            assert now is not None
            x, t = watch.bank.x[0], watch.bank.t_ns * 1e-9
            truth = world.truth_at(np.array([t]))
            place = displace(*now.position, -x[0], -x[1], 0.0)
            north, east, _ = separation(place, Geodetic(truth.lat[0], truth.lon[0], place.alt))
            alarm = ALLOTMENT.false_alarm(len(watch.bank.rows) - 1)
            level = integrity.protection(watch.bank, alarm, LEVEL_RISK).level
            yield Second(t, math.hypot(north, east), level, exclusions, watch)


def flown(fault: Fault | None, seed: int = 1) -> list[Second]:
    faults = (fault,) if fault else ()
    return list(watched(World(dataclasses.replace(SCENARIOS["one-beacon"], faults=faults, seed=seed))))


def excluded(seconds: list[Second]) -> list[tuple[float, str]]:
    return [(s.t, e.source) for s in seconds for e in s.exclusions]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_without_a_fault_nothing_is_excluded(seed: int) -> None:
    seconds = flown(None, seed)
    assert excluded(seconds) == []
    assert not any(s.watch.unresolved for s in seconds)
    assert all(s.error < s.level for s in seconds)


@pytest.mark.parametrize("slope", [0.5, 2.0, 5.0])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_spoofer_is_excluded_before_it_has_drawn_the_position_off(slope: float, seed: int) -> None:
    seconds = flown(Fault("gnss-spoof", 300.0, 540.0, slope), seed)
    found = excluded(seconds)
    assert [source for _, source in found] == ["gnss"]
    assert 300.0 < found[0][0] < 360.0
    assert max(s.error for s in seconds if s.t <= found[0][0]) < 30.0
    assert max(s.error for s in seconds) < 300.0
    assert all(s.error < s.level for s in seconds)


@pytest.mark.parametrize(
    "fault, source",
    [
        (Fault("beacon-bias", 300.0, 540.0, 300.0), "rsbn 1 range"),
        (Fault("beacon-bias", 300.0, 540.0), "rsbn 1 range"),
        (Fault("beacon-north", 300.0, 540.0, math.radians(0.3)), "rsbn 1 azimuth"),
        (Fault("beacon-north", 300.0, 540.0), "rsbn 1 azimuth"),
        (Fault("gnss-jump", 300.0, 540.0, 50.0), "gnss"),
        (Fault("gnss-frozen", 300.0, 540.0), "gnss"),
    ],
)
def test_the_faulty_one_is_named_and_azimuth_and_range_apart(fault: Fault, source: str) -> None:
    seconds = flown(fault)
    assert [name for _, name in excluded(seconds)] == [source]
    assert all(s.error < s.level for s in seconds)
