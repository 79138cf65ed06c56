"""Answers about one topic of a recording out of its table.

The rows come in order, and each answer is exactly that of the messages themselves. Where a
table cannot tell, the answer is None, and another way has to be asked.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.columns.tables import Tables
    from hybridlog.columns.topic_table import TableRows, TopicTable
    from hybridlog.query.intervals import Span
    from hybridlog_storage.catalog import RecordingEntry

Mask = Callable[[Any], "NDArray[np.bool_] | None"]
"""Tells of which messages, a struct each, a predicate holds; None if it cannot tell."""


def count(
    tables: Tables,
    recording: RecordingEntry,
    topic: str,
    *,
    mask: Mask | None = None,
    fields: Collection[str] = (),
    spans: Sequence[Span] | None = None,
) -> int | None:
    """Number of messages of which a predicate holds.

    Args:
        tables: Of the store.
        recording: As the catalog has it.
        topic: Full name.
        mask: The predicate; None for all messages.
        fields: Paths of the fields that it is about.
        spans: Ranges of log time, ns, apart and in order; None for all times.
    """
    table = tables.of(recording, topic)
    if table is None:
        return None
    if mask is None and spans is None:
        return table.rows
    try:
        found = _rows(table, mask, fields if mask else (), (), spans)
        return None if found is None else sum(map(len, found))
    except StoreError:
        tables.reject(recording, topic)
        return None


def rows(
    tables: Tables,
    recording: RecordingEntry,
    topic: str,
    *,
    mask: Mask | None = None,
    fields: Collection[str] | None = (),
    own: Collection[str] = (),
    spans: Sequence[Span] | None = None,
) -> Iterator[TableRows] | None:
    """Messages of which a predicate holds, by log time and arrival.

    Args:
        tables: Of the store.
        recording: As the catalog has it.
        topic: Full name.
        mask: The predicate; None for all messages.
        fields: Paths of the fields that are wanted or that the predicate is about; None for
            all.
        own: Columns of the table itself: `pub`, `stamp`, `channel`, `state`, `error`, `ref`.
        spans: Ranges of log time, ns, apart and in order; None for all times.

    Raises:
        StoreError: While rows are taken: what follows is damaged. Another way can go on behind
            the last row.
    """
    table = tables.of(recording, topic)
    found = None if table is None else _rows(table, mask, fields, own, spans)
    return None if found is None else _guarded(found, tables, recording, topic)


def _guarded(
    found: Iterator[TableRows], tables: Tables, recording: RecordingEntry, topic: str
) -> Iterator[TableRows]:
    try:
        yield from found
    except StoreError:
        tables.reject(recording, topic)
        raise


def _rows(
    table: TopicTable,
    mask: Mask | None,
    fields: Collection[str] | None,
    own: Collection[str],
    spans: Sequence[Span] | None,
) -> Iterator[TableRows] | None:
    needs_fields = mask is not None or fields is None or bool(fields)
    if table.reduced and needs_fields:
        return None  # the index has the fields of these, the table has not
    if mask is None:
        return table.scan(fields, own=own, spans=spans)
    if mask(table.empty(fields)) is None:
        return None
    columns = {*own, "state"} if table.unreadable else own
    return _matching(table, table.scan(fields, own=columns, spans=spans), mask)


def _matching(table: TopicTable, found: Iterator[TableRows], mask: Mask) -> Iterator[TableRows]:
    for block in found:
        holds = mask(block.records)
        if holds is None:
            raise StoreError(f"The table of {table.topic} cannot tell what it could before.")
        if table.unreadable:
            states = block.own["state"].to_numpy(zero_copy_only=False)
            holds = holds & (states != "unreadable")
        if holds.all():
            yield block
            continue
        chosen = np.flatnonzero(holds)
        if len(chosen):
            yield block.take(chosen)
