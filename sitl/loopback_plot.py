"""Loopback plot: error of every source and the guaranteed bound over the flight, phases shaded."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from companion.analysis import error_statistics
from sitl.scenarios import Scenario

#: By source, the uppermost last.
COLOURS = {
    error_statistics.RSBN: "#d95f0e",
    error_statistics.GNSS: "#2c7fb8",
    error_statistics.INS: "#888888",
    error_statistics.CORRECTED: "#111111",
}
SHADES = {"GNSS+RSBN": "#e5f5e0", "GNSS only": "#deebf7", "RSBN only": "#fee6ce", "neither": "#fde0dd"}


def draw(
    path: Path, found: dict[str, error_statistics.ErrorSeries], scenario: Scenario, start_ns: int
) -> None:
    """Write the plot to `path`; the suffix selects the format."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.2), layout="constrained")
    axes = figure.subplots()
    for phase in scenario.phases():
        axes.axvspan(phase.start_s / 60.0, phase.end_s / 60.0, color=SHADES[phase.name], lw=0)
        middle = (phase.start_s + phase.end_s) / 120.0
        axes.text(middle, 1.02, phase.name, ha="center", transform=axes.get_xaxis_transform(), fontsize=9)
    for source, colour in COLOURS.items():
        if source in found:
            e = found[source]
            minutes = (e.t_ns - start_ns) / 60e9
            style = {"ls": "", "marker": ".", "ms": 2.0} if "fix" in source else {"lw": 1.6}
            axes.plot(minutes, np.maximum(e.error, 0.1), color=colour, label=source, **style)
    corrected = found[error_statistics.CORRECTED]
    minutes = (corrected.t_ns - start_ns) / 60e9
    axes.plot(minutes, corrected.bound, color="#c51b8a", lw=1.4, label="guaranteed bound (r.m.s.)")
    axes.set(yscale="log", ylim=(0.1, 5000.0), xlim=(0.0, scenario.duration_s / 60.0))
    axes.set(xlabel="time of flight [min]", ylabel="horizontal error [m]")
    axes.grid(alpha=0.3, which="both", lw=0.5)
    axes.legend(loc="upper left", ncols=2, fontsize=9, markerscale=4.0)
    figure.savefig(path, dpi=110)
