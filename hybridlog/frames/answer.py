"""Conversion of answers to tables, from payloads or from the tables of topics."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from hybridlog.columns.rows import LeftFields
from hybridlog.frames.names import FIELD, arranged, free_name, is_part, own_columns, summary_of
from hybridlog.query.rows import RowBatch, summaries_in
from hybridlog.schema.arrow_types import (
    OFFSET_LIMIT,
    TIME,
    common_type,
    converted,
    has_empty,
    is_array,
    is_list,
    is_time,
    missing_of,
    numbers,
    statistic,
    structs,
    with_values,
)
from hybridlog.schema.codec import Decoded, no_messages, stamp_array
from hybridlog.schema.column import STAMP
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import Batch, order_of, rows_by_channel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import MessageRun
    from hybridlog.query.planner import Planner
    from hybridlog.query.question import Part, Question, RecordedChannel


_BLOCK_ROWS = 65_536
_BLOCK_BYTES = 32 << 20
_SEQ_BITS = 44
FIXED = {"ros1", "cdr"}
"""Encodings whose definition fixes the fields."""


def to_arrow(planner: Planner) -> pa.Table:
    """The whole answer as an Arrow table, in order."""
    question = planner.question
    groups = _groups(planner, planner.parts())
    return _table([block for group in groups for block in group], question)


def _groups(planner: Planner, parts: Sequence[Part] | None) -> Iterator[Iterable[Block]]:
    """The blocks of an answer, those that overlap in time together; the first have no rows.

    Tables may answer the parts; without any, messages are read.
    """
    decoder = Decoder(planner)
    yield decoder.empty()
    if parts and decoder.fits_tables and planner.question.returns_all:
        found = [planner.tabled(part, decoder.fields) for part in parts]
        if None not in found:
            for part in parts:
                values = planner.values(part, decoder.fields)
                yield from ([block] for block in decoder.of_table(part, values))
            return
    for run in planner.runs():
        yield decoder.blocks(run)


def stream(planner: Planner, *, at_once: bool = False) -> Iterator[pa.Table]:
    """The answer in order, in tables of bounded size; at least one, possibly empty.

    The type of a column may differ between tables if no definition fixes it. With `at_once` there
    is a table of the columns, then one of what is read at a time.
    """
    question = planner.question
    parts = [] if question.reverse or len(planner.resolved) > 1 else planner.split()
    blocks: list[Block] = []
    rows, size, given = 0, 0, False
    for group in _groups(planner, parts if len(parts) == 1 else None):
        for block in group:
            blocks.append(block)
            rows, size = rows + len(block.log_time), size + block.size
        # Blocks of one group overlap in time, so no table ends between them.
        if at_once or rows >= _BLOCK_ROWS or size >= _BLOCK_BYTES:
            yield _table(blocks, question)
            rows, size, given = 0, 0, True
    if rows or not given:
        yield _table(blocks, question)


def is_fixed(planner: Planner) -> bool:
    """True if definitions fix the columns of an answer: its first table has them all."""
    return all(channel.encoding in FIXED for channel in planner.examples)


def _table(blocks: list[Block], question: Question) -> pa.Table:
    table = table_of(blocks, question.fields)
    return table.take(np.arange(table.num_rows - 1, -1, -1)) if question.reverse else table


class Decoder:
    """Makes blocks from the messages of a query, with the built-in columns `own`.

    `fields` are the requested ones without those, None for all; tables may lack columns.
    """

    def __init__(self, planner: Planner) -> None:
        check_definitions(planner.examples)
        self._examples = planner.examples
        self._counters = planner.counters
        self._chosen = planner.question.fields
        self.own = _own(planner)
        names = {"log_time", *self.own}
        self.fields = None if self._chosen is None else [p for p in self._chosen if p not in names]
        self.fits_tables = self.fields != [] and names <= {"log_time", "topic", "recording"}
        self._ranks = {key: rank << _SEQ_BITS for key, rank in planner.ranks.items()}

    def empty(self) -> Iterator[Block]:
        """A block without rows for each example: columns exist even without messages."""
        for channel in self._examples:
            batch = no_messages()
            yield self.block(channel, batch, batch.log_time, self.decoded(channel, batch))

    def blocks(self, run: MessageRun) -> Iterator[Block]:
        """The messages of a run, by channel."""
        for number, rows in rows_by_channel(run.batch.channel):
            channel, batch = run.channels[number], run.batch.take(rows)
            yield self.block(channel, batch, run.seq[rows], self.decoded(channel, batch))

    def of_table(self, part: Part, values: Iterator[RowBatch]) -> Iterator[Block]:
        """The messages of a part from its table, in order."""
        names = {"topic": part.topic, "recording": part.recording.name}
        # Tables have lists where a definition fixes the length.
        kind = part.channels[0].arrow_type(self.fields)
        for found in values:
            rows = len(found.log_time)
            self._counters.messages += rows
            own = {name: text_column(names[name], rows) for name in self.own}
            order = found.seq + self._ranks[part.recording.key]
            yield Block(part.topic, found.log_time, order, own, found.records.cast(kind), 0)

    def _summaries(self, channel: RecordedChannel) -> set[str]:
        """The requested paths that are summaries of arrays."""
        return summaries_in(self._chosen, {path.path: path.type for path in channel.codec.paths()})

    def decoded(self, channel: RecordedChannel, batch: Batch) -> Decoded:
        """The fields of messages of one channel; those that cannot be read are counted."""
        fields = None
        if self._chosen is not None:
            # Arrays of which summaries are asked for, too.
            arrays = {path.rpartition(".")[0] for path in self._summaries(channel)}
            fields = frozenset(arrays).union(self._chosen, {STAMP} if "stamp" in self.own else ())
        found = channel.codec.columns_of(batch, fields)
        self._counters.unreadable += len(batch) - len(found.rows)
        if isinstance(found.records, LeftFields):
            alone = () if fields is None else arrays.difference(self._chosen or ())
            self._counters.lacking += int(found.records.lacks(fields, alone).sum())
        return found

    def block(
        self, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64], decoded: Decoded
    ) -> Block:
        """The readable messages of one channel."""
        records, good = decoded.arrow(), decoded.rows
        if len(good) < len(batch):
            batch, seq = batch.take(good), seq[good]
        own = self.own_columns(channel, batch, seq, records)
        order = seq + self._ranks.get(channel.recording.key, 0)  # examples have no messages
        left, summaries = decoded.records, {}
        if isinstance(left, LeftFields):
            summaries = left.statistics(self._summaries(channel))
        topic, size = channel.channel.topic, batch.payload_bytes
        return Block(topic, batch.log_time, order, own, records, size, summaries)

    def own_columns(
        self, channel: RecordedChannel, batch: Batch, seq: NDArray[np.int64], records: Any = None
    ) -> dict[str, pa.Array[Any]]:
        """Built-in columns of messages of one channel, without the log time."""
        rows, is_known = len(batch), channel.channel.has_publish_time
        stamps = stamp_array(records) if records is not None and "stamp" in self.own else None
        made: dict[str, Callable[[], pa.Array[Any]]] = {
            "topic": lambda: text_column(channel.channel.topic, rows),
            "recording": lambda: text_column(channel.recording.name, rows),
            "seq": lambda: numbers(seq),
            "sequence": lambda: numbers(batch.sequence),
            "publish_time": lambda: (
                numbers(batch.publish_time, "time") if is_known else pa.nulls(rows, TIME)
            ),
            "stamp": lambda: pa.nulls(rows, TIME) if stamps is None else stamps,
        }
        return {name: made[name]() for name in self.own}


def _own(planner: Planner) -> list[str]:
    """Built-in columns of a table, without the log time."""
    question, channels = planner.question, planner.examples
    defined = {path.path for c in channels for path in c.codec.paths()}
    requested = own_columns(question.fields, defined)
    added = []
    if len(question.topics) > 1:
        added.append("topic")
    if question.names_recording or len(planner.session.summaries_of(question)) > 1:
        added.append("recording")
    return [name for name in dict.fromkeys([*added, *requested]) if name != "log_time"]


def text_column(text: str, rows: int) -> pa.Array[Any]:
    """A column of the same text."""
    text = text.encode("utf-8", "replace").decode()
    return pa.repeat(pa.scalar(text, pa.string()), rows)


def check_definitions(channels: Sequence[RecordedChannel]) -> None:
    """Refuse topics without fields."""
    for channel in channels:
        if channel.codec.reason is not None:
            raise DefinitionError(
                f"{channel.channel.topic} cannot be made a table: {channel.codec.reason}. "
                "Its payloads can be fetched as they are (--format raw or mcap)."
            )


class Block(NamedTuple):
    """Decoded messages of one topic: log times, ns, order of equal ones, columns of n rows each.

    `size` is the bytes of their payloads; `summaries` are of arrays that are not there, by path.
    """

    topic: str
    log_time: NDArray[np.int64]
    order: NDArray[np.int64]
    own: Mapping[str, pa.Array[Any]]
    records: pa.StructArray
    size: int
    summaries: Mapping[str, pa.Array[Any]] = MappingProxyType({})


def table_of(blocks: list[Block], fields: Sequence[str] | None = None) -> pa.Table:
    """The table of some blocks, sorted by log time and order; the list is empty afterwards.

    Nested messages become dotted columns (`pose.position.x`); `fields` are their paths, None for
    all. A column that a block lacks is null there. A column whose type changes gets the common
    exact type (`schema/arrow_types.py`). Messages of a topic are converted to one type before they
    are flattened, which makes the table independent of the division into chunks.

    The first column is `log_time`, timestamp[ns, UTC]. Numbers keep their wire type; times are
    timestamp[ns, UTC], durations duration[ns], strings string, arrays fixed_size_list if the
    definition fixes their length and list otherwise.
    """
    blocks.sort(key=_beginning)
    timed = [block for block in blocks if len(block.log_time)]
    order = None
    if timed:
        times = np.concatenate([block.log_time for block in timed])
        order = order_of(times, np.concatenate([block.order for block in timed]))

    made: dict[str, pa.ChunkedArray[Any]] = {}
    schema_fields: list[Any] = []

    def add(name: str, arrays: Sequence[pa.Array[Any]], kind: Any, path: str = "") -> None:
        column = pa.chunked_array([array for array in arrays if len(array)], type=kind)
        made[name] = column if order is None else in_order(column, order)
        of = {FIELD: path} if path not in {"", name} else None
        schema_fields.append(pa.field(name, kind, metadata=of))

    add("log_time", [numbers(block.log_time, "time") for block in blocks], TIME)
    for name in dict.fromkeys(name for block in blocks for name in block.own):
        arrays = [block.own[name] for block in blocks]
        add(name, arrays, common_type(arrays))
    kinds = {
        topic: common_type([b.records for b in blocks if b.topic == topic])
        for topic in {b.topic for b in blocks}
    }
    parts = [leaves_of(converted(b.records, kinds[b.topic]), fields, b.summaries) for b in blocks]
    lengths = [len(block.log_time) for block in blocks]
    blocks.clear()  # the columns below take their memory
    for path in dict.fromkeys(path for part in parts for path in part):
        found = [part.pop(path, None) for part in parts]
        kind = common_type([array for array in found if array is not None])
        arrays = [
            pa.nulls(rows, kind) if array is None else converted(array, kind)
            for array, rows in zip(found, lengths, strict=True)
        ]
        add(free_name(path, made), arrays, kind, path)
    table = pa.Table.from_arrays([*made.values()], schema=pa.schema(schema_fields))
    return table.select(arranged(table.column_names, fields))


def _beginning(block: Block) -> tuple[int, int]:
    return (int(block.log_time[0]), int(block.order[0])) if len(block.log_time) else (-1, -1)


# Nested messages as flat columns: `pose.position.x`.


def flat(records: pa.StructArray) -> dict[str, pa.Array[Any]]:
    """The leaves of messages by dotted path, in the order of the definition.

    Fields of a null message are null. A message without fields has no leaf. A duplicate path,
    which only names with dots can cause, gets underscores.
    """
    leaves: dict[str, pa.Array[Any]] = {}
    pending = _children("", records)
    while pending:
        path, array = pending.pop()
        if pa.types.is_struct(array.type):
            pending.extend(_children(f"{path}.", array))
            continue
        while path in leaves:
            path += "_"
        leaves[path] = with_fields(array)
    return leaves


def _children(prefix: str, array: pa.StructArray) -> list[tuple[str, pa.Array[Any]]]:
    """The fields of a struct array, last first."""
    names = (prefix + field.name for field in array.type)
    return list(zip(names, array.flatten(), strict=True))[::-1]


def with_fields(array: pa.Array[Any]) -> pa.Array[Any]:
    """The array with `true` for messages without fields, which few formats support."""
    if not has_empty(array.type):
        return array
    if is_list(array.type):
        return with_values(array, with_fields(array.flatten()))
    missing = missing_of(array)
    if not array.type.num_fields:
        return pa.array(np.ones(len(array), np.bool_), mask=missing)
    children = zip(array.type, array.flatten(), strict=True)
    return structs({f.name: with_fields(child) for f, child in children}, len(array), missing)


def leaves_of(
    records: pa.StructArray,
    requested: Collection[str] | None,
    known: Mapping[str, pa.Array[Any]] = MappingProxyType({}),
) -> dict[str, pa.Array[Any]]:
    """The requested leaves of messages, by dotted path, and summaries (`ranges.min`).

    None requests all fields. Fields that were decoded only for others are left out; `known` are
    summaries of arrays that are not there.
    """
    leaves = flat(records)
    if requested is None:
        return leaves
    wanted = [path.replace("[]", "") for path in requested]
    made: dict[str, pa.Array[Any]] = {}
    for path in wanted:
        summary = summary_of(path)
        array = None if summary is None or path in leaves else leaves.get(summary[0])
        if summary is not None and array is not None:
            found = known.get(path, summary_array(array, summary[1]))
            made |= {} if found is None else {path: found}
    asked = [one for one in wanted if one not in made]
    return {
        path: array
        for path, array in leaves.items()
        # A path that is there twice has an underscore.
        if path in asked
        or any(is_part(path, one) or is_part(path.rstrip("_"), one) for one in asked)
    } | made


def summary_array(array: pa.Array[Any], what: str) -> pa.Array[Any] | None:
    """One summary of each row; None if the array has no such summary."""
    kind = array.type
    if not is_array(kind):
        return None
    if what != "n" and is_list(kind):
        if pa.types.is_null(kind.value_type):  # all arrays are empty
            return pa.nulls(len(array), pa.float64())
        if is_time(kind.value_type):
            return None
    return statistic(array, what)


def columns(
    planner: Planner, part: Part, fields: Collection[str] | None, *, partial: bool = False
) -> Iterator[RowBatch]:
    """Rows of a part with fields by dotted path and summaries of arrays; see `Rows.values`."""
    for rows in planner.values(part, fields, partial=partial):
        leaves = leaves_of(rows.records, fields, rows.summaries)
        yield rows._replace(records=structs(leaves, len(rows.log_time)))


def in_order(column: pa.ChunkedArray[Any], order: NDArray[np.intp]) -> pa.ChunkedArray[Any]:
    """The rows of a column in another order; what may be long for 32-bit offsets in pieces."""
    kind = column.type
    if is_list(kind):
        wide = column.cast(pa.large_list(kind.value_type))
    elif pa.types.is_string(kind) or pa.types.is_binary(kind):
        wide = column.cast(pa.large_binary() if pa.types.is_binary(kind) else pa.large_string())
    else:
        return column.take(pa.array(order))
    count = max(1, len(order) * (OFFSET_LIMIT // 16) // max(column.nbytes, 1))
    pieces: list[pa.Array[Any]] = []
    for begin in range(0, len(order), count):
        part = wide.take(pa.array(order[begin : begin + count]))
        pieces.extend(part.cast(kind).chunks)
    return pa.chunked_array(pieces, type=kind)
