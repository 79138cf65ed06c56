"""`hybridlog intervals`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options
from hybridlog.cli.print_intervals import IntervalChoices, print_intervals

if TYPE_CHECKING:
    from hybridlog.query.intervals import Intervals
    from hybridlog.query.query import Query


@click.command()
@options.one_topic
@options.store
@options.between
@options.where
@options.choice
@options.at_least
@click.option(
    "--length",
    metavar="DURATION",
    help="Cut each into as many of exactly this length as fit, one after the other.",
)
@click.option(
    "--max-gap",
    metavar="DURATION",
    help="A message is valid for at most this long; without, until the next one.",
)
@click.option(
    "--state",
    type=click.Choice(["held", "not-held", "unknown"]),
    help="When it certainly held, certainly did not, or when lost messages leave it open; "
    "without, what the stored messages say.",
)
@options.strict
@options.count
@options.mongo
@options.as_json
@options.quiet
@options.verbose
def command(
    *,
    at_least: str | None,
    length: str | None,
    max_gap: str | None,
    state: str | None,
    **parameters: Any,
) -> None:
    """Show when the messages of a topic satisfied a predicate.

    A message is valid until the next one, or until the end of the recording.
    """

    def answer(query: Query) -> Intervals:
        return query.intervals(at_least, length, max_gap, state and state.replace("-", " "))

    print_intervals(IntervalChoices(**parameters), answer)
