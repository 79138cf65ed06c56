"""Questions: predicates and SQL, their matches over time, and completion."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, cast

from hybridlog.drawing.matches import (
    AskedMatches,
    Match,
    bands,
    count_before,
    matches_after,
    matches_before,
    ticks,
)
from hybridlog.query.answers.infer_fields import infer_fields
from hybridlog.query.predicate.completion import complete
from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.query.topics import resolve
from hybridlog.view.asked import MAX_OFFSET
from hybridlog.view.context import Context, route, start_of
from hybridlog.view.question import program, question_of
from hybridlog.view.stopping import stoppable_route
from hybridlog_storage.errors import ResourceError, TopicError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hybridlog.drawing.matches import Matches
    from hybridlog.sql.engine import SqlAnswer
    from hybridlog.view.asked import Asked
    from hybridlog.view.question import PageQuestion

MAX_LISTED: Final = 200
"""Greatest number of matches that are listed at once."""
SQL_MEMORY: Final = 512 << 20
"""Bytes that DuckDB may use for all queries together."""
SQL_SECONDS: Final = 60
"""Seconds that a query in SQL may take."""
SQL_ROWS: Final = 1000
_SQL_BYTES: Final = 32 << 20
SQL_COLUMNS: Final = 200
_MAX_CANDIDATES: Final = 50
_POLL_S: Final = 0.1

_sql_turns = threading.BoundedSemaphore(2)


def ask(context: Context, asked: Asked) -> dict[str, Any]:
    """The number of messages that satisfy a predicate, with losses and remarks."""
    question = question_of(context, asked)
    query = question.query()
    count = query.count()
    lost = query.lost()
    remarks = query.remarks(*query.topics)
    if question.recording.status == "open":
        remarks.append(
            f"{question.recording.label} is being recorded; the latest messages may be missing."
        )
    return {
        "count": count,
        "lost": lost.describe(count) if lost else None,
        "remarks": remarks,
        "python": question.python(),
        "command": question.command(),
    }


def matches(context: Context, asked: Asked) -> dict[str, Any]:
    """The matches in a range by pixel, and the bands in which the predicate holds."""
    question = question_of(context, asked)
    start = start_of(question.recording)
    span, pixels = asked.span(start), asked.pixels()
    asked_for = _matches(context, question)
    found = ticks(asked_for, span, pixels)
    held = bands(asked_for, span, pixels)
    return {
        "begin": span[0] - start,
        "width": found.width,
        "pixels": found.pixels.tolist(),
        "counts": found.counts.tolist(),
        "first": (found.first - start).tolist(),
        "bands": (held - start).tolist(),
    }


def match_list(context: Context, asked: Asked) -> dict[str, Any]:
    """Some matches behind or in front of a place, and how many are in front of them."""
    question = question_of(context, asked)
    start = start_of(question.recording)
    place = Match(asked.moment(start), asked.integer("seq", -1, MAX_OFFSET, -1))
    count = asked.integer("count", 1, MAX_LISTED, MAX_LISTED)
    find = {"later": matches_after, "earlier": matches_before}
    asked_for = _matches(context, question)
    found = find[asked.word("direction", find, "later")](asked_for, place, count)
    return {
        "rows": [[one.time - start, one.seq] for one in found],
        "before": count_before(asked_for, found[0]) if found else None,
    }


def _matches(context: Context, question: PageQuestion) -> Matches:
    recording = question.recording
    if recording.status == "open":
        return AskedMatches(question.query())
    asked = question.topics, question.where, question.within
    key = recording.id, recording.status, recording.messages, recording.span, asked
    return context.matches.matches(key, question.query)


def completion(context: Context, asked: Asked) -> dict[str, Any]:
    """Candidates for completing a predicate or SQL at a place."""
    text = asked.text("text", "", longest=MAX_TEXT)
    place = min(asked.integer("place", 0, MAX_TEXT), len(text))
    if asked.word("language", ("predicate", "sql"), "predicate") == "sql":
        return _sql_completion(context, text, place)
    recording = context.recording(asked)
    own = asked.text("topic")
    topics = {channel.topic for channel in recording.channels}

    def fields(topic: str | None) -> Mapping[str, str] | None:
        try:
            (name,) = resolve([topic or own], topics)
        except (TopicError, ValueError):
            return None
        query = context.query(recording, name)
        known = query.field_types()
        if known is None:
            known = {str(one["path"]): str(one["type"]) for one in infer_fields(query)}
        return known

    found = complete(text, place, topics - {own}, fields, most=_MAX_CANDIDATES)
    offered = [[one.text, one.kind, one.type] for one in found.candidates]
    return {"begin": found.begin, "candidates": offered}


def _sql_completion(context: Context, text: str, place: int) -> dict[str, Any]:
    from hybridlog.sql.completion import candidates, word_before

    word = word_before(text[:place])
    connection = context.store.sql_engine.connect(SQL_MEMORY, only_reads=True)
    try:
        found = candidates(connection, text, word)
    finally:
        connection.close()
    offered = [[name, "word", ""] for name in found[:_MAX_CANDIDATES]]
    return {"begin": place - len(word), "candidates": offered}


def sql(context: Context, asked: Asked, stopped: threading.Event) -> dict[str, Any]:
    """The first rows of a query in SQL."""
    from hybridlog.sql.shown import shown

    recording = context.recording(asked)
    text = asked.text("text", longest=MAX_TEXT)
    with _sql_turn(stopped):
        connection = context.store.sql_engine.connect(SQL_MEMORY, only_reads=True)
        connection.stopped = stopped
        try:
            answer = connection.query(text, timeout=SQL_SECONDS)
            table, is_cut = answer.first(SQL_ROWS, _SQL_BYTES)
            body = f"    print(store.sql({text!r}).to_pandas())\n"
            found = shown(table, SQL_COLUMNS)
            times, labels = found.pop("times"), found["recordings"]
            return found | {
                "at": _offsets(context, times, labels or [recording.label] * len(times)),
                "more": is_cut,
                "remarks": _remarks(context, answer),
                "python": program(context.store, body),
            }
        finally:
            connection.close()


def _offsets(
    context: Context, times: Sequence[int | None], labels: Sequence[str | None]
) -> list[int | None]:
    """Times since the start of the recording of each row, ns; None where that is not known."""
    starts: dict[str | None, int | None] = {None: None}
    for label in labels:
        if label is not None and label not in starts:
            try:
                starts[label] = start_of(context.store.entry(label))
            except TopicError:
                starts[label] = None
    return [
        None if time is None or starts[label] is None else time - cast("int", starts[label])
        for time, label in zip(times, labels, strict=False)
    ]


@contextmanager
def _sql_turn(stopped: threading.Event) -> Iterator[None]:
    while not _sql_turns.acquire(timeout=_POLL_S):
        if stopped.is_set():
            raise ResourceError("The query was stopped.")
    try:
        yield
    finally:
        _sql_turns.release()


def _remarks(context: Context, answer: SqlAnswer) -> list[str]:
    """Remarks about values that an answer lacks."""
    remarks = answer.remarks
    found = [
        f"{topic} has no columns of fields: {why}." for topic, why in remarks.undefined.items()
    ]
    for state, counts in (("unreadable", remarks.unreadable), ("reduced", remarks.reduced)):
        found += [
            f"Fields of {count} {state} messages of {topic} are null."
            for topic, count in counts.items()
        ]
    # Topics of a running recording that are in no sealed segment yet have no losses either.
    entries = remarks.recordings.values()
    topics = remarks.topics & {one.topic for entry in entries for one in entry.channels}
    if topics:
        lost = context.store.query(sorted(topics), [*remarks.recordings]).lost()
        if lost:
            found.append(f"Of what was read, {lost.told}; the table losses says where.")
    return found


routes = [
    route("/ask", ask),
    route("/matches", matches),
    route("/match-list", match_list),
    route("/complete", completion),
    stoppable_route("/sql", sql),
]
