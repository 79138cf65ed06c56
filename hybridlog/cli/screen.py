"""Prints an answer on a terminal: a table when it fits, else a block for each message."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.cli import output
from hybridlog.cli.answer_notes import print_reduced, print_unreadable
from hybridlog.frames.cells import cells

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.query.query import Query

SCREEN_ROWS = 20
"""Messages shown without --limit."""


class _Answer(NamedTuple):
    names: list[str]
    rows: list[list[str]]


def print_answer(query: Query) -> Query:
    """Print messages for people to read, long arrays in short.

    Args:
        query: The query; without a limit, its first messages are shown.

    Returns:
        The query that was answered, with its counters.
    """
    limit = query.question.limit
    # One more than is shown tells whether there is more.
    answered = query if limit is not None else query.limit(SCREEN_ROWS + 1)
    shown = 0
    for table in answered.to_tables():
        wanted = table if limit is not None else table.slice(0, SCREEN_ROWS - shown)
        _print_block(_cells(wanted), answered.topics)
        shown += wanted.num_rows
    if not shown and not answered.counters.messages:
        output.note("No message.")
    if limit is None and answered.counters.messages > SCREEN_ROWS:
        output.note(
            f"The first {SCREEN_ROWS} messages. --limit shows more, --format jsonl or -o FILE "
            "gives all."
        )
        answered.counters.messages = SCREEN_ROWS
    print_unreadable(answered.counters.messages - answered.counters.reduced - shown)
    print_reduced(answered.counters.reduced)
    return answered


def print_table_rows(table: pa.Table) -> None:
    """Print the rows of a table for people to read; the first column is their title."""
    answer = _cells(table)
    if answer.rows and output.fits(answer.names, answer.rows):
        output.print_table([(name, "left") for name in answer.names], answer.rows)
        return
    for row in answer.rows:
        cells = zip(answer.names[1:], row[1:], strict=True)
        output.print_record(row[0], [(name, cell) for name, cell in cells if cell])


def _cells(table: pa.Table) -> _Answer:
    return _Answer(list(table.column_names), cells(table))


def _print_block(answer: _Answer, topics: Sequence[str]) -> None:
    if not answer.rows:
        return
    if output.fits(answer.names, answer.rows):
        output.print_table([(name, "left") for name in answer.names], answer.rows)
        return
    for row in answer.rows:
        # The first column is the time, the second the topic when there are several; a
        # column without a value is another topic's.
        several = len(topics) > 1
        title = f"{row[0]}  {row[1] if several else topics[0]}"
        first = 2 if several else 1
        fields = [(n, c) for n, c in zip(answer.names[first:], row[first:], strict=True) if c]
        output.print_record(title, fields)
