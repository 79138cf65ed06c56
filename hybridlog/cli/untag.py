"""`hybridlog untag`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options
from hybridlog.cli.open_store import opened_store


@click.command()
@options.one_recording
@click.argument("keys", nargs=-1, required=True, metavar="KEY...", help="Keys of tags.")
@options.store
@options.quiet
def command(*, recording: str, keys: tuple[str, ...], store: Path | None, quiet: bool) -> None:
    """Remove tags of a recording."""
    with opened_store(store, None, quiet=quiet) as opened:
        opened.untag(recording, *keys)
