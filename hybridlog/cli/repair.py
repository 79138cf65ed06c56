"""`hybridlog repair`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.query_options import recordings_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command()
@options.only_recordings
@options.choice
@options.store
@click.option("--moved", is_flag=True, help="The store was moved to here: take its index over.")
@click.option(
    "--new-id",
    is_flag=True,
    help="The store is a copy: give it an id of its own, with the index at --mongo.",
)
@options.mongo
@options.as_json
@options.quiet
def repair_command(
    *,
    choice: Choice,
    store: Path | None,
    moved: bool,
    new_id: bool,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Repair what can be repaired without losing anything.

    It restores the names of segments, writes damaged summaries and journals again, and brings
    catalog and index up to date. Exits with 1, and a list, when only a copy can restore the
    rest.
    """
    if moved and new_id:
        raise UsageError("A store was moved or it is a copy: give --moved or --new-id, not both.")
    if new_id:
        from hybridlog.maintenance.lease import become_another
        from hybridlog.store import store_path

        become_another(store_path(store), mongo)
        output.say("the store has a new id now")
    with opened_store(store, mongo, quiet=quiet) as opened:
        if moved:
            opened.take_over()
            output.say("the index belongs to the store at this place now")
        chosen = None if choice.is_everything else recordings_of(opened, choice)
        with progress_bar("repair", 0, quiet=quiet) as bar:
            done = opened.repair(chosen, Stages(bar))
    left = [one for one in done if not one.is_cured]
    if as_json:
        output.print_json([asdict(one) for one in done])
    else:
        for one in done:
            result = "mended" if one.is_cured else "left"
            of = f"{one.recording}: " if one.recording else ""
            output.say(f"{of}{one.place}: {result}: {one.done}")
        if not done and not quiet:
            output.say("nothing to mend")
    if left:
        raise click.exceptions.Exit(1)
