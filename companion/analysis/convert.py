"""A log of another recorder as an MCAP of ours: its records, and nothing computed from them."""

from __future__ import annotations

from pathlib import Path

from companion.analysis.replay import writer
from companion.analysis.replay_inputs import CONVERTED, is_own, sentences
from companion.importers import sources
from companion.importers.sources import Summary
from companion.records import OUTPUTS
from companion.storage.reader import LogError, opened


def convert(source: Path, output: Path) -> Summary:
    """Write the records of `source` to `output`. LogError, one sentence, where it cannot be read or written.

    What the source itself tells (events, refused messages) goes to topics under /link, as in a replay.
    """
    with sentences():
        if is_own(source):
            with opened(source):
                raise LogError(f"{source} is an MCAP log already: there is nothing to convert")
        if output.resolve() == source.resolve() or output.exists():
            raise LogError(f"{output} is there already: give another name")
        records = sources.open_source(source)
        sink = writer(output, {CONVERTED: {"from": source.name}})
        try:
            for record in records:
                told = isinstance(record, OUTPUTS)
                sink.record(record, f"/link/{type(record).__name__}" if told else None)
        finally:
            sink.close()
        if sink.trouble:
            raise LogError(f"{output} is not whole: {sink.trouble}")
    return records.summary()
