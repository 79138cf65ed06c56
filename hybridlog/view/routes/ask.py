"""Questions: predicates and SQL, their matches over time, and completion."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from contextlib import closing, suppress
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np

from hybridlog.drawing.matches import Match, Matches
from hybridlog.query.answers.infer_fields import infer_fields
from hybridlog.query.answers.match_times import match_times
from hybridlog.query.asked import field_types
from hybridlog.query.intervals import Intervals
from hybridlog.query.predicate.completion import complete
from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.query.topics import resolve
from hybridlog.view.context import SQL_MEMORY, Context, route, start_of
from hybridlog.view.question import program, question_of
from hybridlog_storage.errors import HybridlogError, TopicError
from hybridlog_storage.stopping import held
from hybridlog_storage.times import BEGIN, END, span_of

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from hybridlog.sql.topic_view import Remarks
    from hybridlog.view.params import RequestParams
    from hybridlog.view.question import PageQuestion
    from hybridlog_storage.catalog import RecordingEntry

MAX_LISTED: Final = 200
"""Greatest number of matches that are listed at once."""
SQL_SECONDS: Final = 60
"""Seconds that a query in SQL may take."""
SQL_ROWS: Final = 1000
_SQL_BYTES: Final = 32 << 20
SQL_COLUMNS: Final = 200
_MAX_CANDIDATES: Final = 50


def ask(context: Context, params: RequestParams) -> dict[str, Any]:
    """The number of messages that satisfy a predicate, with losses and remarks."""
    return question_of(context, params).told()


def matches(context: Context, params: RequestParams) -> dict[str, Any]:
    """The matches in a range by pixel, and the bands in which the predicate holds."""
    question = question_of(context, params)
    start = start_of(question.recording)
    span, pixels = params.span(start), params.pixels()
    matching = _matches(context, question)
    found, in_force = matching.ticks(span, pixels), matching.bands(span, pixels)
    return {
        "begin": span[0] - start,
        "width": found.width,
        "pixels": found.pixels.tolist(),
        "counts": found.counts.tolist(),
        "first": (found.first - start).tolist(),
        "bands": (in_force - start).tolist(),
    }


def match_list(context: Context, params: RequestParams) -> dict[str, Any]:
    """Some matches behind or in front of a place, and how many are in front of them."""
    question = question_of(context, params)
    start = start_of(question.recording)
    place = Match(params.moment(start), params.integer("seq", -1, END, -1))
    count = params.integer("count", 1, MAX_LISTED, MAX_LISTED)
    matching = _matches(context, question)
    find = {"later": matching.after, "earlier": matching.before}
    found = find[params.word("direction", find, "later")](place, count)
    return {
        "rows": [[str(one.time - start), one.seq] for one in found],
        "before": matching.count_before(found[0]) if found else None,
    }


def _matches(context: Context, question: PageQuestion) -> Matches:
    recording = question.recording
    state = recording.status, recording.messages, frozenset(recording.digests.items())
    key = recording.id, state, (question.topics, question.where, question.within)
    with held(context.matching):  # a second client that asks the same waits
        cache = context.store.shared.cache
        return cache.made("matches", *key, make=lambda: Matches(question.query()), size_of=_size)


_size: Callable[[Matches], int] = attrgetter("size")


def completion(context: Context, params: RequestParams) -> dict[str, Any]:
    """Candidates for completing a predicate or SQL at a place."""
    text = params.text("text", "", longest=MAX_TEXT)
    place = min(params.integer("place", 0, MAX_TEXT), len(text))
    if params.word("language", ("predicate", "sql"), "predicate") == "sql":
        return context.sql.ask(sql_completion, text, place)
    recording = context.recording(params)
    own = params.text("topic")
    topics = {channel.topic for channel in recording.channels}

    def fields(topic: str | None) -> Mapping[str, str] | None:
        try:
            (name,) = resolve([topic or own], topics)
        except (TopicError, ValueError):
            return None
        query = context.query(recording, name)
        known = field_types(query)
        if known is None:
            known = {str(one["path"]): str(one["type"]) for one in infer_fields(query)}
        return known

    found = complete(text, place, topics - {own}, fields, most=_MAX_CANDIDATES)
    offered = [[one.text, one.kind, one.type] for one in found.candidates]
    return {"begin": found.begin, "candidates": offered}


def sql_completion(context: Context, text: str, place: int) -> dict[str, Any]:
    """Candidates for completing SQL, worked out in the process for SQL."""
    from hybridlog.sql.completion import candidates, word_before

    word = word_before(text[:place])
    with closing(context.store.sql_engine.connect(SQL_MEMORY, only_reads=True)) as connection:
        found = candidates(connection, text, word)
    offered = [[name, "word", ""] for name in found[:_MAX_CANDIDATES]]
    return {"begin": place - len(word), "candidates": offered}


def sql(context: Context, params: RequestParams) -> dict[str, Any]:
    """The first rows of a query in SQL."""
    text = params.text("text", longest=MAX_TEXT)
    return context.sql.ask(sql_answer, text, SQL_SECONDS)


def sql_answer(context: Context, text: str, seconds: float) -> dict[str, Any]:
    """The first rows of a query, worked out in the process for SQL."""
    from hybridlog.frames.cells import shown

    with closing(context.store.sql_engine.connect(SQL_MEMORY, only_reads=True)) as connection:
        answer = connection.query(text, timeout=seconds)
        table, is_cut = answer.first(SQL_ROWS, _SQL_BYTES)
        body = f"    print(store.sql({text!r}).to_pandas())\n"
        found = shown(table, SQL_COLUMNS)
        found["at"], found["recordings"] = _moments(
            context, found.pop("times"), found["recordings"], answer.remarks
        )
        return found | {
            "more": is_cut,
            "remarks": answer.sentences(),
            "python": program(context.store, body),
        }


def _moments(
    context: Context,
    times: Sequence[range | None],
    names: Sequence[str | None],
    remarks: Remarks,
) -> tuple[list[str | None], list[str | None]]:
    """The message of each row: time since the start of its recording, ns, as text, and its name.

    It is the only one of the topics that were read at a time that the row may be of. Without a
    column `recording`, the recording is known if a single one was read.
    """
    if not times:
        return [], []
    read = [entry.name for entry in remarks.recordings.values()]
    named = names or [read[0] if len(read) == 1 else None] * len(times)
    found: list[str | None] = [None] * len(times)
    for name in {*named} - {None}:
        rows = [n for n, one in enumerate(named) if one == name and times[n]]
        spans = [cast("range", times[n]) for n in rows]
        with suppress(HybridlogError):  # there is no such recording, or it is damaged
            entry = context.store.entry(str(name))
            known = _messages_in(context, entry, remarks.topics, spans)
            for n, time in zip(rows, known, strict=True):
                found[n] = None if time is None else str(time - start_of(entry))
    return found, [name if at else None for name, at in zip(named, found, strict=False)]


def _messages_in(
    context: Context, entry: RecordingEntry, topics: Collection[str], spans: Sequence[range]
) -> list[int | None]:
    """The log time of the only message of each of some topics in a span, ns; None for none.

    None also if there are several, of one topic or at several times.
    """
    ends = [[min(max(time, BEGIN), END) for time in (one[0], one[-1])] for one in spans]
    bounds = np.array([(*span_of(*pair), 0) for pair in ends], np.int64).reshape(-1, 3)
    own = {channel.topic for channel in entry.channels}
    query = context.store.query(sorted(own & {*topics} or own), [entry.id])
    params = query.during(Intervals.of([(entry.id, bounds)]))
    by_topic: dict[str, list[NDArray[np.int64]]] = defaultdict(list)
    for found in match_times(params.session, params.question, params.counters):
        by_topic[found.topic].append(found.log_time)
    first, last = np.array(ends, np.int64).reshape(-1, 2).T
    least, greatest = np.full(len(spans), END), np.full(len(spans), BEGIN)
    is_one = np.ones(len(spans), np.bool_)
    for parts in by_topic.values():
        known = np.sort(np.concatenate(parts))
        low, high = np.searchsorted(known, first), np.searchsorted(known, last, "right")
        is_one &= high - low <= 1
        there = high > low
        least[there] = np.minimum(least[there], known[low[there]])
        greatest[there] = np.maximum(greatest[there], known[low[there]])
    is_one &= least == greatest
    return [
        time if one else None for time, one in zip(least.tolist(), is_one.tolist(), strict=True)
    ]


routes = [
    route("/ask", ask),
    route("/matches", matches),
    route("/match-list", match_list),
    route("/complete", completion),
    route("/sql", sql, threading.BoundedSemaphore(2)),
]
