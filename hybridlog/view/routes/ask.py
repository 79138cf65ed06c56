"""Questions about a recording: command lines, programs and files; matches over time; SQL."""

from __future__ import annotations

import asyncio
import io
import re
import shlex
import threading
from collections.abc import AsyncIterator, Generator, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from msgspec import Struct
from msgspec.structs import replace
from starlette.concurrency import run_in_threadpool
from starlette.responses import StreamingResponse

from hybridlog.drawing.times import Match, Matches, aligned
from hybridlog.query.predicate.parser import MAX_TEXT
from hybridlog.query.times import format_time
from hybridlog.view.context import route, start_of
from hybridlog.view.sql_process import in_process, program, sql_answer
from hybridlog_storage.stopping import held
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from starlette.responses import Response

    from hybridlog.query.query import Query
    from hybridlog.query.question import Span
    from hybridlog.store import Store
    from hybridlog.view.context import Context, RequestParams
    from hybridlog_storage.catalog import RecordingEntry

MAX_TOPICS: Final = 200
"""Greatest number of topics that are named; without any, all are meant."""
_EVERY_TOPIC: Final = "**"
_NO_NAME: Final = re.compile(r"[^\w.+-]+")


class PageQuestion(Struct, frozen=True):
    """A question about one recording.

    Attributes:
        topics: Full names; none for all.
        where: Predicate, empty for every message.
        within: Greatest distance in time of messages of other topics, empty without any.
        span: Log time `[begin, end)`, ns; None for all of it.
    """

    store: Store
    recording: RecordingEntry
    topics: tuple[str, ...]
    where: str
    within: str
    span: Span | None

    def query(self) -> Query:
        """Its messages."""
        query = self.store.query(self._topics(), [self.recording.id])
        if self.span is not None:
            # First, so that conditions on other topics are asked in this range only.
            query = query.between(*self.span)
        if self.where:
            query = query.where(self.where, self.within or None)
        return query

    def told(self) -> dict[str, Any]:
        """The number of its messages, losses and remarks, its command line, file and program."""
        query = self.query()
        count = query.count()
        found = query.completeness()
        return {
            "count": count,
            "lost": found.describe(count) if found.has_losses else None,
            "remarks": found.sentences,
            "python": self.python(),
            "command": self.command(),
            "name": self.file_name(),
        }

    def command(self) -> str:
        """The command line that writes it to a file of `file_name`."""
        words = ["hybridlog", "fetch", "--store", self.store.directory.place]
        words += ["-r", self.recording.name]
        for topic in self.topics or [_EVERY_TOPIC]:
            words += ["-t", topic]
        if self.span is not None:
            words += ["--between", *map(format_time, self.span)]
        if self.where:
            words += ["--where", self.where]
        if self.within:
            words += ["--within", self.within]
        return shlex.join([*words, "-o", self.file_name()])

    def python(self) -> str:
        """A program that asks the same."""
        recordings = f"store.recordings({self.recording.name!r})"
        topics = ", ".join(map(repr, self.topics))
        steps = [f"{recordings}.topic({topics})" if topics else f"{recordings}.all_topics()"]
        if self.span is not None:
            steps.append(f".between({self.span[0]}, {self.span[1]})")
        if self.where:
            within = f", within={self.within!r}" if self.within else ""
            steps.append(f".where({self.where!r}{within})")
        lines = "".join(f"\n        {step}" for step in steps)
        body = (
            f"    messages = ({lines}\n    )\n"
            "    print(messages.count())\n"
            "    for message in messages.limit(10):\n"
            "        print(message.log_time_ns, message.topic)\n"
        )
        return program(self.store, body)

    def file_name(self) -> str:
        """The name of its file: recording and range."""
        begin, end = self.span or self.recording.extent
        times = "_".join(format_time(time).replace(":", "") for time in (begin, end))
        return f"{_NO_NAME.sub('_', self.recording.name)}_{times}.mcap"

    def _topics(self) -> Sequence[str]:
        return self.topics or sorted({channel.topic for channel in self.recording.channels})


def question_of(context: Context, params: RequestParams) -> PageQuestion:
    """The question of a request, about all times.

    It has the parameters `recording`, `topic`, repeated, `where` and `within`.
    """
    recording = context.recording(params)
    topics = tuple(dict.fromkeys(params.texts("topic", most=MAX_TOPICS)))
    context.query(recording, *topics)
    where = params.text("where", "", longest=MAX_TEXT).strip()
    within = params.text("within", "", longest=64)
    return PageQuestion(context.store, recording, topics, where, within, None)


PIECE: Final = 256 << 10
"""Least size of a piece that is sent, bytes."""
MAX_STREAMS: Final = 4
"""Number of files that are sent at once; others wait for their turn."""

Pieces: TypeAlias = "Generator[bytes, None, None]"
_streams = asyncio.Semaphore(MAX_STREAMS)


def ask(context: Context, params: RequestParams) -> dict[str, Any]:
    """The number of messages, with losses and remarks; the command line and Python for them."""
    return _question(context, params).told()


def file(context: Context, params: RequestParams) -> Response:
    """A part of a recording as an MCAP file, made while it is sent."""
    question = _question(context, params)
    pieces = pieces_of(question.query())
    first = next(pieces)  # most errors come before it, and can still be told
    headers = {"Content-Disposition": f'attachment; filename="{question.file_name()}"'}
    sent = _sent(first, pieces)
    return StreamingResponse(sent, headers=headers, media_type="application/octet-stream")


async def _sent(piece: bytes, rest: Pieces) -> AsyncIterator[bytes]:
    """All pieces, none of them empty; nothing more is made when the client has gone."""
    try:
        async with _streams:
            while piece:
                yield piece
                piece = await run_in_threadpool(next, rest, b"")
    finally:
        rest.close()


def _question(context: Context, params: RequestParams) -> PageQuestion:
    question = question_of(context, params)
    if params.has("begin") or params.has("end"):
        question = replace(question, span=params.span(start_of(question.recording)))
    return question


def pieces_of(query: Query) -> Pieces:
    """An MCAP file in pieces; a piece is made when it is asked for."""
    from hybridlog.formats.mcap.writer import McapWriter
    from hybridlog.formats.slices import log_of

    written, log = io.BytesIO(), log_of(query)
    with McapWriter(written, profile=log.profile) as writer:
        for batch, channels in log.batches:
            writer.write(batch, channels)
            if written.tell() >= PIECE:
                yield written.getvalue()
                written.seek(0)
                written.truncate()
    yield written.getvalue()


# Matches and SQL.

MAX_LISTED: Final = 200
"""Greatest number of matches that are listed at once."""
SQL_SECONDS: Final = 60
"""Seconds that a query in SQL may take."""


def matches(context: Context, params: RequestParams) -> dict[str, Any]:
    """The matches in a range by pixel, and the bands in which the predicate holds."""
    question = _of_topic(context, params)
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
    question = _of_topic(context, params)
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


def _of_topic(context: Context, params: RequestParams) -> PageQuestion:
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


def sql(context: Context, params: RequestParams) -> dict[str, Any]:
    """The first rows of a query in SQL."""
    text = params.text("text", longest=MAX_TEXT)
    return in_process(context.store, sql_answer, text, SQL_SECONDS)


routes = [
    route("/ask", ask),
    route("/export", file),
    route("/matches", matches),
    route("/match-list", match_list),
    route("/sql", sql, threading.BoundedSemaphore(1)),
]
