"""Message rates wanted of an autopilot: asked for, watched, asked for again. Pure; knows no link.

A rate may be refused, lost with the command, or overwritten by a ground station at any time, and an
acknowledgement does not say which message it means. So what counts is what arrives: every message has its
window (5 s, or three intervals of a slow one); when less than 70 % of the wanted number came in it, it is
asked for again, after 5, 10, 20 ... 60 s as long as asking does not help. (Autopilots round: asked 50 Hz,
ArduPilot gives 40.) More than was asked is somebody else's wish and let be.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

SECOND = 1_000_000_000
WINDOW = 5 * SECOND
LONGEST_PAUSE = 60 * SECOND
ENOUGH = 0.7


@dataclass(slots=True)
class Stream:
    """One wanted message."""

    rate_hz: float
    window: int
    count: int = 0
    since: int = 0
    check_at: int = 0
    pause: int = 0
    measured_hz: float | None = None


class Streams:
    """The wanted rates (Hz) by message id. Idle until `start`."""

    def __init__(self, rates_hz: Mapping[int, float]) -> None:
        self._streams: dict[int, Stream] = {}
        self._running = False
        self.want(rates_hz, 0)

    def want(self, rates_hz: Mapping[int, float], now: int) -> None:
        """Want these from now on: what is new is asked for at the next `due`. ValueError if impossible."""
        before, self._streams = self._streams, {}
        for msgid, rate in rates_hz.items():
            if not 0 < rate <= 1000:
                raise ValueError(f"a rate of {rate} Hz for message {msgid} is not between 0 and 1000 Hz")
            stream = before.get(msgid)
            if stream is None or stream.rate_hz != rate:
                stream = Stream(rate, max(WINDOW, int(3 * SECOND / rate)), since=now, check_at=now)
            self._streams[msgid] = stream

    def start(self, now: int) -> None:
        """Ask for everything at the next `due`: the autopilot has come, come back or rebooted."""
        self._running = True
        for stream in self._streams.values():
            stream.count, stream.since, stream.check_at, stream.pause = 0, now, now, 0
            stream.measured_hz = None

    def stop(self) -> None:
        """Ask for nothing: the autopilot is gone."""
        self._running = False

    def heard(self, msgid: int) -> None:
        """Count an arrival."""
        if (stream := self._streams.get(msgid)) is not None:
            stream.count += 1

    def deadline(self) -> int | None:
        """Return when `due` is next worth calling."""
        if not self._running or not self._streams:
            return None
        return min([stream.check_at for stream in self._streams.values()])

    def due(self, now: int) -> list[tuple[int, float]]:
        """Return the (message id, rate) to ask for now, and begin the next windows."""
        asked = []
        if self._running:
            for msgid, stream in self._streams.items():
                if stream.check_at <= now and self._check(stream, now):
                    asked.append((msgid, stream.rate_hz))
        return asked

    def rates(self) -> dict[int, tuple[float, float | None]]:
        """Return by message id the rate wanted and the one last measured (None: not yet), Hz."""
        return {msgid: (s.rate_hz, s.measured_hz) for msgid, s in self._streams.items()}

    def _check(self, stream: Stream, now: int) -> bool:
        elapsed = now - stream.since
        if elapsed >= stream.window:
            stream.measured_hz = stream.count * SECOND / elapsed
        enough = stream.measured_hz is not None and stream.measured_hz >= ENOUGH * stream.rate_hz
        stream.pause = (
            0 if enough else min(max(2 * stream.pause, stream.window), max(LONGEST_PAUSE, stream.window))
        )
        stream.count, stream.since = 0, now
        stream.check_at = now + max(stream.pause, stream.window)
        return not enough
