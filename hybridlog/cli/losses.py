"""`hybridlog losses`, and how complete a recording is in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import recordings_of
from hybridlog.record.losses import Cause, in_words, losses_of
from hybridlog.wording import counted

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


_NOT_LOST = {Cause.THROTTLE: "left out by a throttle", Cause.DEGRADE: "without their payload"}


def describe_coverage(entry: RecordingEntry, losses: list[dict[str, Any]]) -> str:
    """The completeness of a recording in words: `complete`, or the number of missing messages."""
    found = _completeness(entry, [loss for loss in losses if loss["cause"] not in _NOT_LOST])
    for cause, what in _NOT_LOST.items():
        messages = sum(loss["count"] or 0 for loss in losses if loss["cause"] == cause)
        found += f"; {counted(messages, 'message')} {what}" if messages else ""
    return found


def _completeness(entry: RecordingEntry, losses: list[dict[str, Any]]) -> str:
    if not losses:
        if entry.status == "open":
            return "being recorded"
        if entry.status == "unproven":
            return "not known: its journal was lost, so a segment may be missing"
        # An empty log is complete; a robot that sent nothing may not have been reached.
        is_live = not entry.source["bytes"]
        return "nothing was received" if is_live and not entry.messages else "complete"
    lost = sum(loss["count"] or 0 for loss in losses)
    if any(loss["count"] is None for loss in losses):
        return in_words(losses)
    if not lost:
        return f"complete, although its source was damaged in {counted(len(losses), 'place')}"
    share = min(100 * entry.messages / (entry.messages + lost), 99.99)
    return f"{in_words(losses)} ({share:.2f} % there)"
