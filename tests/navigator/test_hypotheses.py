"""Priors of the navigator's hypotheses against the risk of the protection level."""

import math

import numpy as np
import pytest

from companion.config import Config, InertialConfig
from companion.estimate import bank as banks
from companion.estimate.bank.layout import FAULT_CODES
from companion.nav.geometry import Geodetic
from companion.navigator.channel import Nominal
from companion.navigator.hypotheses import AIRSPEED, GNSS, MOST_BEACONS, Model, Situation
from companion.navigator.inertial_track import Point
from companion.navigator.own_error_model import HEADING, VERSINE, air_velocity, begin


@pytest.mark.parametrize("config", [Config(), Config(inertial=InertialConfig(independent=True))])
def test_a_lie_that_begins_is_within_the_protection_level_before_there_is_evidence(config: Config) -> None:
    """Each scale of each onset weighs more than the risk from its birth on."""
    known = Model(config).hypotheses(Situation(1))
    for fault in known.layout.faults:
        if fault.sources == (GNSS,):
            born = fault.rate_h * known.settings.birth_s / 3600.0
            total = sum(lie.share for lie in fault.lies)
            assert min(born * lie.share / total for lie in fault.lies) > config.integrity.risk


def test_a_heading_that_is_far_off_stays_so_while_parked() -> None:
    """Ten minutes: with the decay of a heading little off its sine would be 0.37 of what it was."""
    model = Model(Config())
    layout, bank = model.hypotheses(Situation()).layout, model.begin(0.0)
    Phi, Q = model.channel.propagator.transition(begin("hold", (0.0, 0.0))._replace(seconds=5.0))
    bank = bank._replace(x=bank.x + 0.01 * (np.arange(layout.n) == HEADING))
    sine = bank.x[:, HEADING]
    for _ in range(120):
        bank = model.on_circle(banks.propagate(bank, layout, 5.0, Phi, Q), Phi)
    turned = bank.event > 0
    assert turned.sum() == len(model.channel.grades)
    np.testing.assert_allclose(bank.x[turned, HEADING], sine[turned])
    np.testing.assert_allclose(bank.x[~turned, HEADING], math.exp(-1.0) * 0.01)
    np.testing.assert_allclose(np.unique(bank.x[:, VERSINE].round(12)), [0.0, 1.0])


@pytest.mark.parametrize("airspeed", [0.0, 0.5, 22.0])
def test_a_false_airspeed_moves_the_position_along_the_nose(airspeed: float) -> None:
    """One of zero too: its direction was lost, and what it was off by came out as wind, 1377 m in 3 s."""
    model, heading = Model(Config()), 2.0
    V = air_velocity(airspeed, 0.1, heading)
    since, point = (Point(t_ns, Geodetic(0.9, 0.5, 100.0), (*V, 0.0)) for t_ns in (0, 10**9))
    Phi, _ = model.transition(Nominal(point, (0.0, 0.0), since, begin("air", V)._replace(seconds=1.0)), 0)
    lie = model.hypotheses(Situation()).layout.lie_states(AIRSPEED)[0]
    np.testing.assert_allclose(Phi[0:4, lie], 2 * [math.cos(heading), math.sin(heading)])


def test_a_hovering_copter_shows_no_step_of_its_heading_but_where_its_velocity_changes() -> None:
    """In a hover the step stood for any change of the wind: 91 m off after a minute, 40 m without it."""
    model = Model(Config())

    def steps(**now: bool) -> bool:
        jumps = model.hypotheses(Situation(is_received=True, **now)).layout.jumps
        return next(jump.rate_h for jump in jumps if jump.name == "heading") > 0.0

    assert steps(along_nose=True)
    assert steps(along_nose=False, has_turned=True)
    assert not steps(along_nose=False)


def test_as_many_beacons_as_are_followed_may_all_be_false_at_once() -> None:
    """The codes of such an explanation are those of plain integers: none is cut off."""
    model = Model(Config())
    layout, bank = model.hypotheses(Situation(MOST_BEACONS)).layout, model.begin(0.0)
    for k in range(MOST_BEACONS):
        bank = model.with_beacon(bank, k)
    false = {layout.fault_group(f): f for f in range(len(layout.faults))}
    bank = bank._replace(fault=bank.fault * 0 + [false[g] for g in range(len(layout.groups))])
    code = sum((f + 1) * FAULT_CODES**g for g, f in false.items())
    assert banks.families(bank).tolist() == [code] * len(bank.L)
    assert set(banks.explanations(bank, layout).tolist()) == {code * (len(layout.jumps) + 1)}
    is_beacon = [source.name.startswith(("azimuth", "range")) for source in layout.sources]
    np.testing.assert_allclose(banks.false_probability(bank, layout)[is_beacon], 1.0)
