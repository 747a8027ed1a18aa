"""Text from outside (logs, messages, file names) made safe for a terminal."""

from __future__ import annotations


def printable(text: str) -> str:
    r"""Return `text` with control and invisible characters written as escapes (\x1b); line ends stay."""
    return "".join(
        c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode("ascii") for c in text
    )
