"""Tables of the commands: compact, and never cut where the terminal is narrow or is a pipe."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

_WIDEST = 1000


def print_tables(*tables: Table) -> None:
    """Print tables at their natural width."""
    for table in tables:
        table.box, table.padding, table.show_edge = SIMPLE_HEAD, (0, 1, 0, 0), False
        console = Console()
        natural = Measurement.get(console, console.options.update(width=_WIDEST), table).maximum
        Console(width=max(console.width, natural)).print(table)
