"""Follows the ROS graph: topics, their publishers, and subscriptions to them."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.definitions import UnknownTypeError, parse_type
from hybridlog.live.sources.ros2.child.middleware import (
    DEPTH,
    DEPTH_OF_BYTES,
    Profile,
    offered_text,
    publisher_id,
    request,
)
from hybridlog.live.sources.sequence_gaps import (
    MODULUS,
    SequenceGap,
    SequenceGapDetector,
    joined_gap,
)

if TYPE_CHECKING:
    from collections.abc import Collection

    from hybridlog.live.sources.ros2.child.definitions import Definition, Definitions
    from hybridlog.live.sources.ros2.child.middleware import Middleware, Offer, Subscription
    from hybridlog.live.sources.ros2.child.outbox import Outbox

MAX_TOPICS = 10_000
"""Maximum number of topics and types; further ones are ignored."""

_TRY_AGAIN_S = 10.0
_MIXED = "mixed"


class Topic:
    """A topic and type that has, or had, publishers.

    Attributes:
        definition: Definition of the type, None if unknown.
        stream: The messages, None without a subscription.
        version: Hash of the type of the current channel; `_MIXED` if publishers differ.
        profiles: Profiles that publishers have offered for this channel.
        tried_at: Monotonic time of the last attempt to subscribe.
    """

    def __init__(self, name: str, kind: str) -> None:
        self.name = name
        self.kind = kind
        self.offers: list[Offer] = []
        self.is_wanted = False
        self.definition: Definition | None = None
        self.stream: Stream | None = None
        self.version = ""
        self.profiles: set[Profile] = set()
        self.tried_at = 0.0


class Topics:
    """All topics of the graph; follows its changes.

    `outbox` takes events, and the messages of a subscription that is made anew.

    Attributes:
        owners: Topic of each subscription.
    """

    def __init__(self, middleware: Middleware, outbox: Outbox, definitions: Definitions) -> None:
        self.owners: dict[Subscription, Topic] = {}
        self._middleware = middleware
        self._outbox = outbox
        self._definitions = definitions
        self._topics: dict[tuple[str, str], Topic] = {}

    def look(self) -> None:
        """Looks at the graph, follows its changes, and reports losses."""
        found = self._middleware.publishers()
        for key, offers in found.items():
            topic = self._topics.get(key)
            if topic is None:
                if len(self._topics) >= MAX_TOPICS:
                    self._outbox.say(f"more than {MAX_TOPICS} topics; the rest is ignored")
                    continue
                topic = self._topics[key] = Topic(*key)
                self._outbox.event("candidate", topic=key[0], type=key[1])
            before, topic.offers = topic.offers, offers
            if topic.is_wanted:
                self._update(topic, before)
        for key, topic in list(self._topics.items()):
            if key not in found:
                self._without_publishers(topic)
        self.account()

    def _without_publishers(self, topic: Topic) -> None:
        """Handles a topic without publishers; its subscription stays for the next one."""
        had, topic.offers = bool(topic.offers), []
        if topic.stream is None:
            del self._topics[topic.name, topic.kind]
        if had and topic.is_wanted:
            others = (other for other in self._topics.values() if other.name == topic.name)
            if not any(other.offers and other.is_wanted for other in others):
                self._outbox.event("gone", topic=topic.name)

    def _update(self, topic: Topic, before: list[Offer]) -> None:
        """Handles the publishers of a wanted topic."""
        if not before:
            self._outbox.event("topic", topic=topic.name, type=topic.kind)
        if topic.stream is None:
            if time.monotonic() - topic.tried_at >= _TRY_AGAIN_S:
                self._subscribe(topic)
            return
        requested, wanted = topic.stream.subscription.profile, self._wanted(topic)
        # Volatile and best effort have greater numbers: a new publisher offers less.
        is_less = wanted.reliability > requested.reliability
        if is_less or wanted.durability > requested.durability or not before:
            self._resubscribe(topic, topic.stream, wanted)
        if topic.stream is not None:
            self._set_channel(topic, topic.stream)

    def _resubscribe(self, topic: Topic, stream: Stream, wanted: Profile) -> None:
        """Subscribes again, with a profile that is compatible with all publishers.

        What comes between the two subscriptions is missing in the numbers of the messages.
        """
        if wanted == stream.subscription.profile:
            return
        try:
            stream.take(self._outbox)
            self._close(topic, stream)
            stream.subscription = self._middleware.subscribe(
                topic.name, parse_type(topic.kind), wanted
            )
        except Exception as error:
            # rclpy raises errors of many kinds; each concerns only this topic.
            self._refuse(topic, f"rclpy cannot subscribe again: {error or type(error).__name__}")
        else:
            topic.stream = stream
            self.owners[stream.subscription] = topic

    def _close(self, topic: Topic, stream: Stream) -> None:
        topic.stream = None
        self.owners.pop(stream.subscription, None)
        self._middleware.close_one(stream.subscription)

    def _wanted(self, topic: Topic) -> Profile:
        assert topic.definition is not None
        depth = DEPTH_OF_BYTES if topic.definition.has_bytes else DEPTH
        return request([offer.profile for offer in topic.offers], depth)

    def subscribe(self, name: str, kind: str) -> None:
        """Subscribes to a topic that the recorder wants."""
        topic = self._topics.get((name, kind))
        if topic is None or topic.is_wanted:
            return
        topic.is_wanted = True
        if topic.offers:
            self._outbox.event("topic", topic=topic.name, type=topic.kind)
        self._subscribe(topic)

    def _subscribe(self, topic: Topic) -> None:
        topic.tried_at = time.monotonic()
        for other in self._topics.values():  # a program has one type of a topic
            if other.name == topic.name and not other.offers and other.stream is not None:
                self._close(other, other.stream)
        try:
            topic.definition = self._definitions.find(topic.kind)
            kind = parse_type(topic.kind)
            found = self._middleware.subscribe(topic.name, kind, self._wanted(topic))
        except UnknownTypeError as error:
            self._refuse(topic, str(error))
        except Exception as error:
            # rclpy raises errors of many kinds; each concerns only this topic.
            self._refuse(topic, f"rclpy cannot subscribe: {error or type(error).__name__}")
        else:
            topic.stream = Stream(found)
            self.owners[found] = topic
            self._set_channel(topic, topic.stream)

    def _set_channel(self, topic: Topic, stream: Stream) -> None:
        """Announces a channel for other profiles, or another version of the type."""
        assert topic.definition is not None
        hashes = {offer.type_hash for offer in topic.offers}
        version = topic.version if not hashes else hashes.pop() if len(hashes) == 1 else _MIXED
        profiles = [offer.profile for offer in topic.offers]
        is_same = version == topic.version and topic.profiles.issuperset(profiles)
        if stream.channel >= 0 and is_same:
            return
        topic.version, topic.profiles = version, {*profiles}
        definition = topic.definition.of(version)
        if not definition.text and topic.definition.text:
            self._outbox.say(
                f"{topic.name}: a publisher has another version of {topic.kind} than the one that "
                "is installed here; messages are recorded without that definition. Source the "
                "workspace of the publisher for their fields"
            )
        told = "" if version == _MIXED else version
        offered = offered_text(profiles)
        stream.channel = self._outbox.channel(topic.name, topic.kind, definition, offered, told)

    def _refuse(self, topic: Topic, problem: str) -> None:
        """Reports, now and then, that the messages of a topic without subscription are lost."""
        self._outbox.say(f"{topic.name}: {topic.kind} cannot be recorded: {problem}")
        self._outbox.lost(topic.name, "unreadable", None, detail=problem)

    def account(self, *, final: bool = False) -> None:
        """Reports losses in transport."""
        for topic in self.owners.values():
            assert topic.stream is not None
            offers = topic.offers
            nodes = {offer.publisher: offer.node for offer in offers}
            if len(offers) == 1:
                nodes[b""] = offers[0].node
            for publisher, gap in topic.stream.losses(nodes, final=final):
                node = nodes.get(publisher, "")
                # A message in fragments has the time of the first one, and others may be between.
                times = min(gap.first, gap.last), max(gap.first, gap.last)
                detail = f"from {node}" if node else ""
                self._outbox.lost(topic.name, "transport", gap.missing, times=times, detail=detail)
            if not topic.stream.numbered:
                self._outbox.say(
                    "this ROS does not number messages, so losses in transport cannot be counted"
                )


MAX_PUBLISHERS = 1024
"""Maximum number of publishers of a topic whose numbers are remembered after they are gone."""

MAX_GAP = MODULUS // 2
"""Largest number of missing messages; a number that is further on is one that went back."""

_MAX_MESSAGES = 1000
_BYTES_AT_ONCE = 8 << 20
_OLDEST = 60_000_000_000
_NEWEST = 1_000_000_000
_MAX_INT = 2**63 - 1


class Stream:
    """Moves the messages of a topic from the middleware into the outbox.

    Attributes:
        subscription: The subscription; the owner closes it, and puts another in its place.
        channel: Number of the channel of its messages; -1 before there is one.
        numbered: Messages have numbers; True until one does not.
    """

    def __init__(self, subscription: Subscription) -> None:
        self.subscription = subscription
        self.channel = -1
        self.numbered = True
        self._gaps: dict[bytes, SequenceGapDetector] = {}

    def take(self, outbox: Outbox) -> tuple[int, int]:
        """Takes messages, up to a limit for other topics' sake; returns number and bytes."""
        take, put, channel = self.subscription.take, outbox.message, self.channel
        count = size = 0
        while count < _MAX_MESSAGES and size < _BYTES_AT_ONCE:
            got = take()
            if got is None:
                break
            payload, info = got
            count += 1
            size += len(payload)
            received = _received(info)
            number = self._number(info)
            if number >= 0:
                gid = info.get("publisher_gid")
                self._count(b"" if gid is None else publisher_id(gid["data"]), number, received)
            sent = info["source_timestamp"]
            put(channel, payload, received, sent if 0 < sent <= _MAX_INT else 0, number)
        return count, size

    def _count(self, publisher: bytes, number: int, received: int) -> None:
        """Count a message of a publisher, or of any: before Kilted, messages name nobody."""
        gaps = self._gaps.get(publisher)
        if gaps is None:
            gaps = SequenceGapDetector()
            if publisher:
                gaps = SequenceGapDetector(trust_after=0, confirm_after=0, max_gap=MAX_GAP)
            self._gaps[publisher] = gaps
        # A number that goes back is a late message, which is no loss, or shows several publishers.
        is_late = gaps.expected >= 0 and (number - gaps.expected) % MODULUS > MAX_GAP
        if not (publisher and is_late):
            gaps.see(number % MODULUS, received)

    def _number(self, info: dict[str, Any]) -> int:
        """The sequence number of a message, -1 without one."""
        number = info.get("publication_sequence_number")
        if number is None or not 0 <= number <= _MAX_INT:
            self.numbered = False
            return -1
        return int(number)

    def losses(
        self, publishers: Collection[bytes], *, final: bool = False
    ) -> list[tuple[bytes, SequenceGap]]:
        """Losses since the last call, by publisher; some `publishers` are there still."""
        found = [
            (publisher, joined_gap(lost))
            for publisher, gaps in self._gaps.items()
            if (lost := gaps.finish() if final else gaps.confirmed())
        ]
        if len(self._gaps) > MAX_PUBLISHERS:
            self._gaps = {key: gaps for key, gaps in self._gaps.items() if key in publishers}
        return found


def _received(info: dict[str, Any]) -> int:
    """Receive time of a message, ns since the epoch.

    It is the present if the middleware does not provide it or the clock was set.
    """
    now = time.time_ns()
    received = info["received_timestamp"]
    return int(received) if now - _OLDEST <= received <= now + _NEWEST else now
