"""Text from outside cannot control the terminal, nor print a line of its own."""

import pytest

from companion.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain text, Größe 5 µm", "plain text, Größe 5 µm"),
        ("topic\nok: closed\u2028\x85\r", r"topic\nok: closed\u2028\x85\r"),
        ("\x1b]0;title\x07\x1b[2J", r"\x1b]0;title\x07\x1b[2J"),
        ("C1 \x9b31m, DEL \x7f, return \r", r"C1 \x9b31m, DEL \x7f, return \r"),
        ("bidi \u202egnp.exe", r"bidi \u202egnp.exe"),
        ("surrogate \udcff", r"surrogate \udcff"),
    ],
)
def test_control_characters_are_escaped(text: str, shown: str) -> None:
    assert printable(text) == shown
