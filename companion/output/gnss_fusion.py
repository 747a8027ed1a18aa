"""GNSS fusion of PX4, switched off while GNSS is held false. No I/O.

PX4 has no source sets: it fuses GNSS and our position at once, so a false GNSS draws it off. Its estimator
takes MAV_CMD_ESTIMATOR_SENSOR_ENABLE (development.xml of 2026; PR 26739 proposed 43005). GNSS is switched
off only if it is false by the same predicate as on ArduPilot, never because it is lost: if the companion then
failed, it would stay off. That it is lost is only reported. An autopilot that does not know the command is
reported.

PX4 reports the state in ESTIMATOR_SENSOR_FUSION_STATUS. If the first reports state that it is off, a
companion that failed may have left it so, and PX4 stored it at landing: it is switched on once. What somebody
else switches from then on is left as it is.

What the companion switched off is on while disarmed: PX4 stores it in EKF2_SENS_EN then, and when it disarms.
The next flight would begin without GNSS.
"""

from __future__ import annotations

import math

from companion.link.dialect import Message
from companion.output.source_switch import REPORTS, Selected, SourceSwitch
from companion.output.source_table import (
    COMPANION_SET,
    GNSS_LOST,
    GNSS_SET,
    STEADY_S,
    TO_GNSS,
    Situation,
    is_held_false,
)
from companion.records import Severity

ESTIMATOR_SENSOR_ENABLE = 43006
"""MAV_CMD_ESTIMATOR_SENSOR_ENABLE: source, instance, enable, estimator instance. Not in the dialect yet."""
_GNSS, _FIRST = 0.0, 0.0  # ESTIMATOR_SENSOR_FUSION_SOURCE_GPS, the first receiver


class GnssFusion(SourceSwitch):
    """Fusion of PX4's first receiver; on at the start, or switched on."""

    command = ESTIMATOR_SENSOR_ENABLE
    is_silence_judged = False

    def __init__(self) -> None:
        super().__init__()
        self._wanted = self._leading = GNSS_SET
        self._is_disarmed = False
        self._is_start = True  # until the state is reported
        self._is_lost = False  # GNSS, as last reported

    @staticmethod
    def selected(message: Message, from_autopilot: bool, system: int) -> Selected | None:
        """Return what PX4 reports in `message`, else None."""
        if not from_autopilot or message.get_type() != "ESTIMATOR_SENSOR_FUSION_STATUS":
            return None
        return Selected(GNSS_SET if message.intended[0] & 1 else COMPANION_SET, is_report=True)

    def note_armed(self, is_armed: bool) -> None:
        """Note whether the autopilot is armed."""
        self._is_disarmed = not is_armed

    def update(self, now_ns: int, lack: str = "", is_lossy: bool = False) -> None:
        """Decide, and report that GNSS is lost or back: without a command no text of a switch does."""
        super().update(now_ns, lack, is_lossy)
        s = self.situation(now_ns)
        back = TO_GNSS[0]
        if not self._is_lost and s.sent_s >= STEADY_S and GNSS_LOST.holds(s):
            self._is_lost = True
            self._add_event(Severity.NOTICE, GNSS_LOST.reason, now_ns)
        elif self._is_lost and back.holds(s):
            self._is_lost = False
            self._add_event(Severity.NOTICE, back.reason, now_ns)

    def required(self, s: Situation) -> tuple[int, str] | None:
        """Return `COMPANION_SET` where GNSS must be off, `GNSS_SET` where on, and the reason."""
        if self._is_disarmed:
            return GNSS_SET, "disarmed"
        if is_held_false(s):
            return (COMPANION_SET, "GNSS is false, using companion") if s.sent_s >= STEADY_S else None
        reasons = [each.reason for each in TO_GNSS if s.fix_s >= 0.0 and each.holds(s)]
        return (GNSS_SET, reasons[0]) if reasons else None

    def handle_selected(self, by: Selected, now_ns: int) -> None:
        """Process PX4's report; a source set is ignored: PX4 has none, and answers "unsupported"."""
        if not by.is_report:
            return
        super().handle_selected(by._replace(by_script=self._is_start), now_ns)
        self._is_start = self._is_start and self._reports < REPORTS

    def name(self, number: int | None) -> str:
        """Return how a state is reported."""
        return "GNSS fusion off" if number == COMPANION_SET else "GNSS fusion on"

    def parameters(self, number: int | None) -> dict[str, float | None]:
        """Return the parameters of the command."""
        is_on = float(number == GNSS_SET)
        return {"param1": _GNSS, "param2": _FIRST, "param3": is_on, "param4": math.nan}

    def _give_up(self, why: str, now_ns: int) -> None:
        """Report it, unless fusion was never off: firmware that has no such command fuses GNSS."""
        if self._wanted == GNSS_SET and not self.is_on_companion:
            self._next_ns = None
        else:
            super()._give_up(why, now_ns)
