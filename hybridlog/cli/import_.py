"""`hybridlog import`."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.signals import if_stopped
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command("import")
@click.argument("other", type=options.PATH, metavar="STORE", help="Directory of the other store.")
@options.choice
@options.store
@options.as_json
@options.quiet
def import_command(
    *, other: Path, choice: Choice, store: Path | None, as_json: bool, quiet: bool
) -> None:
    """Copy recordings from another store.

    Every byte is checked. After an interruption, run it again: copied recordings stay.
    """
    with (
        opened_store(store, None, create=True, quiet=quiet) as opened,
        if_stopped("Run the command again: copied recordings are not copied again."),
        progress_bar("import", 0, quiet=quiet) as bar,
    ):
        report = opened.import_from(other, choice, Stages(bar))
    if as_json:
        output.print_json(asdict(report))
    elif not quiet:
        for label in report.imported:
            output.say(f"imported {label}")
        for label in report.known:
            output.say(f"{label} is here already")
    if report.refused:
        sys.stdout.flush()
        raise StoreError(" ".join(report.refused.values()))
