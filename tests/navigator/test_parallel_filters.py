from typing import Any

import numpy as np
import pytest

from companion.config import Config, load
from companion.config.load import ConfigError
from companion.nav.geometry import Geodetic
from companion.navigator import parallel_filters
from companion.navigator.corrected_ins import corrected_ins
from companion.navigator.inertial_track import Point
from companion.navigator.parallel_filters import Filter, Parallel
from companion.records import PARALLEL
from companion.units import Floats

NS = 1_000_000_000
BOTH = {"estimator.parallel": list(PARALLEL)}
AIR = load(flags={"inertial.source": "air_data", "output.profile": "ardupilot", **BOTH}, environment={})
INS = load(flags={"inertial.independent": True, "inertial.correctors": ["airspeed"], **BOTH}, environment={})
START = Point(5 * NS, Geodetic(1.0, 0.5, 300.0), (30.0, 10.0, 0.0))
FIRST = Parallel(
    START,
    tuple(
        Filter(name, np.array([10.0, -20.0, 3.0, 1.0]), np.diag([400.0, 400.0, 4.0, 4.0]))
        for name in PARALLEL
    ),
)


def later(seconds: float) -> Point:
    return START._replace(t_ns=START.t_ns + round(seconds * NS))


def fixed(
    p: Parallel, at: list[float], z: list[Floats], config: Config = AIR, channel: Any = None
) -> Parallel:
    for seconds, value in zip(at, z, strict=True):
        p = parallel_filters.add(
            p,
            later(seconds),
            "beacon",
            value,
            np.eye(2),
            25.0 * np.eye(2),
            white=True,
            config=config,
            channel=channel,
        )
    return p


def test_a_moment_before_its_first_fix_it_is_what_it_was_then() -> None:
    """A solution is of the channel's newest point, and a fix may be newer than that."""
    for earlier_s in (0.0, 1e-4, 0.15):
        for found, first in zip(
            parallel_filters.at(FIRST, later(-earlier_s), AIR, None), FIRST.filters, strict=True
        ):
            assert np.array_equal(found.x, first.x)
            assert np.array_equal(found.P, first.P)


def test_without_fixes_the_wind_carries_them_off_and_they_are_one() -> None:
    first, second = parallel_filters.at(FIRST, later(10.0), AIR, None)
    assert np.allclose(first.x, [10.0 + 30.0, -20.0 + 10.0, 3.0, 1.0])
    assert np.all(np.diag(first.P) > np.diag(FIRST.filters[0].P))
    assert np.array_equal(first.x, second.x)
    assert np.array_equal(first.P, second.P)


def test_fixes_of_an_interval_are_one_at_their_middle() -> None:
    """Fixes of an error that grows evenly leave an estimate that is on it."""
    velocity = np.array([3.0, 1.0])
    times = [float(s) for s in range(1, 400)]
    p = fixed(FIRST, times, [np.array([10.0, -20.0]) + s * velocity for s in times])
    for found in parallel_filters.at(p, later(400.0), AIR, None):
        assert found.x[:2] == pytest.approx([10.0 + 1200.0, -20.0 + 400.0], abs=1e-6)
        assert found.x[2:] == pytest.approx(velocity, abs=1e-9)


def test_after_a_jump_of_the_channel_the_filters_go_on_as_if_it_had_always_been_there() -> None:
    times, rng = [float(s) for s in range(1, 60)], np.random.default_rng(1)
    z = [10.0 * rng.standard_normal(2) for _ in times]
    moved = np.array([300.0, -70.0])
    whole = fixed(parallel_filters.shift(FIRST, *moved), times, [one + moved for one in z])
    halves = fixed(
        parallel_filters.shift(fixed(FIRST, times[:25], z[:25]), *moved),
        times[25:],
        [one + moved for one in z[25:]],
    )
    for a, b in zip(whole.filters, halves.filters, strict=True):
        assert np.allclose(a.x, b.x, atol=1e-8)
        assert np.allclose(a.P, b.P)


def test_beside_an_ins_they_have_all_its_states() -> None:
    """INS 7, gyro drift 3, accelerometers 2, GNSS 6, wind and airspeed scale 3."""
    channel = corrected_ins(INS)
    p = parallel_filters.begin(INS, channel, START, np.zeros(4), np.eye(4))
    assert [f.name for f in p.filters] == list(PARALLEL)
    assert all(len(f.x) == channel.n == 21 for f in p.filters)
    p = fixed(p, [1.0, 2.0, 12.0, 13.0, 25.0], [np.array([500.0, -200.0])] * 5, INS, channel)
    for found in parallel_filters.at(p, later(25.0), INS, channel):
        assert found.x[:2] == pytest.approx([500.0, -200.0], abs=1.0)
        assert np.linalg.eigvalsh(found.P).min() > -1e-9


@pytest.mark.parametrize("flags", [{}, {"inertial.independent": True}, {"inertial.source": "imu"}])
def test_they_need_airspeed(flags: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"estimator\.parallel = .* needs airspeed: set inertial\.source"):
        load(flags={**flags, **BOTH}, environment={})
