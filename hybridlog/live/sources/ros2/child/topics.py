"""Follows the graph: which topics there are, whom we listen to, with what quality.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.definitions import UnknownTypeError, parse_type
from hybridlog.live.sources.ros2.child.publication_gaps import MAX_PUBLISHERS
from hybridlog.live.sources.ros2.child.qos import (
    DEPTH,
    DEPTH_OF_ARRAYS,
    DEPTH_OF_BYTES,
    Profile,
    conflicts,
    offered_text,
    request,
)
from hybridlog.live.sources.ros2.child.stream import Stream

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from hybridlog.live.sources.ros2.child.definitions import Definition, Definitions
    from hybridlog.live.sources.ros2.child.event_sender import EventSender
    from hybridlog.live.sources.ros2.child.middleware import Middleware, Offer, Subscription

MAX_TOPICS = 10_000
"""Topics and types that are looked at; a graph with more is out of its mind."""

_OVERLAP_S = 1.0
_REMIND_S = 10.0


class Topic:
    """A topic and type that have, or had, publishers.

    Attributes:
        offers: The publishers.
        is_wanted: The recorder wants it.
        definition: Its definition, None before it is wanted, and when there is none.
        stream: Its messages, None when it is not subscribed to.
        nodes: Names of publishers' nodes, those that have gone too.
        profiles: What publishers have offered while the channel was the same.
        trouble: Why it cannot be subscribed to, empty when it can.
        reminded: When the trouble was told last, by the monotonic clock.
    """

    def __init__(self, name: str, kind: str) -> None:
        self.name = name
        self.kind = kind
        self.offers: list[Offer] = []
        self.is_wanted = False
        self.definition: Definition | None = None
        self.stream: Stream | None = None
        self.nodes: dict[bytes, str] = {}
        self.profiles: set[Profile] = set()
        self.trouble = ""
        self.reminded = 0.0


class Topics:
    """All topics, and what to do when they change.

    Args:
        middleware: ROS.
        events: Who tells the recorder.
        definitions: Where types are defined.
        overrides: Fields of `Profile` by topic that the user wants otherwise.

    Attributes:
        owners: By subscription, whose it is.
        doubled: Those that have two subscriptions at the moment.
    """

    def __init__(
        self,
        middleware: Middleware,
        events: EventSender,
        definitions: Definitions,
        overrides: Mapping[str, Mapping[str, Any]],
    ) -> None:
        self.owners: dict[Subscription, Topic] = {}
        self.doubled: list[Topic] = []
        self._live: list[Topic] = []
        self._middleware = middleware
        self._events = events
        self._definitions = definitions
        self._overrides = overrides
        self._topics: dict[tuple[str, str], Topic] = {}
        self._ended: int | None = None

    def end(self) -> None:
        """The recorder wants what was sent until now, and no more."""
        self._ended = time.time_ns()

    def has_caught_up(self) -> bool:
        """Whether, since the end, a message has come of all that spoke just before.

        Only the next message shows what is missing before it.
        """
        since = self._ended
        streams = [topic.stream for topic in self._live if topic.stream is not None]
        return since is None or all(stream.has_caught_up(since) for stream in streams)

    def look(self) -> None:
        """Looks at the graph, follows its changes, and tells what has been lost."""
        found = self._middleware.publishers()
        for name, reason in self._middleware.odd.items():
            self._events.say(f"{name!r} is left out, ROS cannot subscribe to it: {reason}")
        for key, offers in found.items():
            topic = self._topics.get(key)
            if topic is None:
                if len(self._topics) >= MAX_TOPICS:
                    self._events.say(f"more than {MAX_TOPICS} topics; the rest is left out")
                    continue
                topic = self._topics[key] = Topic(*key)
                self._events.candidate(*key)
            before, topic.offers = topic.offers, offers
            if topic.is_wanted:
                self._update(topic, before)
        for key, topic in list(self._topics.items()):
            if key not in found:
                self._without_publishers(topic)
        self.account()

    def _without_publishers(self, topic: Topic) -> None:
        """A subscription stays: it hears the next publisher from its first message on."""
        had, topic.offers = bool(topic.offers), []
        if topic.stream is None:
            del self._topics[topic.name, topic.kind]
        if had and topic.is_wanted:
            others = (other for other in self._topics.values() if other.name == topic.name)
            if not any(other.offers and other.is_wanted for other in others):
                self._events.gone(topic.name)

    def _update(self, topic: Topic, before: list[Offer]) -> None:
        """Follows a change of a wanted topic's publishers."""
        if len(before) != len(topic.offers):
            self._events.publishers(topic.name, topic.kind, len(topic.offers))
        stream = topic.stream
        if stream is None:
            self._remind(topic)
            return
        known = {offer.publisher for offer in before}
        if any(offer.publisher not in known for offer in topic.offers):
            self._fit(topic, stream, is_first=not before)
        self._check(topic, stream, known)

    def _fit(self, topic: Topic, stream: Stream, *, is_first: bool) -> None:
        """Fits a subscription to new publishers."""
        asked, wanted = stream.subscription.profile, self._wanted(topic)
        unheard = any(conflicts(offer.profile, asked) for offer in topic.offers)
        if wanted != asked and (unheard or is_first):
            self._go_over(topic, stream, wanted)
        if not {offer.profile for offer in topic.offers} <= topic.profiles:
            stream.channel = self._open_channel(topic)

    def _go_over(self, topic: Topic, stream: Stream, wanted: Profile) -> None:
        """Subscribes anew, with what fits all publishers."""
        try:
            found = self._middleware.subscribe(topic.name, parse_type(topic.kind), wanted)
        except Exception as error:
            self._events.say(f"{topic.name}: new publishers cannot be heard: {error}")
            return
        stream.replace(found, _OVERLAP_S)
        self._list()

    def _check(self, topic: Topic, stream: Stream, known: Collection[bytes]) -> None:
        """Says who is not heard, and whose messages may not be what they seem.

        Args:
            topic: Which.
            stream: Its messages.
            known: Publishers that were there at the last look: names come late.
        """
        for offer in topic.offers:
            reasons = conflicts(offer.profile, stream.subscription.profile)
            if reasons and offer.publisher in known:
                self._events.say(
                    f"{topic.name}: {offer.node or 'a publisher'} cannot be heard, its "
                    f"{' and '.join(reasons)} is less than the QoS overrides ask for; "
                    "take that out of the file"
                )
        if len(_hashes(topic)) > 1:
            self._events.say(
                f"{topic.name}: its publishers have different versions of {topic.kind}; "
                "the definition is the one that is installed here"
            )

    def _wanted(self, topic: Topic) -> Profile:
        assert topic.definition is not None
        depth = DEPTH_OF_ARRAYS if topic.definition.has_arrays else DEPTH
        depth = DEPTH_OF_BYTES if topic.definition.has_bytes else depth
        override = self._overrides.get(topic.name, {})
        return request([offer.profile for offer in topic.offers], depth, override)

    def subscribe(self, name: str, kind: str) -> None:
        """The recorder wants a topic."""
        topic = self._topics.get((name, kind))
        if topic is None or topic.is_wanted:
            return
        topic.is_wanted = True
        self._events.publishers(name, kind, len(topic.offers))
        try:
            topic.definition = self._definitions.find(kind)
            found = self._middleware.subscribe(name, parse_type(kind), self._wanted(topic))
        except UnknownTypeError as error:
            self._refuse(topic, str(error))
            return
        except Exception as error:
            # rclpy has errors of many kinds; each leaves this topic out and no other.
            self._refuse(topic, f"rclpy cannot subscribe: {error or type(error).__name__}")
            return
        topic.stream = Stream(found, self._open_channel(topic), topic.offers)
        self._live.append(topic)
        self._list()

    def _list(self) -> None:
        """Notes which subscriptions there are."""
        self.owners.clear()
        self.doubled.clear()
        for topic in self._live:
            assert topic.stream is not None
            subscriptions = topic.stream.subscriptions
            self.owners.update((subscription, topic) for subscription in subscriptions)
            if len(subscriptions) > 1:
                self.doubled.append(topic)

    def _open_channel(self, topic: Topic) -> int:
        """Tells of a channel; the number that its messages have."""
        assert topic.definition is not None
        profiles = [offer.profile for offer in topic.offers]
        topic.profiles.update(profiles)
        hashes = _hashes(topic)
        type_hash = hashes.pop() if len(hashes) == 1 else ""
        offered = offered_text(profiles)
        return self._events.channel(topic.name, topic.kind, topic.definition, offered, type_hash)

    def _refuse(self, topic: Topic, trouble: str) -> None:
        topic.trouble = trouble
        topic.reminded = -_REMIND_S
        self._events.say(f"{topic.name}: {topic.kind} cannot be recorded: {trouble}")
        self._remind(topic)

    def _remind(self, topic: Topic) -> None:
        """What a topic says that cannot be read is lost as long as it has publishers."""
        now = time.monotonic()
        if topic.trouble and now - topic.reminded >= _REMIND_S:
            topic.reminded = now
            self._events.lost(topic.name, "unreadable", None, detail=topic.trouble)

    def account(self, *, final: bool = False) -> None:
        """Tells what has been lost on the way and at our own door.

        Args:
            final: Nothing more will come.
        """
        self._list()
        ended = (self._ended or time.time_ns()) if final else None
        for topic in self._live:
            assert topic.stream is not None
            self._account(topic, topic.stream, ended)
        self._events.refusals()

    def _account(self, topic: Topic, stream: Stream, ended: int | None) -> None:
        if len(topic.nodes) > MAX_PUBLISHERS:
            topic.nodes.clear()
        topic.nodes.update((offer.publisher, offer.node) for offer in topic.offers if offer.node)
        for loss in stream.look(topic.offers, final=ended):
            node = topic.nodes.get(loss.publisher, "")
            if (not stream.named or not loss.publisher) and len(topic.offers) == 1:
                node = topic.offers[0].node
            times = loss.first, loss.last
            detail = ", ".join(filter(None, (f"from {node}" if node else "", loss.place)))
            self._events.lost(topic.name, "transport", loss.missing, times=times, detail=detail)
        if not (stream.numbered or stream.subscription.tells_losses):
            self._events.say(
                "this ROS gives messages no numbers, so losses on the way cannot be counted"
            )
        if not stream.named and stream.numbered and len(topic.offers) > 1:
            self._events.say(
                f"{topic.name}: this rclpy does not tell the messages of its publishers apart, so "
                "losses on the way cannot be counted there; ROS 2 Kilted does"
            )


def _hashes(topic: Topic) -> set[str]:
    return {offer.type_hash for offer in topic.offers if offer.type_hash}
