"""Filters worth timing: the 16-state example one flight at a time and 200 flights in one call."""

from collections.abc import Callable, Iterator

import numpy as np

from companion.estimate import kalman, restrictive
from companion.estimate.full_horizon import Sample
from companion.estimate.moving_horizon import MHE, Window
from companion.nav.error_model import paper_example

FLIGHTS = 200


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Names and callables; one call is one predict and correct, of one flight or of all."""
    _, A, B, Q, _, H, R, C, x0, P0, *_ = paper_example()
    rng = np.random.default_rng(0)
    z = 0.3 * rng.standard_normal((FLIGHTS, len(R)))
    window, mhe = Window(x0, P0), MHE(10)
    for _ in range(100):  # to a covariance and a window as in flight
        x, P, *_ = restrictive.step(x0, P0, z[0], A, B, Q, H, R, C)
        x0, P0 = x, P
    for z_t in z[:20]:
        window, _ = mhe.step(window, Sample(z_t, A, B, Q, H, R, C))
    many, Ps = np.tile(x, (FLIGHTS, 1)), np.tile(P, (FLIGHTS, 1, 1))
    yield "kalman step, 16 states", lambda: kalman.step(x, P, z[0], A, Q, H, R)
    yield f"kalman step, {FLIGHTS} flights at once", lambda: kalman.step(many, P, z, A, Q, H, R)
    yield "restrictive step, 16 states", lambda: restrictive.step(x, P, z[0], A, B, Q, H, R, C)
    yield (
        f"restrictive step, {FLIGHTS} flights at once",
        lambda: restrictive.step(many, Ps, z, A, B, Q, H, R, C),
    )
    yield "moving horizon of 10, 16 states", lambda: mhe.step(window, Sample(z[0], A, B, Q, H, R, C))
