"""Cost of minimax prediction: closed form, exchange, and HiGHS on the same programme beside it."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.optimize import linprog

from companion.estimate.minimax import closed_form, schuler_row, solve
from companion.estimate.predictor import Window, predict

NANO = 1_000_000_000


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): position on [0, 1] predicted 0.5 ahead, the target gamma; and a live update."""
    target = np.array([1.0, 0.0, 0.0, 0.0])
    yield "minimax closed form, four targets", partial(closed_form, 1.0, 0.5)
    for n in (1001, 8001):
        rows = schuler_row("gamma", 1.5 - np.linspace(0.0, 1.0, n))
        start = solve(rows, target, 1.0).active
        yield f"minimax exchange, {n} samples", partial(solve, rows, target, 1.0)
        yield f"minimax exchange, {n} samples, warm", partial(solve, rows, target, 1.0, start)
        both = np.vstack([rows, -rows])  # the dual form: the primal one takes ten times longer
        yield (
            f"minimax HiGHS, {n} samples",
            partial(linprog, -target, both, np.ones(2 * n), bounds=(None, None), method="highs"),
        )
    window = Window.of(np.arange(1000) * NANO, "position", np.zeros(1000), 30.0)
    last = predict(window, 1600 * NANO)
    yield (
        "minimax update, 1000 fixes: push, predict position and velocity",
        lambda: predict(window.push(1000 * NANO, "position", 0.0, 30.0), 1601 * NANO, start=last),
    )
