"""Stderr writer: never blocks, keeps the order, and reports the number of dropped lines."""

import threading

from companion.runtime.stderr_writer import StderrWriter


class Reader:
    """Reader that is stalled until `reads` is set."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.called, self.reads = threading.Event(), threading.Event()

    def write(self, line: str) -> None:
        self.called.set()
        self.reads.wait()
        self.lines.append(line)


def test_all_lines_are_written_in_order() -> None:
    reader = Reader()
    writer = StderrWriter(reader.write)
    lines = [str(i) for i in range(500)]
    for line in lines:
        writer.write_line(line)
    reader.reads.set()
    writer.close(30.0)
    assert reader.lines == lines


def test_full_queue_drops_the_oldest_lines_and_reports_their_number() -> None:
    reader = Reader()
    writer = StderrWriter(reader.write, max_lines=3)
    writer.write_line("first")
    assert reader.called.wait(30.0)  # the first line is being written
    for i in range(10):
        writer.write_line(str(i))
    reader.reads.set()
    writer.close(30.0)
    assert reader.lines == ["first", "... 7 lines dropped: stderr was not read in time", "7", "8", "9"]


def test_close_does_not_wait_for_a_stalled_reader() -> None:
    reader = Reader()
    writer = StderrWriter(reader.write)
    writer.write_line("first")
    writer.close(0.01)
    assert reader.lines == []
    reader.reads.set()


def test_closed_reader_does_not_stop_the_writer() -> None:
    written: list[str] = []

    def write(line: str) -> None:
        written.append(line)
        raise BrokenPipeError

    writer = StderrWriter(write)
    writer.write_line("first")
    writer.write_line("second")
    writer.close(30.0)
    assert written == ["first", "second"]
