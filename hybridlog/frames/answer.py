"""From a query to tables: payloads are decoded, or columns of whole topics are taken."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from hybridlog.columns.answers import judged
from hybridlog.columns.judged import Judged
from hybridlog.columns.topic import SINGLE_READ
from hybridlog.frames.bson import INDEX_TYPES
from hybridlog.frames.builder import Block, TableBuilder
from hybridlog.frames.names import is_summary, own_columns, summary_of
from hybridlog.indexing import STAMP, rows_by_channel
from hybridlog.query.plan import Lane, Piece, Sweep
from hybridlog.schema.arrow_columns import TIME, numbers, records_array, structs
from hybridlog.schema.arrow_types import common_schema
from hybridlog.schema.column import Column, Records, take
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import Batch

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.reader import Query

_BLOCK_ROWS = 65_536
_BLOCK_BYTES = 32 << 20
_SEQ_BITS = 44


def collect(query: Query) -> TableBuilder:
    """All columns of a query's answer.

    Raises:
        DefinitionError: a topic has no definition to make columns from.
    """
    found = _from_columns(query)
    builder = TableBuilder(query.selected_fields)
    if found is not None:
        for block in chain.from_iterable(found):
            builder.append(block)
        return builder
    plan = query.plan()
    decoder = Decoder(query, plan.lanes)
    for block in decoder.empty():
        builder.append(block)
    sweep = Sweep(plan, query.store.segment)
    for piece in sweep.unordered() if query.is_unthinned else query.pieces(plan):
        for block in decoder.blocks(piece):
            builder.append(block)
    return builder


def stream(query: Query) -> Iterator[pa.Table]:
    """The answer in order, in tables of bounded size; at least one, perhaps empty.

    The type of a column may change from table to table where no definition fixes it.
    """
    groups: Iterator[Iterable[Block]] | None = _from_columns(query)
    if groups is None:
        plan = query.plan()
        decoder = Decoder(query, plan.lanes)
        decoded = (decoder.blocks(piece) for piece in query.pieces(plan))
        groups = chain([decoder.empty()], decoded)
    builder, size = TableBuilder(query.selected_fields), 0
    given = False
    for group in groups:
        # Blocks of one group overlap in time, so no table ends between them.
        if len(builder) >= _BLOCK_ROWS or size >= _BLOCK_BYTES:
            yield _finished(builder, query)
            given = True
            builder, size = TableBuilder(query.selected_fields), 0
        for block in group:
            builder.append(block)
            size += block.size
    if len(builder) or not given:
        yield _finished(builder, query)


def schema_of(query: Query) -> pa.Schema | None:
    """The columns of an answer, when they depend on what is in its messages; else None.

    The messages of which no definition fixes the fields are read for it.
    """
    if not any(_is_open(lane) for lane in query.lanes()):
        return None
    return common_schema(stream(query.again()))


def json_columns(schema: pa.Schema | None) -> list[str]:
    """Columns that are JSON text, since they have no common exact type."""
    return [] if schema is None else [field.name for field in schema if field.type == pa.json_()]


def _is_open(lane: Lane) -> bool:
    """Whether the columns of a channel depend on what is in its messages."""
    return lane.channel.message_encoding not in SINGLE_READ


def _finished(builder: TableBuilder, query: Query) -> pa.Table:
    table = builder.to_arrow()
    return table.take(np.arange(table.num_rows - 1, -1, -1)) if query.is_reversed else table


class Decoder:
    """Makes blocks of the messages of a query.

    Args:
        query: The question.
        lanes: The channels that it is about.

    Attributes:
        lanes: The same.

    Raises:
        DefinitionError: A channel has no definition to make columns from.
    """

    def __init__(self, query: Query, lanes: Sequence[Lane]) -> None:
        _check(lanes)
        self._query = query
        self.lanes = lanes
        self._own = _own(query, lanes)
        self._ranks = _ranks(lanes)
        self._fields = [_to_decode(query.selected_fields, lane, self._own) for lane in lanes]

    def empty(self) -> Iterator[Block]:
        """A block without rows for each channel: columns exist even when no message does."""
        none = np.empty(0, np.int64)
        channel = np.empty(0, np.int32)
        batch = Batch(b"", none, none, channel, none, none, none.astype(np.uint32))
        for number, lane in enumerate(self.lanes):
            if not lane.is_reduced:
                yield self.block(number, batch, none)[0]

    def blocks(self, piece: Piece) -> Iterator[Block]:
        """The messages of a piece, by channel."""
        for number, rows in rows_by_channel(piece.batch.channel):
            if self.lanes[number].is_reduced:
                self._query.counters.reduced += len(rows)
            else:
                yield self.block(number, piece.batch.take(rows), piece.seq[rows])[0]

    def block(
        self, number: int, batch: Batch, seq: NDArray[np.int64]
    ) -> tuple[Block, NDArray[np.intp]]:
        """Messages of one channel, and which of the rows could be read."""
        lane = self.lanes[number]
        decoded = lane.codec.arrow(batch.buffer, batch.offset, batch.length, self._fields[number])
        records, good = decoded.records, decoded.rows
        stamps = None
        if "stamp" in self._own:
            stamps = _stamps(records)
            records = _without_stamp(records, self._query.selected_fields)
        if len(good) < len(batch):
            batch, seq = batch.take(good), seq[good]
        own = self.own_columns(number, batch, seq, stamps)
        order = seq + self._ranks[number]
        topic = lane.channel.topic
        return Block(topic, batch.log_time, order, own, records, batch.payload_bytes), good

    def own_columns(
        self,
        number: int,
        batch: Batch,
        seq: NDArray[np.int64],
        stamps: pa.Array[Any] | None = None,
    ) -> dict[str, pa.Array[Any]]:
        """Our columns of messages of one channel, besides the log time."""
        lane = self.lanes[number]
        return {name: _own_column(name, lane, batch, seq, stamps) for name in self._own}


def _own(query: Query, lanes: Sequence[Lane]) -> list[str]:
    """Columns of ours that a table has besides the log time."""
    defined = {path.path for lane in lanes if not lane.is_reduced for path in lane.codec.paths()}
    asked = own_columns(query.selected_fields, defined)
    unasked = []
    if len(query.topics) > 1:
        unasked.append("topic")
    if len({lane.recording.key for lane in lanes}) > 1:
        unasked.append("recording")
    return [name for name in dict.fromkeys([*unasked, *asked]) if name != "log_time"]


def _own_column(
    name: str, lane: Lane, batch: Batch, seq: NDArray[np.int64], stamps: pa.Array[Any] | None
) -> pa.Array[Any]:
    rows = len(batch)
    if name == "topic":
        return _text(lane.channel.topic, rows)
    if name == "recording":
        return _text(lane.recording.label, rows)
    if name == "seq":
        return numbers(seq)
    if name == "sequence":
        return numbers(batch.sequence)
    if name == "publish_time":
        known = lane.channel.has_publish_time
        return numbers(batch.publish_time, "time") if known else pa.nulls(rows, TIME)
    return pa.nulls(rows, TIME) if stamps is None else stamps


def _text(text: str, rows: int) -> pa.Array[Any]:
    text = text.encode("utf-8", "replace").decode()
    return pa.repeat(pa.scalar(text, pa.string()), rows)


def _to_decode(
    fields: Sequence[str] | None, lane: Lane, own: Sequence[str]
) -> frozenset[str] | None:
    """Paths that are decoded: those asked for, arrays whose summaries are, the stamp."""
    if fields is None or lane.is_reduced:
        return None
    known = {path.path: path.type for path in lane.codec.paths()}
    wanted = set(fields)
    for path in fields:
        summary = summary_of(path)
        if summary is not None and is_summary(path, known):
            wanted.add(summary[0])
    return frozenset(wanted | {STAMP} if "stamp" in own else wanted)


def _stamps(records: pa.StructArray) -> pa.Array[Any] | None:
    """The header stamps of messages; None when they have none."""
    found: pa.Array[Any] = records
    for name in STAMP.split("."):
        if not pa.types.is_struct(found.type) or found.type.get_field_index(name) < 0:
            return None
        found = found.flatten()[found.type.get_field_index(name)]
    return found if found.type == TIME else None


def _without_stamp(records: pa.StructArray, fields: Sequence[str] | None) -> pa.StructArray:
    """The messages without the stamp that was decoded only for the column of that name."""
    if fields is None or any(path in {"header", STAMP} for path in fields):
        return records
    children = dict(zip([f.name for f in records.type], records.flatten(), strict=True))
    header = children.get("header")
    if header is None or not pa.types.is_struct(header.type):
        return records
    inner = dict(zip([f.name for f in header.type], header.flatten(), strict=True))
    inner.pop("stamp", None)
    children["header"] = structs(inner, len(records))
    return structs(children, len(records))


def _ranks(lanes: Sequence[Lane]) -> list[int]:
    """What makes arrival numbers of each lane's recording follow those of the one before."""
    order = {key: rank for rank, key in enumerate(sorted({lane.recording.key for lane in lanes}))}
    return [order[lane.recording.key] << _SEQ_BITS for lane in lanes]


def _check(lanes: Sequence[Lane]) -> None:
    for lane in lanes:
        if lane.codec.reason is not None:
            raise DefinitionError(
                f"{lane.channel.topic} cannot be made a table: {lane.codec.reason}. "
                "Its payloads can be fetched as they are (--format raw or mcap)."
            )


# --- columns of whole topics ----------------------------------------------------------


def _from_columns(query: Query) -> Iterator[list[Block]] | None:
    """Blocks of single values out of kept columns; None when they cannot answer, or cost more.

    The first group has no rows, so that there are columns even when no message is found.
    """
    lanes = query.lanes()
    types = _single_types(query, lanes)
    if types is None or not query.is_unthinned:
        return None
    with query.costing():
        found = judged(query, query.topics[0], types, as_rows=True)
    if found is None:
        return None
    with_recording = "recording" in _own(query, lanes)
    empty = list(Decoder(query, lanes).empty())
    return chain([empty], _blocks(query, types, found, with_recording=with_recording))


def _single_types(query: Query, lanes: Sequence[Lane]) -> Mapping[str, str] | None:
    """Types of the fields asked for, if columns of single values have them exactly."""
    fields = query.selected_fields
    if not fields or query.store.database is None or len(query.topics) != 1:
        return None
    types: dict[str, str] = {}
    for lane in lanes:
        if lane.is_reduced:
            continue  # its fields are those of whole messages
        if lane.channel.message_encoding not in SINGLE_READ:
            return None
        paths = {p.path: p for p in lane.codec.paths()}
        for name in fields:
            path = paths.get(name)
            # The index holds the nearest double of a uint64.
            if path is None or path.array or path.type not in INDEX_TYPES or path.type == "uint64":
                return None
            if types.setdefault(name, path.type) != path.type:
                return None
    return types if types and not set(_own(query, lanes)) - {"recording"} else None


def _blocks(
    query: Query, types: Mapping[str, str], found: Sequence[Judged], *, with_recording: bool
) -> Iterator[list[Block]]:
    """Blocks of fields out of kept columns, in groups that are in order."""
    ordered = sorted(found, key=lambda part: part.recording.key)
    parts = [(part, part.rows()) for part in ordered]
    if not parts:
        return
    times = [part.columns.log_time[rows] for part, rows in parts]
    owner = np.repeat(np.arange(len(parts)), [len(rows) for _, rows in parts])
    order = np.lexsort((owner, np.concatenate(times)))  # stable: within one, by arrival
    if query.is_reversed:
        order = order[::-1]
    row = np.concatenate([rows for _, rows in parts])
    for begin in range(0, len(order), _BLOCK_ROWS):
        here = order[begin : begin + _BLOCK_ROWS]
        group = []
        for rank, (part, _) in enumerate(parts):
            rows = np.sort(row[here[owner[here] == rank]])
            columns: dict[str, Column] = {
                path: take(part.columns.fields[path], rows) for path in types
            }
            own = {"recording": _text(part.recording.label, len(rows))} if with_recording else {}
            group.append(
                Block(
                    query.topics[0],
                    part.columns.log_time[rows],
                    part.columns.seq[rows] + (rank << _SEQ_BITS),
                    own,
                    records_array(_nested(columns, len(rows))),
                    0,
                )
            )
        query.counters.messages += len(here)
        yield group


def _nested(columns: Mapping[str, Column], rows: int) -> Records:
    """Columns by dotted path as the messages that they are parts of."""
    top = Records({}, rows)
    for path, column in columns.items():
        *parents, name = path.split(".")
        inner = top
        for parent in parents:
            below = inner.fields.setdefault(parent, Records({}, rows))
            assert isinstance(below, Records), "a definition has no field within a number"
            inner = below
        inner.fields[name] = column
    return top
