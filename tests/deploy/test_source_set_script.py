"""The script for ArduPilot's side, run by a Lua interpreter against a simulated autopilot.

Truths: it acts only while set 2 leads by external navigation, ODOMETRY is silent and GPS has a fix; once per
silence; never against the pilot's switch.
"""

from pathlib import Path
from typing import Any

import pytest
from lupa.lua53 import LuaRuntime

SCRIPT = Path(__file__).parents[2] / "deploy" / "ardupilot" / "companion_source_set.lua"
BINDINGS = """
function millis() return {tofloat = function() return world.now end} end
gps = {GPS_OK_FIX_3D = 3}
function gps:num_sensors() return world.receivers end
function gps:primary_sensor() return 0 end
function gps:status(instance) return world.fix end
ahrs = {}
function ahrs:get_posvelyaw_source_set() return world.set - 1 end
function ahrs:set_posvelyaw_source_set(set) world.set = set + 1; world.choices = world.choices + 1 end
visual_odom = {}
function visual_odom:healthy() return world.now - world.odometry <= 300 end
rc = {}
function rc:get_aux_cached(option) assert(option == 90); return world.switch end
param = {}
function param:get(name) assert(name == "EK3_SRC2_POSXY"); return world.posxy end
gcs = {}
function gcs:send_text(severity, text) world.text = text end
function gcs:send_named_float(name, value) assert(name == "EKFSRC"); world.report = value end
"""


class Autopilot:
    """ArduPilot as the script sees it; `fly` calls the script when it asks for it."""

    def __init__(self, **changes: Any) -> None:
        lua = LuaRuntime(unpack_returned_tuples=True)
        start = {"now": 0.0, "receivers": 1, "fix": 3, "set": 2, "choices": 0, "odometry": 0.0, "posxy": 6}
        self.world = lua.table_from({**start, "switch": None, "text": "", "report": 0, **changes})
        lua.globals().world = self.world
        lua.execute(BINDINGS)
        self.update, self.period = lua.execute(SCRIPT.read_text(encoding="utf-8"))

    def fly(self, seconds: float, odometry: bool = True) -> "Autopilot":
        end = self.world.now + 1e3 * seconds
        while self.world.now < end:
            self.world.now += self.period
            if odometry:
                self.world.odometry = self.world.now
            self.update, self.period = self.update()
        return self


def test_set_1_after_3_s_without_odometry() -> None:
    autopilot = Autopilot().fly(30.0)
    assert (autopilot.world.set, autopilot.world.report) == (2, 2)
    autopilot.fly(2.9, odometry=False)
    assert autopilot.world.set == 2
    autopilot.fly(2.0, odometry=False)
    assert (autopilot.world.set, autopilot.world.report) == (1, -1)
    assert autopilot.world.text == "EKF source set 1: no ODOMETRY, GPS has a fix"


def test_set_1_once_gps_has_had_a_fix_for_3_s() -> None:
    autopilot = Autopilot(fix=1).fly(10.0).fly(60.0, odometry=False)
    assert autopilot.world.set == 2
    autopilot.world.fix = 3
    assert autopilot.fly(2.9, odometry=False).world.set == 2
    assert autopilot.fly(0.3, odometry=False).world.set == 1


@pytest.mark.parametrize(
    "changes", [{"switch": 1}, {"switch": 2}, {"posxy": 3}, {"set": 1}, {"set": 3}, {"receivers": 0}]
)
def test_it_does_nothing_otherwise(changes: dict[str, Any]) -> None:
    autopilot = Autopilot(**changes).fly(10.0).fly(60.0, odometry=False)
    assert autopilot.world.choices == 0
    assert autopilot.world.report == autopilot.world.set


def test_pilots_switch_at_set_1_is_no_obstacle() -> None:
    assert Autopilot(switch=0).fly(10.0).fly(10.0, odometry=False).world.set == 1


def test_a_persons_second_choice_stands() -> None:
    autopilot = Autopilot().fly(10.0).fly(10.0, odometry=False)
    autopilot.world.set = 2
    autopilot.fly(60.0, odometry=False)
    assert (autopilot.world.set, autopilot.world.report) == (2, 2)
    autopilot.fly(5.0).fly(10.0, odometry=False)  # a new silence
    assert autopilot.world.set == 1


def test_short_gaps_change_nothing() -> None:
    autopilot = Autopilot()
    for _ in range(20):
        autopilot.fly(1.0).fly(2.5, odometry=False)
    assert autopilot.world.choices == 0
