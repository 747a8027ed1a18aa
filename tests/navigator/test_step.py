"""What each kind of record is good for, by the configuration."""

import pytest

from companion.config import Config, InertialConfig
from companion.navigator.hypotheses import Model
from companion.navigator.state import Settings
from companion.navigator.step import uses
from companion.records import Imu, LocalPosition


@pytest.mark.parametrize("source", ["auto", "imu", "air_data", "local_position"])
def test_a_sensor_that_may_not_be_used_is_not_read(source: str) -> None:
    """Its late samples would make the navigator go back for nothing."""
    config = Config(inertial=InertialConfig(source=source))  # type: ignore[arg-type]
    used = uses(Settings(config, Model(config)))
    assert (Imu in used) == (source in ("auto", "imu"))
    assert (LocalPosition in used) == (source == "local_position")
