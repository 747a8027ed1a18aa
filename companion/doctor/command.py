"""Command `companion doctor`: connection, clock and terminal around an `Examination`.

Nothing is set without confirmation, or while the vehicle is armed.
"""

from __future__ import annotations

import asyncio
import os
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import click
from rich.console import Console

from companion.config import Config, ConfigError, load
from companion.config.options import configuration_options
from companion.config.profiles import PROFILES
from companion.doctor.diagnosis import SEVERAL, Diagnosis, Finding
from companion.doctor.examination import Examination
from companion.doctor.rendering import as_json, change_summary, parameter_table, print_diagnosis
from companion.printable import printable
from companion.runtime.exposure import exposure
from companion.runtime.input_monitor import describe_silence
from companion.runtime.signing_key import SigningKey
from companion.transport.reconnect import Address, CannotListen, Connection, connect, describe_failure

CONNECT_TIMEOUT_S = 10.0
#: Limit on the examination and on setting parameters, however slow the line is.
EXAMINATION_TIMEOUT_S = 40.0
MAX_SLEEP_S = 0.2
#: Enough to receive one heartbeat.
HEARTBEAT_S = 1.5
ARMED = "the vehicle is armed; parameters are set only while disarmed"


class NoAutopilot(Exception):
    """No autopilot found; the text states what was received instead and what to check."""


class AutopilotConnection:
    """Connection to one autopilot and its examination."""

    def __init__(self, stream: Connection, examination: Examination) -> None:
        self._stream, self.examination = stream, examination
        self.bytes = 0
        self._start = time.monotonic()

    async def until(self, done: Callable[[int], bool], seconds: float) -> bool:
        """Transfer bytes until `done(now_ns)`; return False after `seconds`.

        Raises ConnectionError if the link ends.
        """
        examination, end = self.examination, time.monotonic() + seconds
        while not done(now := time.monotonic_ns()):
            if time.monotonic() > end:
                return False
            examination.poll(now)
            for data in examination.to_send():
                self._stream.write(data)
            wait = min(1e-9 * (examination.deadline() - time.monotonic_ns()), MAX_SLEEP_S)
            try:
                async with asyncio.timeout(max(wait, 0.001)):
                    data = await self._stream.read()
            except TimeoutError:
                continue
            self.bytes += len(data)
            examination.receive(data, time.monotonic_ns())
        return True

    def close(self) -> None:
        """Close the connection."""
        self._stream.close()

    def reset_byte_count(self) -> None:
        """Restart the byte count, once the requested streams arrive."""
        self.bytes, self._start = 0, time.monotonic()

    def check_line_use(self, address: Address) -> list[Finding]:
        """Report the use of a serial line in our direction, at ten bits per byte."""
        if address.kind != "serial":
            return []
        use = 10.0 * self.bytes / (time.monotonic() - self._start) / address.number
        advice = "raise the baud rate on both sides, or lower the rates"
        return [Finding("line in use", f"{use:.0%}", "at most 80%", use <= 0.8, advice)]


async def open_connection(config: Config, address: Address) -> AutopilotConnection:
    """Open the link. Raises OSError or TimeoutError."""
    key = SigningKey.from_config(config)
    async with asyncio.timeout(CONNECT_TIMEOUT_S):
        stream = await connect(address)
    return AutopilotConnection(stream, Examination(config, key.signing if key else None))


async def run_examination(connection: AutopilotConnection, address: Address) -> Diagnosis:
    """Find the autopilot and examine it. Raises NoAutopilot, or ConnectionError if the link ends."""
    examination = connection.examination
    if not await connection.until(lambda now: examination.is_connected, CONNECT_TIMEOUT_S):
        raise NoAutopilot(
            f"no autopilot found on {address} in {CONNECT_TIMEOUT_S:.0f} s: "
            f"{describe_silence(str(address), examination.session, connection.bytes > 0)}"
        )
    connection.reset_byte_count()
    await connection.until(examination.is_done, EXAMINATION_TIMEOUT_S)
    diagnosis = examination.diagnosis(time.monotonic_ns())
    more = (*connection.check_line_use(address), check_machine(struct.calcsize("P") * 8))
    return diagnosis._replace(findings=(*diagnosis.findings, *more))


async def set_parameters(connection: AutopilotConnection, before: Diagnosis) -> Diagnosis | None:
    """Set the wrong parameters and read them back; return `before` with the new parameters.

    Return None, with nothing set, if the vehicle was armed in the meantime.
    """
    examination = connection.examination
    await connection.until(lambda now: False, HEARTBEAT_S)
    if examination.diagnosis(time.monotonic_ns()).identity.is_armed:
        return None
    examination.set_parameters()
    await connection.until(lambda now: examination.has_all_parameters, EXAMINATION_TIMEOUT_S)
    return before._replace(parameters=examination.diagnosis(time.monotonic_ns()).parameters)


def check_machine(bits: int) -> Finding:
    """Check that the numerical libraries are available for this computer."""
    return Finding("this machine", f"{bits}-bit", "64-bit", bits == 64, "install a 64-bit system")


def confirm_change(diagnosis: Diagnosis, yes: bool) -> str:
    """Ask for confirmation; return "" if confirmed, else why nothing is set."""
    sets = [f"{f.need.name} = {f.need.value:g}" for f in diagnosis.wrong_parameters if f.has is not None]
    if not sets:
        return "there is nothing to set"
    if diagnosis.identity.is_armed:
        return ARMED
    if any(found.what == SEVERAL for found in diagnosis.problems):
        return "several autopilots are received; set link.system_id to the intended one"
    if yes:
        return ""
    if not _is_interactive():
        return "not run in a terminal: give --yes to confirm"
    question = f"Set {', '.join(sets)} on system {diagnosis.identity.system}?"
    return "" if click.confirm(question, err=True) else "not confirmed"


def examine(config: Config, address: Address, apply: bool, yes: bool, as_json_: bool) -> bool:
    """Examine the autopilot, print the diagnosis, set parameters if confirmed; return whether all is well."""
    console, stderr = Console(quiet=as_json_), Console(stderr=True)
    with asyncio.Runner() as runner, stderr.status(f"listening on {address}") as status:
        connection = runner.run(open_connection(config, address))
        try:
            diagnosis = first = runner.run(run_examination(connection, address))
            status.stop()
            print_diagnosis(console, config, address, diagnosis)
            is_open, sentence = exposure(address, config)
            console.print(sentence, style="yellow" if is_open else "", highlight=False)
            if apply:
                why = confirm_change(diagnosis, yes)
                new = None if why else runner.run(set_parameters(connection, diagnosis))
                if new is None:
                    stderr.print(f"Nothing was set: {why or ARMED}.", highlight=False)
                else:
                    diagnosis = new
                    console.print(parameter_table(diagnosis))
                    console.print(change_summary(diagnosis, diagnosis.changed_from(first)), highlight=False)
        finally:
            connection.close()
    if as_json_:
        click.echo(as_json(config, address, diagnosis, diagnosis.changed_from(first)))
    return diagnosis.is_well


def _is_interactive() -> bool:
    return sys.stdin.isatty()


def describe_open_error(address: Address, error: OSError) -> str:
    """Describe why a link cannot be opened, and what to do."""
    if isinstance(error, CannotListen):  # it names the address
        return f"{error.strerror}; is `companion run` still running?"
    return describe_failure(address, error)


@click.command("doctor")
@configuration_options
@click.option("--connect", help="Link to the autopilot; default: the first of the configuration.")
@click.option(
    "--profile", type=click.Choice(list(PROFILES)), help="Output profile; overrides the configuration."
)
@click.option("--apply", is_flag=True, help="Set the wrong parameters, after confirmation.")
@click.option("--yes", is_flag=True, help="Confirm --apply without asking.")
@click.option("--json", "as_json_", is_flag=True, help="Print the findings as JSON.")
def command(
    file: Path | None,
    preset: str | None,
    pairs: tuple[str, ...],
    connect: str | None,
    profile: str | None,
    apply: bool,
    yes: bool,
    as_json_: bool,
) -> None:
    """Check the autopilot's parameters and the link.

    Reads the parameters that the output profile requires and observes the link for 6 to 14 seconds. Nothing
    is set without --apply and confirmation, or while the vehicle is armed. Exit codes: 0 all is well, 1
    something is missing, 69 no autopilot found, 78 invalid configuration.
    """
    if yes and not apply:
        raise click.UsageError("--yes has no effect without --apply: add --apply, or leave --yes out")
    config = load(file, {"output.profile": profile}, pairs=pairs, preset=preset)
    try:
        address = Address.parse(config.link.connect[0] if connect is None else connect)
    except (ValueError, IndexError) as error:
        raise ConfigError(f"--connect: {error}") from None
    try:
        well = examine(config, address, apply, yes, as_json_)
    except NoAutopilot as error:
        click.echo(f"companion: {printable(str(error))}", err=True)
        sys.exit(os.EX_UNAVAILABLE)
    except TimeoutError:
        advice = "check the address, and that the other side runs"
        click.echo(f"companion: {address}: no answer in {CONNECT_TIMEOUT_S:g} s; {advice}", err=True)
        sys.exit(os.EX_UNAVAILABLE)
    except OSError as error:
        click.echo(f"companion: {describe_open_error(address, error)}", err=True)
        sys.exit(os.EX_UNAVAILABLE)
    sys.exit(0 if well else 1)
