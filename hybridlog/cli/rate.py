"""`hybridlog rate`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options
from hybridlog.cli.answer_notes import print_cost, print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked
from hybridlog.cli.table_output import TableChoices, table_options, write_tables

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command()
@options.only_topics
@click.option("--window", metavar="DURATION", help="A row for each so long, such as 1s.")
@options.store
@options.between
@options.where
@options.choice
@table_options
@options.verbose
def command(
    *,
    topic: tuple[str, ...],
    window: str | None,
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    choice: Choice,
    form: str | None,
    output: Path | None,
    force: bool,
    limit: int | None,
    strict: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Show how many messages came in a second."""
    choices = TableChoices(
        form=form, output=output, force=force, limit=limit, quiet=quiet
    ).checked()
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet) as opened:
        query = asked(opened, topic, choice, between=between, where=where, strict=strict)
        write_tables([query.rate(window)], lambda: None, choices)
        sys.stdout.flush()
        if not quiet:
            print_cost(query.counters, time.monotonic() - started, count=True)
            print_remarks(query, topic, is_empty=False)
