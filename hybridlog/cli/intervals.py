"""`hybridlog intervals`, `changes` and `gaps`."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import print_cost, print_remarks
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.query_options import asked, parse_fields

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice
    from hybridlog.query.intervals import Interval, Intervals
    from hybridlog.query.query import Query


@dataclass(frozen=True, slots=True, kw_only=True)
class _Choices:
    """The parameters that the three commands have."""

    store: Path | None
    topic: str
    between: tuple[str, str] | None
    where: tuple[str, ...]
    choice: Choice
    strict: bool
    count: bool
    mongo: str | None
    as_json: bool
    quiet: bool


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
def intervals_command(
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

    _answer(parameters, answer)


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
def changes_command(
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

    _answer(parameters, answer, "change")


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
def gaps_command(*, longer_than: str | None, periods: float | None, **parameters: Any) -> None:
    """Show when no message of a topic came for long."""

    def answer(query: Query) -> Intervals:
        return query.gaps(longer_than, periods)

    _answer(parameters, answer, "gap")


def _answer(
    parameters: Mapping[str, Any], answer: Callable[[Query], Intervals], noun: str = "interval"
) -> None:
    """Open the store, answer the query, and print the intervals.

    Args:
        parameters: Those of `_Choices`.
        answer: Gives the intervals of the query.
        noun: What one of them is called.
    """
    choices = _Choices(**parameters)
    started = time.monotonic()
    quiet = choices.quiet or choices.as_json
    with opened_store(choices.store, choices.mongo, quiet=quiet) as store:
        query = asked(
            store,
            [choices.topic],
            choices.choice,
            between=choices.between,
            where=choices.where,
            strict=choices.strict,
        )
        found = answer(query)
        if choices.strict:
            query.completeness().check()
        labels = {recording.id: recording.label for recording in store.summaries()}
        if choices.count:
            output.say(str(len(found)))
        elif choices.as_json:
            output.print_json_list(_as_dict(row, labels) for row in found)
        elif len(found):
            _print(found, labels)
        sys.stdout.flush()
        if choices.quiet:
            return
        if not len(found) and not choices.count:
            output.note(f"No {noun}.")
        print_cost(query.counters, time.monotonic() - started, count=True)
        print_remarks(query, [choices.topic], is_empty=not len(found))


def _as_dict(row: Interval, labels: Mapping[str, str]) -> dict[str, object]:
    return {
        "recording": labels[row.recording],
        "begin_ns": row.begin_ns,
        "end_ns": row.end_ns,
        "messages": row.messages,
    }


def _print(found: Intervals, labels: Mapping[str, str]) -> None:
    from hybridlog.query.times import format_duration, format_time

    columns: list[output.Column] = [
        ("recording", "left"),
        ("begin", "whole"),
        ("end", "whole"),
        ("duration", "right"),
        ("messages", "right"),
    ]
    if output.is_narrow():
        del columns[2]

    def cells(row: Interval) -> list[str]:
        shown = [
            labels[row.recording],
            format_time(row.begin_ns),
            format_time(row.end_ns),
            format_duration(row.duration_ns),
            str(row.messages),
        ]
        if len(columns) < len(shown):
            del shown[2]
        return shown

    output.print_table(columns, map(cells, found))
