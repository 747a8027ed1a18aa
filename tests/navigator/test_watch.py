"""The watch over the sources: what happens to the channel happens to every solution of the bank."""

from __future__ import annotations

import numpy as np

from companion.config import Config, Inertial
from companion.estimate import integrity
from companion.nav.geometry import Geodetic
from companion.navigator import watch
from companion.navigator.carry import Settings
from companion.navigator.inertial import Point
from companion.records import Gnss

SETTINGS = Settings.of(Config(inertial=Inertial(independent=True)))
NS = 1_000_000_000


def test_a_jump_of_the_channel_moves_every_solution_and_none_apart() -> None:
    w, place = watch.begin(0, SETTINGS.unit), Geodetic(1.0, 0.5, 1000.0)
    for t in range(1, 20):
        ins = Point(t * NS, place, (30.0, 0.0, 0.0))
        w = watch.advance(w, ins, (0.0, 0.0), SETTINGS.unit, SETTINGS.config)
        fix = Gnss(ins.t_ns, ins.t_ns, 0, t, 3, 1.0 + 1e-7 * t, 0.5, 1000.0, 1.5, 3.0, v_n=(30.0, 0.1, 0.0))
        told = watch.of_gnss(fix, ins, SETTINGS.unit, SETTINGS.config)
        w, _ = watch.hear(w, told, SETTINGS.allotment)
    bank, moved = w.monitor.bank, watch.shift(w, 200.0, -50.0, (1.0, 2.0), 9 * NS).monitor.bank
    for a, b in zip(integrity.separations(bank), integrity.separations(moved), strict=True):
        np.testing.assert_allclose(a.d, b.d, atol=1e-9)
        np.testing.assert_allclose(a.statistic, b.statistic, atol=1e-9)
    assert any(np.hypot(*s.d) > 0.1 for s in integrity.separations(bank))  # or nothing would be shown
    wanted = [200.0 + 1.0 * 10.0, -50.0 + 2.0 * 10.0, 1.0, 2.0]
    np.testing.assert_allclose((moved.x - bank.x)[:, :4], [wanted] * len(bank.rows), rtol=1e-9)
