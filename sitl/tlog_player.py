"""`companion sitl play`: playback of a recorded autopilot over a real link.

    companion sitl play FLIGHT.tlog &                       # listens as ArduPilot's SITL does
    companion run --connect tcp:127.0.0.1:5760

The frames of the autopilot in a telemetry log are sent at their recorded times, starting when a client
connects. A recording does not obey: rates are as recorded, a requested message is the last one played,
parameters are unknown, and TIMESYNC is not answered.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import click

from companion.importers import tlog
from companion.importers.tlog import TlogEntry
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.option_types import INPUT_PATH, FloatRange
from companion.transport.address import Address
from sitl.real_time import LONGEST_SLEEP_S, RealTimeRunner, parse_address

NEVER = 2**63 - 1
#: Answers to clients of the recording: not played.
ANSWERS = frozenset({mavlink.MAVLINK_MSG_ID_TIMESYNC, mavlink.MAVLINK_MSG_ID_COMMAND_ACK})


class TlogPlayer:
    """Playback of a log's autopilot without I/O, starting at `start_ns` of the client's clock.

    `from_s` and `to_s` select a part of the log, `speed` is times real time. Raises ValueError if the part
    holds no messages of an autopilot.
    """

    def __init__(
        self,
        entries: Iterable[TlogEntry],
        start_ns: int = 0,
        from_s: float = 0.0,
        to_s: float = math.inf,
        speed: float = 1.0,
    ) -> None:
        entries = list(entries)
        self.system = _find_autopilot(entries)
        ours = [
            e
            for e in entries
            if (e.frame.system, e.frame.component) == (self.system, mavlink.MAV_COMP_ID_AUTOPILOT1)
        ]
        first_ns = entries[0].rx_ns + round(from_s * 1e9)
        self._newest = {e.frame.msgid: e.frame for e in ours if e.rx_ns < first_ns}
        self._schedule = [
            (start_ns + round((e.rx_ns - first_ns) / speed), e.frame)
            for e in ours
            if 0 <= e.rx_ns - first_ns < (to_s - from_s) * 1e9 and e.frame.msgid not in ANSWERS
        ]
        if not self._schedule:
            lasts_s = (entries[-1].rx_ns - entries[0].rx_ns) * 1e-9
            raise ValueError(
                f"no messages of the autopilot in this part of the log, which lasts {lasts_s:.0f} s: "
                "choose another --from and --to"
            )
        self._known = {e.frame.msgid for e in ours}
        self._next = 0
        self._sequence = self._schedule[0][1].sequence - 1 & 0xFF
        self._reader = frame.Reader()
        self._answers: list[bytes] = []

    def poll(self, now_ns: int) -> list[bytes]:
        """Return the answers to requests and every frame due."""
        due, self._answers = self._answers, []
        while self._next < len(self._schedule) and self._schedule[self._next][0] <= now_ns:
            found = self._schedule[self._next][1]
            self._next += 1
            self._sequence = found.sequence
            self._newest[found.msgid] = found
            due.append(found.raw)
        return due

    def deadline(self) -> int:
        """Return the time of the next frame, `NEVER` after the last."""
        return self._schedule[self._next][0] if self._next < len(self._schedule) else NEVER

    def receive(self, data: bytes) -> None:
        """Handle the client's bytes: commands that request messages or intervals are answered."""
        for found in self._reader.receive(data):
            if isinstance(found, frame.Frame) and found.msgid == mavlink.MAVLINK_MSG_ID_COMMAND_LONG:
                message = dialect.decode(found)
                if message.target_system in (0, self.system):
                    self._on_command(message, found)

    def _on_command(self, message: Any, request: frame.Frame) -> None:
        result, msgid = mavlink.MAV_RESULT_UNSUPPORTED, int(message.param1)
        if message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL and msgid in self._known:
            result = mavlink.MAV_RESULT_ACCEPTED
        elif message.command == mavlink.MAV_CMD_REQUEST_MESSAGE and msgid in self._known:
            result = mavlink.MAV_RESULT_ACCEPTED if msgid in self._newest else mavlink.MAV_RESULT_DENIED
            if msgid in self._newest:
                self._answers.append(self._newest[msgid].raw)
        acknowledgement = dialect.new(
            "COMMAND_ACK",
            command=message.command,
            result=result,
            target_system=request.system,
            target_component=request.component,
        )
        # with the sequence number of the last frame played: no frame seems to be lost
        self._answers.append(
            frame.encode(acknowledgement, self._sequence, self.system, mavlink.MAV_COMP_ID_AUTOPILOT1)
        )


def _find_autopilot(entries: Iterable[TlogEntry]) -> int:
    """The system id of the first autopilot heartbeat."""
    for entry in entries:
        found = entry.frame
        beats = (
            found.msgid == mavlink.MAVLINK_MSG_ID_HEARTBEAT
            and found.component == mavlink.MAV_COMP_ID_AUTOPILOT1
        )
        if beats and dialect.decode(found).autopilot != mavlink.MAV_AUTOPILOT_INVALID:
            return found.system
    raise ValueError("the log holds no HEARTBEAT of an autopilot")


class PlayerRunner(RealTimeRunner):
    """Real-time playback over one link, starting when a client connects or sends."""

    def __init__(
        self, make: Callable[[int], TlogPlayer], address: Address, report: Callable[[str], None]
    ) -> None:
        super().__init__((address,), report)
        self._make = make
        self._player: TlogPlayer | None = None

    def _steps(self) -> Iterator[float]:
        while not self._stopped and self._player is None:
            yield LONGEST_SLEEP_S
        while not self._stopped and self._player and self._player.deadline() < NEVER:
            self._send(self._player.poll(time.monotonic_ns()))
            yield 1e-9 * (self._player.deadline() - time.monotonic_ns())

    def _receive(self, link: int, data: bytes) -> None:
        if self._player is None:
            self._player = self._make(time.monotonic_ns())
            self._report("a client connected: playing")
        self._player.receive(data)


@click.command("play")
@click.argument("log", type=INPUT_PATH)
@click.option("--connect", default="tcpin:127.0.0.1:5760", show_default=True, help="Link to the client.")
@click.option(
    "--from", "from_s", type=FloatRange(0.0, 1e6), default=0.0, help="Start at this second of the log."
)
@click.option("--to", "to_s", type=FloatRange(0.0), default=math.inf, help="End at this second of the log.")
@click.option(
    "--speed",
    type=FloatRange(0.1, 20.0),
    default=1.0,
    show_default=True,
    help="Times real time; the client sees a clock that runs faster by this factor.",
)
def command(log: Path, connect: str, from_s: float, to_s: float, speed: float) -> None:
    """Play back the autopilot of a telemetry log (.tlog).

    Plays as if it were live. Starts when a client connects; ends with the log, at SIGINT or SIGTERM.
    Requests do not change the recording. Exit codes: 1 the log cannot be played, 69 cannot listen on the
    address.
    """
    address = parse_address(connect)
    try:
        entries = list(tlog.read(log))
        TlogPlayer(entries, 0, from_s, to_s, speed)
    except (OSError, ValueError) as error:
        click.echo(f"companion: {error}", err=True)
        sys.exit(1)
    runner = PlayerRunner(
        lambda start_ns: TlogPlayer(entries, start_ns, from_s, to_s, speed),
        address,
        lambda text: click.echo(text, err=True),
    )
    click.echo(f"playing {log} over {address}; stop with Ctrl-C", err=True)
    runner.run_command()
