"""The ROS 1 source: subscribes to the topics of a running ROS 1 system.

It has two threads. One runs an event loop for master, calls and handshakes. The other only reads
messages from sockets (see `stream`).

It asks the master twice a second for topics and their publishers, and connects to these. It does
not register: so nobody needs to reach it, and a restarted master or a node that comes back under
another address is noticed in the same way as a new topic.
"""

from __future__ import annotations

import asyncio
import os
import secrets
from typing import TYPE_CHECKING, Final, TypeVar

import msgspec

from hybridlog.live.sources.base import PeerError, one_line
from hybridlog.live.sources.network import Endpoint, LoopSource, endpoint_of
from hybridlog.live.sources.ros1.stream import Reader
from hybridlog.live.sources.ros1.subscription import (
    ANY,
    Context,
    RefusedError,
    Subscription,
    call,
)
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable

    from hybridlog.live.sources.base import Sink

_DEFAULT_URI: Final = "http://localhost:11311"
_DEFAULT_PORT: Final = 11311


class Ros1Source(LoopSource):
    """Subscribes to topics of a ROS 1 system, whatever their type.

    Each connection to a publisher is a channel with the fields of its header, as in a bag.
    ROS 1 does not transmit send times, so channels have no publish time. Gaps in
    `header.seq` show messages that a publisher dropped in its queue (see `sequence_gaps`).
    Losses of types without a header cannot be detected.

    Publishers know it as `/hybridlog_PID_RANDOM`.

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
        poll_s: float = 0.5,
    ) -> None:
        super().__init__()
        self.address = master_uri or os.environ.get("ROS_MASTER_URI") or _DEFAULT_URI
        self.was_reached = False
        self._caller = f"/hybridlog_{os.getpid()}_{secrets.token_hex(4)}"
        self._max_message_bytes = max_message_bytes
        self._poll_s = poll_s

    def check(self) -> None:
        """Checks the address."""
        self._endpoint()

    def start(self, sink: Sink) -> None:
        """Begins to poll the master, which need not be up yet."""
        uri = f"http://{self._endpoint()}/"
        self._begin_loop(sink, lambda: self._follow(sink, uri))

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
        failed: asyncio.Future[None] = loop.create_future()

        def fail(error: BaseException) -> None:
            if not failed.done():
                failed.set_exception(error)

        graph = Graph(uri, self._poll_s, self._reached)
        reader = Reader(lambda error: loop.call_soon_threadsafe(fail, error))
        reader.start()
        try:
            async with asyncio.TaskGroup() as tasks:
                about = self._caller, sink, reader, self._max_message_bytes
                context = Context(*about, tasks.create_task, graph.forget)
                tasks.create_task(graph.watch(context))
                await failed
        except BaseExceptionGroup as group:
            raise group.exceptions[0] from None
        finally:
            reader.stop()


_Kind = TypeVar("_Kind")
_PAUSE_S: Final = 1.0  # while the master does not answer
_REST: Final = 4


class Graph:
    """The topics of a master, and the subscriptions to them."""

    def __init__(self, uri: str, poll_s: float, reached: Callable[[], None]) -> None:
        self._uri = uri
        self._poll_s = poll_s
        self._reached = reached
        self._subscriptions: dict[str, Subscription] = {}
        self._nodes: dict[str, str] = {}  # addresses by name

    def forget(self, uri: str) -> None:
        """Look again where the node of an address is: it does not answer there."""
        self._nodes = {name: known for name, known in self._nodes.items() if known != uri}

    async def watch(self, context: Context) -> None:
        """Polls the master until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            began = loop.time()
            try:
                await self._poll(context)
            except PeerError as error:
                context.sink.say(
                    f"no ROS master at {one_line(self._uri)} ({error}); waiting for it. Start "
                    "roscore, or give its address with --ros1 or ROS_MASTER_URI"
                )
                await asyncio.sleep(_PAUSE_S)
                continue
            # A large system that takes long to poll is polled less often.
            await asyncio.sleep(max(self._poll_s, _REST * (loop.time() - began)))

    async def _poll(self, context: Context) -> None:
        """Polls the master once, and updates the subscriptions."""
        lists = list[tuple[str, list[str]]]
        state = await self._asked(context, tuple[lists, object, object], "getSystemState")
        self._reached()
        types = dict(await self._asked(context, list[tuple[str, str]], "getTopicTypes"))
        publishers = {topic: nodes for topic, nodes in state[0] if nodes}
        for topic in publishers.keys() | self._subscriptions.keys():
            kind = types.get(topic, "")
            kind = "" if kind == ANY else kind
            if topic not in self._subscriptions:
                if not context.sink.wants(topic, kind):
                    continue
                self._subscriptions[topic] = Subscription(context, topic)
            uris = [await self._find(context, node) for node in publishers.get(topic, ())]
            self._subscriptions[topic].update(kind, filter(None, uris))

    async def _find(self, context: Context, node: str) -> str:
        """The address of a node; empty if it has gone."""
        if node not in self._nodes:
            try:
                self._nodes[node] = await self._asked(context, str, "lookupNode", node)
            except RefusedError:
                return ""
        return self._nodes[node]

    async def _asked(
        self, context: Context, kind: type[_Kind], method: str, *arguments: object
    ) -> _Kind:
        """What the master answers."""
        answer = await call(self._uri, method, context.caller, *arguments)
        try:
            return msgspec.convert(answer, kind)
        except msgspec.ValidationError as error:
            raise PeerError("its answer is not that of a ROS master") from error
