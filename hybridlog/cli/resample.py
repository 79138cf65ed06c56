"""`hybridlog resample`."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options
from hybridlog.cli.answer_notes import print_cost
from hybridlog.cli.answers import Destination, answer_tables, table_options
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.output import notes
from hybridlog.cli.query_options import asked

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice


@click.command()
@options.topics
@click.option("--step", required=True, metavar="DURATION", help="Time between two rows: 100ms.")
@click.option(
    "--how",
    type=click.Choice(
        ["asof", "nearest", "interpolate", "count", "first", "last", "min", "max", "mean"]
    ),
    default="asof",
    help="The last message not after the row, the nearest one, or between the last and the next. "
    "Or of the messages from a row to the next: their number, the first, the last, or the least, "
    "greatest or mean of each number.",
)
@options.near
@options.store
@options.between
@options.where
@options.choice
@click.option("--fields", metavar="A,B.C", help="Only these fields, with commas between them.")
@table_options
@options.verbose
def resample_command(
    *,
    topic: tuple[str, ...],
    step: str,
    how: str,
    tolerance: str | None,
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    choice: Choice,
    fields: str | None,
    to: Destination,
    strict: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Show topics at regular times, or what they say between these.

    The times begin with each recording, or with the range of --between.
    """
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet) as opened:
        query = asked(
            opened, topic, choice, between=between, where=where, fields=fields, strict=strict
        )
        rows = query.resample(step, how, tolerance)
        answer_tables(rows.to_tables(), rows.schema, to)
        sys.stdout.flush()
        if not quiet:
            print_cost(rows.counters, time.monotonic() - started, count=False)
            notes(rows.remarks(*topic))
