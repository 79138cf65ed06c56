"""Answers that stop when their client has gone."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable, Generator
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from hybridlog.view.asked import Asked
from hybridlog.view.context import error_response, json_response
from hybridlog_storage.errors import HybridlogError

if TYPE_CHECKING:
    from starlette.requests import Request

    from hybridlog.view.context import Context

MAX_STREAMS: Final = 4
"""Number of files that are sent at once; others wait for their turn."""

Answer: TypeAlias = "Callable[[Context, Asked, threading.Event], Any]"
"""Works out an answer as plain values, and ends soon when the event is set."""

Pieces: TypeAlias = "Generator[bytes, None, None]"
_streams = asyncio.Semaphore(MAX_STREAMS)


def stoppable_route(path: str, answer: Answer) -> Route:
    """A route that answers in a thread, and stops when the client has gone.

    Args:
        path: Path below the token.
        answer: Works out the answer. It waits for its turn by itself.
    """

    def answered(context: Context, asked: Asked, stopped: threading.Event) -> Any:
        with context.store.at_one_moment():
            return answer(context, asked, stopped)

    async def endpoint(request: Request) -> Response:
        stopped = threading.Event()
        context: Context = request.app.state.context
        watching = asyncio.create_task(_wait_until_gone(request, stopped))
        try:
            asked = Asked(request.query_params)
            return json_response(await run_in_threadpool(answered, context, asked, stopped))
        except HybridlogError as error:
            return error_response(error)
        finally:
            stopped.set()
            watching.cancel()
            with suppress(asyncio.CancelledError):
                await watching

    return Route(path, endpoint, name=path)


async def _wait_until_gone(request: Request, stopped: threading.Event) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
    stopped.set()


def file_response(pieces: Pieces, name: str) -> Response:
    """A file that is made while it is sent; nothing more is made when the client has gone.

    Args:
        pieces: Its bytes, none of them empty.
        name: Its name, of plain characters.
    """
    headers = {"Content-Disposition": f'attachment; filename="{name}"'}
    return StreamingResponse(_sent(pieces), headers=headers, media_type="application/octet-stream")


async def _sent(pieces: Pieces) -> AsyncIterator[bytes]:
    try:
        async with _streams:
            while piece := await run_in_threadpool(next, pieces, b""):
                yield piece
    finally:
        pieces.close()
