"""Recorded flights of tests/data as records."""

from __future__ import annotations

import gzip
from functools import lru_cache
from pathlib import Path

import msgspec

from companion.records import Input, Truth

DATA = Path(__file__).parent / "data"


@lru_cache(maxsize=2)
def recording(name: str) -> tuple[Input | Truth, ...]:
    """The records of `tests/data/{name}_cut.jsonl.gz`, in their order."""
    decoder: msgspec.json.Decoder[Input | Truth] = msgspec.json.Decoder(Input | Truth)
    with gzip.open(DATA / f"{name}_cut.jsonl.gz") as lines:
        return tuple(decoder.decode(line) for line in lines)
