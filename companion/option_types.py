"""Parameter types of the commands' options."""

from __future__ import annotations

import math
from typing import Any

import click


class FloatRange(click.FloatRange):
    """Finite number within limits. Infinity is accepted where it is the default: it means no end."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert to a number within the limits; NaN passes every comparison with them."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number) and (param is None or number != param.default):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number
