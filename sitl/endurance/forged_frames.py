"""`python -m sitl.endurance.forged_frames`: millions of well-formed frames with any field values, in flight.

Every message that the companion reads or answers, with fields drawn from values that break arithmetic
(NaN, infinities, subnormal numbers, the extremes of its type) and from plausible ones, from the autopilot's
ids and others, between the frames of a simulated flight; PARAM_SET sets every parameter. Requirements: no
exception, only finite records, and every message to the autopilot well-formed and finite.
"""

from __future__ import annotations

import itertools
import random
import re
import struct
import time
from typing import Any

import click

from companion.config import Config
from companion.link import dialect
from companion.link.parameter_server import parameter_table
from companion.runtime.core import CompanionCore
from sitl.endurance.fuzz_targets import MESSAGE_NAMES, ValidatingLog, make_frame
from sitl.endurance.parameter_sweep import CONFIGS, recorded_flight
from sitl.loopback import LINK

PER_FRAME = 10  # forged frames after each frame of the flight
FLOATS = (
    *(float("nan"), float("inf"), float("-inf"), 1e-40, -1e-40, 3.4e38, -3.4e38, 1e-6, 0.0, 1.0, -1.0),
    *(1e3, 1e5, 1e8, 600.0),
)
_PARAMETERS = tuple(parameter.name.encode() for parameter in parameter_table())
_SPECIAL = frozenset({"COMMAND_LONG", "COMMAND_INT", "PARAM_SET", "PARAM_REQUEST_READ"})


def random_payload(rng: random.Random, name: str) -> bytes:
    """Return a payload of the message with any field values."""
    kind = dialect.type_named(name)
    values: list[Any] = []
    formats = re.findall(r"(\d*)([a-zA-Z])", kind.layout.format)
    for count, code in formats:
        if code == "s":
            values.append(rng.choice(_PARAMETERS) if rng.random() < 0.9 else rng.randbytes(int(count or 1)))
            continue
        values += [_number(rng, code) for _ in range(int(count or 1))]
    payload = kind.layout.pack(*values)
    if name in _SPECIAL and rng.random() < 0.9:  # addressed to us
        payload = _addressed(kind, payload)
    return payload


def _number(rng: random.Random, code: str) -> float | int:
    if code in "fd":
        return rng.choice(FLOATS) if rng.random() < 0.7 else rng.uniform(-100.0, 100.0)
    size = struct.calcsize(code)
    least, greatest = (0, 256**size - 1) if code.isupper() else (-(256**size) // 2, 256**size // 2 - 1)
    if rng.random() < 0.5:
        return rng.choice((least, greatest, 0, 1, min(greatest, 3), least + 1, greatest - 1))
    return rng.choice((rng.randint(least, greatest), min(greatest, rng.randint(0, 600_000_000))))


def _addressed(kind: dialect.MessageType, payload: bytes) -> bytes:
    values = list(kind.layout.unpack(payload))
    for field in kind.fields:
        if field.name == "target_system":
            values[field.first] = 1
        elif field.name == "target_component":
            values[field.first] = 191
        elif field.name == "param_type":
            values[field.first] = 9
        elif field.name == "command":
            values[field.first] = (510, 511, 512, 520)[values[field.first] % 4]
    return bytes(kind.layout.pack(*values))


def fly(config: Config, seed: int, frames: int) -> int:
    """Fly with up to `frames` forged frames; return their number. Raises whatever the companion raises."""
    rng = random.Random(seed)
    core = CompanionCore(config, ValidatingLog(), (LINK,))
    sent = 0
    for now, data in recorded_flight(config.inertial.independent):
        core.receive(LINK, data, now, "autopilot")
        for _ in range(PER_FRAME):
            name = rng.choice(MESSAGE_NAMES)
            forged = make_frame(name, random_payload(rng, name), rng.choice((0, 0, 1, 4, 8)), sent & 0xFF)
            core.receive(LINK, forged, now, "autopilot" if rng.random() < 0.5 else rng.randrange(20))
            sent += 1
        if core.deadline() <= now:
            core.poll(now)
        core.to_send(LINK, now)
        core.take_events()
        if sent >= frames:
            break
    if core.links[LINK].not_sent:
        raise ValueError(f"not sent: {dict(core.links[LINK].not_sent)}")
    return sent


@click.command()
@click.option(
    "--frames", type=click.IntRange(1), default=10_000_000, show_default=True, help="Number of them."
)
@click.option(
    "--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the first flight."
)
def main(frames: int, seed: int) -> None:
    """Fly with forged frames until `--frames` were received. Exit code 1 if a flight failed."""
    total, failed, started = 0, 0, time.monotonic()
    for number in itertools.count(seed):
        try:
            total += fly(CONFIGS[number % len(CONFIGS)], number, frames - total)
        except Exception as error:  # the defect that is looked for
            failed += 1
            click.echo(f"seed {number}: {type(error).__name__}: {error}")
            total += 1
        if total >= frames:
            break
        if number % 10 == 0:
            click.echo(f"{total} frames, {time.monotonic() - started:.0f} s, {failed} failed")
    click.echo(f"{total} frames in {time.monotonic() - started:.0f} s, {failed} flights failed")
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
