"""Frames as their receivers have them."""

from __future__ import annotations

from companion.link import dialect, frame


def parsed(data: bytes) -> frame.Frame:
    """Return the frame that `data` holds."""
    found = frame.parse(data)
    assert isinstance(found, frame.Frame)
    return found


def on_wire(message: dialect.Message, system: int, component: int) -> frame.Frame:
    """Return the frame of a message from a sender."""
    return parsed(frame.encode(message, 0, system, component))
