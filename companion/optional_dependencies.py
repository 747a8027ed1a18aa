"""Missing optional dependencies: found before the work that needs them, and the text of the error."""

from __future__ import annotations

from importlib.util import find_spec


def missing_package(what: str, package: str | None, extra: str) -> str:
    """Return the sentence that `what` needs `package`, and how to install it, from a wheel or a checkout."""
    return f"{what} needs {package}: run `pip install {package}`, or `pip install '.[{extra}]'` in a checkout"


def first_missing(*packages: str) -> str | None:
    """Return the first of the packages that is not installed."""
    return next((package for package in packages if find_spec(package) is None), None)
