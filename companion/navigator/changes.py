"""What changed in the state that leads, each change reported once.

Records are folded again behind late ones, and the same change may then follow from two records or from none
that is new. So no record reports what it changes: the state after it is compared with the last report.
"""

from __future__ import annotations

import math
import re

from companion.navigator.hypotheses import AIRSPEED, GNSS, VELOCITY
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.own_channel import SILENT_NS, Sensors, airspeed_is_sensed, is_switched_off
from companion.navigator.scatter import Scatter
from companion.navigator.state import EXCLUDED, FIXES, SUSPECT, Settings, State, source_name, sources
from companion.records import AirData, Event, Mode, Output, Severity, Solution, Source, Stamped
from companion.units import SECOND_NS

#: An autopilot checks its airspeed sensor against GPS only: ArduPlane dived to the ground for speed in 67 s.
FALSE_AIRSPEED = "switch the airspeed sensor off"
USE_AIRSPEED = {"ardupilot": ": ARSPD_USE 0", "px4": ": FW_USE_AIRSPD 0"}
UNFIT_ANSWERS = 10  # of a beacon, none of which fits, until it is reported
#: A sensor is reported as not used once it has not been for so long, and as used again once it has been. A
#: stream that is slow at the start is requested again within the first.
UNUSED_NS, USED_NS = 12 * SECOND_NS, 60 * SECOND_NS
STUCK_NS = 5 * SECOND_NS // 2  # stale readings of 1 Hz are reported every second or two


class _Use:
    """Why a sensor is not used, as last reported, and since when that is otherwise."""

    def __init__(self, name: str) -> None:
        self._name, self._why = name, ""  # without its numbers; empty while the sensor is used
        self._changed_ns: int | None = None

    def update(self, is_used: bool, why_not: str, t_ns: int) -> list[tuple[Severity, str]]:
        """Return the report that is due, if any; `why_not` is empty while the sensor is not expected."""
        why = "" if is_used else _kind(why_not)
        if why == self._why or not (is_used or why):
            self._changed_ns = None
            return []
        if self._changed_ns is None:
            self._changed_ns = t_ns
        if t_ns - self._changed_ns < (USED_NS if is_used else UNUSED_NS):
            return []
        self._why, self._changed_ns = why, None
        if is_used:
            return [(Severity.NOTICE, f"{self._name} is used again")]
        return [(Severity.WARNING, f"{self._name} is not used: {why_not}")]

    def is_reported(self, why_not: str) -> bool:
        """Whether this reason is the one that was last reported."""
        return self._why == _kind(why_not)


def _kind(why: str) -> str:
    return re.sub(r"[\d.]+", "", why)


class Changes:
    """What was last reported of sources, their scatter, sensors, the guaranteed bound and the mode."""

    def __init__(self) -> None:
        self._beliefs: tuple[int, ...] = ()  # `State.reported`, as far as it was announced
        self._scatter: dict[str, bool] = {}  # whether each source is noisy
        self._unfit: set[int] = set()  # beacons that are reported to fit nothing
        self._imu, self._pitot = _Use("IMU"), _Use("airspeed")
        self._stuck: AirData | None = None  # the last airspeed that was dropped as stale
        self._is_advised = False  # to switch the airspeed sensor off
        self._wider = False  # whether the guaranteed bound is
        self._mode = Mode.INITIALISING, Source(0)  # and the fixes that the solution rests on

    def of_state(self, state: State, record: Stamped, settings: Settings) -> list[Output]:
        """Return an event for each change of the state that leads, after `record`."""
        found: list[tuple[Severity, str]] = []
        beliefs = _announced(self._beliefs, state.reported)
        if beliefs != self._beliefs:
            found += _of_beliefs(self._beliefs, beliefs, state)
            self._beliefs = beliefs
        for name, scatter in state.scatter.items():
            if scatter.noisy != self._scatter.get(name, False):
                self._scatter[name] = scatter.noisy
                found.append((Severity.NOTICE, _of_scatter(name, scatter)))
        unfit = {beacon for beacon, answers in state.unfit if answers >= UNFIT_ANSWERS}
        for beacon in unfit - self._unfit:
            text = "is not used: no answer fits its stated place; check its number and its place"
            found.append((Severity.WARNING, f"rsbn {beacon} {text}"))
        self._unfit = unfit
        found += self._of_sensors(state, record.t_ns, settings)
        g = state.guarantee
        if g.anchored is not None and (g.widening > 1.0) != self._wider:
            self._wider = not self._wider
            found.append((Severity.NOTICE, _of_bound(g)))
        return [Event(record.t_ns, record.rx_ns, severity, text) for severity, text in found]

    def of_stale(self, record: Stamped) -> None:
        """Remember a record that was dropped as stale: no state shows it."""
        if isinstance(record, AirData):
            self._stuck = record

    def _of_sensors(self, state: State, t_ns: int, settings: Settings) -> list[tuple[Severity, str]]:
        """Report whether IMU and airspeed are used, once they came; the streams report what never does.

        Without GNSS nothing but this shows an autopilot that its airspeed sensor is false.
        """
        s, uses, imu, pitot, is_false = state.sensors, settings.config.uses, "", "", False
        if uses("imu") and s.strap.imu_pace.heard > 0 and s.is_silent("imu", t_ns):
            imu = s.strap.why or f"no new sample for {(t_ns - s.imu_ns) * 1e-9:.0f} s"
        if uses("air_data") and s.pitot_ns > 0 and s.ground.flying and not s.landed:
            pitot, is_false = _why_no_airspeed(s, self._stuck, t_ns)
        is_silent = t_ns - s.pitot_ns > SILENT_NS["air"]
        # excluded, it is not used again: without GNSS ArduPilot switches a failed sensor on
        is_excluded = not is_silent and self._beliefs[AIRSPEED : AIRSPEED + 1] == (EXCLUDED,)
        is_used = not is_silent and not is_excluded
        found = self._imu.update(not s.is_silent("imu", t_ns), imu, t_ns) + self._pitot.update(
            is_used, pitot if is_silent else "", t_ns
        )
        if not ((is_excluded and s.ground.flying) or (is_false and self._pitot.is_reported(pitot))):
            self._is_advised = self._is_advised and not is_used
        elif not self._is_advised and not sources(state, t_ns, settings) & Source.GNSS:
            self._is_advised = True
            found.append((Severity.WARNING, _advice(settings)))
        return found

    def of_mode(self, solution: Solution) -> list[Output]:
        """Return an event if the mode of a solution is another, or the fixes that it rests on are."""
        mode = solution.mode, solution.sources & FIXES
        if mode == self._mode:
            return []
        self._mode = mode
        fixes = [s.name.lower() for s in Source if s.name and s & FIXES & solution.sources]
        if solution.mode is Mode.FIXED:
            why = " and ".join(fixes) + " fixes"
        elif solution.protection is not None:
            why = f"no fixes; protection level {solution.protection:.0f} m"
        else:
            why = "no fixes"
        severity = Severity.WARNING if solution.mode is Mode.UNTRUSTED else Severity.NOTICE
        return [Event(solution.t_ns, solution.rx_ns, severity, f"navigation {solution.mode}: {why}")]


def _why_no_airspeed(s: Sensors, stuck: AirData | None, t_ns: int) -> tuple[str, bool]:
    """Why no airspeed is used, and whether it is false while the autopilot uses it."""
    air = s.air.air
    if is_switched_off(s, t_ns):
        return "the autopilot does not use its sensor", False
    if stuck is not None and t_ns - stuck.t_ns <= STUCK_NS and (air is None or air.t_ns < stuck.t_ns):
        return f"it stands still at {stuck.airspeed:.0f} m/s", True
    if air is None or t_ns - air.t_ns > SILENT_NS["air"]:
        return f"no new reading for {(t_ns - s.pitot_ns) * 1e-9:.0f} s", False
    if not airspeed_is_sensed(s, air):
        return "the autopilot calls its sensor unhealthy", False
    return f"{air.airspeed:.0f} m/s is too low for the speed over ground", True


def _advice(settings: Settings) -> str:
    return FALSE_AIRSPEED + USE_AIRSPEED.get(settings.config.output.profile, "")


def _announced(before: tuple[int, ...], now: tuple[int, ...]) -> tuple[int, ...]:
    """Return what is reported `now`; the velocity of GNSS is not used again while GNSS is in doubt."""
    if len(before) <= VELOCITY or len(now) <= VELOCITY or not now[GNSS] or now[VELOCITY]:
        return now
    return (*now[:VELOCITY], before[VELOCITY], *now[VELOCITY + 1 :])


def _of_beliefs(before: tuple[int, ...], after: tuple[int, ...], state: State) -> list[tuple[Severity, str]]:
    found: list[tuple[Severity, str]] = []
    for i, (now, p) in enumerate(zip(after, state.false, strict=True)):
        if now == (before[i] if i < len(before) else 0):
            continue
        text = {
            0: "is used again" if i < len(before) and before[i] == EXCLUDED else "is no longer suspect",
            SUSPECT: f"is suspect: false with probability {p:.2f}",
            EXCLUDED: f"is excluded: false with probability {p:.4f}",
        }[now]
        severity = Severity.WARNING if now else Severity.NOTICE
        found.append((severity, f"{source_name(i, state)} {text}"))
    return found


def _of_scatter(name: str, scatter: Scatter) -> str:
    if not scatter.noisy:
        return f"{name} scatters as it states again"
    return f"{name} scatters {math.sqrt(scatter.factor):.1f} times as much as it states: used with that sigma"


def _of_bound(g: Guarantee) -> str:
    if g.widening <= 1.0:
        return "fixes of the window agree with the stated errors again"
    return f"fixes of the window contradict the stated errors: guaranteed bound {g.widening:.1f} times wider"
