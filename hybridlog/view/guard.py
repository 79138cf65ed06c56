"""Keeps everyone but the user's own page away from the server.

Other users of the machine, and pages of other sites in the user's browser, can reach a port of
the loopback interface. So each request must carry the token in its path, name this server as
its host, and come from no other origin.
"""

from __future__ import annotations

import secrets
from collections.abc import Collection
from typing import TYPE_CHECKING, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' blob: data:; object-src 'none'; base-uri 'none'; "
        "form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
"""Headers of every answer that does not set its own."""

_METHODS: Final = frozenset({"GET", "HEAD"})
_PREFLIGHT: Final = "OPTIONS"
_ONCE: Final = ("host", "origin")


def new_token() -> str:
    """A random token, 128 bits as text for a URL."""
    return secrets.token_urlsafe(16)


class Guard:
    """Refuses requests that are not the page's own.

    Args:
        app: The application behind it; it sees paths below the token.
        token: The first part of every valid path.
        port: The port of the server.
        shared: Beginnings of paths below the token that pages of `origins` may read, too.
        origins: Origins of these pages, such as `https://app.foxglove.dev`.
    """

    def __init__(
        self,
        app: ASGIApp,
        token: str,
        port: int,
        *,
        shared: Collection[str] = (),
        origins: Collection[str] = (),
    ) -> None:
        self._app = app
        self._token = token.encode()
        self._root = f"/{token}"
        self._hosts = {f"{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")}
        self._own = {f"http://{host}" for host in self._hosts}
        self._shared = tuple(shared)
        self._origins = frozenset(origins)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # a web socket is closed without an answer
        headers = Headers(scope=scope)
        path: str = scope["path"]
        refusal = self._refusal(scope["method"], headers, path)
        if refusal is not None:
            code, reason = refusal
            response = PlainTextResponse(f"{reason}\n", code, headers=HEADERS)
            await response(scope, receive, send)
            return
        origin = headers.get("origin")
        if scope["method"] == _PREFLIGHT:
            await _allowed(str(origin))(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                answered = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    answered.setdefault(name, value)
                if origin in self._origins:
                    _let_read(answered, str(origin))
            await send(message)

        await self._app({**scope, "root_path": self._root}, receive, guarded)

    def knows(self, path: str) -> bool:
        """True for a path that has the token."""
        first = path.removeprefix("/").partition("/")[0]
        return secrets.compare_digest(first.encode(), self._token)

    def _refusal(self, method: str, headers: Headers, path: str) -> tuple[int, str] | None:
        """Status and reason; None for a request of the page."""
        if any(len(headers.getlist(name)) > 1 for name in _ONCE):
            return 400, "A header occurs twice."
        if headers.get("host") not in self._hosts:
            return 421, "This server answers to 127.0.0.1 only."
        if not self.knows(path):
            return 404, "Open the address that `hybridlog view` printed; it has a token."
        if not self._is_own(headers, path.removeprefix(self._root)):
            return 403, "Pages of other sites may not read this store."
        preflight = method == _PREFLIGHT and headers.get("origin") in self._origins
        if method not in _METHODS and not preflight:
            return 405, "This server only answers GET: it never changes the store."
        return None

    def _is_own(self, headers: Headers, below: str) -> bool:
        origin = headers.get("origin")
        if origin is not None and origin in self._origins:
            return below.startswith(self._shared)
        if origin is not None and origin not in self._own:
            return False
        site = headers.get("sec-fetch-site", "same-origin")
        return site in {"same-origin", "none"} or headers.get("sec-fetch-mode") == "navigate"


def _allowed(origin: str) -> Response:
    """The answer to a browser that asks whether a page may read ranges."""
    headers = MutableHeaders(HEADERS)
    _let_read(headers, origin)
    headers["Access-Control-Allow-Methods"] = "GET, HEAD"
    headers["Access-Control-Allow-Headers"] = "Range, If-Range, If-Match, If-None-Match"
    headers["Access-Control-Allow-Private-Network"] = "true"
    return Response(status_code=204, headers=headers)


def _let_read(headers: MutableHeaders, origin: str) -> None:
    headers["Access-Control-Allow-Origin"] = origin
    headers["Access-Control-Expose-Headers"] = "Accept-Ranges, Content-Range, Content-Length, ETag"
    headers["Cross-Origin-Resource-Policy"] = "cross-origin"
    headers.add_vary_header("Origin")
