"""A diagnosis as a person reads it on 80 columns, and as a program does."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Console
from rich.table import Table

from companion.config import Config
from companion.doctor.diagnosis import Diagnosis
from companion.link.parameter_client import Value
from companion.transport.links import Address

NAMES = {"ardupilot": "ArduPilot", "px4": "PX4", "other": "an autopilot of another make"}
_GOOD, _BAD, _NOTE = "[green]ok[/]", "[bold red]{}[/]", "[dim]-[/]"


def _shown(value: Value | None) -> str:
    return "-" if value is None else f"{value:.7g}"


def show(console: Console, config: Config, address: Address, diagnosis: Diagnosis) -> None:
    """Print all of it."""
    console.print(heading(config, address, diagnosis), highlight=False)
    if diagnosis.parameters:
        console.print(parameter_table(diagnosis))
    console.print(finding_table(diagnosis))
    console.print(summary(config, diagnosis), highlight=False)


def parameter_table(diagnosis: Diagnosis) -> Table:
    """The parameters: has, needs, why."""
    table = Table(title="parameters of the autopilot", title_justify="left")
    for column in ("", "parameter", "has", "needs", "why"):
        numeric = column in ("has", "needs")
        table.add_column(column, justify="right" if numeric else "left", no_wrap=column in ("", "parameter"))
    for found in diagnosis.parameters:
        state = _GOOD if found.is_well else _BAD.format("absent" if found.has is None else "wrong")
        why = found.need.why + (" (counts after a reboot)" if found.need.reboot else "")
        if found.trouble:
            why = f"[red]{found.trouble}[/]; {why}"
        table.add_row(state, found.need.name, _shown(found.has), _shown(found.need.value), why)
    return table


def finding_table(diagnosis: Diagnosis) -> Table:
    """The link and the machine."""
    table = Table(title="link and machine", title_justify="left")
    for column in ("", "what", "found", "needs"):
        table.add_column(column, no_wrap=column in ("", "what"))
    for found in diagnosis.findings:
        state = _NOTE if found.is_well is None else _GOOD if found.is_well else _BAD.format("wrong")
        table.add_row(state, found.what, found.found, found.needs)
    return table


def heading(config: Config, address: Address, diagnosis: Diagnosis) -> str:
    """Who was heard, and what for it is looked at."""
    who = diagnosis.identity
    name = " ".join(part for part in (NAMES[who.make], who.version) if part)
    armed = "[bold red]armed[/]" if who.is_armed else "disarmed"
    output = config.output
    sent = [name for name, hz in output.rates_hz.items() if hz > 0.0 and name != "NAVIGATION_STATUS"]
    fed = " and ".join(sent) if sent else "nothing is fed to it"
    return (
        f"{name} ({who.vehicle}), system {who.system}, {armed}, over {address}\n"
        f"output profile {output.profile}: {fed}"
    )


def summary(config: Config, diagnosis: Diagnosis) -> str:
    """What is missing, a line each."""
    said = []
    if there := sum(found.has is not None for found in diagnosis.wrong):
        said.append(f"{_number(there, 'parameter')} not as needed: --apply sets what is there, after a yes.")
    if absent := len(diagnosis.wrong) - there:
        said.append(f"{_number(absent, 'parameter')} absent: is the firmware old, or built without?")
    said += [f"{found.what}: {found.advice}." for found in diagnosis.amiss]
    if not said:
        said.append("All is well.")
    if config.output.profile == "monitor":
        said.append("Profile monitor feeds nothing; --profile ardupilot or px4 shows what feeding takes.")
    return "\n".join(said)


def _number(count: int, noun: str) -> str:
    return f"{count} {noun} is" if count == 1 else f"{count} {noun}s are"


def as_json(config: Config, address: Address, diagnosis: Diagnosis, changed: tuple[str, ...]) -> str:
    """The diagnosis for a program."""
    tree: dict[str, Any] = {
        "link": str(address),
        "profile": config.output.profile,
        "autopilot": diagnosis.identity._asdict(),
        "parameters": [
            {
                "name": found.need.name,
                "has": found.has,
                "needs": found.need.value,
                "why": found.need.why,
                "reboot": found.need.reboot,
                "trouble": found.trouble,
                "is_well": found.is_well,
            }
            for found in diagnosis.parameters
        ],
        "findings": [
            {**found._asdict(), "advice": found.advice if found.is_well is False else ""}
            for found in diagnosis.findings
        ],
        "changed": changed,
        "is_well": diagnosis.is_well,
    }
    return json.dumps(tree, indent=2)


def after(diagnosis: Diagnosis, changed: tuple[str, ...]) -> str:
    """What a change came to, and what counts only after a reboot."""
    reboot = [
        found.need.name for found in diagnosis.parameters if found.need.reboot and found.need.name in changed
    ]
    said = f"{_number(len(changed), 'parameter')} set and read back"
    if reboot:
        said += f"; reboot the autopilot for {', '.join(reboot)}, and look again"
    if diagnosis.wrong:
        said += f"; {', '.join(found.need.name for found in diagnosis.wrong)} could not be"
    return said + "."
