"""`hybridlog ls`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output, recording_summary
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import recordings_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.query.choice import Choice
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
        output.print_json([recording_summary.as_dict(entry) for entry in recordings])
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
        ("messages", "right"),
        ("note", "left"),
    ]
    if not narrow:
        columns.insert(3, ("topics", "right"))
        columns.insert(5, ("stored", "right"))
    output.print_pages(columns, [_row(entry, narrow=narrow) for entry in recordings])


def _row(entry: RecordingSummary, *, narrow: bool) -> list[str]:
    span = entry.span
    notes = [] if entry.status == "complete" else [recording_summary.status(entry)]
    if entry.name != entry.label:
        notes.append(entry.name)
    notes.extend(f"{key}={value}" for key, value in sorted(entry.tags.items()))
    start = output.short_time(span[0], minutes=narrow) if span else "-"
    cells = [
        entry.label,
        start,
        output.short_duration(span[1] - span[0]) if span else "-",
        str(entry.messages),
        ", ".join(notes),
    ]
    if not narrow:
        cells.insert(3, str(entry.topic_count))
        cells.insert(5, output.size(entry.stored_bytes))
    return cells
