"""`hybridlog ls`; recordings as text and as JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    InStore,
    command,
)
from hybridlog.cli.output import Column

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingSummary


class _List(Choosing, InStore, AsJson):
    pass


@command(_List)
def ls_command(given: _List) -> None:
    """List the recordings."""
    with given.opened() as store:
        recordings = given.recordings_in(store.snapshot()).summaries
    found = [recording_dict(one) if given.as_json else one for one in recordings]
    without = "" if store.shared.repairs.unreadable else store.directory.when_empty
    given.show(found, RECORDINGS, without)


def _note(entry: RecordingSummary) -> str:
    notes = [] if entry.status == "complete" else [status_text(entry)]
    for number, what in ((entry.expired, "deleted"), (entry.not_copied, "not copied yet")):
        if number:
            notes.append(f"{output.counted(number, 'payload')} {what}")
    notes += (f"{key}={value}" for key, value in sorted(entry.tags.items()))
    return ", ".join([*notes, *(output.cut(note["text"]) for note in entry.notes)])


RECORDINGS = [
    Column("recording", lambda one: one.name),
    Column("start", lambda one: one.span[0] if one.span else None, "second"),
    Column(
        "duration",
        lambda one: output.short_duration(one.span[1] - one.span[0]) if one.span else "-",
        "number",
    ),
    Column("topics", lambda one: one.topic_count, "number", order=1),
    Column("messages", lambda one: one.messages, "number"),
    Column("stored", lambda one: one.stored_bytes, "bytes", order=2),
    Column("note", _note, cut=6),
]
"""Columns of a list of recordings."""
_STATUS = {
    "open": "being recorded",
    "damaged": "source damaged",
    "recovered": "cut short by a crash",
    "unfinished": "cut short by a crash, not recovered yet",
    "unproven": "manifest lost",
}


def status_text(recording: RecordingSummary) -> str:
    """The status of a recording, for people."""
    if recording.status == "damaged" and recording.has_lost_segments:
        return "stored data lost"
    return _STATUS.get(recording.status, recording.status)


def recording_dict(recording: RecordingSummary) -> dict[str, Any]:
    """A recording in short, for JSON."""
    first, last = recording.span or (None, None)
    return {
        "id": recording.id,
        "name": recording.name,
        "tags": recording.tags,
        "status": recording.status,
        "first_ns": first,
        "last_ns": last,
        "topics": recording.topic_count,
        "messages": recording.messages,
        "expired": recording.expired,
        "not_copied": recording.not_copied,
        "notes": recording.notes,
        "stored_bytes": recording.stored_bytes,
        "segments": recording.segments,
        "source": recording.source,
        "created_ns": recording.created,
    }
