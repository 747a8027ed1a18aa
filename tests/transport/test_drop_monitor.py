"""When it is said that a line does not carry what is sent: at the beginning and at the end, not between."""

from companion.transport.address import Address
from companion.transport.drop_monitor import QUIET_S, Shortfall

SERIAL = Address.parse("serial:/dev/ttyS0:57600")


def test_the_beginning_and_the_end_are_said_once_each_with_their_numbers() -> None:
    shortfall = Shortfall(SERIAL)
    said = [shortfall.look(dropped, t) for t, dropped in enumerate([0, 0, 3, 9, 9, 20])]
    assert [text for text in said if text] == [
        "serial:/dev/ttyS0:57600: the line does not carry what is sent, "
        "what waits longer than 0.5 s is dropped: lower the rates or raise the baud rate"
    ]
    assert said[2] and shortfall.lasts
    assert shortfall.look(20, 5 + QUIET_S - 1) is None
    over = "serial:/dev/ttyS0:57600: the line carries what is sent again; 20 frames were dropped"
    assert shortfall.look(20, 5 + QUIET_S) == over
    assert not shortfall.lasts and shortfall.look(20, 100.0) is None


def test_a_line_at_its_limit_that_drops_now_and_then_is_told_once() -> None:
    shortfall = Shortfall(SERIAL)
    said = [shortfall.look(1 + t // 7, float(t)) for t in range(3600)]
    assert sum(text is not None for text in said) == 1


def test_the_next_one_counts_anew() -> None:
    shortfall = Shortfall(Address.parse("tcpin:5760"))
    shortfall.look(5, 0.0)
    assert "; 5 frames" in (shortfall.look(5, 20.0) or "")
    assert "baud" not in (shortfall.look(7, 30.0) or "baud")
    assert "; 2 frames" in (shortfall.look(7, 50.0) or "")
