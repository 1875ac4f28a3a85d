"""What is printed: tables keep their width in pipes."""

from io import StringIO

import pytest

from vmri_jax.running.printed import OutputConsole, PrintedTable

WORDS = "a sentence of several words that says in full how it went"


@pytest.fixture
def table():
    table = PrintedTable("number", *"abcd", caption=f"Below: {WORDS}, {WORDS}.")
    table.add_row("1", *[WORDS] * 4)
    return table


def test_wide_tables_keep_their_lines_where_the_output_is_no_terminal(table, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    for text in (str(table), printed(table)):
        assert [line.count(WORDS) for line in text.splitlines()] == [0, 4, 2]


def test_columns_of_the_environment_are_obeyed(table, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    lines = str(table).splitlines()
    assert max(map(len, lines)) <= 90
    assert len(lines) > 3


def test_a_terminal_has_its_own_width(table, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    assert OutputConsole(file=StringIO(), force_terminal=True).width == 100
    assert table.caption.startswith("Below")  # printing leaves the table as it was


def printed(table) -> str:
    console = OutputConsole(file=(file := StringIO()))
    console.print(table)
    return file.getvalue()
