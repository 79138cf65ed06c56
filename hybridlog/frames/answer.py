"""From a query to columns: out of the index when that is enough, else out of payloads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.frames import TableBuilder
from hybridlog.indexing import rows_by_channel
from hybridlog.schema.column import Records, Strings
from hybridlog_storage.errors import DefinitionError

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.query.chunk_scan import MessageRun, ScanPlan
    from hybridlog.query.planner import Planner
    from hybridlog.query.question import Question, RecordedChannel

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


def collect(planner: Planner) -> TableBuilder:
    """All columns of a query's answer.

    Raises:
        DefinitionError: a topic has no definition to make columns from.
    """
    several = len(planner.question.topics) > 1
    plan = planner.scan_plan()
    _check(plan.channels)
    builder = TableBuilder(expected_rows=_expected(planner, plan))
    for block in _empty(planner):
        _append(builder, block, several=several)
    all_of_them = planner.question.returns_all
    for run in planner.unordered(plan) if all_of_them else planner.runs(plan):
        for block in _decoded(plan.channels, run, planner):
            _append(builder, block, several=several)
    return builder


def to_arrow(planner: Planner) -> pa.Table:
    """The whole answer as an Arrow table, in order."""
    question = planner.question
    table = collect(planner).to_arrow()
    table = table.select(arranged(table.column_names, question.fields))
    return table.take(np.arange(table.num_rows - 1, -1, -1)) if question.reverse else table


def to_pandas(planner: Planner) -> pd.DataFrame:
    """The whole answer as a frame, in order."""
    question = planner.question
    frame = collect(planner).to_pandas()
    names = list(frame.columns)
    wanted = arranged(names, question.fields)
    if wanted != names:  # choosing columns takes as long as making the frame
        frame = frame[wanted]
    return frame.iloc[::-1] if question.reverse else frame


def stream(planner: Planner) -> Iterator[pa.Table]:
    """The answer in order, in tables of bounded size; at least one, perhaps empty."""
    several = len(planner.question.topics) > 1
    plan = planner.scan_plan()
    _check(planner.channels())
    decoded = (_decoded(plan.channels, run, planner) for run in planner.runs(plan))
    groups: Iterator[Iterable[Block]] = chain([_empty(planner)], decoded)
    yield from _tables(planner.question, groups, several=several)


def _tables(
    question: Question, groups: Iterator[Iterable[Block]], *, several: bool
) -> Iterator[pa.Table]:
    builder, size = TableBuilder(), 0
    given = False
    for group in groups:
        # Blocks of one group overlap in time, so no table ends between them.
        if len(builder) >= _BLOCK_ROWS or size >= _BLOCK_BYTES:
            yield _finished(builder, question)
            given = True
            builder, size = TableBuilder(), 0
        for block in group:
            _append(builder, block, several=several)
            size += block.size
    if len(builder) or not given:
        yield _finished(builder, question)


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


def _finished(builder: TableBuilder, question: Question) -> pa.Table:
    table = builder.to_arrow()
    table = table.select(arranged(table.column_names, question.fields))
    if question.reverse:
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


def _decoded(
    lanes: Sequence[RecordedChannel], piece: MessageRun, planner: Planner
) -> Iterator[Block]:
    ranks = _ranks(lanes)
    for number, rows in rows_by_channel(piece.batch.channel):
        lane = lanes[number]
        if lane.is_reduced:
            planner.counters.reduced += len(rows)
            continue
        batch, seq = piece.batch.take(rows), piece.seq[rows]
        decoded = lane.codec.columns(
            batch.buffer, batch.offset, batch.length, planner.question.fields
        )
        good = decoded.rows
        yield Block(
            lane.channel.topic,
            batch.log_time[good],
            seq[good] + ranks[number],
            decoded.records,
            batch.payload_bytes,
        )


def _ranks(lanes: Sequence[RecordedChannel]) -> list[int]:
    """What makes arrival numbers of each lane's recording follow those of the one before."""
    order = {key: rank for rank, key in enumerate(sorted({lane.recording.key for lane in lanes}))}
    return [order[lane.recording.key] << _SEQ_BITS for lane in lanes]


def _empty(planner: Planner) -> Iterator[Block]:
    """A block without rows for each channel: columns exist even when no message does."""
    none = np.empty(0, np.int64)
    for channel in planner.channels():
        if channel.is_reduced:
            continue
        decoded = channel.codec.columns(b"", none, none, planner.question.fields)
        yield Block(channel.channel.topic, none, none, decoded.records, 0)


def _expected(planner: Planner, plan: ScanPlan) -> int | None:
    """How many rows will come, when that is known before."""
    question = planner.question
    if question.returns_all and question.is_unbounded and question.predicate is None:
        return sum(task.messages for task in plan.tasks())
    return None


def _check(lanes: Sequence[RecordedChannel]) -> None:
    for lane in lanes:
        if lane.codec.reason is not None:
            raise DefinitionError(
                f"{lane.channel.topic} cannot be made a table: {lane.codec.reason}. "
                "Its payloads can be fetched as they are (--format raw or mcap)."
            )
