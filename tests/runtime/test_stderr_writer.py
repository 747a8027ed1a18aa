"""Whoever reads, and however slowly: telling never waits, and what is missing is counted where it stood."""

import threading

from companion.runtime.stderr_writer import Telling


class Reader:
    """It reads nothing until `reads`, then everything."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.asked, self.reads = threading.Event(), threading.Event()

    def write(self, line: str) -> None:
        self.asked.set()
        self.reads.wait()
        self.lines.append(line)


def test_lines_come_in_order_and_all_of_them_before_the_end() -> None:
    reader = Reader()
    telling = Telling(reader.write)
    lines = [str(i) for i in range(500)]
    for line in lines:
        telling.tell(line)
    reader.reads.set()
    telling.close(30.0)
    assert reader.lines == lines


def test_of_too_many_the_oldest_are_dropped_and_counted_where_they_stood() -> None:
    reader = Reader()
    telling = Telling(reader.write, most=3)
    telling.tell("first")
    assert reader.asked.wait(30.0)  # it is in the reader's hands, who does not take it
    for i in range(10):
        telling.tell(str(i))
    reader.reads.set()
    telling.close(30.0)
    assert reader.lines == ["first", "... 7 lines that nobody read in time", "7", "8", "9"]


def test_a_reader_who_never_reads_is_not_waited_for_at_the_end() -> None:
    reader = Reader()
    telling = Telling(reader.write)
    telling.tell("first")
    telling.close(0.01)
    assert reader.lines == []
    reader.reads.set()


def test_a_reader_who_is_gone_ends_nothing() -> None:
    told: list[str] = []

    def write(line: str) -> None:
        told.append(line)
        raise BrokenPipeError

    telling = Telling(write)
    telling.tell("first")
    telling.tell("second")
    telling.close(30.0)
    assert told == ["first", "second"]
