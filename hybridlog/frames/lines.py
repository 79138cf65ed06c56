"""Messages as JSON lines with all fields, and rows of tables as text for the terminal."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
from pyarrow import types

from hybridlog.formats.jsonl import json_line, json_rows
from hybridlog.formats.writing import Line
from hybridlog.frames.answer import Decoder, leaves_of, text_column
from hybridlog.frames.names import arranged, free_name
from hybridlog.query.times import format_duration, format_time
from hybridlog.schema.arrow_types import (
    is_bytes,
    is_list,
    is_number,
    numpy_type,
    plain_values,
    structs,
)
from hybridlog.schema.column import Records
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import rows_by_channel

if TYPE_CHECKING:
    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.query.planner import Planner


def lines(planner: Planner) -> Iterator[list[Line]]:
    """The messages of an answer in order, in batches: one JSON object for each message.

    It has `log_time_ns`, `topic`, `recording` if there are several, and the fields of the message,
    with dotted names for those of nested messages. Requested fields are those of tables.
    """
    decoder = Decoder(planner)
    for run in planner.runs():
        yield _lines_of(run, decoder, planner.question.fields)


def _lines_of(run: MessageRun, decoder: Decoder, fields: Sequence[str] | None) -> list[Line]:
    """The lines of a run, in its order."""
    found: list[Line | None] = [None] * len(run.batch)
    for number, rows in rows_by_channel(run.batch.channel):
        channel, batch, seq = run.channels[number], run.batch.take(rows), run.seq[rows]
        decoded = decoder.decoded(channel, batch)
        good = decoded.rows
        firsts = {
            "log_time_ns": pa.array(batch.log_time[good]),
            "topic": text_column(channel.channel.topic, len(good)),
        }
        if decoded.is_typed or fields is not None:
            block = decoder.block(channel, batch, seq, decoded)
            firsts |= {name: array for name, array in block.own.items() if name not in firsts}
            leaves = leaves_of(block.records, fields, block.summaries)
            for path in arranged([*leaves], fields):
                firsts[free_name(path, firsts)] = leaves[path]
            made = json_rows(structs(firsts, len(good)))
        else:  # each message has fields of its own
            own = decoder.own_columns(channel, batch.take(good), seq[good])
            firsts |= {name: array for name, array in own.items() if name not in firsts}
            assert not isinstance(decoded.records, Records)
            made = _of_objects(firsts, decoded.records.plain())
        for row, line in zip(rows[good].tolist(), made, strict=True):
            found[row] = line
    return [line for line in found if line is not None]


def _of_objects(
    firsts: Mapping[str, pa.Array[Any]], messages: Sequence[Mapping[str, Any]]
) -> Iterator[Line]:
    """Lines of messages with different fields; they begin with built-in columns."""
    columns = zip(*map(plain_values, firsts.values()), strict=True)
    for values, message in zip(columns, messages, strict=True):
        row = dict(zip(firsts, values, strict=True))
        for path, value in _flat(message).items():
            row[free_name(path, row)] = value
        yield json_line(row)


def _flat(message: Mapping[str, Any]) -> dict[str, Any]:
    """Values by dotted path; objects without fields are values."""
    found: dict[str, Any] = {}
    pending = list(message.items())[::-1]
    while pending:
        path, value = pending.pop()
        if isinstance(value, Mapping) and value:
            pending.extend([(f"{path}.{name}", v) for name, v in value.items()][::-1])
            continue
        while path in found:
            path += "_"
        found[path] = value
    return found


MAX_CELL: Final = 40
"""Characters of a text in a table."""
MAX_LINE: Final = 200
"""Characters of a value on lines of its own."""
_MAX_ITEMS: Final = 4
UNITS: Final = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
"""Nanoseconds of the units of timestamps."""


def cells(table: pa.Table, *, exact: bool = False, most: int = MAX_CELL) -> list[list[str]]:
    """The rows of a table, a text for each value, of `most` characters; empty for a null.

    `exact` numbers have all digits that tell them apart, not six.
    """
    try:
        columns = [[_cell(one, exact=exact, most=most) for one in each] for each in table.columns]
    except OverflowError as error:
        raise UsageError(
            f"A time is too far away to be shown ({error}). In SQL, `::varchar` makes it text."
        ) from error
    return [list(row) for row in zip(*columns, strict=True)]


def _cell(value: pa.Scalar, *, exact: bool, most: int = MAX_CELL) -> str:
    """A value in few characters."""
    kind, inner = value.type, functools.partial(_cell, exact=exact)
    if not value.is_valid:
        text = ""
    elif types.is_floating(kind):
        text = _exact(value) if exact else f"{value.as_py():.6g}"
    elif types.is_timestamp(kind):
        text = format_time(value.value * UNITS[kind.unit])
    elif types.is_duration(kind):
        text = format_duration(value.value)
    elif is_bytes(kind):
        text = f"{len(value.as_py())} bytes"
    elif types.is_map(kind):
        text = _pairs((inner(item["key"]), inner(item["value"])) for item in value.values)
    elif types.is_struct(kind):
        text = _pairs((name, inner(item)) for name, item in value.items())
    elif is_list(kind):
        text = _list(value.values, inner)
    else:
        text = _cut(str(value.as_py()), most)
    return text


def _exact(value: pa.Scalar) -> str:
    """The shortest digits that give a number back in its type."""
    return str(numpy_type(value.type).type(value.as_py())).removesuffix(".0")


def _pairs(pairs: Iterable[tuple[str, str]]) -> str:
    return _cut("{" + ", ".join(f"{name}: {value}" for name, value in pairs) + "}", MAX_LINE)


def _list(values: Any, shown: Callable[[pa.Scalar], str]) -> str:
    is_short = len(values) <= _MAX_ITEMS
    first = ", ".join(shown(item) for item in values[: _MAX_ITEMS if is_short else 2])
    return _cut(f"[{first}]" if is_short else f"[{first}, … {len(values)} in all]", MAX_LINE)


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def shown(content: bytes, rows: int, columns: int) -> dict[str, Any]:
    """The first rows and columns of an Arrow file for people, as plain values by name.

    `columns` are pairs of the name and whether it is a number, `columns_left_out` their number;
    `rows`, texts, and whether there are `more`; `times`, the log time of each row, ns since 1970,
    the last one of its microsecond where only a timestamp tells it: empty without such a column.
    """
    whole = pa.ipc.open_file(content).read_all()
    table = whole.slice(0, rows)
    first = table.select(range(min(table.num_columns, columns)))
    return {
        "columns": [
            [field.name, is_number(field.type) or pa.types.is_decimal(field.type)]
            for field in first.schema
        ],
        "columns_left_out": table.num_columns - first.num_columns,
        "rows": cells(first, exact=True),
        "more": whole.num_rows > rows,
        "times": _times(table),
    }


def _times(table: pa.Table) -> list[int | None]:
    names = table.column_names
    if names.count("t") == 1 and types.is_int64(table["t"].type):
        return list(table["t"].to_pylist())
    if names.count("log_time") != 1 or not types.is_timestamp(table["log_time"].type):
        return []
    column = table["log_time"]
    unit = UNITS[column.type.unit]
    values = column.cast(pa.int64()).to_pylist()
    return [None if value is None else value * unit + unit - 1 for value in values]
