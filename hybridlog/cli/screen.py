"""Prints an answer on a terminal: a table when it fits, else a block for each message."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, groupby, islice
from operator import itemgetter
from typing import TYPE_CHECKING

from hybridlog.cli import output
from hybridlog.frames.cells import cells

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.query.query import Query

SCREEN_ROWS = 20
"""Rows shown without --limit."""


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
    print_rows(answered.to_tables(), limit, answered.topics)
    if not answered.counters.messages:
        output.note("No message.")
    if limit is None and answered.counters.messages > SCREEN_ROWS:
        output.note(
            f"The first {SCREEN_ROWS} messages. --limit shows more, --format jsonl or -o FILE "
            "gives all."
        )
        answered.counters.messages = SCREEN_ROWS
    return answered


def print_rows(tables: Iterable[pa.Table], limit: int | None, topics: Sequence[str] = ()) -> int:
    """Print rows for people to read: a table if the first of them fit, else a block for each.

    Memory does not grow with the number of rows.

    Args:
        tables: The rows.
        limit: Number of rows to print; None for `SCREEN_ROWS`.
        topics: Topics of messages, which are in the titles of blocks.

    Returns:
        Number of rows of the tables.
    """
    most = SCREEN_ROWS if limit is None else limit
    read = 0

    def rows() -> Iterator[tuple[list[str], list[str]]]:
        nonlocal read
        for table in tables:
            names, wanted = table.column_names, table.slice(0, max(most - read, 0))
            read += table.num_rows
            for row in cells(wanted):
                yield names, row

    # Headings are printed again only where the columns change.
    for names, alike in groupby(rows(), itemgetter(0)):
        lines = (row for _, row in alike)
        first = list(islice(lines, output.ROWS_AT_ONCE))
        if output.fits(names, first):
            output.print_table([(name, "left") for name in names], chain(first, lines))
            continue
        begin = 2 if len(topics) > 1 else 1  # the first column is the time, the second the topic
        for row in chain(first, lines):
            title = "  ".join([*row[:begin], *(topics if len(topics) == 1 else ())])
            # A column without a value is another topic's.
            fields = zip(names[begin:], row[begin:], strict=True)
            output.print_record(title, [(name, cell) for name, cell in fields if cell])
    return read
