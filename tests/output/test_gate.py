"""Output gate: every position that passes is finite, recent, in range and consistent with the last one."""

import itertools
import math
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import dialect
from companion.nav.geometry import Geodetic, displace, separation
from companion.output.encode import ENCODERS, CannotEncode, Receiver, encode
from companion.output.gate import REPORT_INTERVAL_NS, Gate, Position, WithholdingMonitor, withholding_reason
from companion.records import LocalOrigin, Mode, Solution, Trust
from tests.frames import on_wire
from tests.solutions import solution_at

SECOND = 1_000_000_000
NAN, INF = math.nan, math.inf
GOOD = solution_at(
    100 * SECOND, v_n=(30.0, 5.0, 0.0), covariance=(16.0, 2.0, 0.0, 25.0, 0.0, 9.0), sigma_velocity=0.5
)


def changed(**changes: Any) -> Solution:
    return msgspec.structs.replace(GOOD, **changes)


def moved(seconds: float, north: float = 0.0, east: float = 0.0, **changes: Any) -> Solution:
    """Return `GOOD` propagated by `seconds` along its velocity, displaced by `north`, `east` metres."""
    t_ns = GOOD.t_ns + round(seconds * SECOND)
    v_n, v_e, _ = GOOD.v_n
    lat, lon, _ = displace(GOOD.lat, GOOD.lon, GOOD.alt_msl, v_n * seconds + north, v_e * seconds + east, 0.0)
    return changed(**({"t_ns": t_ns, "rx_ns": t_ns, "lat": lat, "lon": lon} | changes))


INVALID: list[tuple[dict[str, Any], str]] = [
    ({"mode": Mode.INITIALISING}, "initialising"),
    ({"mode": Mode.UNTRUSTED}, "untrusted"),
    ({"mode": Mode.FIXED, "trust": Trust.UNTRUSTED}, "untrusted"),
    ({"mode": Mode.PREDICTING, "trust": Trust.UNTRUSTED}, "untrusted"),
    ({"lat": NAN}, "finite"),
    ({"lon": INF}, "finite"),
    ({"alt_msl": -INF}, "finite"),
    ({"v_n": (NAN, 0.0, 0.0)}, "finite"),
    ({"covariance": (NAN, 0.0, 0.0, 1.0, 0.0, 1.0)}, "finite"),
    ({"inertial_age_s": NAN}, "finite"),
    ({"rx_ns": GOOD.t_ns + SECOND + 1}, "old"),
    ({"inertial_age_s": 1.1}, "old"),
    ({"t_ns": 0}, "old"),
    ({"rx_ns": GOOD.t_ns - 2 * SECOND}, "future"),
    ({"lat": 2.0}, "latitude"),
    ({"lat": math.radians(89.5)}, "latitude"),
    ({"lon": 7.0}, "longitude"),
    ({"alt_msl": 40_000.0}, "altitude"),
    ({"alt_msl": -600.0}, "altitude"),
    ({"v_n": (300.0, 300.0, 0.0)}, "speed"),
    ({"covariance": (0.0,) * 6}, "covariance"),
    ({"covariance": (1.0, 0.0, 0.0, -1.0, 0.0, 1.0)}, "covariance"),
    ({"covariance": (1.0, 2.0, 0.0, 1.0, 0.0, 1.0)}, "covariance"),
    ({"covariance": (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)}, "covariance"),
    ({"covariance": (16.0, 0.0, 0.0, 25.0, 0.0, 7e-116)}, "covariance"),  # 0 in single precision
    ({"sigma_velocity": 1e-60}, "velocity"),
    ({"covariance": (1.1e6, 0.0, 0.0, 1.0, 0.0, 1.0)}, "sigma above"),
    ({"sigma_velocity": NAN}, "velocity"),
    ({"sigma_velocity": 0.0}, "velocity"),
]


@pytest.mark.parametrize(("changes", "expected"), INVALID, ids=str)
def test_invalid_solutions_are_withheld_with_a_reason(changes: dict[str, Any], expected: str) -> None:
    assert withholding_reason(GOOD) is None
    refused = Gate().admit(changed(**changes))
    assert isinstance(refused, str) and expected in refused


def test_position_is_propagated_to_the_time_of_sending() -> None:
    plain = Gate().admit(GOOD)
    assert plain == Position(
        100 * SECOND, 1.0, 0.5, 800.0, GOOD.v_n, (16.0, 2.0, 25.0), 9.0, True, 0.5, resets=0
    )
    late = Gate().admit(changed(rx_ns=GOOD.t_ns + SECOND // 2))
    assert isinstance(late, Position)
    assert late.t_ns == GOOD.t_ns + SECOND // 2
    north, east = (late.lat - 1.0) * 6.3781e6, (late.lon - 0.5) * 6.39e6 * math.cos(1.0)
    assert (north, east) == pytest.approx((15.0, 2.5), rel=0.01)
    # an unknown turn of 10 m/s^2 for half a second adds 1.25 m
    assert late.covariance == pytest.approx((16.0 + 1.25**2, 2.0, 25.0 + 1.25**2))


@pytest.mark.parametrize("trust", [Trust.NORMAL, Trust.DEGRADED, Trust.PREDICTING, None])
def test_trust_does_not_change_the_sigma(trust: Trust | None) -> None:
    assert Gate().admit(changed(trust=trust, protection=400.0)) == Gate().admit(GOOD)


def test_positions_across_the_antimeridian() -> None:
    gate, east = Gate(), {"v_n": (0.0, 50.0, 0.0)}
    before = changed(lon=math.pi - 1e-9, rx_ns=GOOD.t_ns + SECOND // 10, **east)
    first = gate.admit(before)
    assert isinstance(first, Position) and -math.pi <= first.lon < -3.1
    after = changed(lon=first.lon, t_ns=before.rx_ns, rx_ns=before.rx_ns, **east)
    second = gate.admit(after)
    assert isinstance(second, Position) and second.resets == 0


@pytest.mark.parametrize("seconds", [0.1, 1.0, 10.0])
def test_jump_beyond_both_accuracies_is_withheld(seconds: float) -> None:
    gate = Gate()
    first = gate.admit(GOOD)
    assert isinstance(first, Position)
    room = 3.0 * 2.0 * first.sigma + 2.0 + 10.0 * seconds**2
    assert isinstance(gate.admit(moved(seconds, east=1.01 * room)), str)
    assert isinstance(gate.admit(moved(seconds, east=0.99 * room)), Position)


def test_jump_by_a_gnss_that_is_found_false_passes_at_once_and_counts_as_a_reset() -> None:
    """The position up to then was that GNSS's own, 130 m off with a sigma of 2 m."""
    gate = Gate()
    for seconds, doubt in ((0.0, 0.0), (0.2, 0.6)):
        assert isinstance(gate.admit(moved(seconds, gnss_false=doubt)), Position)
    assert gate.admit(moved(0.4, east=130.0, gnss_false=0.9)) == "jump larger than its accuracy justifies"
    found = gate.admit(moved(0.6, east=130.0, gnss_false=0.9999))
    assert isinstance(found, Position) and found.resets == 1
    assert isinstance(gate.admit(moved(0.8, east=260.0, gnss_false=0.9999)), str)


def test_withheld_position_passes_later() -> None:
    gate = Gate()
    gate.admit(GOOD)
    passed = [k for k in range(1, 400) if isinstance(gate.admit(moved(0.1 * k, north=3000.0)), Position)]
    first = 0.1 * passed[0]
    assert 10.0 * first**2 == pytest.approx(3000.0, rel=0.02)
    assert passed == list(range(passed[0], 400))


def test_jump_within_the_old_accuracy_counts_as_a_reset() -> None:
    """GNSS returns after an outage; the prediction was off by 300 m, within its sigma."""
    gate, poor = Gate(), (2e4, 0.0, 0.0, 2e4, 0.0, 9.0)
    assert isinstance(gate.admit(changed(covariance=poor, mode=Mode.PREDICTING)), Position)
    back = gate.admit(moved(0.2, east=300.0))
    assert isinstance(back, Position) and back.resets == 1
    on = gate.admit(moved(0.4, east=300.0))
    assert isinstance(on, Position) and on.resets == 1


def test_where_the_position_was_given_up_the_next_one_goes_out_whole_and_is_counted() -> None:
    gate, there = Gate(10.0), moved(0.1, north=22e3, restarts=2)
    first = gate.admit(changed(restarts=1))  # nothing was sent before: nothing to count
    second = gate.admit(there)
    gate.retract()
    again = gate.admit(there)
    assert isinstance(first, Position) and first.resets == 0
    assert isinstance(second, Position) and second.resets == 1
    assert again == second
    assert second.place[:2] == pytest.approx((there.lat, there.lon))
    assert isinstance(gate.admit(moved(0.2, north=23e3, restarts=2)), str)


def test_a_position_that_was_not_sent_is_no_reference() -> None:
    """The local origin was not confirmed; then a jump of 5 km was withheld for 22 s, and nothing armed."""
    gate = Gate(10.0)
    gate.admit(moved(0.0, north=5e3))
    gate.retract()
    assert gate.admit(moved(0.1)) == Gate().admit(moved(0.1))
    assert gate.admit(moved(0.2, north=5e3)) == "jump larger than its accuracy justifies"
    poor = (2e4, 0.0, 0.0, 2e4, 0.0, 9.0)
    gate.admit(moved(0.3, covariance=poor))
    gate.admit(moved(0.4, north=300.0))
    gate.retract()
    on = gate.admit(moved(0.5, covariance=poor))
    assert isinstance(on, Position) and on.resets == 0


def test_jump_goes_out_in_steps_each_counted() -> None:
    """35 m in steps of 10: four resets, the truth within the stated accuracy, then exactly the solution."""
    gate, poor = Gate(10.0), (2e3, 0.0, 0.0, 2e3, 0.0, 9.0)
    last = gate.admit(changed(covariance=poor, mode=Mode.PREDICTING))
    assert isinstance(last, Position)
    for k in range(1, 7):
        solution = moved(0.1 * k, east=35.0)
        sent = gate.admit(solution)
        assert isinstance(sent, Position)
        true = Geodetic(solution.lat, solution.lon, solution.alt_msl)
        north, east, _ = separation(sent.place, true)
        left = min(10.0 * k - 35.0, 0.0)
        assert (north, east) == (pytest.approx(0.0, abs=0.01), pytest.approx(left, abs=0.01))
        assert sent.resets == min(k, 4)
        assert abs(east) <= sent.sigma
        last = sent
    assert last.covariance == (16.0, 2.0, 25.0)


@pytest.mark.parametrize(("own_east", "first_east"), [(50.0, 40.0), (1000.0, 25.0)])
def test_steps_begin_at_the_autopilots_own_position_if_it_follows(own_east, first_east) -> None:
    """The jump is from 35 m east to 0; the autopilot is at 50 m, or so far off that it does not follow."""
    gate, poor = Gate(10.0), (2e3, 0.0, 0.0, 2e3, 0.0, 9.0)
    gate.admit(moved(0.0, east=35.0, covariance=poor, mode=Mode.PREDICTING))
    good, own = moved(0.1), moved(0.1, east=own_east)
    sent = gate.admit(good, Geodetic(own.lat, own.lon, own.alt_msl))
    assert isinstance(sent, Position)
    true = Geodetic(good.lat, good.lon, good.alt_msl)
    assert separation(sent.place, true)[1] == pytest.approx(first_east, abs=0.1)


def test_noise_within_the_accuracy_is_no_reset() -> None:
    gate = Gate()
    for k in range(100):
        found = gate.admit(moved(0.1 * k, north=4.0 * math.sin(k), east=4.0 * math.cos(3 * k)))
        assert isinstance(found, Position) and found.resets == 0


def test_earlier_timestamp_is_withheld() -> None:
    gate = Gate()
    gate.admit(moved(1.0))
    assert gate.admit(moved(0.9)) == "timestamp before the previous position"
    assert isinstance(gate.admit(moved(1.0)), Position)


def test_withheld_position_is_not_the_reference() -> None:
    gate = Gate()
    gate.admit(GOOD)
    for k in range(1, 5):
        assert isinstance(gate.admit(moved(0.1 * k, north=1e5)), str)
    assert isinstance(gate.admit(moved(0.5)), Position)


wild = st.floats(allow_nan=True, allow_infinity=True)
instants = st.integers(-(2**70), 2**70) | st.integers(1, 10**15)


def _near(value: float) -> st.SearchStrategy[float]:
    """Mostly the valid value, so that other fields are tested too."""
    return st.sampled_from((*[value] * 5, None)).flatmap(lambda v: wild if v is None else st.just(v))


def _received(instant: int, after: int | None, own: int | None) -> dict[str, int]:
    return {"t_ns": instant, "rx_ns": instant + after if own is None else own}


solutions = st.builds(
    lambda times, **values: changed(**times, **values),
    st.builds(
        _received,
        st.just(GOOD.t_ns) | instants,
        st.just(0) | st.integers(-2 * SECOND, 2 * SECOND),
        st.none() | st.none() | instants,
    ),
    mode=st.sampled_from(list(Mode)),
    v_n=st.tuples(*map(_near, GOOD.v_n)),
    covariance=st.tuples(*map(_near, GOOD.covariance)),
    inertial_age_s=_near(0.0),
    sigma_velocity=st.none() | _near(0.5),
    lat=_near(GOOD.lat),
    lon=_near(GOOD.lon),
    alt_msl=_near(GOOD.alt_msl),
)


RECEIVERS = [
    Receiver(
        make,
        1,
        origin=LocalOrigin(1, 1, 0.99, 0.51, 100.0, "tangent" if make == "other" else make),
        unix_ns=1_795_248_000 * 10**9,
    )
    for make in ("ardupilot", "px4", "other")
]
#: Fields for which MAVLink defines NaN as "not given".
NAN_FIELDS = {
    "ODOMETRY": {"q", "vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed", "velocity_covariance"},
    "VISION_POSITION_ESTIMATE": {"roll", "pitch", "yaw"},
    "GLOBAL_POSITION_SENSOR": {"alt_ellipsoid"},
    "COMMAND_INT": {"z"},
}


def _numbers(message: Any) -> Iterator[tuple[str, float]]:
    for name in message.fieldnames:
        value = getattr(message, name)
        for number in value if isinstance(value, list) else [value]:
            yield name, number


@settings(max_examples=400)
@given(sent=st.lists(solutions, min_size=1, max_size=4))
def test_every_encoded_message_is_finite_and_in_range(sent: list[Solution]) -> None:
    gate = Gate()
    for solution, receiver in itertools.product(sent, RECEIVERS):
        position = gate.admit(solution)
        if isinstance(position, str):
            assert position
            continue
        assert position.t_ns == solution.rx_ns and abs(solution.rx_ns - solution.t_ns) <= SECOND
        for name in ENCODERS:
            try:
                message = encode(position, receiver, name)
            except CannotEncode:
                continue
            m = dialect.decode(on_wire(message, 1, 191))
            for field, number in _numbers(m):
                spared = field in NAN_FIELDS.get(name, ()) or "covariance" in field
                assert spared or math.isfinite(number), (name, field)
            _in_range(name, m)


def _in_range(name: str, m: Any) -> None:
    if name in ("GPS_INPUT", "GLOBAL_POSITION_SENSOR", "COMMAND_INT"):
        lat, lon = (m.x, m.y) if name == "COMMAND_INT" else (m.lat, m.lon)
        assert abs(lat) < 90 * 10**7 and abs(lon) <= 180 * 10**7
    else:
        c = m.covariance if name == "VISION_POSITION_ESTIMATE" else m.pose_covariance
        assert min(c[0], c[6], c[11]) > 0.0 and max(c[0], c[6], c[11]) < math.inf
        assert max(abs(m.x), abs(m.y)) < 3e7
    if name == "COMMAND_INT":
        assert m.param1 >= 0.0 and m.param2 == 0.0 and 0.0 < m.param3 <= 100.001
    if name == "GPS_INPUT":
        assert math.hypot(m.vn, m.ve) < 401.0 and m.time_week > 0
        assert 0.0 < m.horiz_accuracy <= 100.001 and m.vert_accuracy > 0.0 and m.speed_accuracy > 0.0
    if name == "GLOBAL_POSITION_SENSOR":
        assert 0.0 < m.eph < 1500.0 and 0.0 < m.epv < 1001.0


def test_each_change_is_reported_once_and_rate_limited() -> None:
    withheld, now = WithholdingMonitor(), 0
    events = []

    def update(reason: str | None, seconds: float) -> None:
        nonlocal now
        for _ in range(round(10 * seconds)):
            now += SECOND // 10
            if (event := withheld.update("ODOMETRY", reason, now)) is not None:
                events.append((now * 1e-9, event.severity, event.text))

    update(None, 10.0)
    update("too old", 10.0)
    update(None, 10.0)
    assert [(severity, text) for _, severity, text in events] == [
        (6, "sending ODOMETRY"),
        (4, "ODOMETRY withheld: too old"),
        (6, "sending ODOMETRY, 100 withheld so far"),
    ]
    assert withheld.counts == {("ODOMETRY", "too old"): 100}
    for _ in range(100):
        update("too old", 0.1)
        update(None, 0.1)
    times = [at for at, *_ in events]
    assert len(events) <= 3 + 20 * SECOND // REPORT_INTERVAL_NS + 1
    assert all(b - a >= REPORT_INTERVAL_NS / SECOND for a, b in itertools.pairwise(times))
