"""Events of what changed: each change once, and nothing again of a state that is the same."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from companion.config import Config
from companion.navigator.changes import Changes
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.scatter import Scatter
from companion.navigator.state import EXCLUDED, SUSPECT, Settings, State
from companion.records import Event, Stamped

SETTINGS = Settings.of(Config())


def texts(changes: Changes, state: State) -> list[str]:
    found = changes.of_state(state, Stamped(1, 2), SETTINGS)
    assert all(isinstance(event, Event) and (event.t_ns, event.rx_ns) == (1, 2) for event in found)
    return [event.text for event in found if isinstance(event, Event)]


@dataclass
class Anchored:
    """Any program of the window."""


def believed(number: int, false: float) -> State:
    return State(reported=(number,), false=(false,))


def doubted(gnss: int, velocity: int) -> State:
    return State(reported=(gnss, 0, velocity), false=(0.9995, 0.0, 0.9995))


def scattered(noisy: bool, factor: float) -> State:
    return State(scatter={"gnss": Scatter(0, (0.0, 0.0), factor=factor, noisy=noisy)})


def bounded(widening: float) -> State:
    return State(guarantee=Guarantee(anchored=Anchored(), widening=widening))  # type: ignore[arg-type]


CASES = {
    "belief": [
        (believed(0, 0.0), []),
        (believed(SUSPECT, 0.62), ["gnss is suspect: false with probability 0.62"]),
        (believed(EXCLUDED, 0.9995), ["gnss is excluded: false with probability 0.9995"]),
        (believed(0, 0.01), ["gnss is used again"]),
    ],
    "velocity": [
        (doubted(0, 0), []),
        (doubted(0, EXCLUDED), ["velocity of gnss is excluded: false with probability 0.9995"]),
        (doubted(SUSPECT, 0), ["gnss is suspect: false with probability 1.00"]),
        (doubted(EXCLUDED, 0), ["gnss is excluded: false with probability 0.9995"]),
        (doubted(0, 0), ["gnss is used again", "velocity of gnss is used again"]),
        (doubted(0, SUSPECT), ["velocity of gnss is suspect: false with probability 1.00"]),
        (doubted(0, 0), ["velocity of gnss is no longer suspect"]),
    ],
    "scatter": [
        (scattered(False, 3.0), []),
        (scattered(True, 5.29), ["gnss scatters 2.3 times as much as it states: used with that sigma"]),
        (scattered(False, 1.4), ["gnss scatters as it states again"]),
    ],
    "bound": [
        (State(guarantee=Guarantee(widening=9.0)), []),  # not yet made of the window's fixes
        (bounded(1.0), []),
        (
            bounded(4.2),
            ["fixes of the window contradict the stated errors: guaranteed bound 4.2 times wider"],
        ),
        (bounded(1.0), ["fixes of the window agree with the stated errors again"]),
    ],
}


@pytest.mark.parametrize("case", CASES)
def test_each_change_is_reported_once(case: str) -> None:
    changes = Changes()
    for state, expected in CASES[case]:
        assert texts(changes, state) == expected
        assert texts(changes, state) == []


def test_what_began_again_reports_nothing() -> None:
    """After a reset nothing is known of a source: it is neither false nor used again."""
    changes = Changes()
    state = State(reported=(EXCLUDED,), false=(0.9995,), scatter=scattered(True, 9.0).scatter)
    texts(changes, state)
    assert texts(changes, State()) == []
