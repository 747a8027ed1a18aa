"""`companion study map` prints the reference's states; shooting fails where it must."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from companion.study.map_smoothing import Z, command, long_record, solve


def test_reference_states():
    found = json.loads(CliRunner().invoke(command, ["--json"]).output)["x"]
    # reference/map_and_order.json, computed independently with 50 digits
    for name in ("two-point", "filter + RTS", "shooting"):
        assert found[name][0] == pytest.approx([0.141426184774452, 0.975138510178567], abs=1e-12)
        assert found[name][5] == pytest.approx([5.13076367412608, 1.02140466709842], abs=1e-12)
    for name in found:
        assert found[name][10] == pytest.approx([10.2055446465612, 1.03402979222045], abs=1e-12)


def test_shooting_loses_its_digits_with_length():
    apart = []
    for N in (10, 60, 120):
        states = solve(long_record(N))
        assert np.abs(states["filter + RTS"] - states["two-point"]).max() < 1e-11
        apart.append(np.abs(states["shooting"] - states["two-point"]).max())
    assert apart[0] < 1e-10 < 1e-6 < apart[1] < 1.0 < 1e4 < apart[2]


def test_tables():
    output = CliRunner().invoke(command).output
    assert "0.141426184774" in output and "shooting" in output
    assert len(Z) == 10
