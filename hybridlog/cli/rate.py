"""`hybridlog rate`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options
from hybridlog.cli.answer_notes import print_cost, print_remarks
from hybridlog.cli.answers import Destination, answer_tables, table_options
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked

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
def rate_command(
    *,
    topic: tuple[str, ...],
    window: str | None,
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    choice: Choice,
    to: Destination,
    strict: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Show how many messages came in a second."""
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet) as opened:
        query = asked(opened, topic, choice, between=between, where=where, strict=strict)
        answer_tables([query.rate(window)], lambda: None, to)
        sys.stdout.flush()
        if not quiet:
            print_cost(query.counters, time.monotonic() - started, count=True)
            print_remarks(query, topic, is_empty=False)
