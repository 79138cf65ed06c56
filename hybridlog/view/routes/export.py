"""Questions about a recording, and their messages as files."""

from __future__ import annotations

import asyncio
import io
from collections.abc import AsyncIterator, Generator
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from msgspec.structs import replace
from starlette.concurrency import run_in_threadpool
from starlette.responses import StreamingResponse

from hybridlog.view.context import Context, route, start_of
from hybridlog.view.question import question_of

if TYPE_CHECKING:
    from starlette.responses import Response

    from hybridlog.query.query import Query
    from hybridlog.view.context import RequestParams
    from hybridlog.view.question import PageQuestion

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
