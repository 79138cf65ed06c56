"""The ROS 1 source: subscribes to the topics of a running ROS 1 system.

It has two threads. One runs an event loop for master, calls and handshakes. The other only reads
messages from sockets (see `stream`).

Polling the master once a second finds new topics, which it does not announce. It finds publishers
that the master could not announce because it cannot reach this node, and restarted masters that
lost the registration. Announcements of the master only trigger a poll, so they need not be trusted.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import secrets
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

import msgspec

from hybridlog.live.sources.base import PeerError, one_line
from hybridlog.live.sources.network import Endpoint, LoopSource, Network, endpoint_of
from hybridlog.live.sources.ros1.rpc import RefusedError, RpcServer, call, listen, methods, uri_of
from hybridlog.live.sources.ros1.stream import Reader
from hybridlog.live.sources.ros1.subscription import ANY, Context, Subscription
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Coroutine, Iterable

    from hybridlog.live.sources.base import Sink

_DEFAULT_URI: Final = "http://localhost:11311"
_DEFAULT_PORT: Final = 11311


class Ros1Source(LoopSource):
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
        network = Network()
        listening, host = await listen(network, os.environ, sink.say)

        def fail(error: BaseException) -> None:
            if not failed.done():
                failed.set_exception(error)

        with listening:
            master = Master(network, uri, self.caller, uri_of(host, listening))
            graph = Graph(master, uri, self._poll_s, self._reached)
            server = RpcServer(methods(uri, graph.topics, graph.hint, sink.say))
            serving = await server.start(listening)
            reader = Reader(lambda error: loop.call_soon_threadsafe(fail, error))
            reader.start()
            try:
                async with asyncio.TaskGroup() as tasks:
                    context = Context(
                        *(network, self.caller, sink, reader, self._max_message_bytes),
                        *(tasks.create_task, graph.hint),
                    )
                    tasks.create_task(graph.watch(context))
                    await failed
            except BaseExceptionGroup as group:
                raise group.exceptions[0] from None
            finally:
                serving.close()
                reader.stop()
                await graph.farewell()


_Item = TypeVar("_Item")
_Kind = TypeVar("_Kind")
_Lists = list[tuple[str, list[str]]]
"""Topics and their nodes."""


class State(NamedTuple):
    """State of the ROS system at one time; this node is registered for the topics `ours`."""

    publishers: dict[str, frozenset[str]]
    ours: frozenset[str]


class Master:
    """Calls the master. Every call may raise `PeerError`."""

    def __init__(self, network: Network, uri: str, caller: str, api: str) -> None:
        self._network = network
        self._uri = uri
        self._caller = caller
        self._api = api

    async def state(self) -> State:
        """All topics with their publishers."""
        answer = _read(await self._call("getSystemState"), tuple[_Lists, _Lists, object])
        publishers = {topic: frozenset(nodes) for topic, nodes in answer[0] if nodes}
        return State(publishers, frozenset(t for t, nodes in answer[1] if self._caller in nodes))

    async def types(self) -> dict[str, str]:
        """Types of all topics; unknown ones are missing or `*`."""
        return dict(_read(await self._call("getTopicTypes"), list[tuple[str, str]]))

    async def subscribe(self, topic: str) -> list[str]:
        """Registers this node for a topic, and returns its publishers' addresses."""
        return _read(await self._call("registerSubscriber", topic, "*", self._api), list[str])

    async def unsubscribe(self, topic: str) -> None:
        """Takes back the registration for a topic."""
        await self._call("unregisterSubscriber", topic, self._api)

    async def _call(self, method: str, *arguments: object) -> object:
        return await call(self._network, self._uri, method, self._caller, *arguments)


def _read(answer: object, kind: type[_Kind]) -> _Kind:
    """An answer of the master."""
    try:
        return msgspec.convert(answer, kind)
    except msgspec.ValidationError as error:
        raise PeerError("its answer is not that of a ROS master") from error


_FIRST_PAUSE_S: Final = 0.25
_MAX_PAUSE_S: Final = 2.0
_AFTER_HINT_S: Final = 0.02
_CALLS_AT_ONCE: Final = 8
_FAREWELL_S: Final = 2.0
_MAX_REST_S: Final = 1.0
_REST: Final = 4


class Graph:
    """The topics of a master, and the subscriptions to them."""

    def __init__(
        self, master: Master, uri: str, poll_s: float, reached: Callable[[], None]
    ) -> None:
        self._master = master
        self._uri = uri
        self._poll_s = poll_s
        self._reached = reached
        self._subscriptions: dict[str, Subscription] = {}
        self._types: dict[str, str] = {}
        self._hint = asyncio.Event()
        self._hinted: set[str] = set()
        self._calls = asyncio.Semaphore(_CALLS_AT_ONCE)

    def hint(self, topic: str) -> None:
        """Let the master be polled soon, since the publishers of a topic may have changed."""
        if topic in self._subscriptions:
            self._hinted.add(topic)
            self._hint.set()

    def topics(self) -> list[str]:
        """Topics with a subscription."""
        return list(self._subscriptions)

    async def watch(self, context: Context) -> None:
        """Polls the master until cancelled."""
        loop = asyncio.get_running_loop()
        pause = _FIRST_PAUSE_S
        while True:
            began = loop.time()
            try:
                await self._poll(context)
            except PeerError as error:
                context.sink.say(
                    f"no ROS master at {one_line(self._uri)} ({error}); waiting for it. Start "
                    "roscore, or give its address with --ros1 or ROS_MASTER_URI"
                )
                pause = min(pause * 2, _MAX_PAUSE_S)
                await asyncio.sleep(pause)
                continue
            pause = _FIRST_PAUSE_S
            # A large system that takes long to poll is polled less often.
            rest = min(max(_AFTER_HINT_S, _REST * (loop.time() - began)), _MAX_REST_S)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(self._poll_s):
                    await self._hint.wait()
                # Publishers often appear and disappear together.
                await asyncio.sleep(rest)

    async def farewell(self) -> None:
        """Takes back all registrations, within two seconds."""
        with contextlib.suppress(TimeoutError, PeerError):
            async with asyncio.timeout(_FAREWELL_S):
                await self._all(self._master.unsubscribe, self._subscriptions)

    async def _poll(self, context: Context) -> None:
        """Polls the master once, and updates the subscriptions."""
        self._hint.clear()
        hinted, self._hinted = self._hinted, set()
        try:
            state = await self._master.state()
            self._reached()
            self._types = await self._master.types()
            self._choose(context, state)
            stale = [
                subscription
                for topic, subscription in self._subscriptions.items()
                if topic in hinted
                or topic not in state.ours
                or subscription.nodes != state.publishers.get(topic, frozenset())
            ]
            await self._all(partial(self._refresh, context, state), stale)
        except PeerError:
            self._hinted |= hinted
            raise

    def _choose(self, context: Context, state: State) -> None:
        """Adds a subscription for each wanted topic without one."""
        for topic in state.publishers.keys() - self._subscriptions.keys():
            if context.sink.wants(topic, self._type_of(topic)):
                self._subscriptions[topic] = Subscription(context, topic)

    async def _refresh(self, context: Context, state: State, subscription: Subscription) -> None:
        """Registers for a topic, and updates its publishers."""
        topic = subscription.topic
        try:
            uris = await self._master.subscribe(topic)
        except RefusedError as error:
            context.sink.say(f"{one_line(topic)}: the ROS master refuses the subscription: {error}")
            return
        subscription.nodes = state.publishers.get(topic, frozenset())
        subscription.update(self._type_of(topic), uris)

    def _type_of(self, topic: str) -> str:
        type_name = self._types.get(topic, "")
        return "" if type_name == ANY else type_name

    async def _all(
        self, call: Callable[[_Item], Coroutine[None, None, None]], items: Iterable[_Item]
    ) -> None:
        """Calls the master for all items, some in parallel; raises the first error at the end."""

        async def one(item: _Item) -> None:
            async with self._calls:
                await call(item)

        results = await asyncio.gather(*map(one, items), return_exceptions=True)
        for result in results:
            if isinstance(result, BaseException):
                raise result
