"""PX4 topics as CSV files in a folder (`vehicle_gps_position.csv.gz`, ...) -> records.

The files may be named as by ulog2csv (`flight_vehicle_gps_position_0.csv`: log, topic, instance), of one log.
Each file is one uORB topic, `timestamp` in microseconds since boot, converted as in a ULog of any version of
PX4. The rows of all topics are merged by time; arrival and validity are the same instant, as the log is
written on board. A row that is not one of its topic is skipped and reported.
"""

from __future__ import annotations

import csv
import gzip
import heapq
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias, cast

from companion.importers import ulog
from companion.importers.foreign_file import Damage, one_line, steady_steps
from companion.records import Stamped
from companion.storage.reader import LogError, open_regular

Row: TypeAlias = dict[str, str]

MAX_LINE = 1 << 16  # bytes
MAX_EXPANSION = 60
"""Largest ratio of uncompressed and compressed size; recorded topics reach 10."""


class _Numbers(dict[str, Any]):
    """A row as numbers. A cell is read when it is needed: one that is not may be damaged."""

    def __getitem__(self, name: str) -> float:
        return float(super().__getitem__(name))

    def get(self, name: str, default: Any = None) -> Any:
        try:
            return self[name]
        except KeyError:
            return default


class CsvFolder:
    """The topics of a folder, to be iterated once. Raises LogError if no known topic is found."""

    def __init__(self, folder: Path) -> None:
        self.damage = Damage()
        found = _by_topic(sorted(folder.glob("*.csv*")))
        self._known = [(found[name], topic) for name, topic in ulog.supported_topics(found).items()]
        if not self._known:
            raise LogError(
                f"{folder} has no topic of PX4 as CSV, such as vehicle_gps_position.csv: give a log, or a"
                " folder of the topics of one log"
            )

    def __iter__(self) -> Iterator[Stamped]:
        """Yield the records of all topics by time."""
        topics = (self._records(path, topic) for path, topic in self._known)
        return heapq.merge(*topics, key=lambda record: record.t_ns)

    def _records(self, path: Path, topic: ulog.Topic) -> Iterator[Stamped]:
        def stamped() -> Iterator[tuple[int, int, Row]]:
            for number, row in self._rows(path):
                try:
                    yield int(row["timestamp"]), number, row
                except (KeyError, TypeError, ValueError) as error:
                    self.damage.add(f"line {number} of {path.name}", 0, one_line(error))

        for step in steady_steps(stamped(), self.damage):
            try:
                yield from topic(_Numbers(step.item), (step.boot_us + step.shift_us) * 1000)
            except KeyError as error:  # once for all rows
                self.damage.add(path.name, 0, f"no column {error}: unsupported PX4 version")
                return
            except (TypeError, ValueError, OverflowError) as error:
                place = f"{path.name} at {step.boot_us} us"
                self.damage.add(place, 0, f"not a row of its topic: {one_line(error)}")

    def _rows(self, path: Path) -> Iterator[tuple[int, Row]]:
        """Yield line number and row. The file ends where it cannot be read."""
        try:
            with open_regular(path) as file:
                lines = _lines(file, path, self.damage)
                yield from enumerate(csv.DictReader(lines), start=2)
        except (OSError, EOFError, zlib.error, csv.Error) as error:
            self.damage.add(path.name, 0, f"the rest of the file: {one_line(error)}")


def _by_topic(paths: Sequence[Path]) -> dict[str, Path]:
    """Return the files by topic, without the name of a log that they all begin with."""
    names = {path.name.partition(".csv")[0].removesuffix("_0"): path for path in paths}
    first = min(names, default="")
    begins = ["", *(first[:i] for i, letter in enumerate(first, start=1) if letter == "_")]
    shared = [begin for begin in begins if all(name.startswith(begin) for name in names)]
    found = [{name.removeprefix(begin): path for name, path in names.items()} for begin in shared]
    return max(found, key=lambda files: len(ulog.supported_topics(files)))


def _lines(file: BinaryIO, path: Path, damage: Damage) -> Iterator[str]:
    """Yield the lines of a text file, or of a gzip-compressed one that does not expand without bounds."""
    packed = path.suffix == ".gz"
    limit = MAX_EXPANSION * path.stat().st_size + (1 << 20)
    source: BinaryIO = cast(BinaryIO, gzip.GzipFile(fileobj=file)) if packed else file
    total = 0
    while line := source.readline(MAX_LINE + 1):
        total += len(line)
        if packed and total > limit:
            damage.add(path.name, 0, f"it expands to more than {MAX_EXPANSION} times its size")
            return
        if len(line) > MAX_LINE:
            damage.add(path.name, 0, f"a line is longer than {MAX_LINE} bytes")
            return
        # a quote that is not closed would hold the rest of the file; numbers need none
        yield line.decode("utf-8", "replace").replace("\0", "").replace('"', "")
