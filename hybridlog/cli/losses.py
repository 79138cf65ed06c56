"""`hybridlog losses`: what is missing from recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import recordings_of
from hybridlog.record.losses import losses_of

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice
    from hybridlog_storage.catalog import RecordingEntry


@click.command()
@options.only_recordings
@options.choice
@options.store
@options.only_topics
@options.mongo
@options.as_json
def losses_command(
    *,
    choice: Choice,
    store: Path | None,
    topic: tuple[str, ...],
    mongo: str | None,
    as_json: bool,
) -> None:
    """Show what is missing, from when to when, and why."""
    from hybridlog.query.topics import matcher, resolve

    fits = matcher(topic) if topic else None
    with opened_store(store, mongo) as opened:
        entries = [*recordings_of(opened, choice)]
        if topic:
            resolve(topic, opened.topics())  # refuses a name that fits no topic
    rows = [
        {"recording": entry.label, **loss}
        for entry in entries
        for loss in losses_of(entry)
        if fits is None or (loss.get("topic") is not None and fits(loss["topic"]))
    ]
    if as_json:
        output.print_json(rows)
    elif rows:
        _print(rows, entries)
    else:
        named = output.counted(len(entries), "recording")
        output.say(f"Nothing is missing from {named}, as far as the ledger knows.")
    for entry in entries:
        if entry.status == "open":
            output.note(
                f"{entry.label} is still being recorded; `hybridlog top {entry.label}` shows later "
                "losses."
            )


def _print(rows: Sequence[dict[str, Any]], entries: Sequence[RecordingEntry]) -> None:
    several = len(entries) > 1
    columns: list[output.Column] = [
        ("topic", "left"),
        ("cause", "left"),
        ("messages", "right"),
        ("from", "whole"),
        ("for", "right"),
        ("detail", "left"),
    ]
    if several:
        columns.insert(0, ("recording", "left"))
    output.print_table(
        columns,
        [([row["recording"]] if several else []) + _cells(row) for row in rows],
    )


def _cells(row: dict[str, Any]) -> list[str]:
    begin, end = row.get("from"), row.get("to")
    file = f"{row['file']}: " if row.get("file") else ""
    return [
        row.get("topic") or "any",
        row["cause"],
        "unknown" if row["count"] is None else str(row["count"]),
        "" if begin is None else output.short_time(begin),
        "" if begin is None or end is None else output.short_duration(end - begin),
        f"{file}{row.get('reason') or ''}",
    ]
