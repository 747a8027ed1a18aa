"""Autopilot parameters that a configuration requires, from the table of output profiles."""

from __future__ import annotations

from companion.config.profiles import AGP_ID, MESSAGES, PROFILES, Needed
from companion.config.schema import Config


def needed(config: Config, autopilot: str | None = None) -> tuple[Needed, ...]:
    """The parameters that an autopilot must have for what `config` sends it, each once.

    `autopilot`, the make that is heard ("ardupilot", "px4"), counts under the profile "custom" alone, which
    means none by itself; other makes need nothing that we know of.
    """
    profile = PROFILES[config.output.profile]
    if config.output.profile == "custom":
        profile = next((p for name, p in PROFILES.items() if name == autopilot), profile)
    found: dict[str, Needed] = {}
    for via, way in profile.ways.items():
        if config.output.rates_hz[MESSAGES[via]] > 0.0:
            for parameter in way.parameters:
                if parameter.name == AGP_ID:
                    parameter = parameter._replace(value=config.output.global_position_sensor_id)
                found[parameter.name] = parameter
    return tuple(found.values())
