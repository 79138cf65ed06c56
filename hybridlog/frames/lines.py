"""Messages as JSON lines, with all fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from hybridlog.formats.answer import Line
from hybridlog.formats.jsonl import json_line, json_rows
from hybridlog.frames.answer import Decoder, leaves_of, summary_array, text_column
from hybridlog.frames.names import arranged, free_name, summary_of
from hybridlog.index.indexing import rows_by_channel
from hybridlog.schema.arrow_columns import below, structs, values_array
from hybridlog.schema.arrow_types import plain_values

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.query.planner import Planner


def lines(planner: Planner) -> Iterator[list[Line]]:
    """The messages of an answer in order, in batches: one JSON object for each message.

    It has `log_time_ns`, `topic`, `recording` if there are several, and the fields of the message,
    with dotted names for those of nested messages.
    """
    decoder = Decoder(planner)
    for run in planner.runs():
        yield _lines_of(run, decoder, planner)


def _lines_of(run: MessageRun, decoder: Decoder, planner: Planner) -> list[Line]:
    """The lines of a run, in its order."""
    found: list[Line | None] = [None] * len(run.batch)
    fields = planner.question.fields
    for number, rows in rows_by_channel(run.batch.channel):
        channel, batch, seq = run.channels[number], run.batch.take(rows), run.seq[rows]
        decoded = decoder.decoded(channel, batch)
        good = decoded.rows
        if decoded.is_typed or "stamp" in decoder.own:
            block = decoder.block(channel, batch, seq, decoded)
            own = block.own
        else:
            block, own = None, decoder.own_columns(channel, batch.take(good), seq[good])
        topic = text_column(channel.channel.topic, len(good))
        firsts = {"log_time_ns": pa.array(batch.log_time[good]), "topic": topic}
        firsts |= {name: array for name, array in own.items() if name not in firsts}
        if block is not None and decoded.is_typed:
            leaves = leaves_of(block.records, fields, block.summaries)
            for path in arranged([*leaves], fields):
                firsts[free_name(path, firsts)] = leaves[path]
            made = json_rows(structs(firsts, len(good)))
        else:
            made = _of_objects(firsts, decoded.plain(), fields)
        for row, line in zip(rows[good].tolist(), made, strict=True):
            found[row] = line
    return [line for line in found if line is not None]


def _of_objects(
    firsts: Mapping[str, pa.Array[Any]],
    messages: Sequence[Mapping[str, Any]],
    fields: Sequence[str] | None,
) -> Iterator[Line]:
    """Lines of messages with different fields; they begin with built-in columns."""
    wanted = None
    if fields is not None:
        wanted = [path.replace("[]", "").split(".") for path in fields]
    columns = zip(*map(plain_values, firsts.values()), strict=True)
    for values, message in zip(columns, messages, strict=True):
        row = dict(zip(firsts, values, strict=True))
        leaves = _flat(_chosen(message, wanted))
        if fields is not None:
            _summarise(leaves, fields)
        for path in arranged([*leaves], fields):
            row[free_name(path, row)] = leaves[path]
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


def _chosen(value: Any, wanted: Sequence[Sequence[str]] | None) -> Any:
    """The wanted part of a value: fields of an object, or of each element of a list."""
    if wanted is None:
        return value
    if isinstance(value, Mapping):
        names = {path[0] for path in wanted}
        return {n: _chosen(v, below(wanted, n)) for n, v in value.items() if n in names}
    if isinstance(value, list):
        return [_chosen(item, wanted) for item in value]
    return value


def _summarise(leaves: dict[str, Any], fields: Sequence[str]) -> None:
    """Add requested summaries to the values of a message, and remove their arrays."""
    arrays: dict[str, Any] = {}
    for path in fields:
        summary = summary_of(path)
        if (
            summary is None
            or path in leaves
            or not isinstance(leaves.get(summary[0]), list | bytes)
        ):
            continue
        arrays[summary[0]] = leaves[summary[0]]
        made = summary_array(values_array([leaves[summary[0]]]), summary[1])
        if made is not None:
            leaves[path] = made[0].as_py()
    for path in arrays:
        if path not in fields:
            del leaves[path]
