"""Rendering of a diagnosis: tables for a terminal of 80 columns, JSON for programs."""

from __future__ import annotations

import json
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from companion.config import Config
from companion.config.presets import recommend_preset
from companion.doctor.diagnosis import Diagnosis
from companion.link.parameter_client import Value
from companion.transport.reconnect import Address

NAMES = {"ardupilot": "ArduPilot", "px4": "PX4", "other": "an autopilot of another make"}
COLUMNS = 80  # the tables fit; in a narrower terminal their cells would be cut to "h…"
_GOOD, _BAD, _NOTE = "[green]ok[/]", "[bold red]{}[/]", "[dim]-[/]"


def _format_value(value: Value | None) -> str:
    return "-" if value is None else f"{value:.7g}"


def print_diagnosis(console: Console, config: Config, address: Address, diagnosis: Diagnosis) -> None:
    """Print a diagnosis, at least `COLUMNS` wide: a narrower terminal wraps the lines."""
    console.width = max(console.width, COLUMNS)
    console.print(heading(config, address, diagnosis), highlight=False)
    if diagnosis.parameters:
        console.print(parameter_table(diagnosis))
    console.print(finding_table(diagnosis))
    console.print(summary(config, diagnosis), highlight=False)


def parameter_table(diagnosis: Diagnosis) -> Table:
    """Return the table of parameters."""
    table = Table(title="parameters of the autopilot", title_justify="left")
    for column in ("", "parameter", "has", "needs", "why"):
        numeric = column in ("has", "needs")
        table.add_column(column, justify="right" if numeric else "left", no_wrap=column in ("", "parameter"))
    unread = "absent" if _is_answering(diagnosis) else "unread"
    for found in diagnosis.parameters:
        state = _GOOD if found.is_well else _BAD.format(unread if found.has is None else "wrong")
        why = found.need.why + (" (after a reboot)" if found.need.reboot else "")
        if found.trouble:
            why = f"[red]{found.trouble}[/]; {why}"
        table.add_row(state, found.need.name, _format_value(found.has), _format_value(found.need.value), why)
    return table


def finding_table(diagnosis: Diagnosis) -> Table:
    """Return the table of the link and the machine."""
    table = Table(title="link and machine", title_justify="left")
    for column in ("", "what", "found", "needs"):
        table.add_column(column, no_wrap=column in ("", "what"))
    for found in diagnosis.findings:
        state = _NOTE if found.is_well is None else _GOOD if found.is_well else _BAD.format("wrong")
        table.add_row(state, *map(escape, (found.what, found.found, found.needs)))
    return table


def heading(config: Config, address: Address, diagnosis: Diagnosis) -> str:
    """Return the autopilot's identity and the output profile, two lines."""
    who = diagnosis.identity
    name = " ".join(part for part in (NAMES[who.make], who.version) if part)
    armed = "[bold red]armed[/]" if who.is_armed else "disarmed"
    output = config.output
    sent = [name for name, hz in output.rates_hz.items() if hz > 0.0 and name != "NAVIGATION_STATUS"]
    fed = " and ".join(sent) if sent else "no position is sent to it"
    return (
        f"{name} ({who.vehicle}), system {who.system}, {armed}, over {address}\n"
        f"output profile {output.profile}: {fed}"
    )


def summary(config: Config, diagnosis: Diagnosis) -> str:
    """Return what is not well, one line each."""
    lines = []
    if there := sum(found.has is not None for found in diagnosis.wrong_parameters):
        when = "once it is disarmed" if diagnosis.identity.is_armed else "after confirmation"
        lines.append(f"{_number(there, 'parameter')} wrong: --apply sets them, {when}.")
    if _is_answering(diagnosis) and (absent := len(diagnosis.wrong_parameters) - there):
        lines.append(
            f"{_number(absent, 'parameter')} absent: update the firmware, or use a build with this feature."
        )
    lines += [escape(f"{found.what}: {found.advice}.") for found in diagnosis.problems]
    if not lines:
        lines.append("All is well.")
    if config.output.profile == "monitor":
        lines.append(
            "Profile monitor sends no position; --profile ardupilot or px4 shows what that requires."
        )
        if (preset := recommend_preset(diagnosis.identity.make)) is not None and not config.has_own_ins:
            lines.append(
                f"Recommended: --preset {preset}. Only if LOCAL_POSITION_NED comes from an INS of its own: "
                "navigation-ins, tactical-ins or mems, by its data sheet."
            )
    return "\n".join(lines)


def _is_answering(diagnosis: Diagnosis) -> bool:
    """Whether the autopilot answers at all: silence is no missing parameter."""
    return all(found.what not in ("answers", "signing") for found in diagnosis.problems)


def _number(count: int, noun: str) -> str:
    return f"{count} {noun} is" if count == 1 else f"{count} {noun}s are"


def as_json(config: Config, address: Address, diagnosis: Diagnosis, changed: tuple[str, ...]) -> str:
    """Return the diagnosis as JSON."""
    tree: dict[str, Any] = {
        "link": str(address),
        "profile": config.output.profile,
        "autopilot": diagnosis.identity._asdict(),
        "recommended_preset": recommend_preset(diagnosis.identity.make),
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


def change_summary(diagnosis: Diagnosis, changed: tuple[str, ...]) -> str:
    """Return the result of setting parameters, and which ones need a reboot."""
    reboot = [
        found.need.name for found in diagnosis.parameters if found.need.reboot and found.need.name in changed
    ]
    text = f"{_number(len(changed), 'parameter')} set and read back"
    if reboot:
        text += f"; reboot the autopilot for {', '.join(reboot)}, and run the doctor again"
    if diagnosis.wrong_parameters:
        text += f"; {', '.join(found.need.name for found in diagnosis.wrong_parameters)} could not be set"
    return text + "."
