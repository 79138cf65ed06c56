"""The server of the view: its application, on the loopback interface until it is stopped."""

from __future__ import annotations

import asyncio
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import uvicorn
from starlette.applications import Starlette
from starlette.routing import Mount
from starlette.staticfiles import StaticFiles
from uvicorn.protocols.http.h11_impl import H11Protocol

from hybridlog.view.context import Context, broken_response
from hybridlog.view.guard import HOST, Admission, Guard, listen, new_token
from hybridlog.view.routes import ask, pictures

if TYPE_CHECKING:
    from starlette.responses import Response

    from hybridlog.store import Store

_MAX_CONNECTIONS: Final = 256


class ViewServer:
    """A server for one open store; the port of 127.0.0.1 (0 for a free one) is taken at once.

    The URL has the token; without one, a new one is made.
    """

    def __init__(self, store: Store, port: int = 0, token: str = "") -> None:
        self._socket = listen(port)
        self.port: int = self._socket.getsockname()[1]
        token = token or new_token()
        self.url = f"http://{HOST}:{self.port}/{token}/"
        config = uvicorn.Config(
            make_app(store, Admission(port=self.port, token=token)),
            log_level="critical",
            access_log=False,
            lifespan="off",
            http=BoundedConnection,
            ws="none",
            server_header=False,
            limit_concurrency=_MAX_CONNECTIONS,
            timeout_keep_alive=30,
            timeout_graceful_shutdown=1,
        )
        self._server: Any = uvicorn.Server(config)
        # The signals belong to the command line, or to the caller.
        vars(self._server)["capture_signals"] = nullcontext

    def run(self) -> None:
        """Serve until `stop`, or until a signal ends the process."""
        try:
            asyncio.run(self._server.serve([self._socket]))
        finally:
            self._socket.close()

    def stop(self) -> None:
        """End `run` soon. May be called from any thread."""
        self._server.should_exit = True


_STATIC: Final = Path(__file__).parent / "static"


class _Page(StaticFiles):
    """The files of the page: the browser keeps them, and asks whether they have changed."""

    def file_response(self, *args: Any, **options: Any) -> Response:
        found = super().file_response(*args, **options)
        found.headers["Cache-Control"] = "no-cache"
        return found


def make_app(store: Store, rules: Admission) -> Guard:
    """The application, behind its guard."""
    page = Mount("/", _Page(directory=_STATIC, html=True), name="page")
    routes = [*ask.routes, *pictures.routes, page]
    app = Starlette(routes=routes, exception_handlers={Exception: broken_response})
    app.state.context = Context(store)
    return Guard(app, rules)


MAX_UNKNOWN_CLIENTS: Final = 64
"""Connections without a request that has the token; the oldest one makes room for another."""


class BoundedConnection(H11Protocol):
    """A connection whose requests arrive whole within a time, and in bounded memory.

    Otherwise any local user could hold all connections with requests that never end.

    Attributes:
        patience_s: Time for a request to arrive, from the connection or the last answer on.
        is_unknown: True until a request has the token.
        since: Time of the event loop at which it was made.
    """

    patience_s = 30.0

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._waiting: asyncio.TimerHandle | None = None
        self.is_unknown = True
        self.since = self.loop.time()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client has connected."""
        super().connection_made(transport)
        self._wait()
        known: set[Any] = self.connections
        unknown = [one for one in known if one.is_unknown]
        if len(unknown) > MAX_UNKNOWN_CLIENTS:
            oldest = min(unknown, key=lambda one: one.since)
            known.discard(oldest)  # it is lost a little later
            oldest.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is closed."""
        self._stop_waiting()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Something has arrived."""
        before = self.cycle
        super().handle_events()
        if self.cycle is not before:
            self._stop_waiting()
            guard: Any = self.config.app
            self.is_unknown &= not guard.rules.knows(self.scope["path"])

    def on_response_complete(self) -> None:
        """A request is answered."""
        self._wait()
        super().on_response_complete()

    def _wait(self) -> None:
        self._stop_waiting()
        self._waiting = self.loop.call_later(self.patience_s, self._give_up)

    def _stop_waiting(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _give_up(self) -> None:
        if self.transport.get_write_buffer_size():
            self._wait()  # a slow reader, who has asked already
        else:
            self.transport.abort()
