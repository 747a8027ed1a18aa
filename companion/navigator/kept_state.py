"""State of the navigator as bytes: a run of the service that ended in flight is gone on with by the next one.

Kept are the likeliest hypotheses and all that the navigator remembers beside them. Not kept are the window of
the guaranteed bound, which begins again, and the filters beside the bank, which start from it again.
"""

from __future__ import annotations

from typing import Any
from zlib import crc32

import msgspec
import numpy as np
from msgspec import structs

from companion.estimate import bank as banks
from companion.navigator.minimax_bound import Guarantee
from companion.navigator.state import Settings, State, hypotheses

MOST_ROWS = 32  # of the bank: 0.3 MB
CRC_BYTES = 4
MOST_AGE_S = 60.0  # of a state that is gone on with: its velocity held, one sigma of the position is 1 km


def encode(state: State) -> bytes:
    """Encode what the next run needs of a state. Takes 0.3 ms."""
    bank = state.bank
    if bank is not None:
        bank = banks.picked(bank, np.argsort(-bank.L, kind="stable")[:MOST_ROWS])
        bank = bank._replace(L=bank.L - np.logaddexp.reduce(bank.L))
    kept = structs.replace(
        state,
        bank=bank,
        guarantee=Guarantee(),
        parallel=None,
        newborn=None,
        leading=None,
        protection=None,
        pending=None,
        half=None,
    )
    data: bytes = _encoder.encode(kept)
    return crc32(data).to_bytes(CRC_BYTES, "little") + data


def decode(data: bytes, settings: Settings) -> State:
    """Return the state that `encode` was given under the same settings. Raises ValueError if it is none."""
    crc, data = data[:CRC_BYTES], data[CRC_BYTES:]
    if crc32(data).to_bytes(CRC_BYTES, "little") != crc:
        raise ValueError("it is damaged")
    try:
        state = _decoder.decode(data)
    except msgspec.MsgspecError as error:
        raise ValueError(str(error)) from error
    bank, nominal = state.bank, state.nominal
    if bank is None or nominal is None or not state.fixed:
        raise ValueError("it has no position")
    layout, rows = hypotheses(state, settings).layout, len(bank.L)
    shapes = (rows, layout.n), (rows, layout.n, layout.n), (len(layout.sources),)
    if (bank.x.shape, bank.P.shape, bank.seen.shape) != shapes or not banks.is_sound(bank):
        raise ValueError("its hypotheses do not fit")
    return state


def _as_bytes(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, np.generic):
        return value.item()
    return dict(value)  # a mapping that cannot be written to


def _as_array(kind: Any, value: Any) -> Any:
    dtype, shape, data = value
    return np.frombuffer(data, dtype).reshape(shape).copy()


_encoder = msgspec.msgpack.Encoder(enc_hook=_as_bytes)
_decoder = msgspec.msgpack.Decoder(State, dec_hook=_as_array)
