"""STATUSTEXT: complete texts, rate limit, severity order; chunks are joined as in a ground station."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import dialect
from companion.link.status_text import BURST, INTERVAL, MAX_LENGTH, StatusText
from companion.records import Event
from tests.frames import on_wire

SECOND = 1_000_000_000


def joined(messages: list[dialect.Message]) -> list[tuple[int, str]]:
    """Return severity and text of each, chunks joined as the message's description requires."""
    texts: list[tuple[int, str]] = []
    parts: dict[int, bytes] = {}
    for message in messages:
        chunk = dialect.decode(on_wire(message, 1, 191))
        raw = chunk._text_raw
        if chunk.id == 0:
            texts.append((chunk.severity, raw.decode()))
            continue
        assert len(parts.get(chunk.id, b"")) == 50 * chunk.chunk_seq
        parts[chunk.id] = parts.get(chunk.id, b"") + raw
        if len(raw) < 50:
            texts.append((chunk.severity, parts.pop(chunk.id).decode()))
    assert not parts
    return texts


def texts_of(*events: tuple[int, str]) -> list[tuple[int, str]]:
    status_text = StatusText()
    for severity, text in events:
        status_text.add(Event(0, 0, severity, text), 0)
    return joined(status_text.to_send(0))


@pytest.mark.parametrize("size", [0, 1, 49, 50, 51, 99, 100, 101, 150, MAX_LENGTH - 1, MAX_LENGTH])
def test_a_text_arrives_whole_at_any_length(size: int) -> None:
    text = ("GNSS lost; beacon 7 " * 20)[:size]
    assert texts_of((4, text)) == [(4, text)]


@settings(max_examples=100)
@given(texts=st.lists(st.text(max_size=300), max_size=BURST))
def test_any_text_arrives_as_far_as_it_fits(texts: list[str]) -> None:
    received = texts_of(*[(6, text) for text in texts])
    assert len(received) == len(texts)
    for (_, there), here in zip(received, texts):
        here = here.replace("\0", " ").encode(errors="replace").decode()
        assert here.startswith(there) and (here == there or len(there.encode()) > MAX_LENGTH - 4)


def test_chunks_of_two_long_texts_have_different_ids() -> None:
    texts = [(4, "a" * 120), (4, "b" * 120)]
    status_text = StatusText()
    for severity, text in texts:
        status_text.add(Event(0, 0, severity, text), 0)
    messages = status_text.to_send(0)
    assert joined(messages) == texts and {m.id for m in messages} == {1, 2}


def test_debug_events_are_not_sent() -> None:
    assert texts_of((7, "debug"), (6, "info")) == [(6, "info")]


def test_most_severe_of_too_many_events_is_sent_with_the_number_of_the_others() -> None:
    status_text = StatusText()
    for i in range(20):
        status_text.add(Event(0, 0, 2 if i == 12 else 5, f"event {i}"), 0)
    assert joined(status_text.to_send(0)) == [(5, f"event {i}") for i in range(BURST)]
    assert status_text.deadline() == INTERVAL
    assert status_text.to_send(INTERVAL - 1) == []
    assert joined(status_text.to_send(INTERVAL)) == [(2, "event 12 (and 14 more)")]
    assert status_text.deadline() is None and status_text.to_send(10 * INTERVAL) == []


def test_flood_is_rate_limited_and_every_event_is_counted() -> None:
    status_text, received = StatusText(), []
    for step in range(6000):
        now = step * SECOND // 100
        status_text.add(Event(now, now, 4, "no fix"), now)
        received += joined(status_text.to_send(now))
    received += joined(status_text.to_send(10**12))
    assert len(received) <= BURST + 60 * SECOND // INTERVAL + 1
    more = [int(text.split()[-2]) for _, text in received if "more" in text]
    assert len(received) + sum(more) == 6000
