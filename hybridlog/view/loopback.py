"""Servers on the loopback interface: who may ask them, and their port.

Other users of the machine, and pages of other sites in the user's browser, can reach a port of
the loopback interface. So a request names this computer as its host and comes from an origin
that is welcome; what is private also has a token in its path.
"""

from __future__ import annotations

import errno
import secrets
import socket
from collections.abc import Collection
from typing import Final
from urllib.parse import SplitResult, urlsplit

from msgspec import Struct

from hybridlog_storage.errors import UsageError

HOST: Final = "127.0.0.1"
_OWN_HOSTS: Final = ("127.0.0.1", "localhost", "::1")
_FOXGLOVE: Final = ".foxglove.dev"


class Admission(Struct, frozen=True, kw_only=True):
    """The rules of a server about host, origin and token.

    Attributes:
        port: The port that hosts name; None for any: a request may come through a tunnel.
        token: The first part of every path; None without one.
        origins: Web origins that are welcome beside its own.
        viewers: So are pages of Foxglove.
        local: So are pages of this computer, and desktop programs.
    """

    port: int | None = None
    token: str | None = None
    origins: Collection[str] = ()
    viewers: bool = False
    local: bool = False

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
        if self.viewers and parts.scheme == "https" and host.endswith(_FOXGLOVE):
            return True
        if not self.local:
            return False
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
