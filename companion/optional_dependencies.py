"""Error text for missing optional dependencies."""

from __future__ import annotations


def missing_package(what: str, package: str | None, extra: str) -> str:
    """Return the sentence that `what` needs `package`, and how to install it, from a wheel or a checkout."""
    return f"{what} needs {package}: run `pip install {package}`, or `pip install '.[{extra}]'` in a checkout"
