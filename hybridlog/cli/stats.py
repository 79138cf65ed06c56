"""`hybridlog stats` and `rate`."""

from __future__ import annotations

import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import (
    Destination,
    answer_tables,
    print_cost,
    print_remarks,
    table_options,
)
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked, parse_fields

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.query.answers.field_statistics import FieldStatistics
    from hybridlog.query.choice import Choice


_NAMES = ("count", "nan", "infinite", "min", "max", "mean", "std")


@click.command()
@options.topics
@click.option(
    "--fields",
    metavar="A,B.C",
    help="Only these fields, also summaries and arrays; without, all that are numbers.",
)
@options.store
@options.between
@options.where
@options.choice
@options.strict
@options.mongo
@options.as_json
@options.quiet
@options.verbose
def stats_command(
    *,
    topic: tuple[str, ...],
    fields: str | None,
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    choice: Choice,
    strict: bool,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Show count, extremes and mean of numeric fields.

    Also their standard deviation, and how many values are NaN.
    """
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet or as_json) as opened:
        query = asked(opened, topic, choice, between=between, where=where, strict=strict)
        found = query.stats(*([] if fields is None else parse_fields(fields)))
        if strict:
            query.completeness().check()
        if as_json:
            from hybridlog.schema.plain import without_nan

            output.print_json(without_nan([asdict(row) for row in found]))
        elif found:
            _print(found)
        else:
            output.note("No field is a number.")
        sys.stdout.flush()
        if not quiet:
            print_cost(query.counters, time.monotonic() - started, count=True)
            print_remarks(query, topic)


def _print(found: Sequence[FieldStatistics]) -> None:
    several = len({row.topic for row in found}) > 1
    columns: list[output.Column] = [("field", "left"), *((name, "right") for name in _NAMES)]
    if several:
        columns.insert(0, ("topic", "left"))
    rows = [
        ([row.topic] if several else [])
        + [row.field, *(_number(getattr(row, name)) for name in _NAMES)]
        for row in found
    ]
    output.print_table(columns, rows)


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return str(value) if isinstance(value, int) else f"{value:.6g}"


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
        completeness = query.completeness if strict else None
        answer_tables([query.rate(window)], lambda: None, to, completeness)
        sys.stdout.flush()
        if not quiet:
            print_cost(query.counters, time.monotonic() - started, count=True)
            print_remarks(query, topic, is_empty=False)
