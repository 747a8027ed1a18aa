"""Conversion of another recorder's log to MCAP: its records only, nothing computed."""

from __future__ import annotations

from pathlib import Path

from companion.analysis.replay import create_replay_log
from companion.analysis.replay_inputs import CONVERTED, input_errors_as_log_errors, is_own_log
from companion.config import Config
from companion.importers import sources
from companion.importers.sources import ImportSummary
from companion.printable import printable
from companion.storage.flight_log import topic_of_input
from companion.storage.reader import LogError, open_log


def convert_log(source: Path, output: Path, config: Config) -> ImportSummary:
    """Write the records of `source` to `output`. Raises LogError if it cannot be read or written.

    `config` selects the vehicle of a telemetry log with several. Events and rejections of the
    importer go to topics under /link, as in a replay.
    """
    with input_errors_as_log_errors():
        if is_own_log(source):
            with open_log(source):
                raise LogError(f"{source} is already an MCAP log: nothing to convert")
        if output.exists():
            raise LogError(f"{output} already exists: give another name")
        records = sources.open_source(source, config.link.system_id or None)
        with create_replay_log(output, source, {CONVERTED: {"from": printable(source.name)}}) as sink:
            for record in records:
                sink.record(record, topic_of_input(record))
    return records.summary()
