"""Console of `companion run`: events and one status line, on a terminal, in a journal and as JSON."""

import json
import re

import pytest

from companion.records import Event, Mode, Severity, Solution, Source, Trust
from companion.runtime.console import Console
from companion.runtime.input_monitor import STREAMS
from companion.runtime.status import Status
from tests.solutions import solution_at

SECOND = 1_000_000_000
STATUS = Status(True, "normal", "fixed", ("GNSS", "RANGE"), "normal", 1.234, 52.8, 7.7)


def played(lines: list[str]) -> list[str]:
    """What a terminal shows after these lines: the cursor moves up, and clears what is below."""
    shown, row = list[str](), 0
    for line in "\n".join(lines).split("\n"):
        ups = line.count("\x1b[1A")
        if "\x1b[J" in line:
            del shown[row - 1 :]
        row += 1 - ups
        if text := re.sub(r"\x1b\[\w+|\r", "", line):
            shown[row - 1 :] = [text]
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
    console.status(STATUS._replace(state="degraded"), 5 * SECOND)
    shown = played(lines)
    assert [line.split(maxsplit=1)[1] for line in shown[:2]] == ["first", "second"]
    (status,) = shown[2:]
    assert "degraded GNSS+range" in status


def test_status_line_is_cleared_at_the_end() -> None:
    lines: list[str] = []
    console = Console(lines.append, 0, columns=80)
    console.event(event(0.1, "first"))
    console.status(STATUS, SECOND)
    console.event(event(1.5, "log: closed"))
    console.close()
    lines.append("$")
    assert [line.split(maxsplit=1)[-1] for line in played(lines)] == ["first", "log: closed", "$"]


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


def solution(mode: Mode, trust: Trust | None, sources: Source, metres: float) -> Solution:
    """A solution whose lengths have as many digits as `metres`; the sigma of fixes is below 10 m."""
    sigma = 9.8 if sources else metres
    return solution_at(
        SECOND,
        mode=mode,
        covariance=(sigma**2, 0.0, 0.0, 0.0, 0.0, 4.0),
        sources=Source.INERTIAL | sources,
        bound_n=(metres, 0.0),
        protection=metres,
        trust=trust,
    )


@pytest.mark.parametrize("missing", sorted({stream.what for stream in STREAMS.values() if stream.record}))
@pytest.mark.parametrize("trust", [None, *Trust])
@pytest.mark.parametrize("mode", Mode)
def test_whole_status_fits_80_columns_with_one_input_missing(
    mode: Mode, trust: Trust | None, missing: str
) -> None:
    gnss, beacon = Source.GNSS, (Source.AZIMUTH, Source.RANGE, Source.AZIMUTH | Source.RANGE)
    used = [gnss, *beacon, *(gnss | part for part in beacon)] if mode is Mode.FIXED else [Source(0)]
    for sources in used:
        lines: list[str] = []
        given = solution(mode, trust, sources, 999.0 if sources else 4999.0)
        status = Status.of(given, connected=True, is_stale=False, missing=(missing,))
        Console(lines.append, 0, columns=80).status(status, 99_999 * SECOND)
        assert lines[0] == f"99999 {status.text()}"  # not cut
        assert lines[0].endswith(f" m, no {missing}")


def test_many_slow_inputs_do_not_cut_the_lengths_off() -> None:
    every = tuple(sorted({stream.what for stream in STREAMS.values()}))
    lines: list[str] = []
    status = STATUS._replace(sources=("GNSS", "AZIMUTH", "RANGE"), slow=every)
    Console(lines.append, 0, columns=80).status(status, 99_999 * SECOND)
    assert lines[0].startswith("99999 normal GNSS+beacon, sigma 1.2 HPL 53 bound 7.7 m, slow ")
    assert len(lines[0]) == 79


def test_status_names_the_state_then_lengths_then_what_is_missing() -> None:
    assert STATUS.text() == "normal GNSS+range, sigma 1.2 HPL 53 bound 7.7 m"
    both = STATUS._replace(sources=("GNSS", "AZIMUTH", "RANGE"), missing=("airspeed",), slow=("IMU",))
    assert both.text() == "normal GNSS+beacon, sigma 1.2 HPL 53 bound 7.7 m, no airspeed, slow IMU"
    assert both._replace(connected=False).text().startswith("normal GNSS+beacon, no autopilot, sigma")
    assert Status(True, "no solution", missing=("GNSS",)).text() == "no solution, no GNSS"


def test_fixes_that_are_back_while_trust_lags_are_recovering() -> None:
    outage = solution(Mode.PREDICTING, Trust.PREDICTING, Source(0), 300.0)
    back = solution(Mode.FIXED, Trust.PREDICTING, Source.GNSS, 300.0)
    texts = [Status.of(given, True, False, ()).text() for given in (outage, back)]
    assert [text.partition(",")[0] for text in texts] == ["predicting", "recovering GNSS"]
