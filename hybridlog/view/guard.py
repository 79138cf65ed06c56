"""Keeps everyone but the user's own page away from the server.

Each request must carry the token in its path, name this server as its host, and come from no
other origin: see `loopback`.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse, Response

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

    from hybridlog.view.loopback import Admission

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


class Guard:
    """Refuses requests that are not the page's own.

    The application behind it sees paths below the token. Such paths that begin with one of `shared`
    may be read by pages of guests, too.
    """

    def __init__(
        self,
        app: ASGIApp,
        rules: Admission,
        *,
        shared: Collection[str] = (),
    ) -> None:
        self._app = app
        self.rules = rules
        self._root = f"/{rules.token}"
        self._shared = tuple(shared)

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
                if self._is_guest(origin):
                    _let_read(answered, str(origin))
            await send(message)

        await self._app({**scope, "root_path": self._root}, receive, guarded)

    def _is_guest(self, origin: str | None) -> bool:
        return origin is not None and bool(self._shared) and self.rules.is_guest(origin)

    def _refusal(self, method: str, headers: Headers, path: str) -> tuple[int, str] | None:
        """Status and reason; None for a request of the page."""
        if any(len(headers.getlist(name)) > 1 for name in _ONCE):
            return 400, "A header occurs twice."
        if not self.rules.is_host(headers.get("host")):
            return 421, "This server answers to 127.0.0.1 only."
        if not self.rules.knows(path):
            return 404, "Open the address that `hybridlog view` printed; it has a token."
        if not self._is_own(headers, path.removeprefix(self._root)):
            return 403, "Pages of other sites may not read this store."
        preflight = method == _PREFLIGHT and self._is_guest(headers.get("origin"))
        if method not in _METHODS and not preflight:
            return 405, "This server only answers GET: it never changes the store."
        return None

    def _is_own(self, headers: Headers, below: str) -> bool:
        origin = headers.get("origin")
        if self._is_guest(origin):
            return below.startswith(self._shared)
        if origin is not None and not self.rules.is_own(origin):
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
