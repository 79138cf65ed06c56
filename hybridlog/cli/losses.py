"""`hybridlog losses`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hybridlog.cli import output
from hybridlog.cli.coverage import losses_of
from hybridlog.cli.opening import opened

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry


def show(
    recordings: Sequence[str],
    topics: Sequence[str],
    store: Path | None,
    mongo: str | None,
    *,
    as_json: bool,
) -> None:
    """Print every row of the ledger of some recordings, or of all."""
    from hybridlog.query.topics import matcher

    fits = matcher(topics) if topics else None
    with opened(store, mongo) as found:
        entries = found.select(recordings) if recordings else found.recordings()
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
                f"{entry.label} is still being recorded: what it lacks stands here at its end, and "
                f"`hybridlog top {entry.label}` shows it now."
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
