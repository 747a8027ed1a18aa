"""`companion doctor`: one link, the clock and the terminal round an `Examination`.

Nothing is set without a yes, nor while the vehicle is armed.
"""

from __future__ import annotations

import asyncio
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

import click
from rich.console import Console

from companion.config import Config, ConfigError, load
from companion.config.profiles import PROFILES
from companion.doctor.diagnosis import Diagnosis, Finding
from companion.doctor.examination import Examination
from companion.doctor.rendering import after, as_json, parameter_table, show
from companion.runtime.service import EX_UNAVAILABLE
from companion.runtime.signing_key import Keys
from companion.transport.links import Address, CannotListen, Stream, connect

HEAR_S = 10.0
#: However slow the line, the examination or the setting is over after that.
LONGEST_S = 40.0
LONGEST_SLEEP_S = 0.2
#: Long enough for one heartbeat.
HEARTBEAT_S = 1.5
ARMED = "it is armed, and nothing is set in flight"


class NoAutopilot(Exception):
    """None was heard; the text says what was, and what to look at."""


class Patient:
    """The link to one autopilot and what is seen of it."""

    def __init__(self, stream: Stream, examination: Examination) -> None:
        self._stream, self.examination = stream, examination
        self.bytes = 0
        self._begun = time.monotonic()

    async def until(self, done: Callable[[int], bool], seconds: float) -> bool:
        """Carry bytes until `done(now_ns)`, False where it was not after so long. ConnectionError at the
        link's end.
        """
        examination, end = self.examination, time.monotonic() + seconds
        while not done(now := time.monotonic_ns()):
            if time.monotonic() > end:
                return False
            examination.poll(now)
            for data in examination.to_send():
                self._stream.write(data)
            wait = min(1e-9 * (examination.deadline() - time.monotonic_ns()), LONGEST_SLEEP_S)
            try:
                async with asyncio.timeout(max(wait, 0.001)):
                    data = await self._stream.read()
            except TimeoutError:
                continue
            self.bytes += len(data)
            examination.receive(data, time.monotonic_ns())
        return True

    def close(self) -> None:
        """Leave the link."""
        self._stream.close()

    def count_anew(self) -> None:
        """Count bytes from now on: the streams that were asked for come."""
        self.bytes, self._begun = 0, time.monotonic()

    def line_use(self, address: Address) -> list[Finding]:
        """How full a serial line is in our direction: ten bits a byte."""
        if address.kind != "serial":
            return []
        use = 10.0 * self.bytes / (time.monotonic() - self._begun) / address.number
        advice = "raise the baud rate on both sides, or lower the rates"
        return [Finding("line in use", f"{use:.0%}", "at most 80%", use <= 0.8, advice)]


async def meet(config: Config, address: Address) -> Patient:
    """Open the link. OSError where it is not to be had."""
    keys = Keys.of(config)
    async with asyncio.timeout(HEAR_S):
        stream = await connect(address)
    return Patient(stream, Examination(config, keys.signing if keys else None))


async def examine(patient: Patient, address: Address) -> Diagnosis:
    """Hear the autopilot, look at it. Raises NoAutopilot, and ConnectionError where the link ends."""
    examination = patient.examination
    if not await patient.until(lambda now: examination.is_heard, HEAR_S):
        raise NoAutopilot(f"no autopilot heard on {address} in {HEAR_S:.0f} s: {_what_came(patient)}")
    patient.count_anew()
    await patient.until(examination.is_done, LONGEST_S)
    diagnosis = examination.diagnosis(time.monotonic_ns())
    more = (*patient.line_use(address), machine(struct.calcsize("P") * 8))
    return diagnosis._replace(findings=(*diagnosis.findings, *more))


async def change(patient: Patient, before: Diagnosis) -> Diagnosis | None:
    """Set what is not as needed and read it again; the rest of the diagnosis stands as it was.

    None where the vehicle was armed while the question stood, so that nothing is set.
    """
    examination = patient.examination
    await patient.until(lambda now: False, HEARTBEAT_S)
    if examination.diagnosis(time.monotonic_ns()).identity.is_armed:
        return None
    examination.change()
    await patient.until(lambda now: examination.is_read, LONGEST_S)
    return before._replace(parameters=examination.diagnosis(time.monotonic_ns()).parameters)


def machine(bits: int) -> Finding:
    """Whether this computer is one that the numerical libraries are made for."""
    return Finding("this machine", f"{bits}-bit", "64-bit", bits == 64, "install a 64-bit system")


def _what_came(patient: Patient) -> str:
    examination = patient.examination
    senders = [f"{system}/{component}" for system, component in examination.session.reader.counts]
    if refused := examination.session.refused:
        reasons = ", ".join(reason.name.lower() for reason in refused)
        return f"frames were refused ({reasons}); have it sign with the key of signing.key_file"
    if senders:
        return (
            f"only {', '.join(senders)} spoke; is the autopilot connected there, is link.system_id its own?"
        )
    if patient.bytes:
        return (
            f"{patient.bytes} bytes came and no MAVLink among them; is the baud rate the same on both sides?"
        )
    return "not a byte came; look at the address, the wiring (TX to RX) and the port's MAVLink protocol"


def may_change(diagnosis: Diagnosis, yes: bool) -> str:
    """Ask; empty for a yes, else why nothing is set."""
    sets = [f"{f.need.name} = {f.need.value:g}" for f in diagnosis.wrong if f.has is not None]
    if not sets:
        return "there is nothing to set"
    if diagnosis.identity.is_armed:
        return ARMED
    if yes:
        return ""
    if not _is_somebody_here():
        return "nobody is here to say yes: give --yes"
    question = f"Set {', '.join(sets)} on system {diagnosis.identity.system}?"
    return "" if click.confirm(question, err=True) else "you said no"


def look(config: Config, address: Address, apply: bool, yes: bool, as_json_: bool) -> bool:
    """Examine, show, change after a yes, show again; whether all is well at the end."""
    console, said = Console(quiet=as_json_), Console(stderr=True)
    with asyncio.Runner() as runner, said.status(f"listening on {address}") as status:
        patient = runner.run(meet(config, address))
        try:
            diagnosis = first = runner.run(examine(patient, address))
            status.stop()
            show(console, config, address, diagnosis)
            if apply:
                why = may_change(diagnosis, yes)
                new = None if why else runner.run(change(patient, diagnosis))
                if new is None:
                    said.print(f"Nothing was set: {why or ARMED}.", highlight=False)
                else:
                    diagnosis = new
                    console.print(parameter_table(diagnosis))
                    console.print(after(diagnosis, diagnosis.changed_from(first)), highlight=False)
        finally:
            patient.close()
    if as_json_:
        click.echo(as_json(config, address, diagnosis, diagnosis.changed_from(first)))
    return diagnosis.is_well


def _is_somebody_here() -> bool:
    return sys.stdin.isatty()


def _advice(error: OSError) -> str:
    if isinstance(error, PermissionError):
        return "; a serial line belongs to a group, most often dialout: add this user to it and log in again"
    return "; is `companion run` still running?" if isinstance(error, CannotListen) else ""


@click.command("doctor")
@click.option("--config", "file", type=click.Path(path_type=Path), help="TOML file; see check-config.")
@click.option("--connect", help="Link to the autopilot; without it the configuration's first.")
@click.option(
    "--profile", type=click.Choice(list(PROFILES)), help="Output profile in the configuration's place."
)
@click.option("--set", "pairs", multiple=True, metavar="SECTION.KEY=VALUE", help="Any other key of the file.")
@click.option("--apply", is_flag=True, help="Set the parameters that are not as needed, after a yes.")
@click.option("--yes", is_flag=True, help="Say yes to --apply beforehand.")
@click.option("--json", "as_json_", is_flag=True, help="Print the findings as JSON.")
def command(
    file: Path | None,
    connect: str | None,
    profile: str | None,
    pairs: tuple[str, ...],
    apply: bool,
    yes: bool,
    as_json_: bool,
) -> None:
    """Look at the autopilot: has it what the output profile needs, and does the link carry it?

    Reads parameters and watches the link for 6 to 14 seconds. Nothing is set without --apply and a yes, nor
    while it is armed. Exit codes: 0 all is well, 1 something is missing, 69 no autopilot was heard, 78 bad
    configuration.
    """
    config = load(file, {"output.profile": profile}, pairs=pairs)
    try:
        address = Address.parse(connect or config.link.connect[0])
    except (ValueError, IndexError) as error:
        raise ConfigError(f"--connect: {error}") from None
    try:
        well = look(config, address, apply, yes, as_json_)
    except NoAutopilot as error:
        click.echo(f"companion: {error}", err=True)
        sys.exit(EX_UNAVAILABLE)
    except TimeoutError:
        click.echo(f"companion: {address}: nobody answers", err=True)
        sys.exit(EX_UNAVAILABLE)
    except OSError as error:
        click.echo(f"companion: {address}: {error.strerror or error}{_advice(error)}", err=True)
        sys.exit(EX_UNAVAILABLE)
    sys.exit(0 if well else 1)
