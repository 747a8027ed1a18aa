"""Beacon witness: a GNSS that is drawn off is seen in time; a beacon's constant error and noise are not."""

import math
import tracemalloc

import numpy as np
import pytest

from companion.nav.geometry import Geodetic, displace, slant_range_azimuth
from companion.output.beacon_witness import MOST_TRACKS, WINDOW_NS, BeaconWitness
from companion.records import Gnss, RsbnFix
from companion.units import SECOND_NS

BEACON = Geodetic(math.radians(55.75), math.radians(38.57), 200.0)
START = displace(*BEACON, 0.0, -60e3, 0.0)
SIGMA_AZIMUTH, SIGMA_RANGE = math.radians(0.125), 109.0


class Flight:
    """60 km west of a beacon, 25 m/s to the north; an answer a second."""

    def __init__(self, seed: int, azimuth_deg: float = 0.0, range_m: float = 0.0, copies: int = 1) -> None:
        self.copies = copies
        self.witness, self.rng, self.seconds = BeaconWitness(), np.random.default_rng(seed), 0.0
        self.azimuth, self.range = math.radians(azimuth_deg), range_m

    def fly(
        self, seconds: int, pull: tuple[float, float] = (0.0, 0.0), is_believed: bool = True
    ) -> int | None:
        """Fly, GNSS pulled off at `pull` (m/s north, east); return when the witness contradicted first."""
        first = None
        for k in range(seconds):
            self.seconds += 1.0
            now = round(self.seconds * SECOND_NS) + 10**12
            true = displace(*START, 25.0 * self.seconds, 0.0, 300.0)
            seen = displace(*true, pull[0] * k, pull[1] * k, 0.0)
            self.witness.receive(Gnss(now, now, 0, now // 1000, 3, *seen, v_n=(25.0, 0.0, 0.0)), is_believed)
            line = slant_range_azimuth(BEACON, true)
            azimuth = line.azimuth + self.azimuth + SIGMA_AZIMUTH * self.rng.standard_normal()
            slant = line.slant_range + self.range + SIGMA_RANGE * self.rng.standard_normal()
            for copy in range(self.copies):  # the clock of the link is adjusted in between
                t = now + copy * SECOND_NS // 1000
                answer = RsbnFix(t, t, 7, *BEACON, azimuth, slant, SIGMA_AZIMUTH, SIGMA_RANGE)
                self.witness.receive(answer, is_believed)
            if first is None and self.witness.contradicts:
                first = k
        return first


@pytest.mark.parametrize("pull", [(2.0, 0.0), (-2.0, 0.0), (0.0, 2.0), (0.0, -2.0)])
@pytest.mark.parametrize("seed", range(5))
def test_gnss_drawn_off_is_seen_before_150_m(seed: int, pull: tuple[float, float]) -> None:
    flight = Flight(seed)
    flight.fly(120)
    seen = flight.fly(150, pull)
    assert seen is not None and 2.0 * seen < 150.0
    assert flight.fly(300, pull, is_believed=False) == 0  # and stays seen


@pytest.mark.parametrize("late_s", [1.5, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_gnss_drawn_off_is_seen_by_answers_that_arrive_late(seed: int, late_s: float) -> None:
    """By a link of their own: they were compared with the last fix only, so with none."""
    flight, waiting = Flight(seed), list[RsbnFix]()
    receive, late_ns = flight.witness.receive, round(late_s * SECOND_NS)

    def hold(record: Gnss | RsbnFix, is_believed: bool) -> None:
        if isinstance(record, RsbnFix):
            waiting.append(record)
            return
        while waiting and record.t_ns - waiting[0].t_ns >= late_ns:
            receive(waiting.pop(0), is_believed)
        receive(record, is_believed)

    flight.witness.receive = hold  # type: ignore[method-assign]
    assert flight.fly(120) is None
    seen = flight.fly(150, (2.0, 0.0))
    assert seen is not None and 2.0 * (seen - late_s) < 150.0


@pytest.mark.parametrize(("azimuth_deg", "range_m"), [(0.0, 0.0), (0.125, 0.0), (0.0, 100.0)])
def test_healthy_gnss_is_hardly_ever_contradicted(azimuth_deg: float, range_m: float) -> None:
    """Noise and a constant error of one sigma: together with a wrong navigator this must not happen."""
    contradicted = 0
    for seed in range(3):
        flight = Flight(seed, azimuth_deg, range_m)
        contradicted += sum(flight.fly(1) is not None for _ in range(1200))
    assert contradicted <= 0.01 * 3600


@pytest.mark.parametrize("copies", [2, 5])
def test_answers_that_come_more_than_once_are_no_more_certain(copies: int) -> None:
    """A network sends all twice, or a receiver repeats its answer: 5 and 25 % of the time."""
    contradicted = 0
    for seed in range(3):
        flight = Flight(seed, copies=copies)
        contradicted += sum(flight.fly(1) is not None for _ in range(1200))
    assert contradicted <= 0.01 * 3600


def test_a_receiver_that_hangs_contradicts_nothing() -> None:
    """Its last answer goes on under new times, while the aircraft flies 3 km on."""
    flight = Flight(1)
    flight.fly(60)
    receive = flight.witness.receive
    last = slant_range_azimuth(BEACON, displace(*START, 25.0 * flight.seconds, 0.0, 300.0))

    def hang(record: Gnss | RsbnFix, is_believed: bool) -> None:
        if isinstance(record, RsbnFix):
            at = record.t_ns, record.rx_ns
            frozen = last.azimuth, last.slant_range, SIGMA_AZIMUTH, SIGMA_RANGE
            record = RsbnFix(*at, 7, *BEACON, *frozen)
        receive(record, is_believed)

    flight.witness.receive = hang  # type: ignore[method-assign]
    assert flight.fly(120) is None


def test_nothing_is_said_without_a_beacon_or_without_a_fix() -> None:
    flight = Flight(1)
    assert not flight.witness.contradicts
    now = 10**12
    for k in range(60):
        fix = RsbnFix(now + k * SECOND_NS, now, 7, *BEACON, 1.0, 1e3, SIGMA_AZIMUTH, SIGMA_RANGE)
        flight.witness.receive(fix, is_believed=True)
    assert not flight.witness.contradicts


def test_a_beacon_that_is_no_longer_received_contradicts_nothing() -> None:
    """One that lied and fell silent was the witness for the whole flight, beside others that agree."""
    flight = Flight(1)
    flight.fly(60)
    flight.range = 3000.0
    flight.fly(25)
    assert flight.witness.contradicts
    other = displace(*BEACON, 20e3, 0.0, 0.0)
    for k in range(21):
        flight.seconds += 1.0
        now = round(flight.seconds * SECOND_NS) + 10**12
        true = displace(*START, 25.0 * flight.seconds, 0.0, 300.0)
        fix = Gnss(now, now, 0, now // 1000, 3, *true, v_n=(25.0, 0.0, 0.0))
        flight.witness.receive(fix, is_believed=True)
        line = slant_range_azimuth(other, true)
        answer = RsbnFix(now, now, 8, *other, line.azimuth, line.slant_range, SIGMA_AZIMUTH, SIGMA_RANGE)
        flight.witness.receive(answer, is_believed=True)
        assert flight.witness.contradicts == (k < 20)


def test_beacons_by_the_thousand_displace_none_that_answers() -> None:
    """Anyone may name 65536 beacons; compared with all of them, a solution would take 0.1 s and 0.3 GB."""
    flight = Flight(1)
    flight.fly(60)
    tracemalloc.start()
    try:
        for k in range(20 * MOST_TRACKS):
            now = round((flight.seconds + 0.025 * (k % 40)) * SECOND_NS) + 10**12
            answer = RsbnFix(now, now, 100 + k, *BEACON, 4.71, 6e4 + k, SIGMA_AZIMUTH, SIGMA_RANGE)
            flight.witness.receive(answer, is_believed=True)
            if k % 40 == 39:
                flight.fly(1)
            if k == 2 * MOST_TRACKS:
                before, _ = tracemalloc.get_traced_memory()
        after, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert after - before < 50_000
    flight.fly(round(WINDOW_NS / SECOND_NS) + 1)
    assert not flight.witness.contradicts
    assert flight.fly(150, (2.0, 0.0)) is not None
