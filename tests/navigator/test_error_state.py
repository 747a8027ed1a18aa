"""The Gaussian error state: what a silence of any length makes of it."""

import math

import numpy as np
import pytest

from companion.config import Config
from companion.navigator import error_state
from companion.navigator.error_state import STEP_S, ErrorState

CONFIG = Config()
UNIT = error_state.grade(CONFIG.inertial, CONFIG.gnss)
LAT, V_N, A_N = math.radians(57.0), (60.0, -30.0, 1.0), (0.2, -0.1)
SECOND = 1_000_000_000


def stepped(state: ErrorState, seconds: float, steps: int) -> ErrorState:
    for i in range(steps):
        t_ns = round((i + 1) * seconds / steps * SECOND)
        state = error_state.predict(state, t_ns, LAT, V_N, A_N, UNIT)
    return state


@pytest.mark.parametrize("seconds", [8.0, 64.0, 5040.0])
def test_a_silence_at_once_is_as_one_gone_through_step_by_step(seconds: float) -> None:
    begin = error_state.start(0, UNIT)._replace(x=UNIT.sigma0)
    steps = 2 ** max(0, math.ceil(math.log2(seconds / STEP_S)))
    at_once, slowly = stepped(begin, seconds, 1), stepped(begin, seconds, steps)
    scale = np.sqrt(slowly.P.diagonal())
    np.testing.assert_allclose(at_once.x / scale, slowly.x / scale, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(at_once.P, slowly.P, atol=1e-9 * np.outer(scale, scale).max(), rtol=1e-9)


def test_a_silence_of_days_leaves_a_covariance() -> None:
    after = stepped(error_state.start(0, UNIT), 3 * 86400.0, 1)
    assert error_state.is_sound(after)
    assert (after.P.diagonal() >= np.diag(UNIT.sigma0**2).min()).all()
