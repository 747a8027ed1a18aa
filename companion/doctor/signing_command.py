"""`companion signing init`: make a signing key and give it to both ends of a link.

The key is written for the companion with mode 0600 and sent to the autopilot by SETUP_SIGNING, which carries
it in plain: the link must be a serial line or this computer's loopback. The autopilot sends no
acknowledgement, so a frame that it signs with the new key is waited for.
"""

from __future__ import annotations

import asyncio
import os
import secrets
import time
from collections.abc import Callable
from pathlib import Path

import click

from companion.config import Config, ConfigError, load
from companion.config.options import configuration_options
from companion.doctor.command import describe_open_error
from companion.link import dialect, frame
from companion.link.dialect import mavlink
from companion.link.session import MessageReceived, Session
from companion.link.signing import EPOCH_NS, TICK_NS, Signing, read_key
from companion.runtime.exposure import exposure
from companion.runtime.link_addresses import check_links
from companion.transport.reconnect import Address, Connection, connect

FIND_S, ANSWER_S = 10.0, 6.0


class CannotSetUp(Exception):
    """The key cannot be given to the autopilot; the text states why and what to do."""


def write_key(path: Path) -> bytes:
    """Write a new key, readable by its owner only. Raises FileExistsError rather than replace one."""
    key = secrets.token_bytes(32)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="ascii") as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(key.hex() + "\n")
        file.flush()
        os.fsync(file.fileno())
    return key


async def give_key(stream: Connection, config: Config, key: bytes) -> int:
    """Send the key to the autopilot; return its system once it signs with it. Raises CannotSetUp."""
    session = Session(component=config.link.component_id, autopilot_system=config.link.system_id or None)
    armed = False

    def notice_arming(events: list[object]) -> None:
        nonlocal armed
        for event in events:
            if (
                isinstance(event, MessageReceived)
                and event.from_autopilot
                and event.frame.msgid == mavlink.MAVLINK_MSG_ID_HEARTBEAT
            ):
                armed = bool(event.message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    async def until(done: Callable[[bytes], bool], seconds: float) -> bool:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            notice_arming(list(session.poll(time.monotonic_ns())))
            for data in session.to_send():
                stream.write(data)
            try:
                async with asyncio.timeout(0.2):
                    data = await stream.read()
            except TimeoutError:
                continue
            notice_arming(list(session.receive(data, time.monotonic_ns())))
            if done(data):
                return True
        return False

    if not await until(lambda data: session.is_up, FIND_S):
        raise CannotSetUp("no autopilot found; check the link with companion doctor")
    if armed:
        raise CannotSetUp("the vehicle is armed; set up signing while disarmed")
    stamp = max(0, time.time_ns() - EPOCH_NS) // TICK_NS  # a board without a battery may be in 1970
    system = session.autopilot or 0
    for _ in range(2):
        session.send(
            dialect.new(
                "SETUP_SIGNING",
                target_system=system,
                target_component=mavlink.MAV_COMP_ID_AUTOPILOT1,
                secret_key=list(key),
                initial_timestamp=stamp,
            )
        )
    signing, reader = Signing(key), frame.Reader()

    def is_signed(data: bytes) -> bool:
        return any(
            isinstance(found, frame.Frame) and found.system == system and signing.verify(found, 0) is None
            for found in reader.receive(data)
        )

    if not await until(is_signed, ANSWER_S):
        raise CannotSetUp(
            f"autopilot {system} sends no frame signed with the key: it does not support SETUP_SIGNING, or "
            "does not sign on this link (ArduPilot on USB); set the key with a ground station"
        )
    return system


@click.group("signing")
def group() -> None:
    """Set up MAVLink 2 signing."""


@group.command("init")
@configuration_options
@click.option(
    "--key-file", type=click.Path(path_type=Path), help="Default: signing.key_file, or signing.key."
)
@click.option("--connect", "link", help="Link to the autopilot; default: the first of the configuration.")
@click.option("--no-autopilot", is_flag=True, help="Only write the key; give it to the autopilot yourself.")
def init(
    file: Path | None,
    preset: str | None,
    pairs: tuple[str, ...],
    key_file: Path | None,
    link: str | None,
    no_autopilot: bool,
) -> None:
    """Make a key and give it to the companion and to the autopilot.

    An existing key file is used again and not replaced. Exit code 1 if the autopilot does not sign with it.
    """
    if link and no_autopilot:
        raise click.UsageError(
            f"--connect {link} has no effect with --no-autopilot, which only writes the key: leave one out"
        )
    config = load(file, {"link.connect": (link,) if link else None}, pairs=pairs, preset=preset)
    path = key_file or Path(config.signing.key_file or "signing.key")
    check_links(config)
    address = Address.parse(config.link.connect[0])
    is_new = not path.exists()
    try:
        key = write_key(path) if is_new else read_key(path)
    except OSError as error:
        raise ConfigError(
            f"--key-file {path}: the key cannot be written ({error.strerror or error}): give a file in a "
            "folder that exists and that you may write"
        ) from None
    except ValueError as error:  # it names the file
        raise ConfigError(f"--key-file {error}") from None
    click.echo(f"key: {path} ({'new, mode 0600' if is_new else 'exists, used again'})")
    if not no_autopilot:
        if exposure(address, config).is_open:
            raise SystemExit(
                f"companion: {address} is a network: the key would be sent in plain; use a serial line, or "
                "--no-autopilot and a ground station"
            )
        try:
            system = asyncio.run(_give_key_over(address, config, key))
        except CannotSetUp as error:
            raise SystemExit(f"companion: {address}: {error}") from None
        except OSError as error:
            raise SystemExit(f"companion: {describe_open_error(address, error)}") from None
        click.echo(f"autopilot {system} on {address} signs with this key")
    click.echo(f"set in the configuration:\n[signing]\nkey_file = {str(path.absolute())!r}")


async def _give_key_over(address: Address, config: Config, key: bytes) -> int:
    async with asyncio.timeout(FIND_S):
        stream = await connect(address)
    try:
        return await give_key(stream, config, key)
    finally:
        stream.close()
