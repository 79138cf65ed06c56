"""`hybridlog du`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output, sizes_table
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import recordings_of

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command()
@options.only_recordings
@click.option(
    "--by",
    type=click.Choice(["recording", "topic", "both"]),
    default="recording",
    help="A row for each recording, for each topic, or for each topic of each recording.",
)
@options.choice
@options.store
@options.mongo
@options.as_json
def du_command(
    *, choice: Choice, by: str, store: Path | None, mongo: str | None, as_json: bool
) -> None:
    """Show what recordings and topics take on the disk.

    Sizes are those in segments, in tables and in MongoDB; the largest come first. Shares of
    what topics have in common are estimates.
    """
    with opened_store(store, mongo, quiet=as_json) as opened:
        sizes = opened.sizes(recordings_of(opened, choice))
    rows = sizes.rows
    if by != "both":
        rows = sizes.by_recording() if by == "recording" else sizes.by_topic()
    if as_json:
        each = [sizes_table.as_dict(row) for row in rows]
        output.print_json({"rows": each, "total": sizes_table.as_dict(sizes.total)})
    elif rows:
        sizes_table.print_sizes(
            rows, sizes.total, recordings=by != "topic", topics=by != "recording"
        )
    else:
        output.note("The store is empty: `hybridlog record FILE` fills it.")
