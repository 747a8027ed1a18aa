"""Firmware version of an autopilot, as AUTOPILOT_VERSION states it."""

from __future__ import annotations

from typing import NamedTuple

from companion.link.dialect import Message, mavlink

STAGES = {
    mavlink.FIRMWARE_VERSION_TYPE_DEV: "-dev",
    mavlink.FIRMWARE_VERSION_TYPE_ALPHA: "-alpha",
    mavlink.FIRMWARE_VERSION_TYPE_BETA: "-beta",
    mavlink.FIRMWARE_VERSION_TYPE_RC: "-rc",
    mavlink.FIRMWARE_VERSION_TYPE_OFFICIAL: "",
}


class Firmware(NamedTuple):
    """Version numbers; `stage` is FIRMWARE_VERSION_TYPE."""

    major: int
    minor: int
    patch: int
    stage: int

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}{STAGES.get(self.stage, '')}"


def firmware_of(message: Message) -> Firmware | None:
    """Return the version of an AUTOPILOT_VERSION; None if it states none."""
    stated = message.flight_sw_version
    return Firmware(*(stated >> shift & 255 for shift in (24, 16, 8, 0))) if stated else None
