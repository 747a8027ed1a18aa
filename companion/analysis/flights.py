"""Any log as the flights it holds: as they flew with us, or with the navigator run over what was recorded.

An MCAP of ours holds what came out of the navigator. Another recorder's log, and an MCAP converted from one,
holds inputs only: the navigator is run over it here, in memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from companion.analysis.flight_arrays import Flight, gather
from companion.analysis.replay import metadata
from companion.analysis.replay_inputs import has_flown, inputs, is_own, sentences
from companion.config import Config
from companion.navigator import Navigator
from companion.records import INPUTS, OUTPUTS, Stamped
from companion.storage import flight_log
from companion.storage.reader import LogError

CHANNELS = {
    "local_position": "the autopilot's local position, which may rest on that GNSS (see inertial.source)",
    "air_data": "air-data dead reckoning",
    "strapdown": "a strapdown reckoning of its own",
}


def open_flights(path: Path, config: Config) -> list[Flight]:
    """The flights in the log at `path`; `config` is what the navigator flies with where none flew.

    LogError, one sentence, where the file cannot be read or holds nothing.
    """
    with sentences():
        first_unix_ns, remarks = None, list[str]()
        if is_own(path):
            info = flight_log.info(path)
            first = next(iter(flight_log.read(path)), None)
            if first is None:
                raise LogError(f"{path} holds no message: there is nothing to report")
            first_unix_ns = first.log_time
            if not info.closed:
                lost = f"{info.bytes_lost} bytes at its end are lost"
                remarks.append(f"The log is torn: it was not closed, and {lost}.")
            if has_flown(path):
                return gather(
                    _as_flown(path),
                    path.name,
                    unix_ns=first_unix_ns,
                    metadata=info.metadata,
                    remarks=tuple(remarks),
                )
        remarks.append(
            "Another recorder's log: the navigator was run over it for this report, the inertial channel "
            f"being {CHANNELS[config.channel]}."
        )
        return gather(
            _run_over(inputs(path).records, config),
            path.name,
            unix_ns=first_unix_ns,
            metadata=metadata(config),
            remarks=tuple(remarks),
        )


def _as_flown(path: Path) -> Iterator[tuple[str, Stamped]]:
    for entry in flight_log.read(path):
        if not isinstance(entry.value, bytes):
            yield entry.topic, entry.value


def _run_over(records: Iterable[Stamped], config: Config) -> Iterator[tuple[str, Stamped]]:
    navigator = Navigator(config)
    for record in records:
        kind = type(record)
        told = isinstance(record, OUTPUTS)  # by the source, not by the navigator
        yield f"/link/{kind.__name__}" if told else flight_log.topic_of(kind), record
        if isinstance(record, INPUTS):
            for output in navigator.handle(record):  # type: ignore[arg-type]
                yield flight_log.topic_of(type(output)), output
