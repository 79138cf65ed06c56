"""From a query to columns: out of the index when that is enough, else out of payloads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.columns.answers import judged
from hybridlog.columns.judged import Judged
from hybridlog.frames import TableBuilder
from hybridlog.frames.bson import INDEX_TYPES, INSTANTS, records_from_bson
from hybridlog.indexing import rows_by_channel
from hybridlog.query.plan import Lane, Piece, Plan, Sweep
from hybridlog.schema.column import Column, Records, Scalars, Strings, take
from hybridlog_storage.errors import DefinitionError, UsageError
from hybridlog_storage.messages import Batch

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.reader import Query

_BLOCK_ROWS = 65_536
_BLOCK_BYTES = 32 << 20
_SEQ_BITS = 44


class Block(NamedTuple):
    """Columns of some messages.

    Attributes:
        topic: Their topic.
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
        records: n rows.
        size: Bytes of their payloads, 0 when they came out of the index.
    """

    topic: str
    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]
    records: Records
    size: int


def collect(query: Query) -> TableBuilder:
    """All columns of a query's answer.

    Raises:
        DefinitionError: a topic has no definition to make columns from.
    """
    several = len(query.topics) > 1
    types = scalar_types(query)
    if types is not None:
        builder = TableBuilder()
        for block in chain.from_iterable(_single_values(query, types)):
            builder.append(block.log_time, block.seq, block.records)
        return builder
    plan = query.plan()
    _check(plan.lanes)
    builder = TableBuilder(expected_rows=_expected(query, plan))
    for block in _empty(plan, query):
        _append(builder, block, several=several)
    sweep = Sweep(plan, query.store.segment)
    for piece in sweep.unordered() if query.is_unthinned else query.pieces(plan):
        for block in _decoded(plan.lanes, piece, query):
            _append(builder, block, several=several)
    return builder


def stream(query: Query) -> Iterator[pa.Table]:
    """The answer in order, in tables of bounded size; at least one, perhaps empty."""
    several = len(query.topics) > 1
    types = scalar_types(query)
    groups: Iterator[Iterable[Block]]
    if types is not None:
        groups = _single_values(query, types)
    else:
        plan = query.plan()
        _check(plan.lanes)
        decoded = (_decoded(plan.lanes, piece, query) for piece in query.pieces(plan))
        groups = chain([_empty(query.empty_plan(), query)], decoded)
    yield from _tables(query, groups, several=several)


def _tables(
    query: Query, groups: Iterator[Iterable[Block]], *, several: bool
) -> Iterator[pa.Table]:
    builder, size = TableBuilder(), 0
    given = False
    for group in groups:
        # Blocks of one group overlap in time, so no table ends between them.
        if len(builder) >= _BLOCK_ROWS or size >= _BLOCK_BYTES:
            yield _finished(builder, query)
            given = True
            builder, size = TableBuilder(), 0
        for block in group:
            _append(builder, block, several=several)
            size += block.size
    if len(builder) or not given:
        yield _finished(builder, query)


def arranged(names: Sequence[str], fields: Sequence[str] | None) -> list[str]:
    """Column names in the order in which their fields were asked for."""
    if fields is None:
        return list(names)

    def place(name: str) -> int:
        for number, path in enumerate(fields):
            plain = path.replace("[]", "")
            if name == plain or name.startswith(f"{plain}.") or plain.startswith(f"{name}."):
                return number
        return -1  # what was not asked for comes first: log time, topic

    return sorted(names, key=place)


def _finished(builder: TableBuilder, query: Query) -> pa.Table:
    table = builder.to_arrow()
    table = table.select(arranged(table.column_names, query.selected_fields))
    if query.is_reversed:
        table = table.take(np.arange(table.num_rows - 1, -1, -1))
    return table


def _append(builder: TableBuilder, block: Block, *, several: bool) -> None:
    records = with_topic(block.records, block.topic) if several else block.records
    builder.append(block.log_time, block.seq, records)


def with_topic(records: Records, topic: str) -> Records:
    """The same columns behind one that says the topic."""
    name = np.frombuffer(topic.encode("utf-8", "replace"), np.uint8)
    rows = len(records)
    column = Strings(np.tile(name, rows), np.arange(rows + 1, dtype=np.int64) * len(name))
    return Records({"topic": column, **records.fields}, rows)


def _decoded(lanes: Sequence[Lane], piece: Piece, query: Query) -> Iterator[Block]:
    ranks = _ranks(lanes)
    for number, rows in rows_by_channel(piece.batch.channel):
        lane = lanes[number]
        if lane.is_reduced:
            query.counters.reduced += len(rows)
            continue
        batch, seq = piece.batch.take(rows), piece.seq[rows]
        decoded = lane.codec.columns(
            batch.buffer, batch.offset, batch.length, query.selected_fields
        )
        good = decoded.rows
        yield Block(
            lane.channel.topic,
            batch.log_time[good],
            seq[good] + ranks[number],
            decoded.records,
            batch.payload_bytes,
        )


def _ranks(lanes: Sequence[Lane]) -> list[int]:
    """What makes arrival numbers of each lane's recording follow those of the one before."""
    order = {key: rank for rank, key in enumerate(sorted({lane.recording.key for lane in lanes}))}
    return [order[lane.recording.key] << _SEQ_BITS for lane in lanes]


def _empty(plan: Plan, query: Query) -> Iterator[Block]:
    """A block without rows for each channel: columns exist even when no message does."""
    none = np.empty(0, np.int64)
    for number, _ in enumerate(plan.lanes):
        channel = np.empty(0, np.int32)
        batch = Batch(b"", none, none, channel, none, none, none.astype(np.uint32))
        lane = plan.lanes[number]
        decoded = lane.codec.columns(
            batch.buffer, batch.offset, batch.length, query.selected_fields
        )
        yield Block(lane.channel.topic, none, none, decoded.records, 0)


def _expected(query: Query, plan: Plan) -> int | None:
    """How many rows will come, when that is known before."""
    if query.is_unthinned and query.is_unbounded and plan.chooser is None:
        return sum(task.messages for task in plan.tasks())
    return None


def _check(lanes: Sequence[Lane]) -> None:
    for lane in lanes:
        if lane.codec.reason is not None:
            raise DefinitionError(
                f"{lane.channel.topic} cannot be made a table: {lane.codec.reason}. "
                "Its payloads can be fetched as they are (--format raw or mcap)."
            )


def scalar_types(query: Query) -> Mapping[str, str] | None:
    """Types of the fields asked for, if the index alone can answer; None if it cannot.

    Raises:
        UsageError: a summary of an array is asked for where the index cannot answer.
    """
    from hybridlog.reader import summary_type

    fields = query.selected_fields
    if fields is None:
        return None
    types: dict[str, str] = {}
    summaries: list[str] = []
    indexed = query.store.database is not None and len(query.topics) == 1
    for lane in query.lanes():
        if lane.is_reduced:
            continue  # the index has of it what it has of whole messages
        paths = {p.path: p for p in lane.codec.paths()}
        known = {name: path.type for name, path in paths.items()}
        for name in fields:
            found = summary_type(name, known)
            if found is not None:
                summaries.append(name)
            elif name in paths and not paths[name].array and known[name] in INDEX_TYPES:
                found = known[name]
            if found is None or types.setdefault(name, found) != found:
                indexed = False
    if summaries and not indexed:
        raise UsageError(
            f"{summaries[0]} stands in the index: ask for it on one topic, together with "
            "single values only, while MongoDB is there."
        )
    return types if indexed else None


def _single_values(query: Query, types: Mapping[str, str]) -> Iterator[Iterable[Block]]:
    """Blocks of single values of one topic, out of kept columns or the index.

    The first group has no rows, so that there are columns even when no message is found.
    """
    topic = query.topics[0]
    none = np.empty(0, np.int64)
    yield [Block(topic, none, none, Records(_no_values(types), 0), 0)]
    found = None
    if query.is_unthinned:
        with query.costing():
            found = judged(query, topic, types, as_rows=True)
    yield from _from_index(query, types) if found is None else _from_columns(query, types, found)


def _no_values(types: Mapping[str, str]) -> dict[str, Column]:
    """Columns without rows."""
    columns: dict[str, Column] = {}
    for path, kind in types.items():
        dtype = INDEX_TYPES[kind]
        if kind == "string":
            columns[path] = Strings(np.empty(0, np.uint8), np.zeros(1, np.int64))
        elif dtype is None:
            columns[path] = Scalars(np.empty(0, np.int64), INSTANTS[kind])
        else:
            columns[path] = Scalars(np.empty(0, dtype))
    return columns


def _from_columns(
    query: Query, types: Mapping[str, str], found: Sequence[Judged]
) -> Iterator[list[Block]]:
    """Blocks of fields out of kept columns, in groups that are in order."""
    if not found:
        return
    ordered = sorted(found, key=lambda part: part.recording.key)
    parts = [(part, part.rows()) for part in ordered]
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
            seq = part.columns.seq[rows] + (rank << _SEQ_BITS)
            log_time = part.columns.log_time[rows]
            group.append(Block(query.topics[0], log_time, seq, Records(columns, len(rows)), 0))
        query.counters.messages += len(here)
        yield group


def _from_index(query: Query, types: Mapping[str, str]) -> Iterator[list[Block]]:
    """Blocks of the fields asked for, in groups that are in the order of the index."""
    topic = query.topics[0]
    projection = {"_id": 0, "_meta.t": 1, "_meta.seq": 1, **dict.fromkeys(types, 1)}
    for raw, rows, before in query.thinned_documents(topic, projection):
        group = []
        # Documents that lack a field (an array too short for a summary) form parts.
        for part in records_from_bson(raw, types):
            chosen = np.flatnonzero(np.isin(part.rows, rows, assume_unique=True))
            query.counters.messages += len(chosen)
            reference, records = part.reference, part.records
            if len(chosen) < len(reference):
                reference, records = reference.take(chosen), take(records, chosen)
            # Their places keep rows of one log time in the order of the index.
            places = before + part.rows[chosen]
            place = -places if query.is_reversed else places
            group.append(Block(topic, reference.t, place, records, 0))
        yield group
