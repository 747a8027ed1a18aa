"""Message rates requested from an autopilot: request, measure, request again. Pure; knows no link.

A request may be refused, lost, or overwritten by a ground station at any time. Only the measured rate counts.
Every message has a measuring window (5 s, or three intervals of a slow message). If less than 70 % of the
requested number arrived in the window, the rate is requested again, after 5, 10, 20 ... 60 s as long as
the request has no effect. The limit is 70 % because autopilots round: at 50 Hz requested ArduPilot sends 40.
A rate above the requested one is left as it is.

A rate that the autopilot has never reached since it appeared is requested twice (once if it refused), then
half of it, and so on; below `LEAST_HZ` no more. ArduPilot answers each request of more than 0.8 of
SCHED_LOOP_RATE with a line of text on every ground station, and leaves the stream at 1 Hz.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from companion.units import SECOND_NS

WINDOW = 5 * SECOND_NS
MAX_PAUSE = 60 * SECOND_NS
ENOUGH = 0.7
TRIES = 2
LEAST_HZ = 0.5


@dataclass(slots=True)
class StreamRate:
    """One requested message rate and its measurement.

    `asked_hz` is the rate of the next request: `rate_hz`, or less where that was refused; 0: no more. `tries`
    counts the requests at this rate while it has not been reached.
    """

    rate_hz: float
    window: int
    asked_hz: float = 0.0
    tries: int = 0
    is_reached: bool = False
    count: int = 0
    since: int = 0
    check_at: int = 0
    pause: int = 0
    measured_hz: float | None = None


class StreamRates:
    """Requested rates (Hz) by message id. Idle until `start`."""

    def __init__(self, rates_hz: Mapping[int, float]) -> None:
        self._rates: dict[int, StreamRate] = {}
        self._running = False
        self.set_rates(rates_hz, 0)

    def set_rates(self, rates_hz: Mapping[int, float], now: int) -> None:
        """Replace the requested rates; new ones are requested at the next `due`.

        Raises
        ------
        ValueError
            If a rate is not between 0 and 1000 Hz.
        """
        before, self._rates = self._rates, {}
        for msgid, rate in rates_hz.items():
            if not 0 < rate <= 1000:
                raise ValueError(f"a rate of {rate} Hz for message {msgid} is not between 0 and 1000 Hz")
            stream = before.get(msgid)
            if stream is None or stream.rate_hz != rate:
                window = max(WINDOW, int(3 * SECOND_NS / rate))
                stream = StreamRate(rate, window, asked_hz=rate, since=now, check_at=now)
            self._rates[msgid] = stream

    def start(self, now: int) -> None:
        """Request every rate at the next `due`: the autopilot appeared, returned or rebooted."""
        self._running = True
        for stream in self._rates.values():
            stream.count, stream.since, stream.check_at, stream.pause = 0, now, now, 0
            stream.measured_hz, stream.asked_hz, stream.tries = None, stream.rate_hz, 0
            stream.is_reached = False

    def stop(self) -> None:
        """Request nothing: the autopilot is lost."""
        self._running = False

    def count(self, msgid: int) -> None:
        """Count one received message."""
        if (stream := self._rates.get(msgid)) is not None:
            stream.count += 1

    def deadline(self) -> int | None:
        """Return when `due` must be called next."""
        if not self._running or not self._rates:
            return None
        return min([stream.check_at for stream in self._rates.values()])

    def due(self, now: int) -> list[tuple[int, float]]:
        """Return the (message id, rate) to request now, and start the next windows."""
        due = []
        if self._running:
            for msgid, stream in self._rates.items():
                if stream.measured_hz == 0.0 and stream.count and stream.check_at - now > stream.window:
                    # it arrives again: measure now, not at the end of a long pause
                    stream.count, stream.since, stream.check_at = 0, now, now + stream.window
                elif self._is_enough(stream, now):
                    stream.check_at = now  # likewise
                if stream.check_at <= now and self._check(stream, now):
                    due.append((msgid, stream.asked_hz))
        return due

    def refuse(self, msgid: int) -> None:
        """Note that the autopilot refused the last request: it is not repeated."""
        if (stream := self._rates.get(msgid)) is not None:
            stream.tries = max(stream.tries, TRIES)

    def rates(self) -> dict[int, tuple[float, float | None]]:
        """Return the requested and the last measured rate (None: not measured yet), Hz, by message id."""
        return {msgid: (s.rate_hz, s.measured_hz) for msgid, s in self._rates.items()}

    @staticmethod
    def _is_enough(stream: StreamRate, now: int) -> bool:
        """Whether `stream` has arrived as often as requested, for a window at least since the last check."""
        elapsed = now - stream.since
        return elapsed >= stream.window and stream.count * SECOND_NS >= ENOUGH * stream.asked_hz * elapsed

    def _check(self, stream: StreamRate, now: int) -> bool:
        """Close the window of `stream`; return whether its rate must be requested again."""
        elapsed = now - stream.since
        if elapsed >= stream.window:
            stream.measured_hz = stream.count * SECOND_NS / elapsed
        enough = stream.measured_hz is not None and stream.measured_hz >= ENOUGH * stream.asked_hz
        stream.pause = (
            0 if enough else min(max(2 * stream.pause, stream.window), max(MAX_PAUSE, stream.window))
        )
        stream.count, stream.since = 0, now
        stream.check_at = now + max(stream.pause, stream.window)
        if enough:
            stream.is_reached, stream.tries = stream.asked_hz > 0.0, 0
            return False
        if not stream.is_reached and stream.tries >= TRIES:
            stream.asked_hz, stream.tries = 0.5 * stream.asked_hz, 0
            if stream.asked_hz < LEAST_HZ:
                stream.asked_hz = 0.0
        stream.tries += 1
        return stream.asked_hz > 0.0
