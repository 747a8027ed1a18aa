"""The watch over the sources: what happens to the channel happens to every solution of the bank."""

from __future__ import annotations

import numpy as np

from companion.config import Config, InertialConfig
from companion.estimate.integrity import separations
from companion.nav.geometry import Geodetic, slant_range_azimuth
from companion.navigator import fix_observations, integrity
from companion.navigator.inertial_track import Point
from companion.navigator.integrity import MOST_BEACONS, Watch
from companion.navigator.state import Settings
from companion.records import Gnss, RsbnFix

SETTINGS = Settings.of(Config(inertial=InertialConfig(independent=True)))
NS = 1_000_000_000


def test_a_jump_of_the_channel_moves_every_solution_and_none_apart() -> None:
    w, place = integrity.begin(0, SETTINGS.unit), Geodetic(1.0, 0.5, 1000.0)
    for t in range(1, 20):
        ins = Point(t * NS, place, (30.0, 0.0, 0.0))
        w = integrity.advance(w, ins, (0.0, 0.0), SETTINGS.unit, SETTINGS.config)
        fix = Gnss(ins.t_ns, ins.t_ns, 0, t, 3, 1.0 + 1e-7 * t, 0.5, 1000.0, 1.5, 3.0, v_n=(30.0, 0.1, 0.0))
        told = integrity.of_gnss(fix, ins, SETTINGS.unit, SETTINGS.config)
        w, _ = integrity.hear(w, told, SETTINGS.allotment)
    bank, moved = w.monitor.bank, integrity.shift(w, 200.0, -50.0, (1.0, 2.0), 9 * NS).monitor.bank
    for a, b in zip(separations(bank), separations(moved), strict=True):
        np.testing.assert_allclose(a.d, b.d, atol=1e-9)
        np.testing.assert_allclose(a.statistic, b.statistic, atol=1e-9)
    assert any(np.hypot(*s.d) > 0.1 for s in separations(bank))  # or nothing would be shown
    wanted = [200.0 + 1.0 * 10.0, -50.0 + 2.0 * 10.0, 1.0, 2.0]
    np.testing.assert_allclose((moved.x - bank.x)[:, :4], [wanted] * len(bank.rows), rtol=1e-9)


INS = Point(0, Geodetic(1.0, 0.5, 1000.0), (30.0, 0.0, 0.0))
FAR = Geodetic(1.01, 0.5, 0.0)


def heard(w: Watch, t: int, beacon: int) -> Watch:
    """After GNSS and one answer."""
    ins = INS._replace(t_ns=t * NS)
    w = integrity.advance(w, ins, (0.0, 0.0), SETTINGS.unit, SETTINGS.config)
    fix = Gnss(ins.t_ns, ins.t_ns, 0, t, 3, 1.0, 0.5, 1000.0, 1.5, 3.0)
    w, _ = integrity.hear(w, integrity.of_gnss(fix, ins, SETTINGS.unit, SETTINGS.config), SETTINGS.allotment)
    seen = slant_range_azimuth(FAR, ins.position)
    answer = RsbnFix(ins.t_ns, ins.t_ns, beacon, *FAR, seen.azimuth, seen.slant_range, 0.004, 100.0)
    w = integrity.met(w, beacon)
    for z in fix_observations.from_rsbn(answer, ins, SETTINGS.config.rsbn):
        w, told = integrity.of_beacon(w, integrity.named(beacon, z), z, SETTINGS.config)
        assert told is not None
        w, _ = integrity.hear(w, told, SETTINGS.allotment)
    return w


def test_of_any_number_of_beacons_the_last_heard_are_followed() -> None:
    w = integrity.begin(0, SETTINGS.unit)
    for t in range(1, 4 * MOST_BEACONS):
        w = heard(w, t, t % (MOST_BEACONS + 5))
        w = heard(w, t, 100)  # one that never falls silent
    bank = w.monitor.bank
    beacons = {name.split()[1] for name in bank.biases}
    assert len(beacons) == MOST_BEACONS
    assert "100" in beacons
    assert bank.x.shape == (2 * MOST_BEACONS + len(integrity.begin(0, SETTINGS.unit).monitor.bank.rows), 30)
    assert integrity.is_sound(w)


def test_what_is_forgotten_leaves_what_the_others_know_as_it_is() -> None:
    w = integrity.begin(0, SETTINGS.unit)
    for t in range(1, MOST_BEACONS + 1):
        w = heard(w, t, t)
    fewer = integrity.met(w, 99)
    assert "rsbn 1 range" not in fewer.monitor.bank.biases
    keep = [i for i, row in enumerate(w.monitor.bank.rows) if not row.without.startswith("rsbn 1 ")]
    k = len(SETTINGS.unit.sigma0)
    states = [*range(k), *range(k + 2, w.monitor.bank.x.shape[1])]
    np.testing.assert_array_equal(fewer.monitor.bank.x, w.monitor.bank.x[np.ix_(keep, states)])
    np.testing.assert_array_equal(fewer.monitor.bank.P, w.monitor.bank.P[np.ix_(keep, states, states)])
