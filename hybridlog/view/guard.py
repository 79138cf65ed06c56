"""Keeps everyone but the user's own page away from the server.

Other users of the machine, and pages of other sites in the user's browser, can reach a port of the
loopback interface. So each request must carry the token in its path, name this server as its host,
and come from no other origin.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import socket
from collections.abc import Collection
from contextlib import suppress
from typing import TYPE_CHECKING, Final
from urllib.parse import SplitResult, urlsplit

from msgspec import Struct
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse

from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from pathlib import Path

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
_ONCE: Final = ("host", "origin")


class Guard:
    """Refuses requests that are not the page's own.

    The application behind it sees paths below the token.
    """

    def __init__(self, app: ASGIApp, rules: Admission) -> None:
        self._app = app
        self.rules = rules
        self._root = f"/{rules.token}"

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            return  # a web socket is closed without an answer
        refusal = self._refusal(scope["method"], Headers(scope=scope), scope["path"])
        if refusal is not None:
            code, reason = refusal
            response = PlainTextResponse(f"{reason}\n", code, headers=HEADERS)
            await response(scope, receive, send)
            return

        async def guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                answered = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    answered.setdefault(name, value)
            await send(message)

        await self._app({**scope, "root_path": self._root}, receive, guarded)

    def _refusal(self, method: str, headers: Headers, path: str) -> tuple[int, str] | None:
        """Status and reason; None for a request of the page."""
        if any(len(headers.getlist(name)) > 1 for name in _ONCE):
            return 400, "A header occurs twice."
        if not self.rules.is_host(headers.get("host")):
            return 421, "This server answers to 127.0.0.1 only."
        if not self.rules.knows(path):
            return 404, "Open the address that `hybridlog view` printed; it has a token."
        if not self._is_own(headers):
            return 403, "Pages of other sites may not read this store."
        if method not in _METHODS:
            return 405, "This server only answers GET: it never changes the store."
        return None

    def _is_own(self, headers: Headers) -> bool:
        origin = headers.get("origin")
        if origin is not None and not self.rules.is_own(origin):
            return False
        site = headers.get("sec-fetch-site", "same-origin")
        return site in {"same-origin", "none"} or headers.get("sec-fetch-mode") == "navigate"


HOST: Final = "127.0.0.1"
_OWN_HOSTS: Final = ("127.0.0.1", "localhost", "::1")
_FOXGLOVE: Final = ".foxglove.dev"


class Admission(Struct, frozen=True, kw_only=True):
    """The rules of a server about host, origin and token.

    Attributes:
        port: The port that hosts name; None for any: a request may come through a tunnel.
        token: The first part of every path; None without one.
        origins: Web origins that are welcome as guests, beside those of Foxglove and of this
            computer.
    """

    port: int | None = None
    token: str | None = None
    origins: Collection[str] = ()

    def is_host(self, host: str | None) -> bool:
        """True for a name of this computer, as the header `Host` has it."""
        if self.port is None:
            return _split(f"//{host}").hostname in _OWN_HOSTS
        return host in self._hosts()

    def is_own(self, origin: str) -> bool:
        """True for the origin of pages that the server itself serves."""
        return origin in {f"http://{host}" for host in self._hosts()}

    def is_guest(self, origin: str) -> bool:
        """True for the origin of other pages and programs that are welcome."""
        parts = _split(origin)
        host = parts.hostname or ""
        if origin in self.origins:
            return True
        if parts.scheme == "https" and host.endswith(_FOXGLOVE):
            return True
        # A scheme such as file:// is a program's; a page in a sandbox has "null".
        return host in _OWN_HOSTS if parts.scheme in {"http", "https"} else bool(parts.scheme)

    def knows(self, path: str) -> bool:
        """True for a path that has the token."""
        if self.token is None:
            return True
        first = path.removeprefix("/").partition("/")[0]
        return secrets.compare_digest(first.encode(), self.token.encode())

    def _hosts(self) -> list[str]:
        names = (f"[{name}]" if ":" in name else name for name in _OWN_HOSTS)
        return [f"{name}:{self.port}" for name in names]


def new_token() -> str:
    """A random token, 128 bits as text for a URL."""
    return secrets.token_urlsafe(16)


def token_of(path: Path) -> str:
    """The token in a file, which only its owner can read; a new one is put into one that is new."""
    try:
        with suppress(FileExistsError):
            made = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
            with os.fdopen(made, "w") as file:
                file.write(f"{new_token()}\n")
        is_private, token = not path.stat().st_mode & 0o077, path.read_text("ascii").strip()
    except (OSError, UnicodeError) as error:
        raise UsageError(f"No token can be read from {path}: {error}") from error
    if not is_private:
        raise UsageError(f"Others may read the token in {path}: chmod 600 {path}")
    if not re.fullmatch(r"[\w-]{16,200}", token):
        raise UsageError(f"{path} has no token: 16 letters, digits, - or _, or more.")
    return token


def listen(port: int) -> socket.socket:
    """Take a port of the loopback interface; 0 for any that is free."""
    # With the protocol named, asyncio sends answers at once and not with the next acknowledgement.
    listening = socket.socket(proto=socket.IPPROTO_TCP)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((HOST, port))
        listening.listen(128)  # from here on, a browser may come
    except (OSError, OverflowError) as error:
        listening.close()
        taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        reason = "is in use" if taken else f"cannot be used: {error}"
        cure = "Give another one with --port, or 0 for any."
        raise UsageError(f"Port {port} {reason}. {cure}") from error
    return listening


def _split(url: str) -> SplitResult:
    """The parts of an address; none of one that is invalid."""
    try:
        return urlsplit(url)
    except ValueError:
        return urlsplit("")
