"""Benchmark of minimax prediction: closed form, exchange, HiGHS, and the guaranteed bound in flight."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy.optimize import linprog

from companion.estimate.minimax import closed_form_tau
from companion.estimate.minimax_lp import Design, Minimax
from companion.estimate.predictor import Step, Window, anchor
from companion.estimate.schuler import schuler_row
from companion.nav.bounded_channel import BoundedIns, Motion, UnitErrors
from companion.units import Floats

NAVIGATION = UnitErrors(4.8e-8, 18_000.0, 5.8e-7, 4.9e-4, 3600.0, 1e-3, 0.5, 1e-4, 9e-4)  # SI


def _solve(rows: Floats, target: Floats, start: Minimax | None = None) -> Minimax:
    return Design.of(rows, 1.0).minimax(target, start)


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): position on [0, 1] predicted 0.5 ahead, the target gamma; and a live update."""
    target = np.array([1.0, 0.0, 0.0, 0.0])
    yield "minimax closed form, four targets", partial(closed_form_tau, 1.0, 0.5)
    for n in (1001, 8001):
        rows = schuler_row("gamma", 1.5 - np.linspace(0.0, 1.0, n))
        yield f"minimax exchange, {n} samples", partial(_solve, rows, target)
        yield f"minimax exchange, {n} samples, warm", partial(_solve, rows, target, _solve(rows, target))
        both = np.vstack([rows, -rows])  # dual form: ten times faster than the primal
        yield (
            f"minimax HiGHS, {n} samples",
            partial(linprog, -target, both, np.ones(2 * n), bounds=(None, None), method="highs"),
        )
    law = BoundedIns(NAVIGATION)
    window = Window.begin(0.0, law)
    rows = np.eye(law.n)[:2]
    motion = Motion(0.8, (30.0, 20.0), (30.0, 20.0), 10.0)
    for k in range(150):
        window = window.extend(10.0 * k + 10.0, *law.step(motion))
        window = window.with_fix(10.0 * k + 5.0, rows @ window.C[-1], np.zeros(2), np.full(2, 2.0), 1500.0)
    anchored = anchor(window, law)
    ahead = [Step(10.0, *law.step(motion)[:2])] * 60
    wanted = anchored.targets(window, (0,), ahead)[0]
    solved = anchored.solve(wanted)
    yield "guaranteed bound, 150 fixes of two axes: a new fix", partial(anchor, window, law)
    yield "guaranteed bound: one axis, cold", partial(anchored.solve, wanted)
    yield "guaranteed bound: one axis, warm", partial(anchored.solve, wanted, solved.start)
