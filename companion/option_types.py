"""Parameter types of the commands' options."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import click


class InputPath(click.Path):
    """Path of a file or folder to read. An empty one is rejected: pathlib takes it for the current folder.

    A file that cannot be read is reported by its reader, with that one's exit code.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        """Convert to a path."""
        if not str(value):
            self.fail("'' is no name: give that of a file", param, ctx)
        return Path(os.fsdecode(super().convert(value, param, ctx)))


INPUT_PATH = InputPath(readable=False)


class FloatRange(click.FloatRange):
    """Finite number within limits. Infinity is accepted where it is the default: it means no end."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert to a number within the limits; NaN passes every comparison with them."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number) and (param is None or number != param.default):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class FloatList(click.ParamType):  # type: ignore[type-arg]
    """Finite numbers within limits, written A,B,C; a tuple."""

    name = "number,..."

    def __init__(self, *limits: Any, **more_limits: Any) -> None:
        """Take the limits of one number, those of `FloatRange`."""
        self._number = FloatRange(*limits, **more_limits)

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, ...]:
        """Convert each number of the list."""
        return tuple(self._number.convert(word, param, ctx) for word in str(value).split(","))
