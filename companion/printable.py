"""Text from outside (logs, messages, file names) made safe for one line of a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return `text` in one line: control and invisible characters and line ends as escapes (\x1b, \n)."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
