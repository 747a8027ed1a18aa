"""Jobs run by many processes (Dask), and their journal, by which an interrupted run continues."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError
from contextlib import ExitStack
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from companion import interrupt
from companion.optional_dependencies import missing_package

if TYPE_CHECKING:
    from dask.distributed import Future

Job = TypeVar("Job")

WORKER_LOST = "worker lost"
SILENT = "100"  # a level above critical: what Dask loses is stated by `run_jobs`
#: The variable of the environment, which workers inherit, leaves the level of the last two unchanged.
DASK_LOGGERS = ("distributed", "distributed.client", "distributed.gc")
#: One thread of linear algebra a worker. Dask's own MALLOC_TRIM_THRESHOLD_ is left out: by it every array of
#: more than 128 KiB goes back to the kernel, and a third of a flight's time into page faults.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


class FinishedJob(NamedTuple):
    """Result of a job by its key; `failure` states why there is none."""

    key: str
    result: Any
    failure: str = ""


def run_jobs(
    work: Callable[[Job], Any], jobs: Mapping[str, Job], scheduler: str | None, workers: int, extra: str
) -> Iterator[FinishedJob]:
    """Yield each job when it is finished, in any order.

    Parameters
    ----------
    work : a function of a module; what it raises is a failure of the job, except in this process.
    jobs : by key.
    scheduler : address of a Dask scheduler; None for a cluster of this machine.
    workers : processes of that cluster; with 0 the jobs run in this process, one after another.
    extra : optional dependencies that contain Dask, named if it is missing.

    Raises ValueError if Dask is missing, or its scheduler is not found or lost. A job whose worker died is
    retried by another.
    """
    if scheduler is None and workers == 0:
        yield from (FinishedJob(key, work(job)) for key, job in jobs.items())
        return
    quiet = os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", SILENT) == SILENT
    with interrupt.held():  # an interrupted import ends in another error
        try:
            from dask import config
            from dask.distributed import Client, KilledWorker, LocalCluster
        except ImportError:
            missing = missing_package("work by many processes", "Dask", extra)
            raise ValueError(f"{missing}, or use --workers 0") from None
    for name in DASK_LOGGERS if quiet else ():
        logging.getLogger(name).setLevel(int(SILENT))
    finished: SimpleQueue[Future | None] = SimpleQueue()  # None: interrupted
    noted = interrupt.passed_to(lambda: finished.put(None))
    with ExitStack() as stack:
        if scheduler is None:
            stack.enter_context(noted)
            with interrupt.held(), config.set({"distributed.nanny.pre-spawn-environ": ENVIRONMENT}):
                cluster = stack.enter_context(
                    LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0")
                )
            client = stack.enter_context(Client(cluster))
        else:
            try:
                client = stack.enter_context(Client(scheduler))
            except (OSError, ValueError) as error:
                raise ValueError(
                    f"--scheduler {scheduler}: {error}: give the HOST:PORT of a Dask scheduler that runs, or"
                    " leave it out for workers on this machine"
                ) from None
            stack.enter_context(noted)
        keys = {client.submit(work, job, key=key, pure=False): key for key, job in jobs.items()}
        for future in keys:
            future.add_done_callback(finished.put)
        for _ in keys:
            if (future := finished.get()) is None:
                raise KeyboardInterrupt
            try:
                failure = future.exception()  # of a result that was lost with its worker: after another try
                result = future.result() if failure is None else None
            except CancelledError:
                raise ValueError("Dask scheduler lost: start again, finished work is kept") from None
            why = f"{WORKER_LOST}: {failure}" if isinstance(failure, KilledWorker) else repr(failure)
            yield FinishedJob(keys[future], result, "" if failure is None else why)
            future.release()
    if not finished.empty():
        raise KeyboardInterrupt


class Journal:
    """One JSON object a line, appended: a kill while writing loses the last line only."""

    def __init__(self, path: Path) -> None:
        """Open the journal, which may not exist. Raises ValueError if it is another file."""
        self.path = path
        self.entries: list[dict[str, Any]] = []
        if not path.exists():
            return
        data = path.read_bytes()
        whole = data[: data.rfind(b"\n") + 1]
        if len(whole) < len(data):
            os.truncate(path, len(whole))
        try:
            self.entries = [dict(json.loads(line)) for line in whole.splitlines()]
        except (ValueError, TypeError) as error:
            raise self.invalid(error) from None

    def invalid(self, error: Exception) -> ValueError:
        """Return the error that an entry of another kind is."""
        return ValueError(f"{self.path}: invalid result ({error}); choose another --results folder")

    def append(self, entry: Mapping[str, Any]) -> None:
        """Write one entry."""
        with self.path.open("ab") as file:
            file.write(json.dumps(entry).encode() + b"\n")
