"""`python -m sitl.endurance.file_mutants`: mutated logs of every format, each read by its reader.

    python -m sitl.endurance.file_mutants --mutants 20000     # a process per format; exit code 1 on a defect

A mutant is a valid small log with a few bytes, numbers or parts changed, removed, inserted or repeated. Its
reader gives records that can be stored, or one LogError of one line. Anything else is a defect, as is more
processor time than `SLOWEST_S` for a mutant or more memory than `MOST_MB` for the process. A mutant with a
defect is kept in the folder of the results.
"""

from __future__ import annotations

import math
import multiprocessing
import queue
import random
import resource
import signal
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import click

from companion.importers import sources
from companion.storage.reader import LogError
from sitl.endurance.fuzz_targets import IN_MEMORY, check_record, read_log
from sitl.endurance.sample_logs import SAMPLES

SLOWEST_S = 2.0
MOST_MB = 300.0
MOST_PROCESSES = 2000  # mutants of a format that is read in a process of its own
_NUMBERS = (
    *(struct.pack("<f", v) for v in (math.nan, math.inf, -1e38, 1e-40)),
    *(struct.pack("<d", v) for v in (math.nan, math.inf, -1e308, 5e-324)),
    *(struct.pack("<q", v) for v in (0, -1, 2**63 - 1, -(2**63), 2**31)),
    *(b"nan", b"-inf", b"1e999", b"9" * 400, b"\n", b",", b"[65535]", b"\xa3\x95\x80", b"\xfd\x00\x00"),
    *(b"<!--<script>", b"\x1b]0;x\x07", b"../../x", b"\0"),
)


class MutantReport(NamedTuple):
    """Counts of one format: mutants read (whole or in part), rejected, defective; worst time and memory."""

    format: str
    mutants: int
    read: int
    rejected: int
    defects: int
    slowest_s: float
    peak_mb: float
    first_defect: str


def mutate(seed: bytes, rng: random.Random) -> bytes:
    """Return a mutant of `seed`: 1 to 8 edits, or a cut."""
    data = bytearray(seed)
    for _ in range(1 + int(rng.expovariate(0.7))):
        at, size = rng.randrange(len(data) + 1), int(rng.expovariate(0.1))
        match rng.randrange(8):
            case 0:
                data[at : at + 1] = bytes([rng.randrange(256)])
            case 1 if at < len(data):
                data[at] ^= 1 << rng.randrange(8)
            case 2:
                value = rng.choice(_NUMBERS)
                data[at : at + len(value)] = value
            case 3:
                data[at:at] = rng.choice((rng.randbytes(size), rng.choice(_NUMBERS)))
            case 4:
                del data[at : at + size]
            case 5:
                source = rng.randrange(len(data) + 1)
                data[at:at] = data[source : source + 10 * size] * rng.choice((1, 1, 1, 20))
            case 6:
                source = rng.randrange(len(data) + 1)
                part = bytes(data[source : source + size])
                data[at : at + len(part)] = part
            case 7 if rng.random() < 0.3:
                del data[at:]
    return bytes(data)


def read_foreign(path: Path) -> None:
    """Read another recorder's log to its end; every record can be stored. LogError as its reader."""
    source = sources.open_source(path)
    for record in source:
        check_record(record)
    source.summary()


class _TooSlow(BaseException):
    """Raised by the timer: the last guard of a reader must not catch it."""


def _stop(number: int, frame: object) -> None:
    raise _TooSlow


def read_mutants(name: str, count: int, seed: int, keep: Path | None = None) -> MutantReport:
    """Read `count` mutants of one format; those with a defect go to the folder `keep`."""
    file_name, build = SAMPLES[name]
    count = min(count, MOST_PROCESSES) if name == "mat" else count
    read = read_log if "mcap" in name else read_foreign
    original, rng = build(), random.Random(f"{name} {seed}")
    tally = {"read": 0, "rejected": 0, "defects": 0}
    slowest, first = 0.0, ""
    signal.signal(signal.SIGVTALRM, _stop)
    with tempfile.TemporaryDirectory(dir=IN_MEMORY) as scratch:
        for number in range(count):
            data = mutate(original, rng)
            path = Path(scratch) / file_name
            path.write_bytes(data)
            # a topic is read by its folder
            outcome, seconds, text = _outcome(read, path.parent if ".csv" in file_name else path)
            for left in path.parent.iterdir():
                left.unlink()
            tally[outcome] += 1
            slowest = max(slowest, seconds)
            if outcome == "defects":
                first = first or text
                if keep is not None:
                    keep.mkdir(parents=True, exist_ok=True)
                    (keep / f"{seed}-{number}-{file_name}").write_bytes(data)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    return MutantReport(name, count, **tally, slowest_s=slowest, peak_mb=peak, first_defect=first)


def _outcome(read: Callable[[Path], None], path: Path) -> tuple[str, float, str]:
    """Return "read", "rejected" or "defects", the processor time and what was wrong."""
    start = time.process_time()
    signal.setitimer(signal.ITIMER_VIRTUAL, SLOWEST_S)
    try:
        read(path)
    except LogError as error:
        outcome, text = ("defects", str(error)) if "\n" in str(error) else ("rejected", "")
    except _TooSlow:
        outcome, text = "defects", f"took more than {SLOWEST_S:g} s"
    except Exception as error:
        outcome, text = "defects", f"{type(error).__name__}: {error}"
    else:
        outcome, text = "read", ""
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
    return outcome, time.process_time() - start, text


def _run_inside(name: str, count: int, seed: int, keep: Path, results: multiprocessing.Queue) -> None:  # type: ignore[type-arg]
    results.put(read_mutants(name, count, seed, keep))


def run_formats(names: tuple[str, ...], count: int, seed: int, keep: Path) -> Iterator[MutantReport]:
    """Run each format in a process of its own, so that its memory can be measured."""
    context = multiprocessing.get_context("spawn")
    for name in names:
        results = context.Queue()
        process = context.Process(target=_run_inside, args=(name, count, seed, keep, results))
        process.start()
        report = None
        while report is None:
            try:
                report = results.get(timeout=1.0)
            except queue.Empty:
                if not process.is_alive():
                    text = f"the process ended with {process.exitcode}"
                    report = MutantReport(name, count, 0, 0, 1, math.nan, math.nan, text)
        yield report
        process.join()


@click.command()
@click.option("--format", "names", multiple=True, type=click.Choice(tuple(SAMPLES)), help="Default: all.")
@click.option("--mutants", type=click.IntRange(1), default=20_000, show_default=True, help="Per format.")
@click.option("--seed", type=click.IntRange(min=0), default=1, show_default=True, help="Seed of the mutants.")
@click.option(
    "--keep",
    type=click.Path(path_type=Path, file_okay=False),
    default=Path("logs/mutants"),
    show_default=True,
    help="Folder for the mutants with a defect.",
)
def main(names: tuple[str, ...], mutants: int, seed: int, keep: Path) -> None:
    """Read mutated logs of every format. Exit code 1 on a defect."""
    failed = False
    click.echo("format       mutants    read  rejected  defects  slowest s  peak MB")
    for found in run_formats(names or tuple(SAMPLES), mutants, seed, keep):
        failed |= bool(found.defects) or found.peak_mb > MOST_MB
        click.echo(
            f"{found.format:<11}{found.mutants:>9}{found.read:>8}{found.rejected:>10}{found.defects:>9}"
            f"{found.slowest_s:>11.3f}{found.peak_mb:>9.0f}  {found.first_defect[:100]}"
        )
    if failed:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
