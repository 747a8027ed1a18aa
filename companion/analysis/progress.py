"""Progress of a command: one line on a terminal's stderr, removed at the end; nothing elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rich import progress as bars
from rich.console import Console
from rich.markup import escape

from companion.printable import printable

Item = TypeVar("Item")


@contextmanager
def show_step(first: str) -> Iterator[Callable[[str], None]]:
    """Show the step in progress and its time; yield the function that names the next step."""
    columns = (bars.SpinnerColumn(), bars.TextColumn("{task.description}"), bars.TimeElapsedColumn())
    console = Console(stderr=True)
    with bars.Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task(escape(printable(first)))
        yield lambda step: progress.reset(task, description=escape(printable(step)))


def show_items(items: Sequence[Item], what: str) -> Iterable[Item]:
    """Yield the items and show the share that is done."""
    return bars.track(items, what, console=Console(stderr=True), transient=True)


def show_count() -> bars.Progress:
    """Return the progress of many jobs: how many are done, and the time that remains."""
    columns = bars.TextColumn("{task.description}"), bars.MofNCompleteColumn(), bars.TimeRemainingColumn()
    return bars.Progress(*columns, console=Console(stderr=True), transient=True)
