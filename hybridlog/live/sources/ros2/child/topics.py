"""Follows the ROS graph: topics, their publishers, and subscriptions to them."""

from __future__ import annotations

import time
from functools import partial
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.definitions import UnknownTypeError, parse_type
from hybridlog.live.sources.ros2.child.middleware import (
    DEPTH,
    DEPTH_OF_ARRAYS,
    DEPTH_OF_BYTES,
    Profile,
    conflicts,
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
    from collections.abc import Callable, Collection, Mapping, Sequence

    from hybridlog.live.sources.ros2.child.definitions import Definition, Definitions
    from hybridlog.live.sources.ros2.child.middleware import Middleware, Offer, Subscription
    from hybridlog.live.sources.ros2.child.outbox import Outbox

MAX_TOPICS = 10_000
"""Maximum number of topics and types; further ones are ignored."""

_REPORT_S = 10.0


class Topic:
    """A topic and type that has, or had, publishers.

    Attributes:
        definition: Definition of the type, None if unknown.
        stream: The messages, None without a subscription.
        nodes: Names of the nodes of present and past publishers.
        channels: Numbers of the current channels, by hash of the type.
        profiles: Profiles that publishers have offered for these channels.
        problem: The reason why it cannot be subscribed to, or an empty string.
        reported_at: Monotonic time of the last report of the problem.
    """

    def __init__(self, name: str, kind: str) -> None:
        self.name = name
        self.kind = kind
        self.offers: list[Offer] = []
        self.is_wanted = False
        self.definition: Definition | None = None
        self.stream: Stream | None = None
        self.nodes: dict[bytes, str] = {}
        self.channels: dict[str, int] = {}
        self.profiles: dict[str, set[Profile]] = {}
        self.problem = ""
        self.reported_at = 0.0


class Topics:
    """All topics of the graph; follows its changes.

    Args:
        outbox: Takes events, and the messages of a subscription that is made anew.
        overrides: Fields of `Profile` by topic that the user has set.

    Attributes:
        owners: Topic of each subscription.
    """

    def __init__(
        self,
        middleware: Middleware,
        outbox: Outbox,
        definitions: Definitions,
        overrides: Mapping[str, Mapping[str, Any]],
    ) -> None:
        self.owners: dict[Subscription, Topic] = {}
        self._live: list[Topic] = []
        self._middleware = middleware
        self._outbox = outbox
        self._definitions = definitions
        self._overrides = overrides
        self._topics: dict[tuple[str, str], Topic] = {}

    def look(self) -> None:
        """Looks at the graph, follows its changes, and reports losses."""
        found = self._middleware.publishers()
        for name, reason in self._middleware.invalid.items():
            self._outbox.say(f"{name!r} is ignored, ROS cannot subscribe to it: {reason}")
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
        stream = topic.stream
        if stream is None:
            self._report_problem(topic)
            return
        known = {offer.publisher for offer in before}
        if any(offer.publisher not in known for offer in topic.offers):
            self._adapt(topic, stream, is_first=not before)
            if topic.stream is None:
                return
        self._set_channels(topic, stream, topic.offers)
        self._check(topic, stream, known)

    def _adapt(self, topic: Topic, stream: Stream, *, is_first: bool) -> None:
        """Adapts a subscription to new publishers."""
        requested, wanted = stream.subscription.profile, self._wanted(topic)
        is_incompatible = any(conflicts(offer.profile, requested) for offer in topic.offers)
        if wanted != requested and (is_incompatible or is_first):
            self._resubscribe(topic, stream, wanted)

    def _resubscribe(self, topic: Topic, stream: Stream, wanted: Profile) -> None:
        """Subscribes again, with a profile that is compatible with all publishers.

        What comes between the two subscriptions is missing in the numbers of the messages.
        """
        try:
            stream.take(self._outbox)
            stream.subscription.close()
            stream.subscription = self._middleware.subscribe(
                topic.name, parse_type(topic.kind), wanted
            )
        except Exception as error:
            # rclpy raises errors of many kinds; each concerns only this topic.
            topic.stream = None
            self._live.remove(topic)
            self._refuse(topic, f"rclpy cannot subscribe again: {error or type(error).__name__}")
        self._list()

    def _check(self, topic: Topic, stream: Stream, known: Collection[bytes]) -> None:
        """Reports incompatible publishers and different versions of the type.

        `known` are publishers of the last look: names of new ones come late.
        """
        for offer in topic.offers:
            reasons = conflicts(offer.profile, stream.subscription.profile)
            if reasons and offer.publisher in known:
                self._outbox.say(
                    f"{topic.name}: {offer.node or 'a publisher'} is incompatible: its "
                    f"{' and '.join(reasons)} does not satisfy the QoS overrides; change that "
                    "in the file"
                )
        assert topic.definition is not None
        hashes = {offer.type_hash for offer in topic.offers if offer.type_hash}
        if len(hashes) > 1 and not stream.named:
            self._outbox.say(
                f"{topic.name}: its publishers have different versions of {topic.kind}, and this "
                "rclpy does not tell their messages apart; the installed definition is recorded"
            )
        elif any(topic.definition.of(each) != topic.definition for each in hashes):
            self._outbox.say(
                f"{topic.name}: a publisher has another version of {topic.kind} than the one that "
                "is installed here; its messages are recorded without that definition. Source "
                "the workspace of the publisher for their fields"
            )

    def _wanted(self, topic: Topic) -> Profile:
        assert topic.definition is not None
        depth = DEPTH_OF_ARRAYS if topic.definition.has_arrays else DEPTH
        depth = DEPTH_OF_BYTES if topic.definition.has_bytes else depth
        override = self._overrides.get(topic.name, {})
        return request([offer.profile for offer in topic.offers], depth, override)

    def subscribe(self, name: str, kind: str) -> None:
        """Subscribes to a topic that the recorder wants."""
        topic = self._topics.get((name, kind))
        if topic is None or topic.is_wanted:
            return
        topic.is_wanted = True
        if topic.offers:
            self._outbox.event("topic", topic=topic.name, type=topic.kind)
        try:
            topic.definition = self._definitions.find(kind)
            found = self._middleware.subscribe(name, parse_type(kind), self._wanted(topic))
        except UnknownTypeError as error:
            self._refuse(topic, str(error))
            return
        except Exception as error:
            # rclpy raises errors of many kinds; each concerns only this topic.
            self._refuse(topic, f"rclpy cannot subscribe: {error or type(error).__name__}")
            return
        look_again = partial(self._look_again, topic)
        number = self._open_channel(topic, "", []) if not topic.offers else -1
        topic.stream = Stream(found, number, topic.offers, look_again)
        self._set_channels(topic, topic.stream, topic.offers)
        self._live.append(topic)
        self._list()

    def _list(self) -> None:
        """Updates `owners`."""
        self.owners = {t.stream.subscription: t for t in self._live if t.stream is not None}

    def _look_again(self, topic: Topic) -> None:
        """Looks at the publishers of a topic: a message of a new one has come."""
        try:
            found = self._middleware.offers(topic.name)
        except Exception as error:
            # rclpy raises errors of many kinds; the next look tells more.
            self._outbox.say(f"{topic.name}: its publishers are unknown for now: {error}")
            return
        assert topic.stream is not None
        offers = [offer for kind, offer in found if kind == topic.kind]
        self._set_channels(topic, topic.stream, offers)

    def _set_channels(self, topic: Topic, stream: Stream, offers: Sequence[Offer]) -> None:
        """Gives each version of the type a channel of its own, and a new one for new profiles.

        Messages of publishers that are not named share a channel.
        """
        versions: dict[str, list[Offer]] = {}
        for offer in offers:
            versions.setdefault(offer.type_hash, []).append(offer)
        if len(versions) > 1 and not stream.named:
            versions = {"": list(offers)}
        for type_hash, group in versions.items():
            profiles = [offer.profile for offer in group]
            if not topic.profiles.get(type_hash, set()).issuperset(profiles):
                topic.channels[type_hash] = self._open_channel(topic, type_hash, profiles)
            stream.channel = topic.channels[type_hash]
        stream.channels = {
            offer.publisher: topic.channels[type_hash]
            for type_hash, group in versions.items()
            for offer in group
        }

    def _open_channel(self, topic: Topic, type_hash: str, profiles: Sequence[Profile]) -> int:
        """Announces a channel, and returns its number."""
        assert topic.definition is not None
        topic.profiles.setdefault(type_hash, set()).update(profiles)
        definition, offered = topic.definition.of(type_hash), offered_text(profiles)
        return self._outbox.channel(topic.name, topic.kind, definition, offered, type_hash)

    def _refuse(self, topic: Topic, problem: str) -> None:
        topic.problem = problem
        topic.reported_at = -_REPORT_S
        self._outbox.say(f"{topic.name}: {topic.kind} cannot be recorded: {problem}")
        self._report_problem(topic)

    def _report_problem(self, topic: Topic) -> None:
        """Reports, now and then, that the messages of a topic without subscription are lost."""
        now = time.monotonic()
        if topic.problem and now - topic.reported_at >= _REPORT_S:
            topic.reported_at = now
            self._outbox.lost(topic.name, "unreadable", None, detail=topic.problem)

    def account(self, *, final: bool = False) -> None:
        """Reports losses in transport and in the outbox."""
        for topic in self._live:
            assert topic.stream is not None
            self._account(topic, topic.stream, final=final)
        self._outbox.report_refused()

    def _account(self, topic: Topic, stream: Stream, *, final: bool) -> None:
        if len(topic.nodes) > MAX_PUBLISHERS:
            topic.nodes.clear()
        topic.nodes.update((offer.publisher, offer.node) for offer in topic.offers if offer.node)
        for publisher, gap in stream.look(topic.offers, final=final):
            node = topic.nodes.get(publisher, "")
            if not stream.named and len(topic.offers) == 1:
                node = topic.offers[0].node
            # A message in fragments has the time of the first one, and others may come between.
            times = min(gap.first, gap.last), max(gap.first, gap.last)
            detail = f"from {node}" if node else ""
            self._outbox.lost(topic.name, "transport", gap.missing, times=times, detail=detail)
        if not stream.numbered:
            self._outbox.say(
                "this ROS does not number messages, so losses in transport cannot be counted"
            )
        if not stream.named and stream.numbered and len(topic.offers) > 1:
            self._outbox.say(
                f"{topic.name}: this rclpy does not name the publishers of messages, so losses "
                "in transport cannot be counted; ROS 2 Kilted names them"
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

    Args:
        look_again: Updates `channels`: a publisher is not among them.

    Attributes:
        subscription: The subscription; the owner closes it, and puts another in its place.
        named: Messages name their publisher; True until one does not.
        numbered: Messages have numbers; True until one does not.
        alone: The topic has had the same single publisher since its count began.
        channel: Number of the channel of publishers that are not in `channels`.
        channels: Numbers of channels by publisher.
    """

    def __init__(
        self,
        subscription: Subscription,
        channel: int,
        offers: Sequence[Offer],
        look_again: Callable[[], None],
    ) -> None:
        self.subscription = subscription
        self.channel = channel
        self.channels: dict[bytes, int] = {}
        self._look_again = look_again
        self._looked_for: set[bytes] = set()
        self.named = True
        self.numbered = True
        self.alone = len(offers) == 1
        self._gaps: dict[bytes, SequenceGapDetector] = {}
        self._unsure: list[tuple[bytes, SequenceGap]] = []  # they wait for a look at the graph
        self._publishers = frozenset(offer.publisher for offer in offers)

    def take(self, outbox: Outbox) -> tuple[int, int]:
        """Takes messages, up to a limit for other topics' sake; returns number and bytes."""
        take, put = self.subscription.take, outbox.message
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
            gid = info.get("publisher_gid")
            if gid is None:
                self.named = False
                publisher, is_usable = b"", self.alone and number >= 0
                channel = self.channel
            else:
                publisher, is_usable = publisher_id(gid["data"]), number >= 0
                found = self.channels.get(publisher)
                channel = self._meet(publisher) if found is None else found
            if is_usable:
                self._count(publisher, number, received)
            sent = info["source_timestamp"]
            put(channel, payload, received, sent if 0 < sent <= _MAX_INT else 0, number)
        return count, size

    def _count(self, publisher: bytes, number: int, received: int) -> None:
        gaps = self._gaps.get(publisher)
        if gaps is None:
            gaps = SequenceGapDetector(trust_after=0, confirm_after=0, max_gap=MAX_GAP)
            self._gaps[publisher] = gaps
        # A number that goes back is a late message, which is no loss.
        if gaps.expected < 0 or (number - gaps.expected) % MODULUS <= MAX_GAP:
            gaps.see(number % MODULUS, received)

    def _meet(self, publisher: bytes) -> int:
        """The channel of a publisher that came after the last look at the graph."""
        if publisher not in self._looked_for:
            if len(self._looked_for) >= MAX_PUBLISHERS:
                self._looked_for.clear()
            self._looked_for.add(publisher)
            self._look_again()
        return self.channels.get(publisher, self.channel)

    def _number(self, info: dict[str, Any]) -> int:
        """The sequence number of a message, -1 without one."""
        number = info.get("publication_sequence_number")
        if number is None or not 0 <= number <= _MAX_INT:
            self.numbered = False
            return -1
        return int(number)

    def look(
        self, offers: Sequence[Offer], *, final: bool = False
    ) -> list[tuple[bytes, SequenceGap]]:
        """Losses since the last call, by publisher; called at each look at the graph."""
        found = [
            (publisher, joined_gap(lost))
            for publisher, gaps in self._gaps.items()
            if (lost := gaps.confirmed())
        ]
        publishers = frozenset(offer.publisher for offer in offers)
        if not self.named:
            self.alone = len(offers) == 1 and publishers == self._publishers
            if not self.alone:
                self._gaps.clear()
                found = self._unsure = []
            elif not final:
                # Another publisher may have sent before the graph shows it.
                found, self._unsure = self._unsure, found
            else:
                found = self._unsure + found
        self._publishers = publishers
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
