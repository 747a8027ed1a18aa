"""A source's sigma stated wrong in flight: everything it states is scaled, and nothing else."""

from __future__ import annotations

import pytest

from companion.config import Config
from companion.records import AirData, Gnss, RsbnFix
from sitl import weights_study
from sitl.scenarios import get_scenario
from sitl.world import World


@pytest.fixture(scope="module")
def world() -> World:
    return World(get_scenario("short"))


def test_configuration_and_records_are_scaled() -> None:
    plain = Config()
    gnss = weights_study.stated(plain, "GNSS", 10.0)
    assert gnss.gnss.sigma_m == 10.0 * plain.gnss.sigma_m
    assert gnss.rsbn == plain.rsbn and gnss.inertial == plain.inertial
    ins = weights_study.stated(plain, "INS", 0.1)
    assert ins.inertial.gyro_drift_deg_h == pytest.approx(0.1 * plain.inertial.gyro_drift_deg_h)
    assert ins.inertial.height_sigma_m == plain.inertial.height_sigma_m
    rsbn = weights_study.stated(plain, "RSBN", 3.0)
    assert rsbn.rsbn.sigma_range_m == 3.0 * plain.rsbn.sigma_range_m
    assert rsbn.gnss == plain.gnss


@pytest.mark.parametrize(
    ("source", "kind", "field"),
    [
        ("GNSS", Gnss, "sigma_horizontal"),
        ("RSBN", RsbnFix, "sigma_range"),
    ],
)
def test_only_the_source_states_another_sigma(world: World, source: str, kind: type, field: str) -> None:
    before = list(world.records())
    after = list(weights_study.restated(before, source, 3.0))
    for a, b in zip(before, after, strict=True):
        if isinstance(a, kind) and getattr(a, "has_3d_fix", True):
            assert getattr(b, field) == pytest.approx(3.0 * getattr(a, field))
        elif isinstance(a, AirData):
            assert a is b


@pytest.mark.flight
def test_one_filter_is_spoilt_by_a_sigma_stated_too_great(world: World) -> None:
    """GNSS stated ten times too coarse: the error with fixes grows; stated right, the phases are as flown."""
    right, wrong = (weights_study.fly(world, "GNSS", factor, bank=False) for factor in (1.0, 10.0))
    assert len(right.phases) == len(world.scenario.phases())
    assert right.phases[0] < 3.0  # m, with fixes of 1.7 m
    assert wrong.overall > right.overall
