"""Trust in the position: worse at once, better only after a while."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from companion.navigator import trust
from companion.navigator.trust import Evidence, Held, Limits
from companion.records import Trust

NS = 1_000_000_000
GOOD = Evidence(True, False, 10.0)
evidence = st.builds(Evidence, st.booleans(), st.booleans(), st.floats(0.0, 1e4))


@settings(max_examples=200)
@given(st.lists(evidence, min_size=1, max_size=60))
def test_trust_falls_at_once_and_rises_after_settling(course: list[Evidence]) -> None:
    limits = Limits(settle_s=5.0)
    held = Held(Trust.UNTRUSTED, 0)
    for t, now in enumerate(course, 1):
        before, held = held, trust.turn(held, t * NS, now, limits)
        assert held.trust >= trust.judge(now, limits)
        if held.trust < before.trust:
            better = course[t - 6 : t]
            assert len(better) == 6
            assert all(trust.judge(e, limits, limits.clear) < before.trust for e in better)


def test_trust_has_hysteresis_at_its_limit() -> None:
    limits, held = Limits(protection=100.0), Held(Trust.NORMAL, 0)
    changes = 0
    for t in range(1, 400):
        level = 100.0 + 5.0 * (-1) ** t
        before, held = held, trust.turn(held, t * NS, GOOD._replace(protection=level), limits)
        changes += held.trust is not before.trust
    assert changes == 1
    assert held.trust is Trust.DEGRADED
    for t in range(400, 420):
        held = trust.turn(held, t * NS, GOOD, limits)
    assert held.trust is Trust.NORMAL
    assert trust.turn(held, 421 * NS, Evidence(False, False, 6000.0), limits).trust is Trust.UNTRUSTED
    assert trust.turn(held, 421 * NS, Evidence(False, False, 60.0), limits).trust is Trust.PREDICTING
