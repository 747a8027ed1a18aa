"""Benchmark of frame parsing: the companion's frame reader and pymavlink's parser on the same bytes."""

from collections.abc import Callable, Iterator

from companion.link import dialect, frame

MESSAGES = 200


def stream(messages: int = MESSAGES) -> bytes:
    """Return the bytes of `messages` frames of the most frequent types."""
    kinds = ("ATTITUDE", "LOCAL_POSITION_NED", "HIGHRES_IMU", "GPS_RAW_INT", "GLOBAL_POSITION_INT", "VFR_HUD")
    values = {kind: {field.name: 7 for field in dialect.type_named(kind).fields} for kind in kinds}
    sent = []
    for i in range(messages):
        kind = kinds[i % len(kinds)]
        sent.append(frame.encode(dialect.new(kind, **values[kind]), i & 0xFF, 1, 1))
    return b"".join(sent)


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): one call reads the whole stream."""
    data = stream()
    parser = dialect.mavlink.MAVLink(None)
    parser.robust_parsing = True

    def decoded() -> list[dialect.Message]:
        return [dialect.decode(f) for f in frame.Reader().receive(data) if isinstance(f, frame.Frame)]

    def bytewise() -> None:
        reader = frame.Reader()
        for i in range(len(data)):
            reader.receive(data[i : i + 1])

    def pymavlink_bytewise() -> None:
        for i in range(len(data)):
            parser.parse_char(data[i : i + 1])

    message = dialect.new("GPS_RAW_INT", lat=1, lon=2, alt=3)
    sender = dialect.mavlink.MAVLink(None, 1, 191)
    yield f"frame: {MESSAGES} frames, read", lambda: frame.Reader().receive(data)
    yield f"frame: {MESSAGES} frames, read and decoded", decoded
    yield f"pymavlink: {MESSAGES} frames, parse_buffer", lambda: parser.parse_buffer(data)
    yield f"frame: {MESSAGES} frames, read byte by byte", bytewise
    yield f"pymavlink: {MESSAGES} frames, parse_char byte by byte", pymavlink_bytewise
    yield "frame: encode", lambda: frame.encode(message, 1, 1, 191)
    yield "pymavlink: pack", lambda: message.pack(sender)
