"""Tables of the commands: compact, and never cut where the terminal is narrow or is a pipe."""

from __future__ import annotations

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

_WIDEST = 1000


def number_table(title: str, *heads: str, texts: int = 1, caption: str | None = None) -> Table:
    """Return an empty table: the first `texts` columns are left-justified, the others right-justified."""
    table = Table(title=title, caption=caption)
    for k, head in enumerate(heads):
        table.add_column(head, justify="left" if k < texts else "right")
    return table


def print_tables(*tables: Table) -> None:
    """Print tables at their natural width."""
    for table in tables:
        table.box, table.padding, table.show_edge = SIMPLE_HEAD, (0, 1, 0, 0), False
        console = Console(markup=False)  # a bracket is text: a unit, a file name
        natural = Measurement.get(console, console.options.update(width=_WIDEST), table).maximum
        Console(width=max(console.width, natural), markup=False).print(table)
