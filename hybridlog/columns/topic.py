"""Fields of all messages of a topic, as columns, and which fields can be such columns."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog.query.column_filter import Single, is_single
from hybridlog.schema.column import Records, Scalars, Strings, flatten, take
from hybridlog.schema.utf8 import repaired
from hybridlog_storage.segment_writer import SegmentSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.schema.codec import Codec

SINGLE_READ = frozenset({"ros1", "cdr"})
"""Encodings of which every message has every field, so that payloads tell what the index does."""
LARGE = SegmentSettings().large_payload
"""Mean payload bytes from which a topic has few documents for its size."""
_PIECE = 1 << 14  # rows that are compared at once


class UnfitError(Exception):
    """These messages cannot be kept as columns."""


class Order(NamedTuple):
    """When messages were logged, by log time and arrival.

    Attributes:
        log_time: int64[n], ns.
        seq: int64[n], arrival numbers.
    """

    log_time: NDArray[np.int64]
    seq: NDArray[np.int64]

    @property
    def is_kept(self) -> bool:
        """Whether the messages are in this order already."""
        # A piece at a time: new memory for arrays as long as these would take longer.
        for begin in range(0, len(self.seq) - 1, _PIECE):
            time, seq = (part[begin : begin + _PIECE + 1] for part in self)
            later = time[1:] > time[:-1]
            if later.all():
                continue
            same = time[1:] == time[:-1]
            if not (later | (same & (seq[1:] > seq[:-1]))).all():
                return False
        return True


@dataclass(frozen=True, slots=True, eq=False)
class TopicColumns:
    """Fields of all messages of a topic in a recording, by log time and arrival.

    Attributes:
        rows: Number of messages.
        order: When they were logged; None when nobody wanted to know.
        fields: Columns of n rows by dotted path.
    """

    rows: int
    order: Order | None
    fields: Mapping[str, Single]

    def __len__(self) -> int:
        """Number of messages."""
        return self.rows

    @property
    def log_time(self) -> NDArray[np.int64]:
        """int64[n], ns; only where the order was wanted."""
        assert self.order is not None
        return self.order.log_time

    @property
    def seq(self) -> NDArray[np.int64]:
        """int64[n], arrival numbers; only where the order was wanted."""
        assert self.order is not None
        return self.order.seq

    @property
    def nbytes(self) -> int:
        """Memory that they take."""
        order = 0 if self.order is None else sum(part.nbytes for part in self.order)
        return order + sum(map(nbytes, self.fields.values()))


def in_order(
    log_time: NDArray[np.int64], seq: NDArray[np.int64], fields: Mapping[str, Single]
) -> TopicColumns:
    """Columns by log time and arrival, whatever their order was."""
    order = Order(log_time, seq)
    if not order.is_kept:
        rows = np.lexsort((seq, log_time))
        order = Order(log_time[rows], seq[rows])
        fields = {path: take(column, rows) for path, column in fields.items()}
    return TopicColumns(len(seq), order, fields)


def types_of(codec: Codec) -> dict[str, str]:
    """The fields that can be columns, and their types."""
    if not codec.indexed:
        return {}
    return {p.path: p.type for p in codec.paths() if not p.array and is_single(p.type)}


def singles(records: Records, paths: Collection[str]) -> dict[str, Single]:
    """Fields by path, as the index has them: text is UTF-8, and a boolean is 0 or 1.

    Raises:
        UnfitError: One of them is not a single value in every message.
    """
    leaves = flatten(records)
    found: dict[str, Single] = {}
    for path in paths:
        leaf = leaves.get(path)
        if isinstance(leaf, Strings):
            found[path] = repaired(leaf)
        elif not isinstance(leaf, Scalars):
            raise UnfitError
        elif leaf.values.dtype == np.bool_:
            found[path] = Scalars(leaf.values.view(np.uint8) != 0)
        else:
            found[path] = leaf
    return found


def is_small(payload_bytes: int, messages: int) -> bool:
    """Whether messages are so small that all topics with such messages share chunks."""
    return payload_bytes < LARGE * max(messages, 1)


def nbytes(column: Single) -> int:
    """Memory that a column takes."""
    if isinstance(column, Strings):
        return column.data.nbytes + column.offset.nbytes
    return column.values.nbytes
