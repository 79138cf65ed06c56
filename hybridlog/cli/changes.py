"""`hybridlog changes`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options
from hybridlog.cli.print_intervals import IntervalChoices, print_intervals
from hybridlog.cli.query_options import parse_fields

if TYPE_CHECKING:
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.query import Query


@click.command()
@options.one_topic
@click.option(
    "--fields", required=True, metavar="A,B.C", help="The fields, with commas between them."
)
@options.store
@options.between
@options.where
@options.choice
@click.option(
    "--pause",
    default="1s",
    metavar="DURATION",
    help="Longest time between steps of one change.",
)
@click.option(
    "--tolerance",
    type=float,
    default=0.0,
    metavar="X",
    help="Numbers that differ by at most this are equal.",
)
@options.at_least
@options.strict
@options.count
@options.mongo
@options.as_json
@options.quiet
@options.verbose
def command(
    *, fields: str, pause: str, tolerance: float, at_least: str | None, **parameters: Any
) -> None:
    """Show when fields of a topic changed.

    A step is a message that differs from the one before it. Steps that follow each other
    within --pause are one change.
    """
    names = parse_fields(fields)

    def answer(query: Query) -> Intervals:
        found = query.changes(*names, pause=pause, tolerance=tolerance)
        return found if at_least is None else found.at_least(at_least)

    print_intervals(IntervalChoices(**parameters), answer, "change")
