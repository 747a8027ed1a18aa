"""Well-formed frames with any field values do not raise, and leave nothing that cannot be sent."""

import random

import pytest

from companion.link import dialect
from sitl.endurance.forged_frames import fly, random_payload
from sitl.endurance.fuzz_targets import MESSAGE_NAMES
from sitl.endurance.parameter_sweep import CONFIGS


@pytest.mark.parametrize("number", range(len(CONFIGS)))
def test_a_flight_survives_forged_frames(number: int) -> None:
    assert fly(CONFIGS[number], number, 3000) == 3000


def test_payloads_fit_their_messages() -> None:
    rng = random.Random(1)
    for name in MESSAGE_NAMES:
        assert len(random_payload(rng, name)) == dialect.type_named(name).layout.size
