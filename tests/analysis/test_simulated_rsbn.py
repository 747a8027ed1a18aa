"""Simulated beacon measurements follow geometry and stated noise; outages remove the named source."""

import gzip
import math
import pathlib

import numpy as np
import pytest

from companion import records as r
from companion.analysis import simulated_rsbn
from companion.config import Config
from companion.importers import sources
from companion.nav.geometry import Geodetic, radio_horizon, slant_range_azimuth
from companion.storage.reader import LogError

TESTS = pathlib.Path(__file__).parents[1]
SHARED = TESTS.parent.parent / "shared" / "data"
NEAR = simulated_rsbn.ListedBeacon(7, 0.79, -1.62, 300.0)


def track(n: int = 2000, alt: float = 3000.0) -> simulated_rsbn.AircraftTrack:
    """Return a track eastwards at about 100 m/s, a position every half second."""
    t = 500_000_000 * np.arange(n)
    lat = np.full(n, 0.785)
    return simulated_rsbn.AircraftTrack(
        t, lat, -1.63 + 1.1e-5 * np.arange(n), np.full(n, alt), "a straight line"
    )


def place(aircraft: simulated_rsbn.AircraftTrack, t_ns: int) -> Geodetic:
    return Geodetic(
        *(float(np.interp(t_ns, aircraft.t_ns, x)) for x in (aircraft.lat, aircraft.lon, aircraft.alt))
    )


def test_measurements_have_the_stated_noise() -> None:
    aircraft = track()
    fixes = simulated_rsbn.simulate_measurements([NEAR], aircraft)
    assert len(fixes) == 1000
    geometries = [slant_range_azimuth(Geodetic(*NEAR[1:4]), place(aircraft, a.t_ns)) for a in fixes]
    azimuth = [(a.azimuth - s.azimuth) / a.sigma_azimuth for a, s in zip(fixes, geometries)]  # type: ignore[operator]
    slant = [(a.slant_range - s.slant_range) / a.sigma_range for a, s in zip(fixes, geometries)]  # type: ignore[operator]
    for standard in (azimuth, slant):
        assert abs(np.mean(standard)) < 4.0 / math.sqrt(1000)
        assert np.std(standard) == pytest.approx(1.0, abs=0.1)
    assert fixes[0].sigma_range == pytest.approx(200.0 + 3e-4 * geometries[0].slant_range)


def test_noise_depends_on_seed_and_beacon() -> None:
    other = NEAR._replace(number=8, lat=0.78)
    alone, again = (simulated_rsbn.simulate_measurements([NEAR], track(), seed=3) for _ in "ab")
    assert alone == again != simulated_rsbn.simulate_measurements([NEAR], track(), seed=4)
    both = simulated_rsbn.simulate_measurements([other, NEAR], track(), seed=3)
    assert [answer for answer in both if answer.beacon == 7] == alone
    assert [answer.rx_ns for answer in both] == sorted(answer.rx_ns for answer in both)


@pytest.mark.parametrize(
    ("beacon", "named"),
    [  # a sign forgotten, in radians, in kilometres, under the ground
        (NEAR._replace(lon=1.62), "7 at 45.26367, 92.81916 deg and 300 m, is 9005.3 km away"),
        (
            NEAR._replace(lat=math.radians(0.79), lon=math.radians(-1.62)),
            "7 at 0.79, -1.62 deg and 300 m, is 9000 km",
        ),
        (NEAR._replace(range_limit=0.37), "its range limit is 0.00037 km; check its numbers"),
        (NEAR._replace(lat=0.84, alt=-6000.0), "and -6000 m, is 350.3 km away, its radio horizon is 226 km"),
    ],
)
def test_beacon_out_of_reach_is_described_with_its_limit(
    beacon: simulated_rsbn.ListedBeacon, named: str
) -> None:
    assert not simulated_rsbn.simulate_measurements([beacon], track())
    assert named in simulated_rsbn.describe_unreached([beacon], track())
    assert simulated_rsbn.describe_unreached([beacon, NEAR], track()) == ""


def test_only_beacons_above_the_horizon_and_within_range_are_received() -> None:
    low, beacon = track(alt=20.0), Geodetic(0.785, -1.632, 1.0)
    fixes = {
        a.t_ns for a in simulated_rsbn.simulate_measurements([simulated_rsbn.ListedBeacon(1, *beacon)], low)
    }
    horizon = radio_horizon(beacon.alt - simulated_rsbn.GROUND, 20.0 - simulated_rsbn.GROUND)
    slant = {int(t): slant_range_azimuth(beacon, place(low, int(t))).slant_range for t in low.t_ns[::2]}
    records = {t for t, distance in slant.items() if distance <= horizon}
    assert fixes == records and 0 < len(records) < 1000
    far = track(alt=300.0 + 9000.0)
    limit = 50_000.0
    close = simulated_rsbn.simulate_measurements(
        [simulated_rsbn.ListedBeacon(1, *beacon, range_limit=limit)], far
    )
    assert 0 < len(close) < 1000
    assert all(slant_range_azimuth(beacon, place(far, a.t_ns)).slant_range <= limit for a in close)


@pytest.mark.parametrize("alt", [20.0, 250.0])
def test_higher_beacon_is_received_wherever_a_lower_one_is(alt: float) -> None:
    fixes: set[int] = set()
    for height in (-30.0, 0.0, 20.0, 50.0, 200.0, 260.0, 2000.0):
        lower, beacon = fixes, simulated_rsbn.ListedBeacon(1, 0.7855, -1.64, height)
        fixes = {answer.t_ns for answer in simulated_rsbn.simulate_measurements([beacon], track(alt=alt))}
        assert fixes >= lower
    assert fixes


def test_no_azimuth_in_the_cone_of_silence_and_nearest_beacons_are_followed() -> None:
    aircraft = track(n=200, alt=9000.0)
    below = simulated_rsbn.ListedBeacon(1, float(aircraft.lat[100]), float(aircraft.lon[100]), 0.0)
    quiet = {a.azimuth is None for a in simulated_rsbn.simulate_measurements([below], aircraft)}
    assert quiet == {True}  # always within 9 km horizontally
    ring = [simulated_rsbn.ListedBeacon(k, 0.785 + 0.002 * k, -1.63, 0.0) for k in range(1, 8)]
    assert {a.beacon for a in simulated_rsbn.simulate_measurements(ring, aircraft)} == {1, 2, 3, 4}


def test_no_measurements_in_gaps_of_the_track() -> None:
    whole = track()
    kept = np.r_[0:400, 800:2000]
    cut = simulated_rsbn.AircraftTrack(*(column[kept] for column in whole[:4]), whole.origin)
    times = [a.t_ns * 1e-9 for a in simulated_rsbn.simulate_measurements([NEAR], cut)]
    assert not any(200.0 <= t < 400.0 for t in times) and len(times) == pytest.approx(800, abs=2)


def test_track_is_the_truth_if_logged() -> None:
    records = [r.Truth(k, k, 0.1 * k, 0.2, 3.0, (0.0, 0.0, 0.0)) for k in (1, 2, 2, 3)]
    found = simulated_rsbn.extract_track(records, Config())
    assert found.origin == "the log's truth"
    assert found.t_ns.tolist() == [1, 2, 3] and found.lat[2] == pytest.approx(0.3)


def test_track_without_truth_is_the_smoothed_flight() -> None:
    folder = TESTS / "data" / "umn_fixed_wing_cut"
    found = simulated_rsbn.extract_track(sources.open_source(folder), Config())
    assert "not a truth" in found.origin
    for record in sources.open_source(folder):
        if isinstance(record, r.Gnss) and found.t_ns[5] < record.t_ns < found.t_ns[-1]:
            at = place(found, record.t_ns)
            assert abs(at.lat - record.lat) * 6.4e6 < 15.0  # 0.2 s delay at 25 m/s, and noise
    with pytest.raises(LogError, match="no track"):
        simulated_rsbn.extract_track([], Config())


def without(records: list[r.Stamped], *outages: str) -> tuple[list[r.Stamped], list[str]]:
    """Return the records left by outages of a log from 100 s on, and what is reported of the outages."""
    found = simulated_rsbn.OutageFilter([simulated_rsbn.parse_outage(o) for o in outages], 100 * 10**9)
    return list(found.left(records)), found.describe_unused()


def test_outage_removes_the_named_source() -> None:
    def fix(second: int) -> r.Gnss:
        return r.Gnss(10**9 * second, 10**9 * second, 0, second, 3, 0.1, 0.2, 3.0)

    def answer(second: int) -> r.RsbnFix:
        t = 10**9 * second
        return r.RsbnFix(t, t, 1, 0.1, 0.2, 3.0, 0.4, 5.0, 0.1, 1.0)

    records: list[r.Stamped] = [make(s) for s in range(100, 110) for make in (fix, answer)]
    left, _ = without(records, "gnss:2-5")
    assert [x.stamp_us for x in left if isinstance(x, r.Gnss)] == [100, 101, 105, 106, 107, 108, 109]
    assert sum(isinstance(x, r.RsbnFix) for x in left) == 10
    left, _ = without(records, "RSBN:0-9.5")
    assert sum(isinstance(x, r.RsbnFix) for x in left) == 0
    left, unused = without(records[::2], "GNSS:2-5", "GNSS:9.1-12", "GNSS:3.1-3.9", "RSBN:0-5")
    assert len(left) == 7
    assert unused == [
        "--outage GNSS:9.1-12 has no effect: the log ends at 9 s",
        "--outage GNSS:3.1-3.9 has no effect: no GNSS arrives then",
        "--outage RSBN:0-5 has no effect: no RSBN arrives then",
    ]


@pytest.mark.parametrize("text", ["GNSS", "GPS:1-2", "GNSS:1", "GNSS:1-2-3", "GNSS:-1-2"])
def test_invalid_outage_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match="write it as GNSS:600-900"):
        simulated_rsbn.parse_outage(text)


@pytest.mark.parametrize("text", ["GNSS:20-10", "GNSS:20-20"])
def test_outage_that_ends_before_its_start_is_rejected(text: str) -> None:
    with pytest.raises(ValueError, match=r"the end, [12]0, is not after the start, 20$"):
        simulated_rsbn.parse_outage(text)


def test_both_beacon_list_formats_are_read(tmp_path: pathlib.Path) -> None:
    own, airports = tmp_path / "own.csv", tmp_path / "navaids.csv"
    own.write_text("id,lat_deg,lon_deg,alt_m,range_m\n1,45,-93,300,\n2,46,-94,310.5,50000\n")
    first, second = simulated_rsbn.read_beacons(own)
    assert (first.range_limit, second.range_limit, second.alt) == (
        simulated_rsbn.RANGE_LIMIT_M,
        50_000.0,
        310.5,
    )
    assert second.lat == math.radians(46.0)
    rows = [
        "id,type,latitude_deg,longitude_deg,elevation_ft",
        "5,VOR-DME,45,-93,1000",
        "6,NDB,45,-93,1",
        "7,DME,45,-93,",
    ]
    airports.write_text("\n".join(rows))
    both, ranging = simulated_rsbn.read_beacons(airports)
    assert (both.number, both.azimuth, both.ranging, both.alt) == (5, True, True, pytest.approx(304.8))
    assert (ranging.number, ranging.azimuth, ranging.ranging) == (7, False, True)


def test_beacon_list_may_have_a_byte_order_mark(tmp_path: pathlib.Path) -> None:
    plain, packed = tmp_path / "beacons.csv", tmp_path / "beacons.csv.gz"
    text = "id,lat_deg,lon_deg,alt_m\n1,45,-93,300\n".encode("utf-8-sig")
    plain.write_bytes(text)
    packed.write_bytes(gzip.compress(text))
    for path in (plain, packed):
        (beacon,) = simulated_rsbn.read_beacons(path)
        assert beacon.number == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is not a beacon list"),
        ("a,b\n1,2\n", "is not a beacon list: it needs the columns id, lat_deg"),
        ("id,lat_deg,lon_deg,alt_m\n", "contains no beacons"),
        (
            "id,lat_deg,lon_deg,alt_m\n1,45,-93,3\n1,95,-93,3\n",
            "line 3 is not a valid beacon: lat_deg 95 is not within",
        ),
        ("id,lat_deg,lon_deg,alt_m\none,45,-93,3\n", "line 2 is not a valid beacon"),
        ("id,lat_deg,lon_deg,alt_m\n1,45\n", "line 2 is not a valid beacon"),
        ("id,lat_deg,lon_deg,alt_m\n1,45,-93,nan\n", "line 2 is not a valid beacon: alt_m nan is not within"),
        ("id,lat_deg,lon_deg,alt_m\n1,45,-93,\n", "line 2 is not a valid beacon: alt_m is empty"),
        ("id,lat_deg,lon_deg,alt_m\n1,45,-93,x\n", "line 2 is not a valid beacon: alt_m 'x' is not a number"),
        (
            "id,lat_deg,lon_deg,alt_m\n1,45,-93,2e5\n",
            "line 2 .*: alt_m 200000 is not within",
        ),
        (
            "id,lat_deg,lon_deg,alt_m\n-1,45,-93,3\n",
            "line 2 .*: id '-1' is not an integer",
        ),
        ("id,lat_deg,lon_deg,alt_m\n65536,45,-93,3\n", "line 2 .* from 0 to 65535"),
        ("id,lat_deg,lon_deg,alt_m\n1,45,-93,3\n1,46,-93,3\n", "line 3 .*: id 1 is given twice"),
        ("id,lat_deg,lon_deg,alt_m,range_m\n1,45,-93,3,inf\n", "line 2 .*: range_m inf is not finite"),
        ("id,lat_deg,lon_deg,alt_m,range_m\n1,45,-93,3,0\n", "line 2 .*: range_m 0 is not above 0"),
        ("id;lat_deg;lon_deg;alt_m\n1;45;-93;3\n", "columns .* separated by commas"),
        ("id,lat_deg,lon_deg,alt_m\n1,45,5,-93,3\n", "line 2 .*: it has more columns than the header; write"),
        ("a" * 200_000, "cannot be read: field larger than field limit"),
    ],
)
def test_invalid_beacon_list_is_reported_in_one_sentence(
    tmp_path: pathlib.Path, text: str, words: str
) -> None:
    path = tmp_path / "beacons.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=words):
        simulated_rsbn.read_beacons(path)


def test_unreadable_beacon_list_is_reported(tmp_path: pathlib.Path) -> None:
    foreign = tmp_path / "beacons.csv.gz"
    foreign.write_bytes(b"not gzip")
    for path in (foreign, tmp_path / "none.csv"):
        with pytest.raises(LogError, match="cannot be read"):
            simulated_rsbn.read_beacons(path)


@pytest.mark.shared
def test_worldwide_navaids_are_read() -> None:
    path = SHARED / "navaids" / "ourairports_navaids.csv.gz"
    if not path.exists():
        pytest.skip("the list is not available")
    found = simulated_rsbn.read_beacons(path)
    assert 3000 < len(found) < 11_008
    assert len({beacon.number for beacon in found}) == len(found)
