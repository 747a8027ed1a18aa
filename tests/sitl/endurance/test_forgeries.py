"""What strangers can do: nothing on a signed link, no displacement from an address of their own."""

import pytest
from click.testing import CliRunner

from sitl.endurance.forgeries import FORGERIES, KEY, SENDERS, STRANGERS_KEY, Sent, compare, fly, forger, main
from sitl.endurance.parameter_sweep import CONFIGS

CONFIG = CONFIGS[1]


@pytest.fixture(scope="module")
def plain() -> Sent:
    return fly(CONFIG, lambda now: [])


def test_no_forged_frame_has_an_effect_on_a_signed_link() -> None:
    """All forgeries from all senders at once: unsigned, and signed with another key."""
    rows = [
        forger(name, sender, key) for name in FORGERIES for sender in SENDERS for key in (None, STRANGERS_KEY)
    ]
    alone = fly(CONFIG, lambda now: [], KEY)
    attacked = fly(CONFIG, lambda now: [frame for row in rows for frame in row(now)], KEY)
    assert len(alone.odometry) > 300
    assert attacked.messages == alone.messages


@pytest.mark.parametrize("sender", ["another system", "autopilot's ids"])
def test_positions_are_not_moved_from_another_address(plain: Sent, sender: str) -> None:
    """Every message but beacon answers, which may come from any sender, and the services of stations."""
    rows = [
        forger(name, sender)
        for name in FORGERIES
        if name != "RSBN_MEASUREMENT" and not name.startswith(("PARAM", "COMMAND_LONG"))
    ]
    effect = compare(plain, fly(CONFIG, lambda now: [frame for row in rows for frame in row(now)]))
    assert effect.displaced_m < 1.0
    assert effect.share > 0.95


def test_an_unknown_message_is_named() -> None:
    """Regression: a traceback, after two flights."""
    done = CliRunner().invoke(main, ["--only", "TERM"])
    assert (done.exit_code, "'TERM' is not one of 'HEARTBEAT'" in done.output) == (2, True)
