"""What people are told: whole texts, few of them, the gravest first; chunks joined as a station does."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link import dialect, frame
from companion.link.status_text import BURST, EVERY, LONGEST, StatusText
from companion.records import Event

SECOND = 1_000_000_000


def told(messages: list[dialect.Message]) -> list[tuple[int, str]]:
    """Severity and text of each, chunks joined after the message's description."""
    texts: list[tuple[int, str]] = []
    parts: dict[int, bytes] = {}
    for message in messages:
        found = frame.examine(frame.encode(message, 0, 1, 191))
        assert isinstance(found, frame.Frame)
        chunk = dialect.decode(found)
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


def say(*events: tuple[int, str]) -> list[tuple[int, str]]:
    speaker = StatusText()
    for severity, text in events:
        speaker.tell(Event(0, 0, severity, text), 0)
    return told(speaker.to_send(0))


@pytest.mark.parametrize("size", [0, 1, 49, 50, 51, 99, 100, 101, 150, LONGEST - 1, LONGEST])
def test_a_text_arrives_whole_at_any_length(size: int) -> None:
    text = ("GNSS lost; beacon 7 " * 20)[:size]
    assert say((4, text)) == [(4, text)]


@settings(deadline=None, max_examples=100)
@given(texts=st.lists(st.text(max_size=300), max_size=BURST))
def test_any_text_arrives_as_far_as_it_fits(texts: list[str]) -> None:
    heard = say(*[(6, text) for text in texts])
    assert len(heard) == len(texts)
    for (_, there), here in zip(heard, texts):
        here = here.replace("\0", " ").encode(errors="replace").decode()
        assert here.startswith(there) and (here == there or len(there.encode()) > LONGEST - 4)


def test_long_texts_of_one_voice_are_told_apart() -> None:
    texts = [(4, "a" * 120), (4, "b" * 120)]
    speaker = StatusText()
    for severity, text in texts:
        speaker.tell(Event(0, 0, severity, text), 0)
    messages = speaker.to_send(0)
    assert told(messages) == texts and {m.id for m in messages} == {1, 2}


def test_what_is_only_for_the_log_is_not_told() -> None:
    assert say((7, "debug"), (6, "info")) == [(6, "info")]


def test_the_gravest_of_too_many_is_told_with_the_number_of_the_others() -> None:
    speaker = StatusText()
    for i in range(20):
        speaker.tell(Event(0, 0, 2 if i == 12 else 5, f"event {i}"), 0)
    assert told(speaker.to_send(0)) == [(5, f"event {i}") for i in range(BURST)]
    assert speaker.deadline() == EVERY
    assert speaker.to_send(EVERY - 1) == []
    assert told(speaker.to_send(EVERY)) == [(2, "event 12 (and 14 more)")]
    assert speaker.deadline() is None and speaker.to_send(10 * EVERY) == []


def test_a_flood_is_held_to_the_rate_and_nothing_is_uncounted() -> None:
    speaker, heard = StatusText(), []
    for step in range(6000):
        now = step * SECOND // 100
        speaker.tell(Event(now, now, 4, "no fix"), now)
        heard += told(speaker.to_send(now))
    heard += told(speaker.to_send(10**12))
    assert len(heard) <= BURST + 60 * SECOND // EVERY + 1
    more = [int(text.split()[-2]) for _, text in heard if "more" in text]
    assert len(heard) + sum(more) == 6000
