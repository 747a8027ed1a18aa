"""Joint estimator against independent reference values, scipy and its own statistics; degenerate cases."""

import itertools
import json
import math
import pathlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import chi2

from companion.bench.fusion import cases
from companion.estimate.fusion import (
    Ambiguous,
    Azimuth,
    Height,
    NoFix,
    Position,
    Range,
    Unobservable,
    maximum_likelihood,
)
from companion.estimate.observations import Model

REFERENCE = json.loads((pathlib.Path(__file__).parents[1] / "data" / "ml_fusion.json").read_text())["cases"]
SIGMA_A = math.radians(0.25)


def observations(case):
    """Observations of the reference case, its RSBN pair last."""
    given_ = case["input"]
    found = []
    for name in ("ins", "gnss"):
        if name in given_:
            pairs = np.array(given_[name])
            found.append(Position(pairs[:, 0], np.diag(pairs[:, 1] ** 2)))
    found += [Height(*pair) for pair in given_.get("baro", [])]
    sigma_A = given_["sA_rad"] if "sA_rad" in given_ else math.radians(given_["sA_deg"])
    sigma_D = math.sqrt(given_["sD2"]) if "sD2" in given_ else given_["sD"]
    beacon = given_["beacon"]
    return [
        *found,
        Azimuth(beacon, math.radians(given_["A_deg"]), sigma_A),
        Range(beacon, given_["D"], sigma_D),
    ]


def seen(beacon, x, axes=None):
    """Azimuth and range of x at the beacon, without error."""
    d = np.asarray(x, dtype=float) - beacon
    e = d if axes is None else axes @ d
    return math.atan2(e[0], e[1]), float(np.linalg.norm(d))


def information(observations, x):
    """Fisher information (n, n) at x: of the places and the sizes of the errors, not of the values."""
    model = Model(observations, len(x))
    J = model.at(model.point(x)).J
    return J.T @ J


def rotation(angle, axis):
    c, s = math.cos(angle), math.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    C = np.eye(3)
    C[i, i] = C[j, j] = c
    C[i, j], C[j, i] = -s, s
    return C


@pytest.mark.parametrize("case", REFERENCE, ids=lambda c: c["name"])
class TestReferenceValues:
    def test_the_most_likely_position(self, case):
        fix = maximum_likelihood(observations(case))
        np.testing.assert_allclose(fix.position, case["ML"], rtol=1e-9)
        np.testing.assert_allclose(fix.covariance, case["cov_FIM"], rtol=1e-9)
        np.testing.assert_allclose(np.sqrt(np.diag(fix.covariance)), case["rms"], rtol=1e-9)
        assert fix.cost == pytest.approx(case["J"], rel=1e-9, abs=1e-12)
        assert fix.iterations <= 7

    def test_the_estimated_azimuth_and_range(self, case):
        A, D = seen(case["input"]["beacon"], maximum_likelihood(observations(case)).position)
        assert math.remainder(A - math.radians(case["A_hat_deg"]), math.tau) == pytest.approx(0, abs=1e-10)
        assert pytest.approx(case["D_hat"], rel=1e-9) == D

    def test_the_weighted_mean_of_the_converted_measurement(self, case):
        if case["input"]["dim"] == 3:
            pytest.skip("the reference converts in the plane only")
        *positions, _, _ = observations(case)
        P = Position(case["conv_xy"], np.array(case["conv_cov"]))
        mean = maximum_likelihood([*positions, P])
        np.testing.assert_allclose(mean.position, case["WLS_converted"], rtol=1e-9)
        np.testing.assert_allclose(
            mean.covariance, case["WLS_cov"], rtol=1e-9, atol=1e-12 * mean.covariance.max()
        )
        # "the channels are independent" is another, worse, estimate
        alone = Position(P.value, np.diag(np.diag(P.covariance)))
        diagonal = maximum_likelihood([*positions, alone]).position
        np.testing.assert_allclose(diagonal, case["WLS_diag_only"], rtol=1e-9)


def test_scalar_form_is_overconfident_beside_the_joint_form():
    A, D = math.radians(1.0), 140e3
    x = D * np.array([math.sin(A), math.cos(A)])
    pair = [Azimuth([0, 0], A, SIGMA_A), Range([0, 0], D, 200.0)]
    ins, gnss = Position(x, np.eye(2) * 1500.0**2), Position(x, np.eye(2) * 100.0**2)
    claim = 200.0 * math.sin(A)
    alone = math.sqrt(maximum_likelihood(pair).covariance[0, 0])
    joint = math.sqrt(maximum_likelihood([ins, gnss, *pair]).covariance[0, 0])
    assert (round(claim, 1), round(alone, -1), round(joint, 1)) == (3.5, 610.0, 98.5)


@pytest.mark.parametrize("A_deg", [0.0, 90.0, 180.0, 270.0, 359.9999999, 45.0])
def test_no_azimuth_is_singular_for_the_joint_form(A_deg):
    A, D = math.radians(A_deg), 140e3
    x = D * np.array([math.sin(A), math.cos(A)])
    noisy = [
        Position(x + np.array([900.0, -700.0]), np.eye(2) * 1500.0**2),
        Azimuth([0, 0], A - math.tau, SIGMA_A),
        Range([0, 0], D, 200.0),
    ]
    fix = maximum_likelihood(noisy)
    along = np.array([math.sin(A), math.cos(A)])
    assert along @ fix.covariance @ along == pytest.approx(1 / (1 / 200**2 + 1 / 1500**2), rel=1e-4)
    assert np.linalg.norm(fix.position - x) < 300.0


# coordinates of aircraft, beacons, start and noise; beacons well spread, so that one minimum is the deepest
unit = st.integers(-100, 100).map(lambda k: k / 100)
plane = st.tuples(unit, unit)


@settings(max_examples=120)
@given(
    n=st.sampled_from([2, 3]),
    x=plane,
    beacons=st.lists(plane, min_size=1, max_size=4),
    ins=plane,
    start=plane,
    seed=st.integers(0, 2**32 - 1),
)
def test_agrees_with_scipy_from_poor_starts(n, x, beacons, ins, start, seed):
    rng = np.random.default_rng(seed)
    aircraft = np.array([*(50e3 * np.array(x)), 8000.0][:n])
    sites = [np.array([*(150e3 * np.array(b)), 200.0][:n]) for b in beacons]
    sites = [b for b in sites if np.linalg.norm((aircraft - b)[:2]) > 15e3]
    sites = sites or [aircraft + np.array([80e3, 0.0, 0.0])[:n]]
    L = rng.normal(size=(n, n)) * 300.0 + np.eye(n) * 1500.0
    C = L @ L.T
    z = aircraft + np.array([*(1000.0 * np.array(ins)), 0.0][:n])
    obs = [Position(z, C)]
    for b in sites:
        A, D = seen(b, aircraft)
        obs += [Azimuth(b, A + SIGMA_A * rng.normal(), SIGMA_A), Range(b, D + 200 * rng.normal(), 200.0)]
    W = np.linalg.inv(np.linalg.cholesky(C))

    def r(p):
        rows = list(W @ (z - p))
        for a, d in zip(obs[1::2], obs[2::2], strict=True):
            A, D = seen(a.beacon, p)
            rows += [math.remainder(a.value - A, math.tau) / a.sigma, (d.value - D) / d.sigma]
        return np.array(rows)

    def J(p):
        rows = [*-W]
        for a, d in zip(obs[1::2], obs[2::2], strict=True):
            east, north, *up = p - a.beacon
            h2 = east**2 + north**2
            rows.append(np.array([-north, east, *np.zeros_like(up)]) / h2 / a.sigma)
            rows.append((a.beacon - p) / np.linalg.norm(p - a.beacon) / d.sigma)
        return np.array(rows)

    # with its own differences scipy stops up to 3 cm short along directions known to a kilometre
    scipy = least_squares(r, aircraft + 50.0, J, method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    poor = np.array([*(120e3 * np.array(start)), 5000.0][:n])
    for first in (None, poor):
        fix = maximum_likelihood(obs, first)
        # in standard deviations: how far from the minimum, and from where scipy stops
        J_fix = J(fix.position)
        newton = np.linalg.solve(J_fix.T @ J_fix, J_fix.T @ r(fix.position))
        assert np.linalg.norm(J_fix @ newton) < 1e-8
        assert np.linalg.norm(J_fix @ (fix.position - scipy.x)) < 1e-6
        assert fix.cost <= 2 * scipy.cost * (1 + 1e-9) + 1e-9
        np.testing.assert_allclose(fix.cost, r(fix.position) @ r(fix.position), rtol=1e-9, atol=1e-9)


def test_errors_and_cost_match_their_distribution():
    # NEES of 3000 fixes: mean n, and the share inside the 95 % ellipse; cost: chi-square with m - n
    rng = np.random.default_rng(3)
    x = np.array([30e3, -20e3, 9000.0])
    beacons = np.array([[-60e3, 10e3, 100.0], [50e3, 90e3, 300.0]])
    C = np.array([[4.0, 1.0, 0.3], [1.0, 3.0, -0.2], [0.3, -0.2, 1.0]]) * 300.0**2
    L = np.linalg.cholesky(C)
    nees, costs, k = [], [], 0
    for _ in range(3000):
        obs = [Position(x + L @ rng.normal(size=3), C), Height(x[2] + 50 * rng.normal(), 50.0)]
        for b in beacons:
            A, D = seen(b, x)
            obs += [Azimuth(b, A + SIGMA_A * rng.normal(), SIGMA_A), Range(b, D + 200 * rng.normal(), 200.0)]
        fix = maximum_likelihood(obs)
        e = fix.position - x
        nees.append(e @ np.linalg.solve(fix.covariance, e))
        costs.append(fix.cost)
        k = fix.degrees_of_freedom
    assert k == 5
    for sample, freedom in ((nees, 3), (costs, 5)):
        assert np.mean(sample) == pytest.approx(freedom, abs=4 * math.sqrt(2 * freedom / 3000))
        share = np.mean(np.array(sample) < chi2.ppf(0.95, freedom))
        assert share == pytest.approx(0.95, abs=4 * math.sqrt(0.95 * 0.05 / 3000))


@settings(max_examples=60)
@given(A=st.floats(-math.pi, math.pi), D=st.floats(20e3, 400e3), seed=st.integers(0, 2**32 - 1))
def test_one_more_observation_never_raises_the_bound(A, D, seed):
    rng = np.random.default_rng(seed)
    x = np.array([D * math.sin(A), D * math.cos(A), 9000.0])
    other = np.array([*rng.uniform(-2e5, 2e5, 2), 0.0])
    obs = [
        Position(x, np.diag(rng.uniform(10, 3000, 3) ** 2)),
        Azimuth([0, 0, 0], A, SIGMA_A),
        Range([0, 0, 0], D, 200.0),
        Azimuth(other, 0.0, SIGMA_A),
        Range(other, 1.0, 200.0),
        Height(9000.0, 30.0),
    ]
    bounds = [np.linalg.inv(information(obs[:k], x)) for k in range(1, 7)]
    for before, after in itertools.pairwise(bounds):
        assert np.linalg.eigvalsh(before - after).min() >= -1e-9 * before.max()
    parts = sum(information([o], x) for o in obs)
    np.testing.assert_allclose(information(obs, x), parts, rtol=1e-9, atol=1e-12 * parts.max())


def test_jacobian_is_the_derivative_of_the_measurement():
    axes = rotation(0.04, 0) @ rotation(0.05, 2)
    b, x = np.array([300e3, -150e3, -9000.0]), np.array([200.0, 300.0, 500.0])

    def h(p):
        return np.array(seen(b, p, axes)) / [SIGMA_A, 200.0]

    J = np.column_stack([(h(x + e) - h(x - e)) / 20.0 for e in 10.0 * np.eye(3)])
    F = information([Azimuth(b, 0.0, SIGMA_A, axes), Range(b, 1.0, 200.0)], x)
    np.testing.assert_allclose(F, J.T @ J, rtol=1e-6, atol=1e-6 * F.max())


def test_an_azimuth_counts_from_the_north_of_its_beacon():
    # rotate the whole problem into the beacon's own axes: the same fix, without `axes`
    axes = rotation(0.03, 1) @ rotation(-0.06, 2)
    b, x = np.array([250e3, 100e3, -6000.0]), np.array([0.0, 0.0, 400.0])
    A, D = seen(b, x, axes)
    z, C = x + np.array([800.0, -500.0, 30.0]), np.diag([4e6, 3e6, 900.0])
    here = maximum_likelihood([Position(z, C), Azimuth(b, A + 1e-3, SIGMA_A, axes), Range(b, D, 200.0)])
    there = maximum_likelihood(
        [
            Position(axes @ z, axes @ C @ axes.T),
            Azimuth(axes @ b, A + 1e-3, SIGMA_A),
            Range(axes @ b, D, 200.0),
        ]
    )
    np.testing.assert_allclose(axes @ here.position, there.position, atol=1e-4)
    np.testing.assert_allclose(axes @ here.covariance @ axes.T, there.covariance, rtol=1e-6, atol=1e-3)


class TestWithoutAPosition:
    x = np.array([20e3, 45e3])
    a, b, c = np.array([0.0, 0.0]), np.array([90e3, 10e3]), np.array([-40e3, 80e3])

    def test_azimuths_alone(self):
        fix = maximum_likelihood([Azimuth(s, seen(s, self.x)[0], SIGMA_A) for s in (self.a, self.b, self.c)])
        np.testing.assert_allclose(fix.position, self.x, atol=1e-4)

    def test_three_ranges_alone(self):
        fix = maximum_likelihood([Range(s, seen(s, self.x)[1], 200.0) for s in (self.a, self.b, self.c)])
        np.testing.assert_allclose(fix.position, self.x, atol=1e-4)

    def test_two_ranges_are_ambiguous_without_a_start_or_a_position(self):
        two = [Range(s, seen(s, self.x)[1], 200.0) for s in (self.a, self.b)]
        with pytest.raises(Ambiguous, match=r"two places .* give a start") as e:
            maximum_likelihood(two)
        near, far = sorted(e.value.positions, key=lambda p: np.linalg.norm(p - self.x))
        np.testing.assert_allclose(near, self.x, atol=1e-4)
        # the mirror image in the line between the beacons
        n = np.array([-10.0, 90.0]) / math.hypot(10.0, 90.0)
        np.testing.assert_allclose(far, self.x - 2 * (self.x @ n) * n, atol=1e-4)
        for place in (near, far):
            np.testing.assert_allclose(maximum_likelihood(two, place + 5e3).position, place, atol=1e-4)
        ins = Position(far + 3e3, np.eye(2) * 4000.0**2)
        assert np.linalg.norm(maximum_likelihood([ins, *two]).position - far) < 300.0

    def test_a_range_and_an_azimuth_of_two_beacons(self):
        b = np.array([45e3, 20e3])
        obs = [Azimuth(self.a, seen(self.a, self.x)[0], SIGMA_A), Range(b, seen(b, self.x)[1], 200.0)]
        with pytest.raises(Ambiguous):
            maximum_likelihood(obs)
        np.testing.assert_allclose(maximum_likelihood(obs, [15e3, 60e3]).position, self.x, atol=1e-4)

    def test_azimuths_that_do_not_meet(self):
        with pytest.raises(NoFix):
            maximum_likelihood([Azimuth([0, 0], -0.3, 0.01), Azimuth([50e3, 0], 0.3, 0.01)])


class TestUnobservable:
    def test_one_range(self):
        with pytest.raises(Unobservable, match=r"azimuth 120\.00 deg.*add a Position, a Range") as e:
            maximum_likelihood([Range([0, 0], 5e4, 200.0)], start=5e4 * np.array([0.5, math.sqrt(0.75)]))
        np.testing.assert_allclose(np.abs(e.value.directions), [[math.sqrt(0.75), 0.5]], atol=1e-9)

    def test_one_azimuth(self):
        with pytest.raises(Unobservable, match=r"azimuth 30\.00 deg"):
            maximum_likelihood([Azimuth([0, 0], math.radians(210.0), SIGMA_A)])

    def test_two_azimuths_of_one_beacon(self):
        with pytest.raises(Unobservable, match=r"azimuth 30\.00 deg: add") as e:
            maximum_likelihood([Azimuth([0, 0], math.radians(A), SIGMA_A) for A in (29.9, 30.1)])
        assert e.value.directions.shape == (1, 2)

    def test_no_height(self):
        with pytest.raises(Unobservable, match="the vertical: add a Height"):
            maximum_likelihood([Position([0, 0], np.eye(2)), Azimuth([9e4, 0, 0], -math.pi / 2, SIGMA_A)])

    def test_two_beacons_in_one_line_with_the_aircraft(self):
        with pytest.raises(Unobservable, match=r"azimuth 0\.00 deg"):
            maximum_likelihood([Range([0, 0], 4e4, 200.0), Range([9e4, 0], 5e4, 200.0)], start=[4e4, 0.0])

    def test_only_a_height(self):
        with pytest.raises(Unobservable, match=r"azimuth .* and azimuth"):
            maximum_likelihood([Height(100.0, 3.0)])


class TestOverhead:
    def test_azimuth_in_the_cone_of_silence_is_left_out_and_listed(self):
        x = np.array([300.0, -200.0, 9000.0])
        gnss = Position(x, np.eye(3) * 100.0)
        pair = [Azimuth([0, 0, 0], 0.4, SIGMA_A), Range([0, 0, 0], float(np.linalg.norm(x)) + 100.0, 200.0)]
        fix = maximum_likelihood([gnss, *pair])
        assert fix.in_cone_of_silence == (1,)
        without = maximum_likelihood([gnss, pair[1]])
        np.testing.assert_allclose(fix.position, without.position, atol=1e-6)
        assert fix.degrees_of_freedom == without.degrees_of_freedom == 1

    def test_exactly_over_the_beacon(self):
        fix = maximum_likelihood([Position([0, 0, 5e3], np.eye(3)), Azimuth([0, 0, 0], 1.0, SIGMA_A)])
        np.testing.assert_allclose(fix.position, [0, 0, 5e3], atol=1e-9)
        assert fix.in_cone_of_silence == (1,)

    def test_the_cone_can_take_observability_away(self):
        pair = [Azimuth([0, 0, 0], 0.4, SIGMA_A), Range([0, 0, 0], 9050.0, 200.0), Height(9000.0, 20.0)]
        with pytest.raises(Unobservable, match=r"azimuths \[0\] are left out"):
            maximum_likelihood(pair)

    def test_a_start_at_the_beacon_itself(self):
        pair = [Azimuth([0, 0], 2.0, SIGMA_A), Range([0, 0], 9e4, 200.0)]
        fix = maximum_likelihood(pair, start=[0, 0])
        np.testing.assert_allclose(fix.position, 9e4 * np.array([math.sin(2), math.cos(2)]), atol=1e-3)


def test_a_wild_measurement_shows_in_the_cost():
    x = np.array([40e3, 30e3])
    A, D = seen([0, 0], x)
    fix = maximum_likelihood(
        [Position(x, np.eye(2) * 1e4), Azimuth([0, 0], A, SIGMA_A), Range([0, 0], D + 5e3, 200.0)]
    )
    assert chi2.sf(fix.cost, fix.degrees_of_freedom) < 1e-9


GOOD = Position([0.0, 0.0], np.eye(2))


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Range([0, 0], 1e3, 0.0), r"observation 1 \(Range\): sigma is 0.0"),
        (Azimuth([0, 0], 1.0, -1.0), r"observation 1 \(Azimuth\): sigma"),
        (Azimuth([0, 0], math.nan, 1.0), r"observation 1 \(Azimuth\): value is nan"),
        (Range([0, 0], -5.0, 1.0), r"observation 1 \(Range\): .*not negative"),
        (Range([0, math.inf], 5.0, 1.0), r"observation 1 \(Range\): beacon"),
        (Height(1.0, math.nan), r"observation 1 \(Height\): sigma"),
        (Position([0, math.nan], np.eye(2)), r"observation 1 \(Position\): value .* not finite"),
        (Position([0, 0], [[1, 2], [2, 1]]), r"observation 1 \(Position\): .*positive definite"),
        (Position([0, 0], [[1, 2], [0, 9]]), r"observation 1 \(Position\): .*symmetric"),
        (Position([0, 0], np.eye(3)), r"observation 1 \(Position\): value has shape"),
        (Azimuth([0, 0], 1.0, 1.0, np.eye(3)), r"observation 1 \(Azimuth\): axes"),
        (Azimuth([0, 0, 0], 1.0, 1.0, 2 * np.eye(3)), r"observation 1 \(Azimuth\): axes"),
        ("nonsense", "observation 1 is a str"),
    ],
)
def test_bad_observation_is_reported(bad, message):
    with pytest.raises(ValueError, match=message) as e:
        maximum_likelihood([GOOD, bad])
    assert not isinstance(e.value, NoFix)


def test_bad_calls_are_rejected():
    with pytest.raises(ValueError, match="no observations"):
        maximum_likelihood([])
    with pytest.raises(ValueError, match="start is"):
        maximum_likelihood([GOOD], start=[1.0, math.nan])
    with pytest.raises(ValueError, match="start has 2"):
        maximum_likelihood([Position([0, 0, 0], np.eye(3))], start=[1.0, 1.0])
    with pytest.raises(ValueError, match=r"beacon has shape \(2,\)"):
        maximum_likelihood([Height(1.0, 1.0), Range([0, 0], 1.0, 1.0)])


def test_the_benchmarks_run():
    for name, case in cases():
        assert case().iterations <= 7, name
