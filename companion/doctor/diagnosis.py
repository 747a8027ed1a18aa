"""Diagnosis: the findings of `companion doctor` on the autopilot, its parameters, the link and the machine.

Values only: `examination` observes, `rendering` shows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set
from typing import NamedTuple

from companion.config import Config
from companion.config.profiles import PROFILES, FailsafeLimit, RequiredParameter
from companion.link.decode import FIXED_WINGS, MULTIROTORS
from companion.link.parameter_client import Value, equal_real32
from companion.runtime.input_monitor import stream_states

#: ArduPilot's text after VISO_TYPE was set and before the reboot.
NOT_REBOOTED = "VisOdom: out of memory"
#: What to check of a stream that is too slow, and of one of which nothing arrives.
SLOW = "the line is too slow, or a ground station sets other rates"
NOTHING = "nothing arrives: the sensor (for positions of the EKF: a fix) is missing, or a router drops it"
#: Index of the source in PX4's ESTIMATOR_SENSOR_FUSION_STATUS that a message of ours is.
PX4_SOURCES = {"GLOBAL_POSITION_SENSOR": 3, "ODOMETRY": 2, "VISION_POSITION_ESTIMATE": 2}
#: The finding on other autopilots: nothing is set on the one that happens to come first.
SEVERAL = "autopilots"


class ParameterFinding(NamedTuple):
    """Required parameter and the autopilot's value; None if not read, with the reason in `trouble`."""

    need: RequiredParameter
    has: Value | None
    trouble: str

    @property
    def is_well(self) -> bool:
        """Whether the autopilot has the required value."""
        return equal_real32(self.has, self.need.value)


class Finding(NamedTuple):
    """Finding about the link or the machine; with `is_well` None for information only."""

    what: str
    found: str
    needs: str
    is_well: bool | None
    advice: str = ""


class Identity(NamedTuple):
    """Identity of the autopilot; `make` is the name of a profile or "other", `version` empty if unknown."""

    system: int
    make: str
    vehicle: str
    version: str
    is_armed: bool


class Diagnosis(NamedTuple):
    """All findings of one examination."""

    identity: Identity
    parameters: tuple[ParameterFinding, ...]
    findings: tuple[Finding, ...]

    @property
    def wrong_parameters(self) -> tuple[ParameterFinding, ...]:
        """The parameters without the required value."""
        return tuple(p for p in self.parameters if not p.is_well)

    @property
    def problems(self) -> tuple[Finding, ...]:
        """The other findings that are not well."""
        return tuple(f for f in self.findings if f.is_well is False)

    @property
    def is_well(self) -> bool:
        """Whether all requirements are met."""
        return not self.wrong_parameters and not self.problems

    def changed_from(self, before: Diagnosis) -> tuple[str, ...]:
        """Return the names of the parameters whose value changed since `before`."""
        pairs = zip(before.parameters, self.parameters)
        return tuple(new.need.name for old, new in pairs if old.has != new.has)


def check_profile(config: Config, make: str) -> list[Finding]:
    """Report an output profile of another make of autopilot."""
    if config.output.fits(make):
        return []
    advice = f"set output.profile = '{make if make in PROFILES else 'monitor'}'"
    return [Finding("output profile", config.output.profile, make, False, advice)]


def check_airspeed(config: Config, healthy: bool | None, vehicle_type: int = 0) -> list[Finding]:
    """Report whether airspeed is measured; `healthy` None where the autopilot did not report it.

    A multirotor's drag is its airspeed; that of a fixed wing without a sensor is taken for steady.
    """
    if config.has_own_ins or not config.uses("air_data"):
        return []
    by_drag = vehicle_type in MULTIROTORS and config.air_data.rotor_drag_per_s and config.uses("imu")
    if by_drag and not healthy:
        return [Finding("airspeed sensor", "none: by the drag of the rotors, in the air", "", None)]
    if healthy is None:
        text = "not reported: not used"
    elif healthy:
        text = "healthy"
    elif vehicle_type in FIXED_WINGS:
        text = "none: taken for steady in the air"
    else:
        text = f"none: reckoning by {'IMU' if config.uses('imu') else 'the last velocity'} only"
    advice = "" if healthy else "without GNSS the wind cannot be separated from the error: add a sensor"
    return [Finding("airspeed sensor", text, "", None, advice)]


def check_failsafe(limits: Iterable[FailsafeLimit], values: Mapping[str, Value | None]) -> list[Finding]:
    """Report the limits by which the autopilot would not fly on without GNSS."""
    return [
        Finding(limit.name, limit.otherwise.format(f"{has:.10g}"), f"{limit.value:.10g} to fly on", None)
        for limit in limits
        if (has := values.get(limit.name)) is not None and not limit.is_met(has)
    ]


def check_script(config: Config, make: str, runs: bool) -> list[Finding]:
    """Report whether the autopilot's script can select source set 1 if the companion fails."""
    if make != "ardupilot" or not config.output.switches_sources:
        return []
    absent = "does not run: if the companion fails, the pilot must select set 1 (deploy/ardupilot)"
    return [Finding("source set script", "runs" if runs else absent, "", None)]


def check_arming(make: str, failing: Set[str], is_answering: bool) -> list[Finding]:
    """Report the arming checks that fail, and a parameter that waits for a reboot."""
    if make != "ardupilot" or not is_answering:
        return []
    found = [Finding("arming checks", "; ".join(sorted(failing)) or "none fails", "", None)]
    if any(text.startswith(NOT_REBOOTED) for text in failing):
        advice = "reboot the autopilot: VISO_TYPE takes effect after it"
        found.append(Finding("reboot", "needed", "done", False, advice))
    return found


def check_fusion(config: Config, make: str, intended: Sequence[int]) -> list[Finding]:
    """Report whether PX4 is set to fuse our position; `intended` as in ESTIMATOR_SENSOR_FUSION_STATUS.

    For right parameters: they may wait for a reboot, and EKF2_SENS_EN, or a command, may leave it out.
    """
    rates = config.output.rates_hz
    source = next((index for message, index in PX4_SOURCES.items() if rates[message] > 0.0), None)
    if make != "px4" or source is None or not intended:
        return []
    advice = "reboot the autopilot; if it stays off, EKF2_SENS_EN switches this source off"
    is_on = bool(intended[source] & 1)
    return [Finding("fusion of our position", "on" if is_on else "off", "on", is_on, advice)]


def check_answers(is_answering: bool, is_signing: bool) -> list[Finding]:
    """Report an autopilot that answers nothing; one that signs drops what is not signed by its key."""
    if is_answering:
        return []
    if is_signing:
        advice = "the autopilot wants signed frames: set signing.key_file to its key"
        return [Finding("signing", "no answer to our frames", "signed", False, advice)]
    advice = "no request arrives: check the line from our TX, the port's MAVLink protocol and the router"
    return [Finding("answers", "none", "to our requests", False, advice)]


def check_feeders(feeders: Set[str]) -> list[Finding]:
    """Report others that send positions to the autopilot's estimator."""
    advice = "only one may feed the autopilot: stop the other"
    return (
        [Finding("other position source", ", ".join(sorted(feeders)), "none", False, advice)]
        if feeders
        else []
    )


def check_streams(
    config: Config, make: str, rates: Mapping[int, tuple[float, float | None]], is_answering: bool
) -> list[Finding]:
    """Compare requested and measured stream rates; they are not judged where no request is answered.

    `rates` has both by message id, Hz; measured None is not known yet.
    """
    found = []
    for state in stream_states(config, make, rates):
        is_well = state.is_enough or (False if state.is_used and is_answering else None)
        advice = "" if state.is_enough else SLOW if state.measured else NOTHING
        has, needs = f"{state.measured or 0.0:.1f} Hz", f"{state.requested:g} Hz"
        found.append(Finding(state.name, has, needs, is_well, advice))
    return found
