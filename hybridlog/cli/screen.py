"""Prints an answer on a terminal: a table when it fits, else a block for each message."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from hybridlog.cli import output
from hybridlog.cli.answer_notes import print_reduced, print_unreadable

if TYPE_CHECKING:
    import pyarrow as pa

    from hybridlog.query.query import Query

SCREEN_ROWS = 20
"""Messages shown without --limit."""
_MAX_CELL = 40
_MAX_LINE = 200
_MAX_ITEMS = 4


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
    columns = [[_cell(value) for value in column] for column in table.columns]
    rows = [list(row) for row in zip(*columns, strict=True)]
    return _Answer(list(table.column_names), rows)


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


def _cell(value: pa.Scalar) -> str:
    """A value in few characters."""
    if not value.is_valid:
        return ""
    for applies, shown in _forms():
        if applies(value.type):
            return shown(value)
    return _cut(str(value.as_py()), _MAX_CELL)


@functools.cache
def _forms() -> list[tuple[Callable[[pa.DataType], bool], Callable[[pa.Scalar], str]]]:
    """Tests of a column's type, and how its values are shown."""
    from pyarrow import types

    from hybridlog.query.times import format_duration, format_time

    def is_list(kind: pa.DataType) -> bool:
        return bool(
            types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind)
        )

    def is_binary(kind: pa.DataType) -> bool:
        return bool(types.is_binary(kind) or types.is_large_binary(kind))

    return [
        (types.is_floating, lambda value: f"{value.as_py():.6g}"),
        (types.is_timestamp, lambda value: format_time(_nanoseconds(value))),
        (types.is_duration, lambda value: format_duration(value.value)),
        (types.is_map, _map),
        (is_list, _list),
        (types.is_struct, _struct),
        (is_binary, lambda value: f"{len(value.as_py())} bytes"),
    ]


def _nanoseconds(value: pa.Scalar) -> int:
    import pyarrow as pa

    return int(value.cast(pa.timestamp("ns", value.type.tz)).value)


def _struct(value: pa.Scalar) -> str:
    inside = (f"{name}: {_cell(item)}" for name, item in value.items())
    return _cut("{" + ", ".join(inside) + "}", _MAX_LINE)


def _map(value: pa.Scalar) -> str:
    inside = (f"{_cell(item['key'])}: {_cell(item['value'])}" for item in value.values)
    return _cut("{" + ", ".join(inside) + "}", _MAX_LINE)


def _list(value: pa.Scalar) -> str:
    inner = value.values
    if inner is None or not len(inner):
        return "[]"
    if len(inner) <= _MAX_ITEMS:
        return _cut("[" + ", ".join(_cell(item) for item in inner) + "]", _MAX_LINE)
    first = ", ".join(_cell(inner[i]) for i in range(2))
    return _cut(f"[{first}, … {len(inner)} in all]", _MAX_LINE)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
