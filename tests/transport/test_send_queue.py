"""What waits for a line: in order, whole, and never old. The line and the clock are made here."""

import pytest

from companion.transport.send_queue import LIMIT, LONGEST_WAIT_S, Outbox


class Line:
    """Takes `room` bytes, then no more; and the clock beside it."""

    def __init__(self, room: int) -> None:
        self.room, self.now = room, 100.0
        self.carried = b""

    def put(self, data: bytes) -> int:
        if not self.room:
            raise BlockingIOError
        taken = data[: self.room]
        self.room -= len(taken)
        self.carried += taken
        return len(taken)

    def outbox(self) -> Outbox:
        return Outbox(self.put, lambda: self.now)


def test_what_the_line_takes_never_waits() -> None:
    line = Line(8)
    outbox = line.outbox()
    outbox.write(b"1111")
    assert not outbox
    outbox.write(b"2222")
    outbox.write(b"3333")
    assert outbox and (line.carried, outbox.dropped) == (b"11112222", 0)


def test_what_waited_goes_out_in_order_and_whole_however_the_line_cuts_it() -> None:
    line = Line(0)
    outbox = line.outbox()
    frames = [bytes([65 + i]) * 10 for i in range(8)]
    for frame in frames:
        outbox.write(frame)
    while outbox:
        line.room = 3
        outbox.flush()
    assert line.carried == b"".join(frames)
    assert outbox.dropped == 0


def test_a_frame_older_than_the_limit_is_dropped_and_counted_but_not_what_came_after() -> None:
    line = Line(0)
    outbox = line.outbox()
    outbox.write(b"old.")
    line.now += LONGEST_WAIT_S
    outbox.write(b"new.")
    assert outbox.dropped == 0
    line.now += 0.01
    line.room = 100
    outbox.flush()
    assert (line.carried, outbox.dropped) == (b"new.", 1)
    assert not outbox


def test_the_rest_of_a_half_written_frame_goes_out_however_old() -> None:
    line = Line(2)
    outbox = line.outbox()
    outbox.write(b"half")
    outbox.write(b"gone")
    line.now += 100.0
    outbox.write(b"last")
    assert outbox.dropped == 1
    line.room = 100
    outbox.flush()
    assert line.carried == b"halflast"


@pytest.mark.parametrize("rate", [960, 5760, 92160])  # bytes/s
def test_a_line_at_half_of_what_is_sent_carries_as_much_as_it_can_and_nothing_old(rate: int) -> None:
    line = Line(0)
    outbox = line.outbox()
    size, steps = rate // 50, 1000  # a frame each hundredth of a second: twice what the line takes
    due = 0.0
    for step in range(steps):
        line.now = 100.0 + 0.01 * step
        outbox.write(step.to_bytes(size, "big"))
        due += 0.01 * rate
        line.room, due = int(due), due % 1
        sent = len(line.carried)
        outbox.flush()
        for begin in range(-(-sent // size) * size, len(line.carried) - size + 1, size):
            made = int.from_bytes(line.carried[begin : begin + size], "big")
            assert 0.01 * (step - made) <= LONGEST_WAIT_S + 0.03  # which it takes to go through
    carried = len(line.carried) // size
    assert len(line.carried) > 0.99 * 0.01 * rate * steps
    assert outbox.dropped + carried == pytest.approx(steps, abs=0.02 * steps + 60)


def test_a_flood_faster_than_time_passes_is_bounded_and_loses_the_oldest() -> None:
    line = Line(0)
    outbox = line.outbox()
    frames = [i.to_bytes(4, "big") * 64 for i in range(1000)]
    for frame in frames:
        outbox.write(frame)
    line.room = 1 << 20
    outbox.flush()
    kept = LIMIT // 256
    assert line.carried == b"".join(frames[-kept:])
    assert outbox.dropped == 1000 - kept


def test_what_the_line_raises_is_raised() -> None:
    def broken(data: bytes) -> int:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        Outbox(broken, lambda: 0.0).write(b"frame")
