"""What `companion doctor` finds, as values: who the autopilot is, its parameters, the link and the machine.

It knows neither how anything is observed (`examination`) nor how it is shown (`doctor`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from companion.config import Config
from companion.config.profiles import PROFILES, Needed
from companion.link.dialect import TYPES
from companion.link.parameter_client import Value, same
from companion.link.stream_rates import ENOUGH
from companion.navigator.step import uses
from companion.records import AirData, Attitude, Gnss, Imu, LocalPosition, Pressure

#: Messages that a make does not have; its other ones tell the same.
LACKING = {
    "ardupilot": frozenset({"HIGHRES_IMU"}),
    "px4": frozenset({"RAW_IMU", "EKF_STATUS_REPORT", "SIM_STATE"}),
}
#: What the navigator makes of which stream: one that its inertial channel does not use may be missing.
READ_AS: Mapping[str, type] = {
    "RAW_IMU": Imu,
    "HIGHRES_IMU": Imu,
    "LOCAL_POSITION_NED": LocalPosition,
    "GPS_RAW_INT": Gnss,
    "ATTITUDE": Attitude,
    "VFR_HUD": AirData,
    "SCALED_PRESSURE": Pressure,
}
LOGGED = frozenset({"EKF_STATUS_REPORT", "SIM_STATE"})


class ParameterFinding(NamedTuple):
    """A parameter that the profile needs, and what the autopilot has: None, and `trouble` says why."""

    need: Needed
    has: Value | None
    trouble: str

    @property
    def is_well(self) -> bool:
        """Whether it has what it needs."""
        return same(self.has, self.need.value)


class Finding(NamedTuple):
    """One line about the link or the machine; `is_well` None is for information."""

    what: str
    found: str
    needs: str
    is_well: bool | None
    advice: str = ""


class Identity(NamedTuple):
    """Who the autopilot is; `make` as profiles are called ("other": neither), empty where not told."""

    system: int
    make: str
    vehicle: str
    version: str
    is_armed: bool


class Diagnosis(NamedTuple):
    """All that was found."""

    identity: Identity
    parameters: tuple[ParameterFinding, ...]
    findings: tuple[Finding, ...]

    @property
    def wrong(self) -> tuple[ParameterFinding, ...]:
        """The parameters that are not as needed."""
        return tuple(p for p in self.parameters if not p.is_well)

    @property
    def amiss(self) -> tuple[Finding, ...]:
        """What else is not as needed."""
        return tuple(f for f in self.findings if f.is_well is False)

    @property
    def is_well(self) -> bool:
        """Whether nothing is missing."""
        return not self.wrong and not self.amiss

    def changed_from(self, before: Diagnosis) -> tuple[str, ...]:
        """The parameters that are not what they were."""
        pairs = zip(before.parameters, self.parameters)
        return tuple(new.need.name for old, new in pairs if old.has != new.has)


def of_profile(config: Config, make: str) -> list[Finding]:
    """What there is to say of a profile that is for another make."""
    profile = config.output.profile
    if profile in ("monitor", "custom", make):
        return []
    advice = f"set output.profile = '{make if make in PROFILES else 'monitor'}'"
    return [Finding("output profile", profile, make, False, advice)]


def of_streams(config: Config, make: str, rates: Mapping[int, tuple[float, float | None]]) -> list[Finding]:
    """What comes of what was asked for: `rates` are asked and measured (None: not yet), Hz, by message id."""
    found, used = [], uses(config.channel)
    for msgid, (asked, measured) in rates.items():
        name = TYPES[msgid].name
        if name in LACKING.get(make, ()):
            continue
        comes = (measured or 0.0) >= ENOUGH * asked
        idle = name in LOGGED or (name in READ_AS and READ_AS[name] not in used)
        is_well = comes or (None if idle else False)
        advice = "" if comes else "too slow a line, or a ground station that sets other rates"
        found.append(Finding(name, f"{measured or 0.0:.1f} Hz", f"{asked:g} Hz", is_well, advice))
    return found
