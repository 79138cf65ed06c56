"""`hybridlog gaps`."""

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
@click.option("--longer-than", metavar="DURATION", help="Only gaps longer than this: 500ms.")
@click.option(
    "--periods",
    type=float,
    metavar="K",
    help="Only gaps longer than so many usual periods of the topic; without both, 5.",
)
@options.store
@options.between
@options.where
@options.choice
@options.strict
@options.count
@options.mongo
@options.as_json
@options.quiet
@options.verbose
def command(*, longer_than: str | None, periods: float | None, **parameters: Any) -> None:
    """Show when no message of a topic came for long."""

    def answer(query: Query) -> Intervals:
        return query.gaps(longer_than, periods)

    print_intervals(IntervalChoices(**parameters), answer, "gap")
