"""A beacon's answer absorbed where the state stands is the one absorbed at its own time."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from companion.config import Config
from companion.navigator import error_state
from companion.navigator.error_state import NEAR_S, Belief, ErrorState

UNIT = error_state.grade(Config().inertial, Config().gnss)
H = error_state.beacon_rows(UNIT)
LAT, V_N, A_N = 1.05, (35.0, -20.0, 0.0), (1.0, 2.0)


def learnt() -> ErrorState:
    """The state after a minute, its errors tied to one another."""
    state = error_state.start(0, UNIT)
    for k in range(1, 13):
        state = error_state.predict(state, k * 5_000_000_000, LAT, V_N, A_N, UNIT)
        (n, e), (nn, ne, ee) = error_state.seen(state, H).belief
        found = Belief((n + 3.0, e - 2.0), (0.5 * nn, 0.5 * ne, 0.5 * ee))
        state = error_state.absorb_position(state, error_state.seen(state, H), found)
    return state


STATE = learnt()


@given(
    dt=st.floats(1e-3, NEAR_S),
    offset=st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)),
    share=st.floats(0.05, 0.95),
)
def test_before_or_after_the_step_it_is_the_same(
    dt: float, offset: tuple[float, float], share: float
) -> None:
    t_ns = STATE.t_ns + round(1e9 * dt)
    later = error_state.predict(STATE, t_ns, LAT, V_N, A_N, UNIT)
    at_its_time = error_state.seen(later, H)
    (n, e), (nn, ne, ee) = at_its_time.belief
    found = Belief(
        (n + offset[0] * math.sqrt(nn), e + offset[1] * math.sqrt(ee)), (share * nn, share * ne, share * ee)
    )
    exact = error_state.absorb_position(later, at_its_time, found)
    where_it_stands = error_state.seen(STATE, error_state.carried(H, dt, V_N, UNIT))
    near = error_state.predict(
        error_state.absorb_position(STATE, where_it_stands, found), t_ns, LAT, V_N, A_N, UNIT
    )
    sigma = np.sqrt(np.diag(exact.P))
    assert np.abs((near.x - exact.x) / sigma).max() < 0.02
    np.testing.assert_allclose(np.sqrt(np.diag(near.P)), sigma, rtol=0.01)


def test_absorbing_is_regression_on_what_is_seen() -> None:
    """By its textbook form: x + K d, P - K (S - C) K'."""
    before = error_state.seen(STATE, H)
    found = Belief((4.0, -7.0), (2.0, 0.3, 3.0))
    after = error_state.absorb_position(STATE, before, found)
    S = H @ STATE.P @ H.T
    K = STATE.P @ H.T @ np.linalg.inv(S)
    C = np.array([[2.0, 0.3], [0.3, 3.0]])
    np.testing.assert_allclose(after.x, STATE.x + K @ (np.array([4.0, -7.0]) - H @ STATE.x), rtol=1e-9)
    np.testing.assert_allclose(after.P, STATE.P - K @ (S - C) @ K.T, rtol=1e-9, atol=1e-18)
    np.testing.assert_allclose(H @ after.P @ H.T, C, rtol=1e-9)
