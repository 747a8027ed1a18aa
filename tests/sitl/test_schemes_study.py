"""Feedforward, feedback and shares in between are informationally equivalent in flight."""

from __future__ import annotations

import numpy as np
import pytest
from click.testing import CliRunner

from sitl import schemes_study
from sitl.scenarios import get_scenario
from sitl.schemes_study import SchemeFlight, apart_m, fly
from sitl.world import World


@pytest.fixture(scope="module")
def flights() -> dict[object, SchemeFlight]:
    world = World(get_scenario("short"))
    return {scheme: fly(world, "air_data", scheme) for scheme in ("feedforward", 0.3, "feedback")}


@pytest.mark.flight
@pytest.mark.long
@pytest.mark.parametrize("scheme", [0.3, "feedback"])
def test_schemes_use_the_same_fixes(flights: dict[object, SchemeFlight], scheme: object) -> None:
    first, other = flights["feedforward"], flights[scheme]
    assert (other.fixes, other.joint, other.rejected) == (first.fixes, first.joint, first.rejected)
    assert first.joint > 100  # a beacon's answer with the GNSS fix of a moment ago


@pytest.mark.flight
@pytest.mark.long
@pytest.mark.parametrize("scheme", [0.3, "feedback"])
def test_schemes_have_the_same_position_and_bound(
    flights: dict[object, SchemeFlight], scheme: object
) -> None:
    first, other = flights["feedforward"], flights[scheme]
    rms, most = apart_m(first, other)
    assert rms < 0.1 and most < 0.5  # m; azimuth and range are linearised elsewhere
    both, known = (np.isfinite(flight.bound).all(axis=1) for flight in (first, other))
    np.testing.assert_array_equal(both, known)
    assert both.mean() > 0.5
    ratio = np.hypot(*other.bound[both].T) / np.hypot(*first.bound[both].T)
    assert np.median(np.abs(ratio - 1.0)) < 0.02


def test_a_flight_without_a_bound_has_a_dash(monkeypatch: pytest.MonkeyPatch) -> None:
    """The own channel by IMU has none."""
    n = 5
    flight = SchemeFlight(np.arange(n, dtype=float), np.zeros((n, 2)), np.full((n, 2), np.nan), 1.0, n, 0, 0)
    monkeypatch.setattr(schemes_study, "fly", lambda *_: flight)
    done = CliRunner().invoke(schemes_study.command, ["--channel", "own"], catch_exceptions=False)
    rows = [line.split() for line in done.stdout.splitlines() if line.split()[:1] == ["own"]]
    assert len(rows) == len(schemes_study.SCHEMES) and {row[6] for row in rows} == {"-"}
