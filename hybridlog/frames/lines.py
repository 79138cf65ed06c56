"""Messages as JSON lines, with all fields."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from hybridlog.formats.answer import Line
from hybridlog.formats.jsonl import json_line, json_rows
from hybridlog.frames.answer import Block, Decoder
from hybridlog.frames.columns import flat, summary_array, with_summaries
from hybridlog.frames.names import arranged, free_name, summary_of
from hybridlog.index.indexing import rows_by_channel
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_objects import below, values_array
from hybridlog.schema.arrow_types import plain_values

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.query.planner import Planner
    from hybridlog.schema.codec import Decoded
    from hybridlog_storage.messages import Batch


def lines(planner: Planner) -> Iterator[list[Line]]:
    """The messages of an answer in order, in batches: one JSON object for each message.

    It has `log_time_ns`, `topic`, `recording` if there are several, and the fields of the
    message, with dotted names for those of nested messages.

    Raises:
        DefinitionError: a topic has no definition to read its messages with.
    """
    decoder = Decoder(planner)
    for run in planner.runs():
        decoder.read(run.channels)
        yield _lines_of(run, decoder, planner)


def _lines_of(run: MessageRun, decoder: Decoder, planner: Planner) -> list[Line]:
    """The lines of a run, in its order."""
    found: list[Line | None] = [None] * len(run.batch)
    for number, rows in rows_by_channel(run.batch.channel):
        channel = decoder.channels[number]
        batch, seq = run.batch.take(rows), run.seq[rows]
        decoded = decoder.decoded(number, batch)
        if decoded.is_typed:
            block = decoder.block(number, batch, seq, decoded)
            made = _of_columns(block, channel.channel.topic, planner.question.fields)
        else:
            firsts = _firsts(decoder, number, batch, seq, decoded)
            made = _of_objects(firsts, decoded.plain(), planner.question.fields)
        for row, line in zip(rows[decoded.rows].tolist(), made, strict=True):
            found[row] = line
    return [line for line in found if line is not None]


def _of_columns(block: Block, topic: str, fields: Sequence[str] | None) -> Iterator[Line]:
    """Lines of messages that all have every field."""
    times = pa.array(block.log_time)
    columns: dict[str, pa.Array[Any]] = {"log_time_ns": times, "topic": _repeated(topic, times)}
    own = {name: array for name, array in block.own.items() if name not in columns}
    columns |= own
    leaves = with_summaries(flat(block.records), fields, block.summaries)
    for path in _by_fields(leaves, fields):
        columns[free_name(path, columns)] = leaves[path]
    yield from json_rows(structs(columns, len(times)))


def _by_fields(names: Iterable[str], fields: Sequence[str] | None) -> list[str]:
    return arranged(list(names), fields)


def _repeated(text: str, rows: pa.Array[Any]) -> pa.Array[Any]:
    return pa.repeat(pa.scalar(text.encode("utf-8", "replace").decode(), pa.string()), len(rows))


def _firsts(
    decoder: Decoder, number: int, batch: Batch, seq: NDArray[np.int64], decoded: Decoded
) -> list[dict[str, Any]]:
    """The beginnings of the lines of messages: the built-in columns."""
    good = decoded.rows
    own = decoder.own_columns(number, batch.take(good), seq[good])
    if "stamp" in own:
        own = dict(decoder.block(number, batch, seq, decoded).own)
    topic = decoder.channels[number].channel.topic
    names = ("log_time_ns", "topic", *(name for name in own if name != "topic"))
    columns = [plain_values(own[name]) for name in names[2:]]
    times = batch.log_time[good].tolist()
    return [
        dict(zip(names, values, strict=True))
        for values in zip(times, [topic] * len(times), *columns, strict=True)
    ]


def _of_objects(
    firsts: Sequence[Mapping[str, Any]],
    messages: Sequence[Mapping[str, Any]],
    fields: Sequence[str] | None,
) -> Iterator[Line]:
    """Lines of messages with different fields."""
    wanted = None
    if fields is not None:
        wanted = [path.replace("[]", "").split(".") for path in fields]
    for first, message in zip(firsts, messages, strict=True):
        row = dict(first)
        leaves = _flat(_chosen(message, wanted))
        if fields is not None:
            _summarise(leaves, fields)
        for path in _by_fields(leaves, fields):
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
