"""Console of `companion run`: events and one status line, on a terminal, in a journal and as JSON."""

import json

from companion.records import Event, Severity
from companion.runtime.console import Console
from companion.runtime.status import Status

SECOND = 1_000_000_000
STATUS = Status(True, "fixed", ("GNSS", "RANGE"), "normal", 1.234, 52.8, 7.7)


def played(lines: list[str]) -> list[str]:
    """What a terminal shows after these lines: the cursor moves up and clears a line."""
    shown: list[str] = []
    for line in "\n".join(lines).split("\n"):
        while line.startswith("\x1b[1A\r\x1b[2K"):
            line = line.removeprefix("\x1b[1A\r\x1b[2K")
            shown.pop()
        shown.append(line)
    return shown


def event(seconds: float, text: str) -> Event:
    return Event(round(seconds * SECOND), round(seconds * SECOND), Severity.NOTICE, text)


def test_terminal_has_one_status_line_below_all_events() -> None:
    lines: list[str] = []
    console = Console(lines.append, 0, columns=80)
    console.event(event(0.1, "first"))
    for second in range(1, 5):
        console.status(STATUS, second * SECOND)
    console.event(event(4.5, "second"))
    console.status(STATUS._replace(trust="degraded"), 5 * SECOND)
    shown = played(lines)
    assert [line.split(maxsplit=1)[1] for line in shown[:2]] == ["first", "second"]
    (status,) = shown[2:]
    assert "trust degraded" in status and len(status) < 80


def test_status_line_is_cut_to_the_terminal() -> None:
    lines: list[str] = []
    Console(lines.append, 0, columns=40).status(STATUS._replace(missing=("airspeed", "pressure")), SECOND)
    assert len(lines[0]) == 39


def test_journal_has_a_status_once_a_minute() -> None:
    lines: list[str] = []
    console = Console(lines.append, 0)
    for second in range(181):
        console.status(STATUS, second * SECOND)
    assert len(lines) == 3 and not any("\x1b" in line for line in lines)


def test_event_is_one_line_without_control_characters() -> None:
    lines: list[str] = []
    Console(lines.append, 0).event(event(1.5, "from a link\n    1.600 forged\x1b[2J"))
    assert lines == [r"    1.500 from a link\n    1.600 forged\x1b[2J"]


def test_json_lines_are_objects() -> None:
    lines: list[str] = []
    console = Console(lines.append, 0, as_json=True, columns=80)
    console.event(event(1.5, 'log: "a"\nb'))
    console.status(STATUS, 60 * SECOND)
    first, second = map(json.loads, lines)
    assert first == {"t_s": 1.5, "severity": "notice", "text": 'log: "a"\nb'}
    assert (second["mode"], second["sources"], second["protection"]) == ("fixed", ["GNSS", "RANGE"], 52.8)


def test_status_text_fits_80_columns_if_nothing_is_missing() -> None:
    worst = Status(True, "predicting", ("GNSS", "AZIMUTH", "RANGE"), "predicting", 12345.6, 12345.6, 12345.6)
    assert len(worst.text()) + 10 < 100
    assert STATUS.text() == "fixed GNSS+RANGE, trust normal, sigma 1.2 m, protection 53 m, guaranteed 7.7 m"
    assert len(STATUS.text()) + 10 <= 90
    assert Status(True, "no solution", missing=("GNSS",)).text() == "no solution, missing: GNSS"
