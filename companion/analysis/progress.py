"""Progress of a command: one line on a terminal's stderr, removed at the end; nothing elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from companion.printable import printable


@contextmanager
def show_step(first: str) -> Iterator[Callable[[str], None]]:
    """Show the step in progress and its time; yield the function that names the next step."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(escape(printable(first)))
        yield lambda step: progress.reset(task, description=escape(printable(step)))
