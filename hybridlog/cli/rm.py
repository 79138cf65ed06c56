"""`hybridlog rm`."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.errors import UsageError


@click.command()
@click.argument(
    "recording",
    nargs=-1,
    required=True,
    metavar="RECORDING...",
    shell_complete=complete_recording,
    help="Recordings to delete.",
)
@options.store
@click.option("--yes", "-y", is_flag=True, help="Do not ask.")
@options.mongo
def command(
    *, recording: tuple[str, ...], store: Path | None, yes: bool, mongo: str | None
) -> None:
    """Delete recordings, payloads and index."""
    with opened_store(store, mongo) as opened:
        copies = [name for name in recording if name in opened.repairs.copies]
        chosen = opened.select([name for name in recording if name not in copies])
        labels = copies + [entry.label for entry in chosen]
        if not yes:
            _confirm(", ".join(labels))
        for label in labels:
            with if_stopped(
                "A recording whose removal began is gone; the next command that opens the "
                "store removes the rest of it."
            ):
                opened.remove(label)
            output.say(f"deleted {label}")


def _confirm(names: str) -> None:
    if not sys.stdin.isatty():
        raise UsageError(f"Deleting {names} for good needs --yes.")
    if not click.confirm(f"Delete {names} for good?", err=True):
        output.note("Nothing is deleted.")
        raise click.exceptions.Exit(1)
