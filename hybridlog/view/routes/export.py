"""Questions about a recording: their queries, command lines and programs; messages as files."""

from __future__ import annotations

import asyncio
import io
import re
import shlex
from collections.abc import AsyncIterator, Generator, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from msgspec import Struct
from msgspec.structs import replace
from starlette.concurrency import run_in_threadpool
from starlette.responses import StreamingResponse

from hybridlog.query.predicate.parser import MAX_TEXT
from hybridlog.query.times import format_time
from hybridlog.record.losses import extent_of
from hybridlog.view.context import route, start_of

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
        begin, end = self.span or extent_of(self.recording)
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


def program(store: Store, body: str) -> str:
    """A program that opens a store; `body` is indented."""
    path = store.directory.place
    return f"import hybridlog as hl\n\nwith hl.open({path!r}) as store:\n{body}"


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


routes = [route("/ask", ask), route("/export", file)]
