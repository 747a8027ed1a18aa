"""Decisions read off the bank: when a false source is acted on, and when it is used again."""

import numpy as np
import pytest

from companion.config import Config
from companion.estimate import bank as banks
from companion.estimate.bank import readout
from companion.navigator import progress
from companion.navigator.hypotheses import GNSS, SOURCES
from companion.navigator.state import EXCLUDED, SUSPECT, Settings, State
from companion.records import Stamped
from companion.units import SECOND_NS

SETTINGS = Settings.of(Config())
BEYOND_DOUBT = 0.9995


def reported(monkeypatch: pytest.MonkeyPatch, *probabilities: float) -> list[int]:
    """What is reported of GNSS as it is false with each of the probabilities, half a second apart."""
    state = State(bank=SETTINGS.model.begin(0.0), false=(0.0,) * len(SOURCES), reported=(0,) * len(SOURCES))
    found = []
    for k, p in enumerate(probabilities):
        for module in (banks, readout):
            monkeypatch.setattr(module, "false_probability", lambda *_, p=p: np.array((p, 0.0, 0.0)))
        t_ns = (1 + k) * SECOND_NS // 2
        state = progress.decided(state, Stamped(t_ns, t_ns), SETTINGS)
        found.append(state.reported[GNSS])
    return found


def test_a_source_is_excluded_after_one_second_beyond_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    assert reported(monkeypatch, 0.0, *[BEYOND_DOUBT] * 4) == [0, SUSPECT, SUSPECT, EXCLUDED, EXCLUDED]


def test_one_fix_beyond_doubt_excludes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    # a healthy GNSS was excluded with a probability of 0.18, a second after one noisy fix
    assert reported(monkeypatch, BEYOND_DOUBT, *[0.4] * 4) == [SUSPECT] * 5


def test_an_excluded_source_is_used_again_once_it_is_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    found = reported(monkeypatch, *[BEYOND_DOUBT] * 3, 0.4, 0.4, 0.05, 0.4)
    assert found == [SUSPECT, SUSPECT, EXCLUDED, EXCLUDED, EXCLUDED, 0, 0]
