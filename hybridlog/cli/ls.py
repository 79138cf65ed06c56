"""`hybridlog ls` and `du`; recordings and sizes as text and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import recordings_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.maintenance.sizes import Size
    from hybridlog.query.choice import Choice
    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary


@click.command()
@options.choice
@options.store
@options.mongo
@options.as_json
def ls_command(*, choice: Choice, store: Path | None, mongo: str | None, as_json: bool) -> None:
    """List the recordings."""
    with opened_store(store, mongo, quiet=as_json) as opened:
        recordings = recordings_of(opened, choice).summaries
    if as_json:
        output.print_json([recording_dict(entry) for entry in recordings])
    elif recordings:
        _print(recordings)
    else:
        output.note("The store is empty: `hybridlog record FILE` fills it.")


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
    output.print_pages(*output.fitted(columns, rows, ("topics", "stored")))


def _row(entry: RecordingSummary, *, narrow: bool) -> list[str]:
    span = entry.span
    notes = [] if entry.status == "complete" else [status_text(entry)]
    if entry.name != entry.label:
        notes.append(entry.name)
    notes.extend(f"{key}={value}" for key, value in sorted(entry.tags.items()))
    start = output.short_time(span[0], minutes=narrow) if span else "-"
    return [
        entry.label,
        start,
        output.short_duration(span[1] - span[0]) if span else "-",
        str(entry.topic_count),
        str(entry.messages),
        output.size(entry.stored_bytes),
        ", ".join(notes),
    ]


@click.command()
@options.only_recordings
@click.option(
    "--by",
    type=click.Choice(["recording", "topic", "both"]),
    default="recording",
    help="A row for each recording, for each topic, or for each topic of each recording.",
)
@options.choice
@options.store
@options.mongo
@options.as_json
def du_command(
    *, choice: Choice, by: str, store: Path | None, mongo: str | None, as_json: bool
) -> None:
    """Show what recordings and topics take on the disk.

    Sizes are those in segments, in tables and in MongoDB; the largest come first. Shares of
    what topics have in common are estimates.
    """
    with opened_store(store, mongo, quiet=as_json) as opened:
        sizes = opened.sizes(recordings_of(opened, choice))
    rows = sizes.rows
    if by != "both":
        rows = sizes.by_recording() if by == "recording" else sizes.by_topic()
    if as_json:
        each = [size_dict(row) for row in rows]
        output.print_json({"rows": each, "total": size_dict(sizes.total)})
    elif rows:
        print_sizes(rows, sizes.total, recordings=by != "topic", topics=by != "recording")
    else:
        output.note("The store is empty: `hybridlog record FILE` fills it.")


_STATUS = {
    "open": "being recorded",
    "damaged": "source damaged",
    "recovered": "cut short by a crash",
    "unfinished": "cut short by a crash, not recovered yet",
    "unproven": "journal lost",
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


NO_TOPIC = "(no topic)"


def size_dict(row: Size) -> dict[str, Any]:
    """A row for JSON, without empty names."""
    return {
        **{name: value for name, value in asdict(row).items() if value != ""},
        "total_bytes": row.total_bytes,
    }


def print_sizes(
    rows: Sequence[Size], total: Size, *, recordings: bool = False, topics: bool = False
) -> None:
    """Print rows and their sum.

    Args:
        rows: The rows.
        total: The sum.
        recordings: Whether the rows are of single recordings.
        topics: Whether the rows are of single topics.
    """
    columns: list[output.Column] = [("recording", "left")] if recordings else []
    if topics:
        columns.append(("topic", "left"))
    has_columns = bool(total.column_bytes)
    columns_too = ("columns",) if has_columns else ()
    headings = ("messages", "payload", "segments", *columns_too, "tables", "MongoDB", "total")
    names: list[output.Column] = [(heading, "right") for heading in headings]
    if output.is_narrow():
        del names[:2]
    cells = []
    for row in (*rows, total):
        is_total = row is total
        named = [("total" if is_total else row.recording)] if recordings else []
        if topics:
            name = row.topic or NO_TOPIC
            named.append(name if not is_total else "" if recordings else "total")
        cells.append([*named, *_numbers(row, has_columns=has_columns)[-len(names) :]])
    output.print_table([*columns, *names], cells)


def _numbers(row: Size, *, has_columns: bool) -> list[str]:
    index = "-" if row.index_bytes is None else output.size(row.index_bytes)
    columns = [row.column_bytes] if has_columns else []
    sizes = [row.payload_bytes, row.segment_bytes, *columns, row.table_bytes]
    return [str(row.messages), *map(output.size, sizes), index, output.size(row.total_bytes)]
