"""A log to be flown otherwise than it was: its inputs with beacons heard, outages had; a configuration with
keys changed.

It opens any log, ours or a foreign one, for its inputs alone; `replay` flies them.
"""

from __future__ import annotations

import heapq
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import msgspec
from msgspec import structs

from companion.analysis import simulated_rsbn
from companion.config import Config, ConfigError, load
from companion.importers import sources
from companion.records import Stamped
from companion.storage import flight_log
from companion.storage.reader import ACTIVE, LogError

CONVERTED = "converted"  # the metadata record of a log that never flew with us, and its key `from`


def changed(config: Config, text: str) -> Config:
    """`config` with KEY=VALUE,... as typed: SECTION.KEY, or KEY alone where one section has it, or
    `estimator` for estimator.output. ConfigError, one sentence, where there is no such key or value, or where
    they do not go together.
    """
    pairs = [
        f"{section}.{key}={msgspec.json.encode(value).decode()}"
        for section in config.__struct_fields__
        for key, value in structs.asdict(getattr(config, section)).items()
    ]
    for pair in re.split(r",(?=[A-Za-z_.]+=)", text):
        name, _, value = pair.partition("=")
        pairs.append(f"{_full_name(name.strip())}={value}")
    try:
        return load(environment={}, pairs=pairs)
    except ConfigError as error:
        raise ConfigError(str(error).replace("--set", "--with")) from None


def _full_name(name: str) -> str:
    if "." in name:
        return name
    if name == "estimator":
        return "estimator.output"
    having = [section for section in Config.__struct_fields__ if hasattr(getattr(Config(), section), name)]
    if len(having) == 1:
        return f"{having[0]}.{name}"
    why = f"sections {', '.join(having)} have one each" if having else "no section has it"
    raise ConfigError(f"--with {name}: {why}; write it as SECTION.KEY=VALUE, for example gnss.sigma_m=3.0")


class Opened(NamedTuple):
    """The inputs of any log, and what it was given for its times: `summary` counts once they are read."""

    records: Iterable[Stamped]
    summary: Callable[[], dict[str, int]]


def inputs(log: Path) -> Opened:
    """What went into a navigator in `log`, ours or a foreign one, with the truth where it has any.

    LogError, one sentence, where it cannot be read.
    """
    if is_own(log):
        return Opened(_own_inputs(log), dict)
    with sentences():
        source = sources.open_source(log)
    return Opened(source, lambda: source.summary()._asdict())


def is_own(log: Path) -> bool:
    """Whether the name is that of a log of ours."""
    return log.suffix == ".mcap" or log.name.endswith(f".mcap{ACTIVE}")


def has_flown(log: Path) -> bool:
    """Whether a log is of ours and holds what a navigator gave out: it is no other recorder's, converted."""
    return is_own(log) and CONVERTED not in flight_log.metadata(log)


def _own_inputs(log: Path) -> Iterator[Stamped]:
    for entry in flight_log.read(log):
        if entry.topic.startswith(("/in/", "/truth/", "/link/")) and isinstance(entry.value, Stamped):
            yield entry.value


@contextmanager
def sentences() -> Iterator[None]:
    """What a foreign log's reader says in a ValueError is for the person who gave the log."""
    try:
        yield
    except ConfigError:
        raise
    except ValueError as error:
        raise LogError(str(error)) from None
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"{error.filename} cannot be read: {error.strerror}") from None


def with_radio(
    log: Path, beacons: Path | None, outages: Sequence[simulated_rsbn.Outage], seed: int, config: Config
) -> tuple[Opened, str]:
    """The inputs of `log` with beacons heard and outages had, and a sentence about the beacons.

    The log is read twice where there are beacons: once for its track.
    """
    opened = inputs(log)
    if beacons is None and not outages:
        return opened, ""
    records = iter(opened.records)
    first = next(records, None)
    if first is None:
        raise LogError(f"{log} holds no message: there is nothing to replay")
    merged, note = chain([first], records), ""
    if beacons is not None:
        track = simulated_rsbn.track_of(inputs(log).records, config)
        heard = simulated_rsbn.answers(simulated_rsbn.read_beacons(beacons), track, seed)
        numbers = sorted({answer.beacon for answer in heard})
        note = (
            f"{len(heard)} RSBN answers of {len(numbers)} beacons ({', '.join(map(str, numbers))}) simulated"
            f" along {track.origin}, seed {seed}"
            if heard
            else f"no beacon of {beacons} is in radio sight along {track.origin}"
        )
        merged = heapq.merge(merged, heard, key=lambda record: record.rx_ns)  # type: ignore[assignment]
    return Opened(simulated_rsbn.without(merged, outages, first.rx_ns), opened.summary), note
