"""Benchmark of the bank of hypotheses: the work between two GNSS positions, and a birth with its reduction.

The target is 300 us for a propagation and an update of 96 rows of 14 states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from companion.estimate import bank as banks
from companion.estimate.bank import EXHAUSTIVE, NONE, Bank, Fault, Layout, Lie, Settings, Source

SIZES = ((48, 10), (96, 10), (96, 17), (96, 30))
"""Rows and base states; one group of two offsets and two rates is added. A stock autopilot has 96 x 34."""
GRADED = 1e-4 * np.array((1.0, 16.0, 256.0, 4096.0))  # process noise of the four grades


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): one call is a propagation and an update, or the births of five seconds."""
    for rows, n_base in SIZES:
        layout, bank = populated(rows, n_base)
        yield f"propagate and update, {rows} rows x {layout.n} states", partial(_follow, bank, layout)
    layout, bank = populated(96, 10)
    later = bank._replace(t=5.0, seen=np.full(1, 5.0))
    yield "births and reduction, 96 rows x 14 states", partial(banks.births, later, layout, Settings(rows=96))


def _follow(bank: Bank, layout: Layout) -> object:
    """Propagate by half a second and update by one position."""
    n = layout.n_base
    Q = GRADED[:, None, None] * np.eye(n)
    moved = banks.propagate(bank, layout, 0.5, 1.001 * np.eye(n), Q)
    return banks.update(moved, layout, np.zeros(2), np.eye(2, n), np.eye(2), 0, EXHAUSTIVE)


def populated(rows: int, n_base: int) -> tuple[Layout, Bank]:
    """Return a layout and a bank of so many rows, half of which hold GNSS to be false."""
    fault = Fault("gnss", (0,), 1e-3, (Lie(3.0, 1.0),))
    layout = Layout(n_base, (2,), (Source("gnss", 2, 0),), (fault,))
    rng = np.random.default_rng(0)
    A = rng.standard_normal((rows, layout.n, layout.n))
    bank = banks.start(layout, 0.0, np.zeros(n_base), np.eye(n_base))
    return layout, bank._replace(
        L=np.full(rows, -math.log(rows)),
        x=rng.standard_normal((rows, layout.n)),
        P=A @ A.transpose(0, 2, 1),
        grade=np.arange(rows) % len(layout.grades),
        fault=np.where(np.arange(rows) % 2, 0, NONE)[:, None],
        event=np.zeros(rows, dtype=np.int64),
        since=np.zeros(rows),
        scale=np.zeros(rows, dtype=np.int64),
        noise=np.full((rows, 2), 1e-4),
        seen=np.zeros(1),
    )
