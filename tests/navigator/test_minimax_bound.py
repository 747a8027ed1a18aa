"""The window of the guaranteed prediction takes whatever fixes come."""

from __future__ import annotations

from typing import Any

import numpy as np

from companion.config import Config, InertialConfig
from companion.navigator import minimax_bound

CONFIG = Config(inertial=InertialConfig(independent=True))
NS = 1_000_000_000


def test_two_fixes_of_one_instant_too_unlike_for_one_bin_both_count() -> None:
    """A near and a far beacon answer at once: each fix is a bin of its own."""
    rng = np.random.default_rng(1)
    both, near = minimax_bound.begin(CONFIG), minimax_bound.begin(CONFIG)
    for k in range(120):
        for sigma in (20.0, 200.0):
            value = tuple((sigma * rng.uniform(-1.0, 1.0, 2)).tolist())
            fix: Any = (k * NS, "position", value, (sigma, sigma), CONFIG.predictor)
            both = minimax_bound.add_fix(both, *fix)
            if sigma < 100.0:
                near = minimax_bound.add_fix(near, *fix)
    assert len(both.north) + len(both.bins) == 240
    assert np.all(np.diff(both.north.t_ns) > 0)
    _, wide = minimax_bound.bounded(near, 130 * NS, CONFIG.predictor)
    _, narrow = minimax_bound.bounded(both, 130 * NS, CONFIG.predictor)
    assert wide is not None
    assert narrow is not None
    assert max(np.abs(narrow.error_n)) < 2.0 * max(narrow.bound_n)
    assert max(narrow.bound_n) < 1.01 * max(wide.bound_n)  # what comes besides takes nothing away
