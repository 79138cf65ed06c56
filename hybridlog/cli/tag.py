"""`hybridlog tag`."""

from __future__ import annotations

from pathlib import Path

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store


@click.command()
@options.one_recording
@click.argument(
    "pairs", nargs=-1, metavar="[KEY=VALUE]...", help="Tags to set; without, show the tags."
)
@options.store
@options.as_json
@options.quiet
def command(
    *, recording: str, pairs: tuple[str, ...], store: Path | None, as_json: bool, quiet: bool
) -> None:
    """Set or show the tags of a recording."""
    with opened_store(store, None, quiet=quiet) as opened:
        if pairs:
            tags = opened.tag(recording, **options.parse_tags(pairs)).tags
        else:
            tags = opened.select([recording])[0].tags
    if as_json:
        output.print_json(tags)
    elif not quiet:
        for key, value in sorted(tags.items()):
            output.say(f"{key}={value}")
