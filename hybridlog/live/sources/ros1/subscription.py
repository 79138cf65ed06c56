"""One topic and its publishers: each is kept connected for as long as there is hope."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from hybridlog.live.sources.ros1.handshake import subscribe
from hybridlog.live.sources.ros1.network import PeerError
from hybridlog.live.sources.ros1.stream import Stream
from hybridlog.live.sources.ros1.wire import ANY, channel_of
from hybridlog.live.sources.text import one_line

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable, Coroutine, Iterable, Mapping

    from hybridlog.live.sources.base import Sink
    from hybridlog.live.sources.ros1.error_aggregator import ErrorAggregator
    from hybridlog.live.sources.ros1.network import Network
    from hybridlog.live.sources.ros1.reader import Reader
    from hybridlog_storage.messages import Channel

_FIRST_PAUSE_S: Final = 0.25
_MAX_PAUSE_S: Final = 10.0
_STABLE_S: Final = 10.0
_MAX_CHANNELS: Final = 64


@dataclass(frozen=True, slots=True)
class Context:
    """What all subscriptions of a source share.

    Attributes:
        network: Makes connections.
        caller: Our node's name.
        sink: Takes the messages.
        reader: Reads them.
        max_message_bytes: Longest message that is believed.
        spawn: Runs a coroutine until the source stops.
        look_again: Asks the master for the publishers of a topic soon.
        errors: Tells of publishers from which nothing can be had.
    """

    network: Network
    caller: str
    sink: Sink
    reader: Reader
    max_message_bytes: int
    spawn: Callable[[Coroutine[None, None, None]], None]
    look_again: Callable[[str], None]
    errors: ErrorAggregator


class Subscription:
    """A topic that is wanted.

    Attributes:
        topic: Name as the master spells it.
        nodes: Names of its publishers when they were last asked for, None before.
    """

    def __init__(self, context: Context, topic: str) -> None:
        self.topic = topic
        self.nodes: frozenset[str] | None = None
        self._context = context
        self._links: dict[str, _Link] = {}
        self._type = ""
        self._types: dict[str, bool] = {}
        self._channels: dict[tuple[tuple[str, str], ...], Channel] = {}
        self._told = (0, "")

    def update(self, type_name: str, uris: Iterable[str], *, is_wanted: bool) -> None:
        """Takes the publishers as the master lists them now.

        A connection to one that is not listed any more goes on until it ends: a master
        that was started anew knows of nobody.

        Args:
            type_name: The topic's type, empty when the master does not know it.
            uris: Addresses of its publishers.
            is_wanted: Whether messages of that type are wanted.
        """
        if type_name:
            self._type = type_name
            self._types[type_name] = is_wanted
        listed = set(uris)
        for uri, link in tuple(self._links.items()):
            link.list(is_listed=uri in listed)
            if link.has_ended and not link.is_listed:
                del self._links[uri]
        for uri in sorted(listed - set(self._links)):
            link = self._links[uri] = _Link(self, uri)
            self._context.spawn(self._keep(uri, link))
        self.tell()

    def tell(self) -> None:
        """Tells the sink how many publishers there are, if that has changed."""
        now = (sum(link.is_up for link in self._links.values()), self._type)
        if now == self._told:
            return
        before, self._told = self._told, now
        if now[0]:
            self._context.sink.topic_came(self.topic, self._type, now[0])
        elif before[0]:
            self._context.sink.topic_gone(self.topic)

    def channel(self, fields: Mapping[str, str]) -> Channel | None:
        """The channel of a connection, the same one for the same header.

        Returns:
            None when messages of the publisher's type are not wanted.
        """
        type_name = fields.get("type", "")
        if type_name and type_name != ANY and not self._takes(type_name, fields):
            return None
        key = tuple(sorted(fields.items()))
        channel = self._channels.pop(key, None)
        if channel is None:
            channel = channel_of(self.topic, fields)
            self._context.sink.expect(channel)
        self._channels[key] = channel
        if len(self._channels) > _MAX_CHANNELS:
            del self._channels[next(iter(self._channels))]
        return channel

    def _takes(self, type_name: str, fields: Mapping[str, str]) -> bool:
        """Whether messages of a type are wanted; says so when publishers disagree."""
        if not self._type:
            self._type = type_name
        elif type_name != self._type:
            publisher = one_line(fields.get("callerid", "a node without a name"))
            self._context.sink.say(
                f"{one_line(self.topic)}: publishers do not agree on its type, "
                f"{one_line(self._type)} or {one_line(type_name)} (from {publisher}); "
                "each is recorded as it comes"
            )
        wanted = self._types.get(type_name)
        if wanted is None:
            wanted = self._context.sink.wants(self.topic, type_name)
            if len(self._types) < _MAX_CHANNELS:
                self._types[type_name] = wanted
        return wanted

    async def _keep(self, uri: str, link: _Link) -> None:
        await link.run(self._context)
        link.is_up, link.has_ended = False, True
        if not link.is_listed:
            del self._links[uri]
        self.tell()


class _Link:
    """One publisher of a topic.

    Attributes:
        is_listed: The master lists it.
        is_up: It is connected.
        has_ended: `run` has returned.
    """

    def __init__(self, subscription: Subscription, uri: str) -> None:
        self.is_listed = True
        self.is_up = False
        self.has_ended = False
        self._subscription = subscription
        self._uri = uri
        self._failures = 0
        self._has_told = False
        self._hurry = asyncio.Event()

    def list(self, *, is_listed: bool) -> None:
        """Takes what the master says now."""
        if is_listed and not self.is_listed:
            self._hurry.set()
        self.is_listed = is_listed

    async def run(self, context: Context) -> None:
        """Connects again and again, until the publisher is neither listed nor there."""
        topic = self._subscription.topic
        while True:
            try:
                connected, fields = await subscribe(
                    context.network, context.caller, topic, self._uri
                )
            except (OSError, PeerError) as error:
                if not self.is_listed:
                    return
                self._failures += 1
                # One failure is nothing: nodes that end are listed a little longer than
                # they live.
                if self._failures >= 2:
                    context.errors.add(self._uri, topic, error)
            else:
                try:
                    channel = self._subscription.channel(fields)
                except BaseException:
                    connected.close()
                    raise
                if channel is None:
                    connected.close()
                    return
                await self._serve(context, connected, channel)
            self._set_up(is_up=False)
            # It may have come back under another address, which only the master knows.
            context.look_again(topic)
            await self._pause()

    async def _serve(self, context: Context, connected: socket.socket, channel: Channel) -> None:
        """Has a connection read until it ends."""
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[str] = loop.create_future()

        def settle(failure: str) -> None:
            if not ended.done():
                ended.set_result(failure)

        def closed(failure: str) -> None:
            loop.call_soon_threadsafe(settle, failure)

        began = loop.time()
        stream = Stream(connected, channel, context.sink, context.max_message_bytes, closed)
        self._set_up(is_up=True)
        context.reader.add(stream)
        failure = await ended
        if loop.time() - began > _STABLE_S:
            self._failures, self._has_told = 0, False
            context.errors.resolve(self._uri, self._subscription.topic)
        else:
            self._failures += 1
        # A publisher that breaks off again and again is told of once; the ledger has all.
        if failure and not self._has_told:
            self._has_told = True
            name = channel.metadata.get("callerid", "a node without a name")
            context.sink.say(
                f"{one_line(self._subscription.topic)}: lost the connection to {one_line(name)} at "
                f"{one_line(self._uri)}: {failure}; connecting again"
            )

    def _set_up(self, *, is_up: bool) -> None:
        self.is_up = is_up
        self._subscription.tell()

    async def _pause(self) -> None:
        """Waits, the longer the more often it failed, unless the master lists it anew."""
        self._hurry.clear()
        pause = min(_FIRST_PAUSE_S * 2 ** min(self._failures, 10), _MAX_PAUSE_S)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause):
                await self._hurry.wait()
