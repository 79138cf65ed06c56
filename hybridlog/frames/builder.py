"""Builds one table from the decoded messages of many chunks."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa

from hybridlog.frames.columns import chunked, flat, in_order, with_summaries
from hybridlog.frames.names import FIELD, TAG, arranged, free_name
from hybridlog.schema.arrow_columns import TIME, numbers
from hybridlog.schema.arrow_types import common_type, converted
from hybridlog_storage.ordering import order_of

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray


class Block(NamedTuple):
    """Decoded messages of one topic.

    Attributes:
        topic: Topic of the messages.
        log_time: int64[n], ns.
        order: int64[n], order of messages with the same log time.
        own: Built-in columns without the log time, n rows each.
        records: n rows.
        size: Bytes of their payloads.
        summaries: Requested summaries of arrays that are not there, by path.
    """

    topic: str
    log_time: NDArray[np.int64]
    order: NDArray[np.int64]
    own: Mapping[str, pa.Array[Any]]
    records: pa.StructArray
    size: int
    summaries: Mapping[str, pa.Array[Any]] = MappingProxyType({})


class TableBuilder:
    """Collects blocks and joins them to one table.

    Nested messages become dotted columns (`pose.position.x`). A column that a block lacks
    is null there. A column whose type changes gets the common exact type
    (`schema/arrow_types.py`). Messages of a topic are converted to one type before they are
    flattened, which makes the table independent of the division into chunks.

    Args:
        fields: Requested paths; None for all fields.
        tags: Keys of tags, by the names of their columns.
    """

    def __init__(
        self, fields: Sequence[str] | None = None, tags: Mapping[str, str] | None = None
    ) -> None:
        self._fields = fields
        self._tags = tags or {}
        self._blocks: list[Block] = []
        self._rows = 0

    def __len__(self) -> int:
        """Number of rows so far."""
        return self._rows

    def append(self, block: Block) -> None:
        """Add a block. Its arrays are referenced, not copied."""
        self._blocks.append(block)
        self._rows += len(block.log_time)

    def to_arrow(self) -> pa.Table:
        """The table, sorted by log time and order.

        Returns:
            The first column is `log_time`, timestamp[ns, UTC]. Numbers keep their wire
            type; times are timestamp[ns, UTC], durations duration[ns], strings string,
            arrays fixed_size_list if the definition fixes their length and list
            otherwise.
        """
        blocks, self._blocks, self._rows = self._blocks, [], 0
        blocks.sort(key=_beginning)
        order = _order(blocks)
        times = [numbers(block.log_time, "time") for block in blocks]
        names = [pa.field("log_time", TIME)]
        columns = [_ordered(times, TIME, order)]
        for name in dict.fromkeys(name for block in blocks for name in block.own):
            arrays = [block.own[name] for block in blocks]
            columns.append(_ordered(arrays, common_type(arrays), order))
            tag = {TAG: self._tags[name]} if name in self._tags else None
            names.append(pa.field(name, columns[-1].type, metadata=tag))
        parts = self._flat(blocks)
        lengths = [len(block.log_time) for block in blocks]
        del blocks
        taken = {field.name for field in names}
        for path in dict.fromkeys(path for part in parts for path in part):
            name = free_name(path, taken)
            taken.add(name)
            found = [part.pop(path, None) for part in parts]
            kind = common_type([array for array in found if array is not None])
            arrays = [
                pa.nulls(rows, kind) if array is None else converted(array, kind)
                for array, rows in zip(found, lengths, strict=True)
            ]
            columns.append(_ordered(arrays, kind, order))
            of = {FIELD: path} if name != path else None
            names.append(pa.field(name, kind, metadata=of))
        table = pa.Table.from_arrays(columns, schema=pa.schema(names))
        return table.select(arranged(table.column_names, self._fields, self._tags))

    def _flat(self, blocks: Sequence[Block]) -> list[dict[str, pa.Array[Any]]]:
        """The leaves of each block, with one type for each topic."""
        topics: dict[str, list[pa.StructArray]] = {}
        for block in blocks:
            topics.setdefault(block.topic, []).append(block.records)
        kinds = {topic: common_type(records) for topic, records in topics.items()}
        return [
            with_summaries(
                flat(converted(block.records, kinds[block.topic])), self._fields, block.summaries
            )
            for block in blocks
        ]


def _beginning(block: Block) -> tuple[int, int]:
    return (int(block.log_time[0]), int(block.order[0])) if len(block.log_time) else (-1, -1)


def _order(blocks: Sequence[Block]) -> NDArray[np.intp] | None:
    """The order of the rows by log time; None if they are in order."""
    blocks = [block for block in blocks if len(block.log_time)]
    if not blocks:
        return None
    time = np.concatenate([block.log_time for block in blocks])
    return order_of(time, np.concatenate([block.order for block in blocks]))


def _ordered(
    arrays: Sequence[pa.Array[Any]], kind: pa.DataType, order: NDArray[np.intp] | None
) -> pa.ChunkedArray[Any]:
    column = chunked(arrays, kind)
    return column if order is None else in_order(column, order)
