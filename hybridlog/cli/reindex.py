"""`hybridlog reindex`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.query_options import recordings_of
from hybridlog.cli.signals import if_stopped

if TYPE_CHECKING:
    from hybridlog.choice import Choice


@click.command()
@options.choice
@options.store
@options.mongo
@options.cache_size
@options.as_json
@options.quiet
def command(
    *,
    choice: Choice,
    store: Path | None,
    mongo: str | None,
    cache_size: int | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Rebuild the index from the segments, recording by recording.

    Queries of the other recordings work meanwhile. After an interruption, the next command
    that needs the index finishes the recording at which it stopped.
    """
    started = time.monotonic()
    with opened_store(
        store, mongo, needs_database=True, cache_mb=cache_size, quiet=quiet
    ) as opened:
        chosen = recordings_of(opened, choice)
        total = sum(entry.stored_bytes for entry in chosen.summaries)
        with (
            if_stopped(
                "Finished recordings stay indexed; the next command that needs the index "
                "finishes the recording at which it stopped."
            ),
            progress_bar("reindex", total, quiet=quiet) as bar,
        ):
            done = opened.reindex(None if choice.is_everything else chosen, Stages(bar))
    left = [entry.label for entry in chosen.summaries if entry.id not in {r.id for r in done}]
    for label in left:
        output.note(f"Recording {label} is in use, and was left as it is.")
    for entry in done:
        if entry.status == "damaged":
            output.note(f"{entry.label} is damaged: `hybridlog losses {entry.label}` shows where.")
    messages = sum(r.documents for r in done)
    without = sum(r.messages for r in done) - messages
    elapsed = time.monotonic() - started
    if as_json:
        output.print_json(
            {
                "recordings": len(done),
                "messages": messages,
                "messages_without_documents": without,
                "left": left,
                "seconds": round(elapsed, 3),
            }
        )
    elif not quiet:
        output.say(
            f"{output.counted(len(done), 'recording')}, "
            f"{output.counted(messages, 'message')} indexed in {elapsed:.2f} s"
            f"{output.without_documents(without)}"
        )
