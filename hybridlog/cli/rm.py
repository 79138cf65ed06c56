"""`hybridlog rm`."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import recordings_of
from hybridlog.cli.signals import if_stopped
from hybridlog.wording import listed
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.query.choice import Choice
    from hybridlog_storage.summary import RecordingSummary

_MOST_ROWS = 20


@click.command()
@options.only_recordings
@options.choice
@options.store
@click.option("--yes", "-y", is_flag=True, help="Do not ask.")
@options.mongo
def rm_command(*, choice: Choice, store: Path | None, yes: bool, mongo: str | None) -> None:
    """Delete recordings, payloads and index."""
    if choice.is_everything:
        raise UsageError(
            "Name the recordings to delete, or choose them: -r 'monday*', --tag robot=7. "
            "`hybridlog ls` lists all; -r '*' is all of them."
        )
    with opened_store(store, mongo) as opened:
        copies = [name for name in choice.name if name in opened.repairs.copies]
        rest = replace(choice, name=tuple(n for n in choice.name if n not in copies))
        chosen: Sequence[RecordingSummary] = ()
        if not copies or not rest.is_everything:
            chosen = recordings_of(opened, rest).summaries
        targets = {copy: copy for copy in copies} | {one.id: one.label for one in chosen}
        if not yes:
            _confirm(copies, chosen)
        for recording, label in targets.items():
            with if_stopped(
                "A recording whose removal began is gone; the next command that opens the "
                "store removes the rest of it."
            ):
                opened.remove(recording)
            output.say(f"deleted {label}")


def _confirm(copies: Sequence[str], chosen: Sequence[RecordingSummary]) -> None:
    """Ask for consent; several recordings are shown with what would be lost."""
    labels = [*copies, *(one.label for one in chosen)]
    several = len(labels) > 1
    names = f"{len(labels)} recordings ({listed(labels)})" if several else labels[0]
    if not sys.stdin.isatty():
        raise UsageError(f"Deleting {names} for good needs --yes.")
    if several:
        for copy in copies:
            output.note(f"  {copy}: a copy")
        for one in chosen[:_MOST_ROWS]:
            span = "" if one.span is None else f"{output.short_time(one.span[0])}, "
            output.note(
                f"  {one.label}: {span}{output.counted(one.messages, 'message')}, "
                f"{output.size(one.stored_bytes)}"
            )
        if len(chosen) > _MOST_ROWS:
            output.note(f"  and {len(chosen) - _MOST_ROWS} more")
        names = f"these {len(labels)} recordings"
    if not click.confirm(f"Delete {names} for good?", err=True):
        output.note("Nothing is deleted.")
        raise click.exceptions.Exit(1)
