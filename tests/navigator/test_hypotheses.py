"""Priors of the navigator's hypotheses against the risk of the protection level."""

import math

import numpy as np
import pytest

from companion.config import Config, InertialConfig
from companion.estimate import bank as banks
from companion.navigator.hypotheses import GNSS, Model, Situation
from companion.navigator.own_error_model import HEADING, VERSINE, begin


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
