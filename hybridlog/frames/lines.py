"""Messages as JSON lines, with all fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from hybridlog.formats.answer import Line
from hybridlog.formats.jsonl import json_line, json_rows
from hybridlog.frames.answer import Decoder, leaves_of, text_column
from hybridlog.frames.names import arranged, free_name
from hybridlog.index.indexing import rows_by_channel
from hybridlog.query.planner import Planner
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_types import plain_values

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.query.query import Query


def lines(planner: Planner) -> Iterator[list[Line]]:
    """The messages of an answer in order, in batches: one JSON object for each message.

    It has `log_time_ns`, `topic`, `recording` if there are several, and the fields of the message,
    with dotted names for those of nested messages. Requested fields are those of tables.
    """
    decoder = Decoder(planner)
    for run in planner.runs():
        yield _lines_of(run, decoder, planner.question.fields)


def json_lines(query: Query) -> Iterator[str]:
    """The answer of a query as lines of JSON, in order."""
    planner = Planner(query.source.now(), query.question, query.counters)
    for line in (line for batch in lines(planner) for line in batch):
        yield line if isinstance(line, str) else "".join(line)


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
            made = _of_objects(firsts, decoded.plain())
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
