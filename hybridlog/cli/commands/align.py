"""`hybridlog align`: topics side by side by time."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, ClassVar

import click

from hybridlog.cli.answers import Tabular
from hybridlog.cli.options import (
    Filtered,
    InFrame,
    command,
    option,
    parse_fields,
    query_of,
)
from hybridlog.cli.output import remarks
from hybridlog.query.choice import Choice
from hybridlog.query.topics import resolve, split_topic
from hybridlog_storage.errors import TopicError, UsageError

if TYPE_CHECKING:
    from hybridlog.across.align import Aligned
    from hybridlog.query.query import Query
    from hybridlog.store import Store


class _Align(Filtered, InFrame, Tabular):
    needs_topic: ClassVar[bool] = True
    base: str | None = option(
        "The topic whose messages are the rows.",
        "TOPIC",
        name="--to",
    )
    step: str | None = option(
        "Instead: rows at regular times, such as 100ms.", "DURATION", excludes=("base", "frame")
    )
    how: str = option(
        "The last message not after the row, the nearest one, or between the last and the next.",
        type=click.Choice(["asof", "nearest", "interpolate"]),
        default="asof",
    )
    tolerance: str | None = option(
        "Greatest distance in time, such as 20ms; without, any.", "DURATION"
    )
    clock: str = option(
        "With --to: the time that is compared.",
        type=click.Choice(["log", "publish", "header"]),
        default="log",
        needs=("base",),
    )
    where: tuple[str, ...] = option(  # type: ignore[misc]
        "Only messages of this topic that satisfy a predicate; with --step a predicate alone.",
        "TOPIC: PREDICATE",
    )
    beside: tuple[str, ...] = option(
        "With --to: the topics beside it are of these recordings, whose time may overlap: a "
        "second robot or recorder. As for --recording; '*' for all.",
        "RECORDING",
        needs=("base",),
    )
    fields: tuple[str, ...] = option(
        "Only these fields of a topic, with commas between them; with --step of all topics, "
        "without their names.",
        "TOPIC: A,B.C",
    )


@command(_Align)
def align_command(given: _Align) -> None:
    """Show topics side by side by time.

    With --to, a row for each message of one topic, with what the others had said by then;
    with --step, rows at regular times, from the beginning of each recording or of --between.
    Columns are named by topic and field; `distance` is the time of a topic's message minus
    that of the row. What is not near enough is empty; lines on standard error say why.
    """
    if given.base is None and given.step is None:
        raise UsageError("Name the rows: --to TOPIC for its messages, or --step for times.")
    with given.opened(snapshot=True) as store:
        if given.base is None:
            query = given.query(store)
            if given.fields:
                query = query.fields(*parse_fields(",".join(given.fields)))
            rows = query.resample(given.step or 0, given.how, given.tolerance)
        else:
            rows = _aligned(store, given)
        # That there is a transform shows only at the end.
        completeness = rows.completeness if given.strict else None
        given.answer(rows.to_tables(given.limit), completeness)
        sys.stdout.flush()
        remarks(rows.remarks())


def _aligned(store: Store, given: _Align) -> Aligned:
    """A row for each message of a topic."""
    from hybridlog.query.query import narrowed

    base, others = given.base or "", Choice.of(given.beside) if given.beside else given.choice
    rest = (query_of(store, [name], others) for name in given.named(store))
    queries = [query_of(store, [base], given.choice)]
    queries += (narrowed(query, topic) for query in rest for topic in query.topics)
    for text in given.where:
        for place, predicate in _named(queries, text, "--where wants TOPIC: PREDICATE"):
            queries[place] = queries[place].where(predicate)
    for text in given.fields:
        for place, names in _named(queries, text, "--fields wants TOPIC: A,B.C"):
            queries[place] = queries[place].fields(*parse_fields(names))
    if given.frame is not None:
        from hybridlog.query.planner import Planner
        from hybridlog.tf.in_frame import has_places

        placed = [has_places(Planner(q.source.now(), q.question, q.counters)) for q in queries]
        queries = [
            given.placed(query) if is_placed or not any(placed) else query
            for query, is_placed in zip(queries, placed, strict=True)
        ]
    queries[0] = given.bounded(queries[0])
    for query in queries if given.strict else ():
        query.completeness().check()
    return store.align(
        queries[0],
        queries[1:],
        how=given.how,
        tolerance=given.tolerance,
        clock=given.clock,
        across_recordings=bool(given.beside),
    )


def _named(queries: list[Query], text: str, form: str) -> list[tuple[int, str]]:
    """The places of the queries about a topic before a colon, and what follows it."""
    topic, rest = split_topic(text)
    if not topic or not rest:
        raise UsageError(f"{form}, not {text!r}.")
    names = resolve([topic], dict.fromkeys(name for query in queries for name in query.topics))
    places = [(n, rest) for n, query in enumerate(queries) if query.topics[0] in names]
    if not places:
        raise TopicError(f"{topic} is no topic of this alignment.")
    return places
