"""`hybridlog align`, `sql`, `tf`."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, ClassVar

import click

from hybridlog.cli import output
from hybridlog.cli.answers import SCREEN, Tabular
from hybridlog.cli.options import (
    SECONDS,
    SIZE,
    Filtered,
    InFrame,
    Ranged,
    Strict,
    Topics,
    argument,
    command,
    option,
    parse_fields,
    query_of,
    tf_topic,
    topics,
)
from hybridlog.cli.output import Column, print_table, remarks
from hybridlog.query.choice import Choice
from hybridlog.query.times import parse_duration, parse_range, parse_time
from hybridlog.query.topics import resolve, split_topic
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import IncompleteError, TopicError, UsageError
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from collections.abc import Mapping

    import numpy as np
    from numpy.typing import NDArray

    from hybridlog.across.align import Aligned
    from hybridlog.query.query import Query
    from hybridlog.store import Store
    from hybridlog.tf.reader import Trees
    from hybridlog.tf.tree import FrameTree


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


class _Sql(Strict, Ranged, Tabular):
    query: str | None = argument("A query; without, what comes on standard input.", "[QUERY]")
    memory: int | None = option(
        "Memory that the query may use, such as 4GiB; without, 1 GiB. hybridlog takes at "
        "most 512 MiB more for itself.",
        "SIZE",
        type=SIZE,
    )
    timeout: float | None = option("Stop a query that takes longer.", "DURATION", type=SECONDS)


@command(_Sql)
def sql_command(given: _Sql) -> None:
    """Ask in SQL: a view a topic, with nested fields as structs.

    Views are named as in `select view, short from topics`: base__scan, or scan where that is
    unambiguous. Tables: recordings, topics, losses, marks. All show the chosen recordings alone,
    and views and marks only the time of --between or --last. Needs no MongoDB.
    """
    from hybridlog.sql.engine import MEMORY, limited_memory

    text = sys.stdin.read() if given.query is None else given.query
    with given.opened(snapshot=True) as store:
        with limited_memory(given.memory or MEMORY):
            answer = store.sql(
                text,
                recordings=None if given.choice.is_everything else given.choice,
                between=given.span,
                memory=given.memory,
                timeout=given.timeout,
            )
            if answer.columns:
                from pyarrow import Table

                if given.to_form != SCREEN:
                    answer.check_names()
                tables = (Table.from_batches([one]) for one in answer.to_batches())
                completeness = answer.completeness if given.strict else None
                given.answer(tables, completeness, is_fixed=True)
        sys.stdout.flush()
        output.remarks(answer.sentences())


_MAX_TIMES = 10_000_000


class _Tf(Strict, Topics, Tabular):
    words: ClassVar[tuple[str, ...]] = ()  # type: ignore[misc]
    target: str | None = argument("The frame of the results.", "[TARGET]")
    source: str | None = argument(
        "The frame to transform from; with -t, without, that of the topic's messages.",
        "[SOURCE]",
    )
    at: tuple[str, ...] = option(
        "At this time.", "TIME", needs=("target",), excludes=("step", "topic", "between")
    )
    step: str | None = option(
        "At regular times, such as 100ms.", "DURATION", needs=("target",), excludes=("topic",)
    )
    topic: tuple[str, ...] = topics(
        "At the header stamps of this topic, or the log times of one without."
    )
    tf_topic: tuple[str, ...] = tf_topic()


@command(_Tf)
def tf_command(given: _Tf) -> None:
    """Show coordinate frames, or transforms between them.

    Without frames, the trees: how often each frame moves, and where its longest gap is. With
    two, where SOURCE is in TARGET: translation in m, rotation as quaternion and as roll,
    pitch and yaw in rad; by default at the latest time that has a transform. Rows of times
    without one are empty, and the reasons are printed.
    """
    if given.target is None and (given.topic or given.topic_type or given.between):
        raise UsageError("Times are those of a transform: name its TARGET and SOURCE frames.")
    from hybridlog.tf.reader import Trees

    with given.opened(snapshot=True) as store:
        chosen = given.recordings_in(store).check()
        topics = given.named(store)
        query = given.bounded(chosen.topic(*topics)) if topics else None
        if query is not None and len(query.topics) > 1:
            raise UsageError(f"Times are those of one topic, not of {listed(query.topics)}.")
        only = chosen.topic(*given.tf_topic).topics if given.tf_topic else ()
        trees = Trees(store.session, chosen.summaries, only)
        names = [topics[0] for topics in trees.topics.values()]
        if given.target is not None or not names:
            names = [] if query is None else [*query.topics]
        shown = {name: trees.tree(name) for name in names} or {"": trees.tree()}
        lacks = [*dict.fromkeys(text for tree in shown.values() for text in tree.remarks)]
        if given.strict and lacks:
            raise IncompleteError(" ".join(lacks))
        if given.target is None:
            _show_trees(shown, given)
        else:
            _show_transforms(given, given.target, trees, query)
        remarks(lacks)


def _show_transforms(given: _Tf, target: str, trees: Trees, query: Query | None) -> None:
    from hybridlog.tf.reader import frames_and_stamps

    source = given.source
    topic = None if query is None else query.topics[0]
    tree = trees.tree(topic)
    if query is None:
        stamps = _times(tree, given, target)
        log_time = 0 * stamps + END  # of the last epoch
    else:
        asked = query.source.now(), query.question, query.counters
        frames, stamps, log_time = frames_and_stamps(*asked)
        source = source or (frames[0] if len(frames) == 1 and frames[0] else None)
    if source is None:
        raise UsageError("A transform has two frames: name TARGET and SOURCE.")
    shown = slice(given.limit)  # reasons are about the rows that are given
    found = trees.lookup(topic, target, source, stamps[shown], log_time[shown])
    if len(stamps) == len(found) == 1 and found.missing:
        tree.transform(target, source, int(stamps[0]))
    given.answer([found.to_arrow()])
    sys.stdout.flush()
    remarks(
        f"{counted(number, 'time')} without a transform: {why}."
        for why, number in found.missing.items()
    )


def _times(tree: FrameTree, given: _Tf, target: str) -> NDArray[np.int64]:
    """The times that are wanted, ns."""
    import numpy as np

    start, end = tree.span
    if given.step is not None:
        low, high = parse_range(*(given.span or (None, None)), start=start, end=end)
        length = parse_duration(given.step)
        if not length or (high - low) // length >= _MAX_TIMES:
            raise UsageError(f"--step {given.step} would be more than {_MAX_TIMES:,} times.")
        return np.arange(low, high, length, dtype=np.int64)
    if given.between is not None:
        raise UsageError("--between needs --step or --topic.")
    times = [parse_time(one, start=start, end=end) for one in given.at]
    return np.array(times or [tree.latest(target, given.source or target)], np.int64)


def _show_trees(trees: Mapping[str, FrameTree], given: _Tf) -> None:
    """Show the frames of trees, by a topic of each, which is a column if there are several."""
    import pyarrow as pa

    if given.to_form != SCREEN:
        tables = ((name, tree.to_arrow()) for name, tree in trees.items())
        given.answer(
            [one.add_column(0, "tree", pa.array([name] * len(one), "str")) for name, one in tables]
        )
        return
    frames = (
        (topic, "  " * depth + name, tree.frames.get(name), tree.span[0])
        for topic, tree in trees.items()
        for name, depth in tree.walk()
    )
    rows = [(*row, row[2] and row[2].longest_gap()) for row in frames]
    print_table(_FRAMES[len(trees) == 1 :], rows)
    remarks(dict.fromkeys(text for tree in trees.values() for text in tree.problems()))


_FRAMES = [
    Column("tree", 0),
    Column("frame", 1),
    Column(
        "transforms",
        lambda row: row[2] and ("static" if row[2].is_static else len(row[2].stamps)),
        "number",
    ),
    Column("Hz", lambda row: row[2] and row[2].rate_hz, "rate"),
    Column("longest gap", lambda row: row[4] and row[4][1] - row[4][0], "duration"),
    Column("from", lambda row: row[4] and f"{(row[4][0] - row[3]) / 1e9:+.3f}s", "number"),
]
