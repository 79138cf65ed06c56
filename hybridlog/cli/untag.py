"""`hybridlog untag`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import named_or_chosen
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command()
@click.argument(
    "words",
    nargs=-1,
    metavar="[RECORDING] KEY...",
    shell_complete=complete_recording,
    help="A recording, as for --recording, unless options choose; and keys of tags.",
)
@options.choice
@options.store
@options.quiet
def untag_command(
    *, words: tuple[str, ...], choice: Choice, store: Path | None, quiet: bool
) -> None:
    """Remove tags of recordings."""
    with opened_store(store, None, quiet=quiet) as opened:
        chosen, keys, is_one = named_or_chosen(opened, choice, words)
        if not keys:
            raise UsageError("Name the keys of the tags to remove.")
        for one in chosen.summaries:
            # Of several recordings, some may lack a tag.
            there = keys if is_one else [key for key in keys if key in one.tags]
            if there:
                opened.untag(one.id, *there)
