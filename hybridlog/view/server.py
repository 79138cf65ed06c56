"""Serves the view on the loopback interface until it is stopped."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, Final

from hybridlog.view.loopback import HOST, Admission, listen, new_token
from hybridlog_storage.errors import MissingDependencyError

if TYPE_CHECKING:
    from hybridlog.store import Store

_MAX_CONNECTIONS: Final = 256


class ViewServer:
    """A server for one open store; the port is taken when it is made.

    Args:
        store: The store that is shown.
        port: Port of 127.0.0.1; 0 for any that is free.
        viewers: Foxglove may read selections as MCAP.
        origins: So may pages of these origins.

    Attributes:
        url: The address of the page, with its token.

    Raises:
        MissingDependencyError: starlette or uvicorn is not installed.
        UsageError: The port cannot be used.
    """

    def __init__(
        self, store: Store, port: int = 0, *, viewers: bool = False, origins: Collection[str] = ()
    ) -> None:
        try:
            import uvicorn

            from hybridlog.view.app import make_app
            from hybridlog.view.connection import BoundedConnection
        except ModuleNotFoundError as error:
            raise MissingDependencyError(
                "The view needs starlette and uvicorn: pip install 'hybridlog[view]'"
            ) from error
        self._socket = listen(port)
        self.port: int = self._socket.getsockname()[1]
        token = new_token()
        self.url = f"http://{HOST}:{self.port}/{token}/"
        rules = Admission(port=self.port, token=token, viewers=viewers, origins=origins)
        config = uvicorn.Config(
            make_app(store, rules),
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
        import asyncio

        try:
            asyncio.run(self._server.serve([self._socket]))
        finally:
            self._socket.close()

    def stop(self) -> None:
        """End `run` soon. May be called from any thread."""
        self._server.should_exit = True
