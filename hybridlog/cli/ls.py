"""`hybridlog ls`; recordings as text and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.binder import command
from hybridlog.cli.options import AsJson, Choosing, InStore

if TYPE_CHECKING:
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary


@dataclass(frozen=True, kw_only=True)
class _Given(Choosing, InStore, AsJson):
    pass


@command(_Given)
def ls_command(given: _Given) -> None:
    """List the recordings."""
    with given.opened() as store:
        if store.directory.look_closely():
            store.refresh()
        recordings = given.recordings_in(store.snapshot()).summaries
    if given.as_json:
        output.print_json([recording_dict(entry) for entry in recordings])
    elif recordings:
        _print(recordings)
    elif not store.repairs.unreadable:
        output.note(store.directory.when_empty)


def _print(recordings: Sequence[RecordingSummary]) -> None:
    narrow = output.is_narrow()
    columns: list[output.Column] = [
        ("recording", "left"),
        ("start", "whole"),
        ("duration", "right"),
        ("topics", "right"),
        ("messages", "right"),
        ("stored", "right"),
        ("note", "left"),
    ]
    rows = [_row(entry, narrow=narrow) for entry in recordings]
    output.print_pages(*_with_short_notes(*output.fitted(columns, rows, ("topics", "stored"))))


def _with_short_notes(
    columns: Sequence[output.Column], rows: Sequence[Sequence[str]]
) -> tuple[Sequence[output.Column], Sequence[Sequence[str]]]:
    """The same table, where notes are cut short if the terminal has no room for them."""
    headings = [heading for heading, _ in columns]
    if output.fits(headings, rows):
        return columns, rows
    room = output.room(headings, [row[:-1] for row in rows]) + len(headings[-1])
    return columns, [[*row[:-1], output.cut(row[-1], max(room, _LEAST_NOTE))] for row in rows]


def _row(entry: RecordingSummary, *, narrow: bool) -> list[str]:
    span = entry.span
    notes = [] if entry.status == "complete" else [status_text(entry)]
    for number, what in ((entry.expired, "deleted"), (entry.not_copied, "not copied yet")):
        if number:
            notes.append(f"{number if narrow else output.counted(number, 'payload')} {what}")
    notes.extend(f"{key}={value}" for key, value in sorted(entry.tags.items()))
    if not narrow:
        notes.extend(output.cut(note["text"]) for note in entry.notes)
    start = output.short_time(span[0], minutes=narrow) if span else "-"
    return [
        entry.name,
        start,
        output.short_duration(span[1] - span[0]) if span else "-",
        str(entry.topic_count),
        str(entry.messages),
        output.size(entry.stored_bytes),
        ", ".join(notes),
    ]


_LEAST_NOTE = 12
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
    span = recording.span
    return {
        "id": recording.id,
        "name": recording.name,
        "tags": recording.tags,
        "status": recording.status,
        "start_ns": span[0] if span else None,
        "last_ns": span[1] if span else None,
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
