"""HTML of stores, recordings and messages, for notebooks.

All text is escaped, since names and values come from logs, and output is bounded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING

from hybridlog.query.times import format_duration, format_time
from hybridlog.wording import MAX_ROWS, listed, table_html

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingSummary


def recordings_html(title: str, recordings: Sequence[RecordingSummary]) -> str:
    """A table of recordings, the latest of them."""
    columns = ["recording", "start", "duration", "topics", "messages", "tags"]
    rows = [_recording_row(one) for one in recordings[-MAX_ROWS:]]
    return table_html(f"{title}, {len(recordings)} recordings", [columns, *rows])


def _recording_row(one: RecordingSummary) -> list[object]:
    first, last = one.span or (0, 0)
    start = format_time(first - first % 10**9) if one.span is not None else "-"
    tags = listed(f"{key}={value}" for key, value in sorted(one.tags.items())) if one.tags else ""
    duration = format_duration(last - first)
    return [one.name, start, duration, one.topic_count, one.messages, tags]


def message_html(title: str, fields: Mapping[str, object]) -> str:
    """The first fields of a message, nested ones with dots in their names."""
    return table_html(title, [*islice(_leaves("", fields), MAX_ROWS)])


def _leaves(prefix: str, fields: Mapping[str, object]) -> Iterator[tuple[str, object]]:
    for name, value in fields.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(f"{prefix}{name}.", value)
        else:
            yield f"{prefix}{name}", value
