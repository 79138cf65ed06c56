"""Topics of a running ROS 1 system, without any ROS installation.

Two threads: one runs an event loop for all talk that takes time (master, publishers'
calls and handshakes, see `graph` and `subscription`), the other does nothing
but empty the sockets that messages come from (`reader`).
"""

from __future__ import annotations

import asyncio
import os
import secrets
import threading
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.base import LiveSource
from hybridlog.live.sources.ros1.error_aggregator import ErrorAggregator
from hybridlog.live.sources.ros1.graph import Graph
from hybridlog.live.sources.ros1.master import Master
from hybridlog.live.sources.ros1.network import Endpoint, Network, PeerError, endpoint_of
from hybridlog.live.sources.ros1.reader import Reader
from hybridlog.live.sources.ros1.rpc import RpcServer
from hybridlog.live.sources.ros1.slave import listen, methods, uri_of
from hybridlog.live.sources.ros1.subscription import Context
from hybridlog.live.sources.text import one_line
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from hybridlog.live.sources.base import Sink

_DEFAULT_URI: Final = "http://localhost:11311"
_DEFAULT_PORT: Final = 11311


class Ros1Source(LiveSource):
    """Subscribes to what the publishers of a ROS 1 system send, whatever its type.

    Each connection to a publisher is a channel with the fields of its header, as in a
    bag. ROS 1 says nothing of when a message was sent, so there is no publish time.
    Messages that a publisher dropped in its queue are seen by the gaps in `header.seq`,
    where a type begins with a header (see `sequence_gaps`); of other types nobody can
    know.

    The node is called `/hybridlog_PID_RANDOM`. It listens on loopback, or on what
    `ROS_HOSTNAME` or `ROS_IP` names.

    Args:
        master_uri: The master's address; `ROS_MASTER_URI`, or the default port of this
            computer, if None.
        max_message_bytes: Longest message that is believed: who announces a longer one
            is hung up on. Memory grows only as bytes come, whatever was announced.
        poll_s: How often the master is asked what is new, seconds.
    """

    kind = "ROS 1"

    def __init__(
        self,
        master_uri: str | None = None,
        *,
        max_message_bytes: int = 1 << 30,
        poll_s: float = 1.0,
    ) -> None:
        self.address = master_uri or os.environ.get("ROS_MASTER_URI") or _DEFAULT_URI
        self.was_reached = False
        self.caller = f"/hybridlog_{os.getpid()}_{secrets.token_hex(4)}"
        self._max_message_bytes = max_message_bytes
        self._poll_s = poll_s
        self._lock = threading.Lock()
        self._end: Callable[[BaseException | None], None] | None = None
        self._is_stopped = False
        self._thread: threading.Thread | None = None

    def check(self) -> None:
        """Refuses an address that is none.

        Raises:
            UsageError: The master's address is none.
        """
        self._endpoint()

    def start(self, sink: Sink) -> None:
        """Begins to follow the master, which need not be there yet.

        Raises:
            UsageError: The master's address is none.
        """
        endpoint = self._endpoint()
        self._thread = threading.Thread(
            target=self._run, args=(sink, f"http://{endpoint}/"), name="ros1", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        """Hands over what has come by now, and leaves the system as if we had not been."""
        with self._lock:
            self._is_stopped = True
            if self._end is not None:
                self._end(None)
        if self._thread is not None:
            self._thread.join()

    def _endpoint(self) -> Endpoint:
        try:
            return endpoint_of(self.address, _DEFAULT_PORT)
        except PeerError as error:
            raise UsageError(
                f"{error}: a ROS master's looks like {_DEFAULT_URI}; say it with --ros1 or "
                "ROS_MASTER_URI"
            ) from error

    def _reached(self) -> None:
        self.was_reached = True

    def _run(self, sink: Sink, uri: str) -> None:
        """The thread of the event loop."""
        try:
            asyncio.run(self._main(sink, uri))
        except BaseException as error:
            sink.ended(f"the ROS 1 source failed: {one_line(repr(error))}")
            raise

    async def _main(self, sink: Sink, uri: str) -> None:
        """Lets `end` be called from anywhere, until the source has ended."""
        loop = asyncio.get_running_loop()
        over: asyncio.Future[None] = loop.create_future()

        def settle(error: BaseException | None) -> None:
            if over.done():
                return
            if error is None:
                over.set_result(None)
            else:
                over.set_exception(error)

        def end(error: BaseException | None) -> None:
            loop.call_soon_threadsafe(settle, error)

        with self._lock:
            if self._is_stopped:
                return
            self._end = end
        try:
            await self._follow(sink, uri, over, end)
        finally:
            with self._lock:
                self._end = None

    async def _follow(
        self,
        sink: Sink,
        uri: str,
        over: asyncio.Future[None],
        end: Callable[[BaseException | None], None],
    ) -> None:
        """Runs everything until somebody ends it, or something fails that must not."""
        loop = asyncio.get_running_loop()
        tasks: set[asyncio.Task[None]] = set()

        def finished(task: asyncio.Task[None]) -> None:
            tasks.discard(task)
            if not task.cancelled() and (error := task.exception()) is not None:
                end(error)

        def spawn(work: Coroutine[None, None, None]) -> None:
            task = loop.create_task(work)
            tasks.add(task)
            task.add_done_callback(finished)

        network = Network()
        listening, host = await listen(network, os.environ, sink.say)
        master = Master(network, uri, self.caller, uri_of(host, listening))
        graph = Graph(master, uri, self._poll_s, self._reached)
        server = RpcServer(listening, methods(uri, graph.topics, graph.hint, sink.say))
        reader = Reader(end)
        errors = ErrorAggregator(sink.say)
        context = Context(
            *(network, self.caller, sink, reader, self._max_message_bytes),
            *(spawn, graph.hint, errors),
        )
        reader.start()
        try:
            spawn(server.serve())
            spawn(graph.watch(context))
            await over
        finally:
            while tasks:
                for task in tuple(tasks):
                    task.cancel()
                await asyncio.wait(tuple(tasks), timeout=1)
            listening.close()
            reader.stop()
            errors.flush()
            await graph.farewell()
