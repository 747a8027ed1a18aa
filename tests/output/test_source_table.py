"""Source table row by row.

First, do no harm: set 2 only where the receiver itself has no fix or GNSS is false with a witness, and set 1
as soon as there is a fix that is not held false, whether or not the companion has a solution.
"""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.output.source_table import (
    BELIEVED,
    FALSE,
    FIX_S,
    NO_FIX_S,
    SILENT_S,
    STEADY_S,
    STOPPED_S,
    TO_COMPANION,
    TO_GNSS,
    Situation,
    required_set,
)

LONG = 1000.0

#: GNSS and companion both well; each row of the table changes what it needs.
WELL = Situation(
    fix_s=LONG, no_fix_s=-1.0, silent_s=0.1, gnss_false=1e-6, witness=True, sent_s=LONG, stopped_s=0.0
)
NO_FIX: dict[str, Any] = {"fix_s": -1.0, "no_fix_s": NO_FIX_S}
SILENT: dict[str, Any] = {"fix_s": -1.0, "silent_s": SILENT_S}
LIE: dict[str, Any] = {"gnss_false": 0.9999, "witness": True}
MUTE: dict[str, Any] = {"sent_s": -1.0, "stopped_s": STOPPED_S}
BLIND: dict[str, Any] = {**MUTE, "gnss_false": None, "witness": False}

TABLE: list[tuple[str, dict[str, Any], int | None]] = [
    ("all well", {}, 1),
    ("no fix", NO_FIX, 2),
    ("no fix, not yet for long", {**NO_FIX, "no_fix_s": NO_FIX_S - 0.1}, None),
    ("no fix, our position not yet steady", {**NO_FIX, "sent_s": STEADY_S - 0.1}, None),
    ("no fix, our position does not go out", {**NO_FIX, **MUTE}, None),
    ("no fix, no witness", {**NO_FIX, "witness": False}, 2),
    ("no fix, and GNSS was believed false", {**NO_FIX, **LIE}, 2),
    ("receiver silent", SILENT, 2),
    ("receiver silent, not yet for long", {**SILENT, "silent_s": SILENT_S - 0.1}, None),
    ("receiver silent, our position does not go out", {**SILENT, **MUTE}, None),
    ("never received, a companion alone", {**SILENT, "silent_s": -1.0}, None),
    ("GNSS false with a witness", LIE, 2),
    ("GNSS false without a witness", {**LIE, "witness": False}, None),
    ("GNSS false, but the autopilot flies by the other receiver", {**LIE, "by_other": True}, None),
    ("GNSS probably false", {**LIE, "gnss_false": FALSE}, None),
    ("GNSS false, our position does not go out", {**LIE, **MUTE}, None),
    ("GNSS suspect", {"gnss_false": 0.5}, None),
    ("GNSS suspect, our position does not go out", {**MUTE, "gnss_false": 0.5}, 1),
    ("GNSS false without a witness, nothing goes out", {**LIE, **MUTE, "witness": False}, 1),
    ("GNSS believed, the fix is new", {"fix_s": FIX_S - 0.1}, None),
    ("GNSS nearly believed", {"gnss_false": BELIEVED}, None),
    ("no solution", BLIND, 1),
    ("no solution, the fix is new, nothing goes out", {**BLIND, "fix_s": 0.0}, 1),
    ("no solution ever", {**BLIND, "stopped_s": -1.0}, 1),
    ("no solution ever, the fix is new", {**BLIND, "stopped_s": -1.0, "fix_s": FIX_S - 0.1}, None),
    ("our position has just stopped, the fix is new", {**MUTE, "fix_s": 0.0, "stopped_s": 1.9}, None),
    ("no solution, no fix", {**BLIND, **NO_FIX}, None),
]


@pytest.mark.parametrize(("changes", "expected"), [row[1:] for row in TABLE], ids=[row[0] for row in TABLE])
def test_table(changes: dict[str, Any], expected: int | None) -> None:
    decision = required_set(WELL._replace(**changes))
    assert (decision and decision[0]) == expected


def test_every_predicate_decides_a_row_and_gives_its_reason() -> None:
    decisions = [required_set(WELL._replace(**changes)) for _, changes, _ in TABLE]
    reasons = {decision[1] for decision in decisions if decision is not None}
    assert reasons == {predicate.reason for predicate in (*TO_COMPANION, *TO_GNSS)}


seconds = st.one_of(st.just(-1.0), st.floats(0.0, 100.0))
situations = st.builds(
    Situation,
    fix_s=seconds,
    no_fix_s=seconds,
    silent_s=seconds,
    gnss_false=st.one_of(st.none(), st.floats(0.0, 1.0)),
    witness=st.booleans(),
    sent_s=seconds,
    stopped_s=seconds,
    by_other=st.booleans(),
)


@given(situations)
def test_set_2_needs_our_position_and_a_reason_of_the_receiver_or_of_a_witness(s: Situation) -> None:
    if (decision := required_set(s)) and decision[0] == 2:
        held_false = s.witness and s.gnss_false is not None and s.gnss_false > FALSE
        assert s.sent_s >= STEADY_S
        assert s.no_fix_s >= NO_FIX_S or s.silent_s >= SILENT_S or held_false


@given(situations)
def test_set_1_needs_a_fix_that_is_not_held_false(s: Situation) -> None:
    if (decision := required_set(s)) and decision[0] == 1:
        assert s.fix_s >= 0.0
        assert not (s.witness and s.gnss_false is not None and s.gnss_false > FALSE)
