"""The recordings of a store as a table."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa

if TYPE_CHECKING:
    from hybridlog_storage.summary import RecordingSummary

TIME: Final = pa.timestamp("us", "UTC")
TIMES: Final = (
    ("first_time", TIME),
    ("last_time", TIME),
    ("first_t", pa.int64()),
    ("last_t", pa.int64()),
)
"""Columns of a first and a last log time."""
TAGS: Final = pa.map_(pa.string(), pa.string())
RECORDINGS: Final = pa.schema(
    [
        ("recording", pa.string()),
        ("id", pa.string()),
        ("tags", TAGS),
        ("status", pa.string()),
        ("created", TIME),
        *TIMES,
        ("messages", pa.int64()),
        ("topics", pa.int64()),
        ("segments", pa.int64()),
        ("bytes", pa.int64()),
        ("has_losses", pa.bool_()),
    ]
)
"""Columns of recordings in SQL."""


def recordings_table(summaries: Iterable[RecordingSummary]) -> pa.Table:
    """A row for each recording."""
    rows = [
        {
            "recording": one.name,
            "id": one.id,
            "tags": list(one.tags.items()),
            "status": one.status,
            "created": one.created // 1000,
            **times(*(one.span or (None, None))),
            "messages": one.messages,
            "topics": one.topic_count,
            "segments": one.segments,
            "bytes": one.stored_bytes,
            "has_losses": one.has_losses,
        }
        for one in summaries
    ]
    return pa.Table.from_pylist(rows, schema=RECORDINGS)


def times(first: int | None, last: int | None) -> dict[str, Any]:
    """Cells of `TIMES` for a first and a last log time, ns."""
    return {
        "first_time": None if first is None else first // 1000,
        "last_time": None if last is None else last // 1000,
        "first_t": first,
        "last_t": last,
    }
