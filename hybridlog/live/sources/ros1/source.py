"""The ROS 1 source: subscribes to the topics of a running ROS 1 system.

It has two threads. One runs an event loop for master, calls and handshakes (see `graph`
and `subscription`). The other only reads messages from sockets (see `reader`).
"""

from __future__ import annotations

import asyncio
import os
import secrets
import threading
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.base import PeerError, ThreadedSource
from hybridlog.live.sources.network import Endpoint, Network, endpoint_of
from hybridlog.live.sources.ros1.graph import Graph, Master
from hybridlog.live.sources.ros1.rpc import RpcServer, listen, methods, uri_of
from hybridlog.live.sources.ros1.stream import Reader
from hybridlog.live.sources.ros1.subscription import Context
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine

    from hybridlog.live.sources.base import Sink

_DEFAULT_URI: Final = "http://localhost:11311"
_DEFAULT_PORT: Final = 11311


class Ros1Source(ThreadedSource):
    """Subscribes to topics of a ROS 1 system, whatever their type.

    Each connection to a publisher is a channel with the fields of its header, as in a bag.
    ROS 1 does not transmit send times, so channels have no publish time. Gaps in
    `header.seq` show messages that a publisher dropped in its queue (see `sequence_gaps`).
    Losses of types without a header cannot be detected.

    The node's name is `/hybridlog_PID_RANDOM`. It listens on loopback, or on the address in
    `ROS_HOSTNAME` or `ROS_IP`.

    Args:
        master_uri: The master's address; if None, `ROS_MASTER_URI` or the default port of
            this computer.
        max_message_bytes: Longest message. A connection that announces a longer one is
            closed. Memory grows only as bytes come.
        poll_s: Interval at which the master is polled, seconds.
    """

    kind = "ROS 1"

    def __init__(
        self,
        master_uri: str | None = None,
        *,
        max_message_bytes: int = 1 << 30,
        poll_s: float = 1.0,
    ) -> None:
        super().__init__()
        self.address = master_uri or os.environ.get("ROS_MASTER_URI") or _DEFAULT_URI
        self.was_reached = False
        self.caller = f"/hybridlog_{os.getpid()}_{secrets.token_hex(4)}"
        self._max_message_bytes = max_message_bytes
        self._poll_s = poll_s
        self._lock = threading.Lock()
        self._end: Callable[[BaseException | None], None] | None = None

    def check(self) -> None:
        """Checks the address."""
        self._endpoint()

    def start(self, sink: Sink) -> None:
        """Begins to poll the master, which need not be up yet."""
        uri = f"http://{self._endpoint()}/"
        self._begin(sink, lambda: asyncio.run(self._follow(sink, uri)))

    def stop(self) -> None:
        """Passes on the messages received so far, and takes back all registrations."""
        with self._lock:
            self._stopping.set()
            if self._end is not None:
                self._end(None)
        self._join()

    def _endpoint(self) -> Endpoint:
        try:
            return endpoint_of(self.address, _DEFAULT_PORT)
        except PeerError as error:
            raise UsageError(
                f"{error}; give a ROS master like {_DEFAULT_URI} with --ros1 or ROS_MASTER_URI"
            ) from error

    async def _follow(self, sink: Sink, uri: str) -> None:
        """Runs all tasks until the source is stopped or one of them fails."""
        loop = asyncio.get_running_loop()
        over: asyncio.Future[None] = loop.create_future()
        tasks: set[asyncio.Task[None]] = set()

        def settle(error: BaseException | None) -> None:
            if over.done():
                return
            if error is None:
                over.set_result(None)
            else:
                over.set_exception(error)

        def end(error: BaseException | None) -> None:
            loop.call_soon_threadsafe(settle, error)

        def finished(task: asyncio.Task[None]) -> None:
            tasks.discard(task)
            if not task.cancelled() and (error := task.exception()) is not None:
                end(error)

        def spawn(work: Coroutine[None, None, None]) -> None:
            task = loop.create_task(work)
            tasks.add(task)
            task.add_done_callback(finished)

        with self._lock:
            if self._stopping.is_set():
                return
            self._end = end
        try:
            network = Network()
            listening, host = await listen(network, os.environ, sink.say)
            master = Master(network, uri, self.caller, uri_of(host, listening))
            graph = Graph(master, uri, self._poll_s, self._reached)
            server = RpcServer(listening, methods(uri, graph.topics, graph.hint, sink.say))
            reader = Reader(end)
            context = Context(
                *(network, self.caller, sink, reader, self._max_message_bytes),
                *(spawn, graph.hint),
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
                await graph.farewell()
        finally:
            with self._lock:
                self._end = None
