"""Command-line options of every command that works by many processes: --scheduler and --workers."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])


def worker_options(command: Command) -> Command:
    """Add the options; they arrive as `scheduler` and `workers`, the arguments of `run_jobs`."""
    scheduler = click.option(
        "--scheduler",
        is_eager=True,  # known when the number of workers is checked
        help="Address of a Dask scheduler; default: a local cluster.",
    )
    workers = click.option(
        "--workers",
        type=click.IntRange(0),
        callback=_workers,
        help="Processes of the local cluster; 0: work in this process. Default: one per processor.",
    )
    return scheduler(workers(command))


def _workers(context: click.Context, parameter: click.Parameter, workers: int | None) -> int:
    scheduler = context.params.get("scheduler")
    if workers is not None and scheduler is not None:
        raise click.UsageError(
            f"--workers {workers} has no effect with --scheduler {scheduler}, which has its own workers:"
            " leave one of them out"
        )
    return (os.cpu_count() or 1) if workers is None else workers
