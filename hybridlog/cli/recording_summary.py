"""Facts about a recording that `ls` and `info` print."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary

_STATUS = {
    "open": "being recorded",
    "damaged": "source damaged",
    "recovered": "cut short by a crash",
    "unfinished": "cut short by a crash, not recovered yet",
    "unproven": "journal lost",
}


def status(recording: RecordingSummary) -> str:
    """The status of a recording, for people."""
    if recording.status == "damaged" and recording.has_lost_segments:
        return "stored data lost"
    return _STATUS.get(recording.status, recording.status)


def as_dict(recording: RecordingSummary) -> dict[str, Any]:
    """A recording in short, for JSON."""
    span = recording.span
    return {
        "recording": recording.label,
        "id": recording.id,
        "name": recording.name,
        "tags": recording.tags,
        "status": recording.status,
        "start_ns": span[0] if span else None,
        "last_ns": span[1] if span else None,
        "topics": recording.topic_count,
        "messages": recording.messages,
        "stored_bytes": recording.stored_bytes,
        "segments": recording.segments,
        "source": recording.source,
        "created_ns": recording.created,
    }


def with_misfits(store: Store, recording: RecordingEntry) -> RecordingEntry:
    """The same recording, where `unreadable` counts what does not fit its definition alone.

    The catalog also counts messages with more fields than the index takes; tables have these.
    """
    channels = []
    for channel in recording.channels:
        unreadable, table = channel.stats.unreadable, None
        if unreadable:
            table = store.session.tables.of(recording, channel.topic)
        if table is not None:
            unfit = sum(int(rows.is_unreadable().sum()) for rows in table.scan(own={"state"}))
            unreadable = min(unreadable, unfit)
        channels.append(replace(channel, stats=replace(channel.stats, unreadable=unreadable)))
    return replace(recording, channels=channels)
