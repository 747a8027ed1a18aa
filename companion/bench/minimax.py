"""Benchmark of minimax prediction: closed form, exchange method, and HiGHS on the same linear programme."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.optimize import linprog

from companion.estimate.minimax import closed_form_tau
from companion.estimate.minimax_lp import solve
from companion.estimate.predictor import Window, predict
from companion.estimate.schuler import schuler_row
from companion.units import SECOND_NS


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): position on [0, 1] predicted 0.5 ahead, the target gamma; and a live update."""
    target = np.array([1.0, 0.0, 0.0, 0.0])
    yield "minimax closed form, four targets", partial(closed_form_tau, 1.0, 0.5)
    for n in (1001, 8001):
        rows = schuler_row("gamma", 1.5 - np.linspace(0.0, 1.0, n))
        start = solve(rows, target, 1.0).active
        yield f"minimax exchange, {n} samples", partial(solve, rows, target, 1.0)
        yield f"minimax exchange, {n} samples, warm", partial(solve, rows, target, 1.0, start)
        both = np.vstack([rows, -rows])  # dual form: ten times faster than the primal
        yield (
            f"minimax HiGHS, {n} samples",
            partial(linprog, -target, both, np.ones(2 * n), bounds=(None, None), method="highs"),
        )
    window = Window.of(np.arange(1000) * SECOND_NS, "position", np.zeros(1000), 30.0)
    last = predict(window, 1600 * SECOND_NS)
    yield (
        "minimax update, 1000 fixes: push, predict position and velocity",
        lambda: predict(window.push(1000 * SECOND_NS, "position", 0.0, 30.0), 1601 * SECOND_NS, start=last),
    )
