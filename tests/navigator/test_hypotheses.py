"""Priors of the navigator's hypotheses against the risk of the protection level."""

import pytest

from companion.config import Config, InertialConfig
from companion.navigator.hypotheses import GNSS, Model


@pytest.mark.parametrize("config", [Config(), Config(inertial=InertialConfig(independent=True))])
def test_a_lie_that_begins_is_within_the_protection_level_before_there_is_evidence(config: Config) -> None:
    """Each scale of each onset weighs more than the risk from its birth on."""
    known = Model(config).hypotheses(1)
    for fault in known.layout.faults:
        if fault.sources == (GNSS,):
            born = fault.rate_h * known.settings.birth_s / 3600.0
            total = sum(lie.share for lie in fault.lies)
            assert min(born * lie.share / total for lie in fault.lies) > config.integrity.risk
