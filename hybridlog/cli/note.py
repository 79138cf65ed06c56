"""`hybridlog note`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options
from hybridlog.cli.open_store import opened_store
from hybridlog_storage.errors import UsageError


@click.command()
@options.one_recording
@click.argument("text", metavar="TEXT", help="Text of the note.")
@options.store
@options.quiet
def note_command(*, recording: str, text: str, store: Path | None, quiet: bool) -> None:
    """Write a note about a recording; `info` shows it."""
    if not text.strip():
        raise UsageError("A note needs a text: give one that is not empty.")
    with opened_store(store, None, quiet=quiet) as opened:
        opened.note(recording, text)
