"""The row with which `hybridlog record` sums up a recording, and its columns."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from math import inf
from typing import TYPE_CHECKING, Any, Final

from hybridlog.cli.render import Column, bytes_of, numbers
from hybridlog.record.losses import losses_of
from hybridlog.wording import counted, unfit

if TYPE_CHECKING:
    from hybridlog.record.recorder import RecordReport
    from hybridlog_storage.catalog import RecordingEntry


def row_of(report: RecordReport, path: object) -> dict[str, Any]:
    """What is told in JSON of each recording."""
    entry, seconds = report.entry, report.elapsed_s
    return {
        "path": str(path),
        "kind": entry.source["kind"],
        "id": entry.id,
        "recording": entry.name,
        "status": entry.status,
        "tags": entry.tags,
        "topics": len({c.topic for c in entry.channels}),
        "messages": entry.messages,
        "messages_indexed": report.indexed,
        "messages_unreadable": sum(c.stats.unreadable for c in entry.channels),
        "messages_surplus": sum(c.stats.surplus for c in entry.channels),
        "messages_skipped": report.skipped,
        "messages_latched": report.latched,
        "attachments": entry.attachments,
        "attachments_left_out": report.attachments_left_out,
        "metadata_records": entry.metadata_records,
        "bytes_in": entry.source["bytes"],
        "bytes_stored": entry.stored_bytes,
        "seconds": round(seconds, 3),
        "losses": losses_of(entry),
        "damage": [{**asdict(d), "file": str(d.file)} for d in report.damage],
        "not_indexed": {c.topic: c.unindexed for c in entry.channels if c.unindexed is not None},
    }


COLUMNS: Final = [
    Column("recording"),
    Column("source", lambda row: f"{row['path']} ({row['kind']})", order=1),
    *numbers("topics", "messages"),
    Column("left out", "messages_skipped", "right", varies=True),
    Column("from before", "messages_latched", "right", varies=True),
    Column("attachments", side="right", varies=True),
    bytes_of("bytes in", "bytes_in", order=3),
    bytes_of("stored", "bytes_stored"),
    Column("ratio", lambda row: f"{row['bytes_in'] / (row['bytes_stored'] or inf):.2f}", "right"),
    Column("indexed", "messages_indexed", "right"),
    Column("time", lambda row: f"{row['seconds']:.2f} s", "right"),
    Column(
        "messages/s",
        lambda row: f"{row['messages'] / (row['seconds'] or inf):,.0f}",
        "right",
        order=2,
    ),
]
"""Columns of the table of such rows."""


def fields_of(row: Mapping[str, Any]) -> list[tuple[str, object]]:
    """What is told to people of one recording."""
    cells = [(one, one.cell(row)) for one in COLUMNS]
    return [(one.name, cell) for one, cell in cells if not (one.varies and cell == "0")]


def remarks_on(recording: RecordingEntry) -> Iterator[str]:
    """A line for each topic with messages whose fields are not all there, or not all they hold."""
    for channel in recording.channels:
        unreadable, surplus = channel.stats.unreadable, channel.stats.surplus
        if channel.is_indexed and channel.reason is not None:
            yield f"{channel.topic}: not indexed beyond time: {channel.reason}"
        if unreadable:
            yield f"{channel.topic}: {unfit(unreadable)}; stored, without fields in the index"
        if surplus:
            yield (
                f"{channel.topic}: {counted(surplus, 'message')} with bytes left over behind the "
                "last field; the fields are read"
            )
