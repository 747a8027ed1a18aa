"""The optional packages: what a person is told where one is missing."""

from __future__ import annotations


def lacking(what: str, package: str | None, extra: str) -> str:
    """A sentence: `what` needs `package`, and how to get it: the program itself is on no index."""
    return f"{what} needs {package}: run `pip install '.[{extra}]'` in the program's checkout"
