"""From a query to columns: out of the index when that is enough, else out of payloads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np
from hybridlog_storage.errors import DefinitionError
from hybridlog_storage.messages import Batch

from hybridlog.frames import TableBuilder
from hybridlog.indexing import rows_by_channel
from hybridlog.query.plan import Lane, Piece, Sweep
from hybridlog.schema.column import Records, Strings

if TYPE_CHECKING:
    from hybridlog.reader import Query


def collect(query: Query) -> TableBuilder:
    """All columns of a query's answer.

    Raises:
        DefinitionError: a topic has no definition to make columns from.
    """
    types = _scalar_types(query)
    if types is not None:
        return _from_index(query, types)
    plan = query.plan()
    _check(plan.lanes)
    plain = query.is_unthinned
    expected = sum(t.messages for t in plan.tasks()) if plain and plan.chooser is None else None
    builder = TableBuilder(expected_rows=expected if query.is_unbounded else None)
    several = len(query.topics) > 1
    for lane in plan.lanes:
        # Columns exist even when no message does.
        _append(builder, lane, _nothing(), query.selected_fields, several=several)
    sweep = Sweep(plan, query.store.segment)
    for piece in sweep.unordered() if plain else query.pieces(plan):
        for number, rows in rows_by_channel(piece.batch.channel):
            part = Piece(piece.batch.take(rows), piece.seq[rows])
            _append(builder, plan.lanes[number], part, query.selected_fields, several=several)
    return builder


def pieces_of_table(query: Query) -> Iterator[tuple[Lane, Piece, Records]]:
    """The answer of a query in order and in parts, for tables that are written as they come.

    Yields:
        The channel, the messages that could be decoded, and their columns.
    """
    plan = query.plan()
    _check(plan.lanes)
    for piece in query.pieces(plan):
        for number, rows in rows_by_channel(piece.batch.channel):
            lane = plan.lanes[number]
            batch, seq = piece.batch.take(rows), piece.seq[rows]
            decoded = lane.codec.columns(
                batch.buffer, batch.offset, batch.length, query.selected_fields
            )
            yield lane, Piece(batch.take(decoded.rows), seq[decoded.rows]), decoded.records


def _append(
    builder: TableBuilder,
    lane: Lane,
    piece: Piece,
    fields: tuple[str, ...] | None,
    *,
    several: bool,
) -> None:
    batch = piece.batch
    decoded = lane.codec.columns(batch.buffer, batch.offset, batch.length, fields)
    records = with_topic(decoded.records, lane.channel.topic) if several else decoded.records
    builder.append(batch.log_time[decoded.rows], piece.seq[decoded.rows], records)


def with_topic(records: Records, topic: str) -> Records:
    """The same columns behind one that says the topic."""
    name = np.frombuffer(topic.encode("utf-8", "replace"), np.uint8)
    rows = len(records)
    column = Strings(np.tile(name, rows), np.arange(rows + 1, dtype=np.int64) * len(name))
    return Records({"topic": column, **records.fields}, rows)


def _check(lanes: list[Lane]) -> None:
    for lane in lanes:
        if lane.codec.reason is not None:
            raise DefinitionError(
                f"{lane.channel.topic} cannot be made a table: {lane.codec.reason}. "
                "Its payloads can be fetched as they are (--format raw or mcap)."
            )


def _scalar_types(query: Query) -> Mapping[str, str] | None:
    """Types of the fields asked for, if the index alone can answer; None if it cannot."""
    fields = query.selected_fields
    if fields is None or query.store.database is None or len(query.topics) != 1:
        return None
    types: dict[str, str] = {}
    for lane in query.lanes():
        paths = {p.path: p for p in lane.codec.paths()}
        for name in fields:
            path = paths.get(name)
            if path is None or path.array or path.type not in INDEX_TYPES:
                return None
            if types.setdefault(name, path.type) != path.type:
                return None
    return types


def _from_index(query: Query, types: Mapping[str, str]) -> TableBuilder:
    from hybridlog.frames.bson import index_columns

    builder = TableBuilder()
    topic = query.topics[0]
    projection = {"_id": 0, "_meta.t": 1, "_meta.seq": 1, **dict.fromkeys(types, 1)}
    taken = 0
    for raw in query.raw_documents(topic, projection):
        reference, records = index_columns(raw, types)
        count = len(reference.t)
        rows = np.arange((-taken) % query.step, count, query.step)
        taken += count
        query.counters.documents_read += count
        query.counters.messages += len(rows)
        builder.append(reference.t, reference.seq, records)
    return builder


def _nothing() -> Piece:
    none = np.empty(0, np.int64)
    batch = Batch(b"", none, none, none.astype(np.int32), none, none, none.astype(np.uint32))
    return Piece(batch, none)
