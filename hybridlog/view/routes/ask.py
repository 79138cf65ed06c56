"""Matches of predicates over time, SQL, and completion of predicates."""

from __future__ import annotations

import re
import threading
from collections.abc import Sequence
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Any, Final

from hybridlog.drawing.series import known_fields
from hybridlog.drawing.times import Match, Matches, aligned
from hybridlog.frames.names import SUMMARIES, is_summary
from hybridlog.query.predicate.parser import MAX_TEXT
from hybridlog.query.topics import resolve
from hybridlog.view.context import Context, route, start_of
from hybridlog.view.routes.export import program, question_of
from hybridlog.view.sql_process import SQL_MEMORY
from hybridlog_storage.errors import HybridlogError, TopicError
from hybridlog_storage.stopping import held
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hybridlog.sql.rows import Reading
    from hybridlog.store import Store
    from hybridlog.view.context import RequestParams
    from hybridlog.view.routes.export import PageQuestion

MAX_LISTED: Final = 200
"""Greatest number of matches that are listed at once."""
SQL_SECONDS: Final = 60
"""Seconds that a query in SQL may take."""
SQL_ROWS: Final = 1000
_SQL_BYTES: Final = 32 << 20
SQL_COLUMNS: Final = 200
_MAX_CANDIDATES: Final = 50
_MICROSECOND: Final = 1000  # ns


def matches(context: Context, params: RequestParams) -> dict[str, Any]:
    """The matches in a range by pixel, and the bands in which the predicate holds."""
    question = _question(context, params)
    start = start_of(question.recording)
    span = params.span(start)
    edges = aligned(span, params.pixels())
    matching = _matches(context, question)
    first, counts = matching.ticks(edges)
    bands = matching.bands(span, int(edges[1] - edges[0]))
    return {
        "first": (first - start).tolist(),
        "counts": counts.tolist(),
        "bands": (bands - start).tolist(),
    }


def match_list(context: Context, params: RequestParams) -> dict[str, Any]:
    """Some matches behind or in front of a place, and how many are in front of them."""
    question = _question(context, params)
    start = start_of(question.recording)
    place = Match(params.moment(start), params.integer("seq", -1, END, -1))
    count = params.integer("count", 1, MAX_LISTED, MAX_LISTED)
    matching = _matches(context, question)
    is_earlier = params.word("direction", ("later", "earlier"), "later") == "earlier"
    found = matching.beside(place, count, earlier=is_earlier)
    return {
        "rows": [[str(one.time - start), one.seq] for one in found],
        "before": matching.count_before(found[0]) if found else None,
    }


def _question(context: Context, params: RequestParams) -> PageQuestion:
    """A question about one topic."""
    params.text("topic")
    return question_of(context, params)


def _matches(context: Context, question: PageQuestion) -> Matches:
    recording = question.recording
    state = recording.status, recording.messages, frozenset(recording.digests.items())
    key = recording.id, state, (question.topics, question.where, question.within)
    with held(context.matching):  # a second client that asks the same waits
        made = context.store.shared.cache.made
        return made(
            "matches", *key, make=lambda: Matches(question.query()), size_of=lambda one: one.size
        )


def completion(context: Context, params: RequestParams) -> dict[str, Any]:
    """Candidates for completing a predicate at a place."""
    text = params.text("text", "", longest=MAX_TEXT)
    place = min(params.integer("place", 0, MAX_TEXT), len(text))
    recording = context.recording(params)
    own = params.text("topic")
    topics = {channel.topic for channel in recording.channels}

    word = re.findall(r"[^\s()!&|<>=~,\"'{}]*\Z", text[:place])[0]
    named = re.findall(r"(\S+):\s", text[: place - len(word)])
    known: Mapping[str, str] = {}
    with suppress(TopicError, ValueError):
        (topic,) = resolve(named[-1:] or [own], topics)
        known = known_fields(context.query(recording, topic))
    summaries = (f"{path}.{name}" for path in known for name in SUMMARIES)
    offered = [[path, "field", kind] for path, kind in known.items()]
    offered += ([path, "field", "summary"] for path in summaries if is_summary(path, known))
    offered += ([f"{topic}: ", "topic", ""] for topic in sorted(topics - {own}))
    found = [one for one in offered if word and word.casefold() in one[0].casefold()]
    found.sort(key=lambda one: not one[0].casefold().startswith(word.casefold()))
    return {"begin": place - len(word), "candidates": found[:_MAX_CANDIDATES]}


def sql(context: Context, params: RequestParams) -> dict[str, Any]:
    """The first rows of a query in SQL."""
    text = params.text("text", longest=MAX_TEXT)
    return context.sql.ask(sql_answer, text, SQL_SECONDS)


def sql_answer(store: Store, text: str, seconds: float) -> dict[str, Any]:
    """The first rows of a query, worked out in the process for SQL."""
    from hybridlog.frames.lines import shown

    with closing(store.sql_engine.connect(SQL_MEMORY, only_reads=True)) as connection:
        answer = connection.query(text, timeout=seconds)
        table, is_cut = answer.first(SQL_ROWS, _SQL_BYTES)
        body = f"    print(store.sql({text!r}).to_pandas())\n"
        found = shown(table, SQL_COLUMNS)
        found["at"], found["recordings"] = _moments(
            store, found.pop("times"), found["recordings"], answer.reading
        )
        return found | {
            "more": is_cut,
            "remarks": answer.sentences(),
            "python": program(store, body),
        }


def _moments(
    store: Store, times: Sequence[int | None], names: Sequence[str | None], read: Reading
) -> tuple[list[str | None], list[str | None]]:
    """The time since the start of its recording, ns, as text, and the recording of each row.

    Without a column `recording`, the recording is known if a single one was read. A row that
    lies in no recording has neither.
    """
    if not times:
        return [], []
    known = [entry.name for entry in read.recordings.values()]
    named = names or [known[0] if len(known) == 1 else None] * len(times)
    spans = {}
    for name in {*named} - {None}:
        with suppress(HybridlogError):  # there is no such recording, or it is damaged
            spans[name] = store.entry(str(name)).span
    found: list[str | None] = []
    for time, name in zip(times, named, strict=True):
        first, last = spans.get(name) or (0, -1)
        is_inside = time is not None and first <= time < last + _MICROSECOND
        found.append(str(min(time or 0, last) - first) if is_inside else None)
    return found, [name if at else None for name, at in zip(named, found, strict=True)]


routes = [
    route("/matches", matches),
    route("/match-list", match_list),
    route("/complete", completion),
    route("/sql", sql, threading.BoundedSemaphore(2)),
]
