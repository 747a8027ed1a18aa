"""Benchmark of frame parsing: the companion's frame reader and pymavlink's parser on the same bytes."""

from collections.abc import Callable, Iterator

from companion.link import dialect, frame

MESSAGES = 200


def stream() -> bytes:
    """Return the bytes of frames of the most frequent types."""
    kinds = ("ATTITUDE", "LOCAL_POSITION_NED", "HIGHRES_IMU", "GPS_RAW_INT", "GLOBAL_POSITION_INT", "VFR_HUD")
    values = {kind: {field.name: 7 for field in dialect.type_named(kind).fields} for kind in kinds}
    sent = []
    for i in range(MESSAGES):
        kind = kinds[i % len(kinds)]
        sent.append(frame.encode(dialect.new(kind, **values[kind]), i & 0xFF, 1, 1))
    return b"".join(sent)


def cases() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield (name, callable): one call reads the whole stream, or encodes one message."""
    data = stream()
    single = [data[i : i + 1] for i in range(len(data))]
    parser = dialect.mavlink.MAVLink(None)
    parser.robust_parsing = True

    def decoded(pieces: list[bytes]) -> list[dialect.Message]:
        reader = frame.Reader()
        found = (event for piece in pieces for event in reader.receive(piece))
        return [dialect.decode(event) for event in found if isinstance(event, frame.Frame)]

    def pymavlink_bytewise() -> list[object]:
        return [message for byte in single if (message := parser.parse_char(byte))]

    message = dialect.new("GPS_RAW_INT", lat=1, lon=2, alt=3)
    sender = dialect.mavlink.MAVLink(None, 1, 191)
    yield f"frame: {MESSAGES} frames, read", lambda: frame.Reader().receive(data)
    yield f"frame: {MESSAGES} frames, read and decoded", lambda: decoded([data])
    yield f"pymavlink: {MESSAGES} frames, parse_buffer", lambda: parser.parse_buffer(data)
    yield f"frame: {MESSAGES} frames, read and decoded byte by byte", lambda: decoded(single)
    yield f"pymavlink: {MESSAGES} frames, parse_char byte by byte", pymavlink_bytewise
    yield "frame: encode", lambda: frame.encode(message, 1, 1, 191)
    yield "pymavlink: pack", lambda: message.pack(sender)
