"""Parts of a recording as files, and the command lines that write the same."""

from __future__ import annotations

import asyncio
import io
from collections.abc import AsyncIterator, Generator
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from starlette.concurrency import run_in_threadpool
from starlette.responses import StreamingResponse

from hybridlog.query.predicate.tokens import MAX_TEXT
from hybridlog.view.context import Context, route, start_of
from hybridlog.view.question import PageQuestion

if TYPE_CHECKING:
    from starlette.responses import Response

    from hybridlog.query.query import Query
    from hybridlog.view.context import RequestParams

MAX_TOPICS: Final = 200
"""Greatest number of topics that are named; without any, all are meant."""
PIECE: Final = 256 << 10
"""Least size of a piece that is sent, bytes."""
MAX_STREAMS: Final = 4
"""Number of files that are sent at once; others wait for their turn."""

Pieces: TypeAlias = "Generator[bytes, None, None]"
_streams = asyncio.Semaphore(MAX_STREAMS)


def command(context: Context, params: RequestParams) -> dict[str, Any]:
    """The command line that writes a part of a recording, and how many messages it has."""
    question = _question(context, params)
    return {**question.told(), "name": question.file_name()}


def file(context: Context, params: RequestParams) -> Response:
    """A part of a recording as an MCAP file."""
    question = _question(context, params)
    return mcap_response(question.query(), question.file_name())


def mcap_response(query: Query, name: str) -> Response:
    """The messages of a query as an MCAP file, made while it is sent.

    Args:
        query: The query.
        name: Name of the file, of plain characters.
    """
    pieces = pieces_of(query)
    first = next(pieces)  # most errors come before it, and can still be told
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
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
    recording = context.recording(params)
    topics = tuple(dict.fromkeys(params.texts("topic", most=MAX_TOPICS)))
    context.query(recording, *topics)
    span = None
    if params.has("begin") or params.has("end"):
        span = params.span(start_of(recording))
    where = params.text("where", "", longest=MAX_TEXT).strip()
    within = params.text("within", "", longest=64)
    question = PageQuestion(context.store, recording, topics, where, within, span)
    return question.around(params.text("around", longest=64)) if params.has("around") else question


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


routes = [route("/export-command", command), route("/export", file)]
