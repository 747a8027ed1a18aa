"""Real flights with a healthy GNSS and a failed airspeed, through the whole companion: no harm is done.

Without the companion the aircraft kept within 2 m. An older companion excluded GNSS in both: one flight ended
on the ground, the other 694 m off.
"""

from pathlib import Path

import pytest

from companion.records import Rejection, Solution
from sitl import harm_recordings

DATA = Path(__file__).parents[1] / "data"


@pytest.mark.parametrize("name", ["no_airspeed_sensor", "pitot_stuck"])
def test_healthy_gnss_is_kept_and_leads(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[harm_recordings.RecordingLog] = []

    def fly(*args, real=harm_recordings.fly_frames):
        flown.append(real(*args))
        return flown[-1]

    monkeypatch.setattr(harm_recordings, "fly_frames", fly)
    result = harm_recordings.fly_harm(DATA / f"{name}_cut.tlog.xz", DATA / f"{name}_cut.truth.csv.xz")
    records = flown[0].records
    assert sum(isinstance(r, Solution) for r in records) > 500
    assert flown[0].set_2_ns == [] and not result.harmful
    assert not result.excluded
    assert not [
        r
        for r in records
        if isinstance(r, Rejection) and r.reason.startswith("excluded") and r.source.startswith("gnss")
    ]
    assert result.refused_s <= harm_recordings.MOST_REFUSED_S
    assert result.truth_m is not None and result.truth_m < 3.0
    assert result.corrected_m is not None and result.corrected_m < 3.0
