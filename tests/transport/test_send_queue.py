"""Send queue with a simulated line and clock: order, whole frames, maximum wait."""

import pytest

from companion.transport.send_queue import LIMIT, MAX_WAIT_S, SendQueue


class Line:
    """Line that accepts `room` bytes, and its clock."""

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

    def queue(self) -> SendQueue:
        return SendQueue(self.put, lambda: self.now)


def test_accepted_frames_do_not_wait() -> None:
    line = Line(8)
    queue = line.queue()
    queue.write(b"1111")
    assert not queue
    queue.write(b"2222")
    queue.write(b"3333")
    assert queue and (line.carried, queue.dropped) == (b"11112222", 0)


def test_waiting_frames_are_sent_whole_and_in_order() -> None:
    line = Line(0)
    queue = line.queue()
    frames = [bytes([65 + i]) * 10 for i in range(8)]
    for frame in frames:
        queue.write(frame)
    while queue:
        line.room = 3
        queue.flush()
    assert line.carried == b"".join(frames)
    assert queue.dropped == 0


def test_frame_older_than_the_limit_is_dropped_and_counted() -> None:
    line = Line(0)
    queue = line.queue()
    queue.write(b"old.")
    line.now += MAX_WAIT_S
    queue.write(b"new.")
    assert queue.dropped == 0
    line.now += 0.01
    line.room = 100
    queue.flush()
    assert (line.carried, queue.dropped) == (b"new.", 1)
    assert not queue


def test_rest_of_a_partly_written_frame_is_always_sent() -> None:
    line = Line(2)
    queue = line.queue()
    queue.write(b"half")
    queue.write(b"gone")
    line.now += 100.0
    queue.write(b"last")
    assert queue.dropped == 1
    line.room = 100
    queue.flush()
    assert line.carried == b"halflast"


@pytest.mark.parametrize("rate", [960, 5760, 92160])  # bytes/s
def test_line_too_slow_by_half_is_fully_used_and_carries_no_old_frame(rate: int) -> None:
    line = Line(0)
    queue = line.queue()
    size, steps = rate // 50, 1000  # a frame each hundredth of a second: twice what the line takes
    due = 0.0
    for step in range(steps):
        line.now = 100.0 + 0.01 * step
        queue.write(step.to_bytes(size, "big"))
        due += 0.01 * rate
        line.room, due = int(due), due % 1
        sent = len(line.carried)
        queue.flush()
        for begin in range(sent // size * size, len(line.carried) - size + 1, size):  # whole by now
            made = int.from_bytes(line.carried[begin : begin + size], "big")
            assert 0.01 * (step - made) <= MAX_WAIT_S + 0.03  # the time to pass the line
    carried = len(line.carried) // size
    assert len(line.carried) > 0.99 * 0.01 * rate * steps
    assert queue.dropped + carried == pytest.approx(steps, abs=0.02 * steps + 60)


def test_flood_is_bounded_and_drops_the_oldest() -> None:
    line = Line(0)
    queue = line.queue()
    frames = [i.to_bytes(4, "big") * 64 for i in range(1000)]
    for frame in frames:
        queue.write(frame)
    line.room = 1 << 20
    queue.flush()
    kept = LIMIT // 256
    assert line.carried == b"".join(frames[-kept:])
    assert queue.dropped == 1000 - kept


def test_error_of_the_line_is_raised() -> None:
    def broken(data: bytes) -> int:
        raise BrokenPipeError

    with pytest.raises(BrokenPipeError):
        SendQueue(broken, lambda: 0.0).write(b"frame")
