"""Benchmark of filters: the 16-state example, one flight at a time and 200 flights in one call.

The last two cases are the same Monte Carlo run, the first samples of `companion study restrictive`; their
ratio is the gain of processing flights as a stack.
"""

from collections.abc import Callable, Iterator

import numpy as np

from companion.estimate import kalman, restrictive
from companion.nav.error_model import paper_example
from companion.study.restrictive import TRUTHS, simulate_flights
from companion.units import Floats

FLIGHTS = 200
SAMPLES = 10


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): one call is a step of one flight or of all, or the samples in the name."""
    model = paper_example()
    _, A, B, Q, _, H, R, C, x0, P0, *_ = model
    z = simulate_flights(model, TRUTHS["constant"], FLIGHTS, np.random.default_rng(0)).z
    many0, Ps0 = np.tile(x0, (FLIGHTS, 1)), np.tile(P0, (FLIGHTS, 1, 1))

    def follow(x: Floats, P: Floats, z: Floats) -> tuple[Floats, Floats]:
        for z_t in z:
            x, P, *_ = restrictive.step(x, P, z_t, A, B, Q, H, R, C)
        return x, P

    many, Ps = follow(many0, Ps0, z[:100])  # to covariances as in flight
    x, P, z_t = many[0], Ps[0], z[100]
    yield "kalman step, 16 states", lambda: kalman.step(x, P, z_t[0], A, Q, H, R)
    yield f"kalman step, {FLIGHTS} flights at once", lambda: kalman.step(many, P, z_t, A, Q, H, R)
    yield "restrictive step, 16 states", lambda: restrictive.step(x, P, z_t[0], A, B, Q, H, R, C)
    yield (
        f"restrictive step, {FLIGHTS} flights at once",
        lambda: restrictive.step(many, Ps, z_t, A, B, Q, H, R, C),
    )
    yield (
        f"restrictive, {SAMPLES} samples, {FLIGHTS} flights at once",
        lambda: follow(many0, Ps0, z[:SAMPLES]),
    )
    yield (
        f"restrictive, {SAMPLES} samples, {FLIGHTS} one by one",
        lambda: [follow(x0, P0, z[:SAMPLES, i]) for i in range(FLIGHTS)],
    )
