"""Messages as JSON lines: what each message says, field by field."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import pyarrow as pa

from hybridlog.export.json_text import json_column
from hybridlog.export.jsonl import json_line, rows_within
from hybridlog.frames.answer import Decoder
from hybridlog.frames.builder import Block
from hybridlog.frames.columns import flat, summary_array, with_summaries
from hybridlog.frames.names import arranged, free_name, summary_of
from hybridlog.indexing import rows_by_channel
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.arrow_objects import below, values_array
from hybridlog.schema.arrow_types import plain_values

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.query.plan import Piece
    from hybridlog.reader import Query
    from hybridlog.schema.codec import DecodedObjects
    from hybridlog_storage.messages import Batch


def lines(query: Query) -> Iterator[list[str]]:
    """The messages of an answer in order, some at a time: one object of JSON a message.

    It has `log_time_ns`, `topic`, `recording` when there are several, and the fields that
    the message has, those of nested messages by dotted names.

    Raises:
        DefinitionError: A topic has no definition to read its messages by.
    """
    plan = query.plan()
    decoder = Decoder(query, plan.lanes)
    for piece in query.pieces(plan):
        yield _lines_of(piece, decoder, query)


def _lines_of(piece: Piece, decoder: Decoder, query: Query) -> list[str]:
    """The lines of a piece, in its order."""
    found: list[str | None] = [None] * len(piece.batch)
    for number, rows in rows_by_channel(piece.batch.channel):
        lane = decoder.lanes[number]
        if lane.is_reduced:
            query.counters.reduced += len(rows)
            continue
        batch, seq = piece.batch.take(rows), piece.seq[rows]
        objects = lane.codec.objects(batch.buffer, batch.offset, batch.length)
        if objects is None:
            block, good = decoder.block(number, batch, seq)
            made = _of_columns(block, lane.channel.topic, query.selected_fields)
        else:
            good = objects.rows
            firsts = _firsts(decoder, number, batch.take(good), seq[good])
            made = _of_objects(firsts, objects, query.selected_fields)
        for row, line in zip(rows[good].tolist(), made, strict=True):
            found[row] = line
    return [line for line in found if line is not None]


def _of_columns(block: Block, topic: str, fields: Sequence[str] | None) -> Iterator[str]:
    """Lines of messages of which every one has every field."""
    times = pa.array(block.log_time)
    columns: dict[str, pa.Array[Any]] = {"log_time_ns": times, "topic": _repeated(topic, times)}
    own = {name: array for name, array in block.own.items() if name not in columns}
    columns |= own
    leaves = with_summaries(flat(block.records), fields)
    for path in _by_fields(leaves, fields):
        columns[free_name(path, columns)] = leaves[path]
    records = structs(columns, len(times))
    rows = rows_within(records.nbytes, len(records))
    for begin in range(0, len(records), rows):
        yield from json_column(records.slice(begin, rows)).to_pylist()


def _by_fields(names: Iterable[str], fields: Sequence[str] | None) -> list[str]:
    return arranged(list(names), fields)


def _repeated(text: str, rows: pa.Array[Any]) -> pa.Array[Any]:
    return pa.repeat(pa.scalar(text.encode("utf-8", "replace").decode(), pa.string()), len(rows))


def _firsts(
    decoder: Decoder, number: int, batch: Batch, seq: NDArray[np.int64]
) -> list[dict[str, Any]]:
    """What stands first in the lines of messages: ours."""
    own = decoder.own_columns(number, batch, seq)
    if "stamp" in own:
        own = dict(decoder.block(number, batch, seq)[0].own)
    topic = decoder.lanes[number].channel.topic
    names = ("log_time_ns", "topic", *(name for name in own if name != "topic"))
    columns = [plain_values(own[name]) for name in names[2:]]
    times = batch.log_time.tolist()
    return [
        dict(zip(names, values, strict=True))
        for values in zip(times, [topic] * len(times), *columns, strict=True)
    ]


def _of_objects(
    firsts: Sequence[Mapping[str, Any]], decoded: DecodedObjects, fields: Sequence[str] | None
) -> Iterator[str]:
    """Lines of messages of which each has fields of its own."""
    wanted = None
    if fields is not None:
        wanted = [path.replace("[]", "").split(".") for path in fields]
    for first, message in zip(firsts, decoded.objects, strict=True):
        row = dict(first)
        leaves = _flat(_chosen(message, wanted))
        for path in _by_fields(leaves, fields):
            row[free_name(path, row)] = leaves[path]
        if fields is not None:
            _summarise(row, fields)
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
    """What is wanted of a value: of an object those fields, of a list that of each element."""
    if wanted is None:
        return value
    if isinstance(value, Mapping):
        names = {path[0] for path in wanted}
        return {n: _chosen(v, below(wanted, n)) for n, v in value.items() if n in names}
    if isinstance(value, list):
        return [_chosen(item, wanted) for item in value]
    return value


def _summarise(row: dict[str, Any], fields: Sequence[str]) -> None:
    """Puts summaries that are asked for into a row, and takes their arrays out of it."""
    arrays: dict[str, Any] = {}
    for path in fields:
        summary = summary_of(path)
        if summary is None or path in row or not isinstance(row.get(summary[0]), list | bytes):
            continue
        arrays[summary[0]] = row[summary[0]]
        made = summary_array(values_array([row[summary[0]]]), summary[1])
        if made is not None:
            row[path] = made[0].as_py()
    for path in arrays:
        if path not in fields:
            del row[path]
