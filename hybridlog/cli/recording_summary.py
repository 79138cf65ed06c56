"""Facts about a recording that `ls` and `info` print."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog.losses import Cause

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

_STATUS = {
    "open": "being recorded",
    "damaged": "source damaged",
    "recovered": "cut short by a crash",
    "unfinished": "cut short by a crash, not recovered yet",
    "unproven": "journal lost",
}


def status(entry: RecordingEntry) -> str:
    """The status of a recording, for people."""
    losses = entry.end.get("losses", ())
    if entry.status == "damaged" and any(loss["cause"] == Cause.SEGMENT for loss in losses):
        return "stored data lost"
    return _STATUS.get(entry.status, entry.status)


def has_content(entry: RecordingEntry) -> bool:
    """True when the catalog knows the content, which it does once a segment is sealed."""
    return entry.status != "open" or bool(entry.channels)


def as_dict(entry: RecordingEntry) -> dict[str, Any]:
    """A recording in short, for JSON."""
    span = entry.span
    return {
        "recording": entry.label,
        "id": entry.id,
        "name": entry.name,
        "tags": entry.tags,
        "status": entry.status,
        "start_ns": span[0] if span else None,
        "last_ns": span[1] if span else None,
        "topics": len({c.topic for c in entry.channels}),
        "messages": entry.messages,
        "stored_bytes": entry.stored_bytes,
        "segments": entry.segments,
        "source": entry.source,
        "created_ns": entry.created,
    }
