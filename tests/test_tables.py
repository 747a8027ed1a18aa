"""Tables of the commands."""

import pytest

from companion.tables import number_table, print_tables


def test_brackets_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    table = number_table("error [m]", "log", "most [m]", caption="of [1]")
    table.add_row("a[b].tlog", "3.0")
    print_tables(table)
    shown = capsys.readouterr().out
    assert all(text in shown for text in ("error [m]", "most [m]", "of [1]", "a[b].tlog"))
