"""Autopilot parameters that concern a configuration, from the table of output profiles."""

from __future__ import annotations

from companion.config.profiles import AGP_ID, MESSAGES, PROFILES, FailsafeLimit, Profile, RequiredParameter
from companion.config.schema import Config


def required_parameters(config: Config, autopilot: str | None = None) -> tuple[RequiredParameter, ...]:
    """Return the parameters that the autopilot needs for the output of `config`, without duplicates.

    `autopilot`, the connected make ("ardupilot", "px4"), is used for the profile "custom" only, which states
    no make itself. Other makes have no known requirements.
    """
    profile = _profile(config, autopilot)
    found: dict[str, RequiredParameter] = {}
    for via, method in profile.methods.items():
        if config.output.rates_hz[MESSAGES[via]] > 0.0:
            for parameter in method.parameters:
                if parameter.name == AGP_ID:
                    parameter = parameter._replace(value=config.output.global_position_sensor_id)
                found[parameter.name] = parameter
    return tuple(found.values())


def failsafe_limits(config: Config, autopilot: str, hovers: bool) -> tuple[FailsafeLimit, ...]:
    """Return the limits of the failsafe of the make `autopilot` that matter if it is fed by `config`.

    `hovers`: it is a multirotor, or a VTOL with a wing.
    """
    if not config.output.feeds_estimator:
        return ()
    limits = _profile(config, autopilot).failsafe
    return tuple(limit for limit in limits if hovers or not limit.hovering)


def _profile(config: Config, autopilot: str | None) -> Profile:
    profile = PROFILES[config.output.profile]
    if config.output.profile == "custom":
        profile = next((p for name, p in PROFILES.items() if name == autopilot), profile)
    return profile
