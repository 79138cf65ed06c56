"""`hybridlog align` and `resample`."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options
from hybridlog.cli.answers import Destination, answer_tables, print_cost, table_options
from hybridlog.cli.completion import complete_recording, complete_topic
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.output import notes
from hybridlog.cli.query_options import asked, parse_fields, query_of
from hybridlog.query.choice import Choice
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.query.choice import Choice
    from hybridlog.query.query import Query
    from hybridlog.store import Store


@click.command()
@click.option(
    "--to",
    "base",
    required=True,
    metavar="TOPIC",
    shell_complete=complete_topic,
    help="The topic whose messages are the rows.",
)
@click.option(
    "--topic",
    "-t",
    required=True,
    multiple=True,
    metavar="TOPIC",
    shell_complete=complete_topic,
    help="A topic beside it: full name, an unambiguous short one, a glob, or re:REGEX. Repeatable.",
)
@click.option(
    "--how",
    type=click.Choice(["asof", "nearest", "interpolate"]),
    default="asof",
    help="The last message not after the row, the nearest one, or between the last and the next.",
)
@options.near
@click.option(
    "--clock",
    type=click.Choice(["log", "publish", "header"]),
    default="log",
    help="The time that is compared.",
)
@options.store
@options.between
@click.option(
    "--where",
    multiple=True,
    metavar="TOPIC: PREDICATE",
    help="Only messages of this topic that satisfy a predicate. Repeatable.",
)
@options.choice
@click.option(
    "--beside",
    multiple=True,
    metavar="RECORDING",
    shell_complete=complete_recording,
    help="The topics beside it are of these recordings, whose time may overlap: a second robot or "
    "recorder. As for --recording; '*' for all. Repeatable.",
)
@click.option(
    "--fields",
    multiple=True,
    metavar="TOPIC: A,B.C",
    help="Only these fields of a topic, with commas between them. Repeatable.",
)
@options.in_frame
@table_options
@options.verbose
def align_command(
    *,
    base: str,
    topic: tuple[str, ...],
    how: str,
    tolerance: str | None,
    clock: str,
    store: Path | None,
    between: tuple[str, str] | None,
    where: tuple[str, ...],
    choice: Choice,
    beside: tuple[str, ...],
    fields: tuple[str, ...],
    frame: str | None,
    to: Destination,
    strict: bool,
    mongo: str | None,
    quiet: bool,
) -> None:
    """Show topics side by side by time.

    A row for each message of one topic, with what the others had said by then. Columns are
    named by topic and field; `distance` is the time of a topic's message minus that of the
    row. What is not near enough is empty; lines on standard error say why.
    """
    started = time.monotonic()
    with opened_store(store, mongo, quiet=quiet) as opened:
        queries = _queries(opened, [base, *topic], choice, beside)
        for predicates, add in ((where, _where), (fields, _fields)):
            for text in predicates:
                add(opened, queries, text)
        if frame is not None:
            from hybridlog.query.planner import Planner
            from hybridlog.tf.in_frame import has_places

            placed = [has_places(Planner(q.session, q.question, q.counters)) for q in queries]
            queries = [
                query.in_frame(frame) if is_placed or not any(placed) else query
                for query, is_placed in zip(queries, placed, strict=True)
            ]
        if between is not None:
            queries[0] = queries[0].between(*between)
        if strict:
            for query in queries:
                query.completeness().check()
        aligned = opened.align(
            queries[0],
            queries[1:],
            how=how,
            tolerance=tolerance,
            clock=clock,
            across_recordings=bool(beside),
        )
        # That there is a transform shows only at the end.
        completeness = aligned.completeness if strict else None
        answer_tables(aligned.to_tables(), aligned.schema, to, completeness)
        sys.stdout.flush()
        if not quiet:
            print_cost(aligned.counters, time.monotonic() - started, count=False)
            notes(aligned.remarks(base, *topic))


def _queries(
    store: Store, topics: Sequence[str], choice: Choice, beside: Sequence[str]
) -> list[Query]:
    """A query for each topic; the base is one topic."""
    others = Choice.of(beside) if beside else choice
    base, *found = (
        query_of(store, [name], others if n else choice) for n, name in enumerate(topics)
    )
    return [base, *(q.with_topic(topic) for q in found for topic in q.topics)]


def _where(store: Store, queries: list[Query], text: str) -> None:
    places, predicate = _named(store, queries, text, "--where wants TOPIC: PREDICATE")
    for place in places:
        queries[place] = queries[place].where(predicate)


def _fields(store: Store, queries: list[Query], text: str) -> None:
    places, names = _named(store, queries, text, "--fields wants TOPIC: A,B.C")
    for place in places:
        queries[place] = queries[place].fields(*parse_fields(names))


def _named(store: Store, queries: list[Query], text: str, form: str) -> tuple[list[int], str]:
    """The queries about a topic before a colon, and what follows it."""
    from hybridlog.query.topics import resolve, split_topic

    topic, rest = split_topic(text)
    if not topic or not rest:
        raise UsageError(f"{form}, not {text!r}.")
    known = dict.fromkeys(name for query in queries for name in query.topics)
    names = resolve([topic], known)
    places = [n for n, query in enumerate(queries) if query.topics[0] in names]
    if not places:
        raise TopicError(f"{topic} is no topic of this alignment.")
    return places, rest


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
