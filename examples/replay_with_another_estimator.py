"""Replay a recording with another configuration and compare the two tracks.

python examples/replay_with_another_estimator.py FLIGHT.tlog [KEY=VALUE,...]
"""

import sys
from pathlib import Path

import numpy as np

from companion.analysis.replay_inputs import apply_changes, open_inputs
from companion.config import Config
from companion.nav.geometry import Geodetic, separation
from companion.navigator import Navigator
from companion.records import INPUTS, Solution


def solutions(path: Path, config: Config) -> dict[int, Solution]:
    """Run a navigator over the recording: its solutions by time."""
    navigator, found = Navigator(config), {}
    for record in open_inputs(path).records:
        if isinstance(record, INPUTS):
            for output in navigator.handle(record):
                if isinstance(output, Solution):
                    found[output.t_ns // 1_000_000_000] = output
    return found


if len(sys.argv) < 2:
    sys.exit("usage: python examples/replay_with_another_estimator.py FLIGHT.tlog [KEY=VALUE,...]")
default = solutions(Path(sys.argv[1]), Config())
changes = sys.argv[2] if len(sys.argv) > 2 else "inertial.source=air_data,estimator.scheme=feedback"
other = solutions(Path(sys.argv[1]), apply_changes(Config(), changes))
apart = [
    np.hypot(*separation(Geodetic(a.lat, a.lon, 0.0), Geodetic(b.lat, b.lon, 0.0))[:2])
    for t, a in default.items()
    if (b := other.get(t)) is not None
]
print(f"solutions: {len(default)} by default, {len(other)} with {changes}")
print(f"distance: {np.median(apart):.2f} m in the median, {max(apart):.2f} m at most")
