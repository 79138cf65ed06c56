"""`hybridlog rename`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog_storage.errors import UsageError


@click.command()
@options.one_recording
@click.argument("name", metavar="NAME", help="Its new name.")
@options.store
@options.quiet
def rename_command(*, recording: str, name: str, store: Path | None, quiet: bool) -> None:
    """Give a recording another name.

    Its directory is renamed as well; nothing else of the recording changes.
    """
    if not name.strip():
        raise UsageError("A recording needs a name: give one that is not empty.")
    with opened_store(store, None, quiet=quiet) as opened:
        entry = opened.rename(recording, name)
    if not quiet:
        output.say(f"renamed to {entry.label}")
