"""`hybridlog tag`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.completion import complete_recording
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import named_or_chosen

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command()
@click.argument(
    "words",
    nargs=-1,
    metavar="[RECORDING] [KEY=VALUE]...",
    shell_complete=complete_recording,
    help="A recording, as for --recording, unless options choose; and tags to set. Without "
    "tags, show them.",
)
@options.choice
@options.store
@options.as_json
@options.quiet
def tag_command(
    *, words: tuple[str, ...], choice: Choice, store: Path | None, as_json: bool, quiet: bool
) -> None:
    """Set or show the tags of recordings."""
    with opened_store(store, None, quiet=quiet) as opened:
        chosen, pairs, is_one = named_or_chosen(opened, choice, words)
        tags = options.parse_tags(pairs)
        found = {
            one.label: opened.tag(one.id, **tags).tags if tags else one.tags
            for one in chosen.summaries
        }
    if as_json:
        output.print_json(next(iter(found.values())) if is_one else found)
    elif not quiet:
        for label, own in found.items():
            for key, value in sorted(own.items()):
                output.say(f"{key}={value}" if is_one else f"{label}: {key}={value}")
