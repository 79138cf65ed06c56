"""The child in the ROS environment: polls the graph, subscribes, passes messages on.

It reports each topic and type with publishers; the recorder decides which to subscribe to.
One thread does everything except reading the recorder's commands.

Child and recorder come from one installation and share one socket. The child sends frames: kind
and length, then the body: a message, or a JSON object. The recorder sends lines of JSON. At the
end of its input the child passes on its remaining messages and ends. While the recorder does not
read, the child waits, and messages wait in the queue of the middleware.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import threading
import time
from collections import deque
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.ros2.child.definitions import (
    Definition,
    Definitions,
    UnknownTypeError,
    parse_type,
    share_folders,
)
from hybridlog.live.sources.ros2.child.middleware import (
    DEPTH,
    DEPTH_OF_BYTES,
    Middleware,
    Offer,
    Profile,
    Subscription,
    offered_text,
    publisher_id,
    request,
)
from hybridlog.live.sources.sequence_gaps import (
    MODULUS,
    SequenceGapDetector,
)

if TYPE_CHECKING:
    from collections.abc import Sequence


EVENT = 1
"""Body: a JSON object; its `event` names the kind of event."""

MESSAGE = 2
"""Body: one `ENTRY`, then the payload."""

HEADER = struct.Struct("<II")
"""Kind of the frame, and length of its body in bytes."""

ENTRY = struct.Struct("<Iqqq")
"""Channel, receive and send time (ns since the epoch), sequence number.

The send time is 0 and the number -1 if the middleware does not know them.
"""

_BATCH = 1 << 18
_LARGE = 32 << 10
_MAX_REPORTS = 10_000  # different ones


class Outbox:
    """Packs messages and events into frames, and sends them; small messages are sent together."""

    def __init__(self, peer: socket.socket) -> None:
        self._peer = peer
        self._batch: list[bytes] = []
        self._small = 0  # bytes of payloads in the batch
        self._channels = 0
        self._said: set[str] = set()

    def message(self, channel: int, payload: bytes, received: int, sent: int, number: int) -> None:
        """Sends a message, now or with the next ones; the arguments are those of `ENTRY`."""
        size = len(payload)
        head = HEADER.pack(MESSAGE, ENTRY.size + size) + ENTRY.pack(channel, received, sent, number)
        if size >= _LARGE:
            self.flush()
            self._peer.sendall(head)
            self._peer.sendall(payload)
            return
        self._batch += (head, payload)
        self._small += size
        if self._small >= _BATCH:
            self.flush()

    def flush(self) -> None:
        """Sends the small messages so far."""
        if self._batch:
            self._peer.sendall(b"".join(self._batch))
            self._batch.clear()
            self._small = 0

    def event(self, kind: str, **values: object) -> None:
        """Sends an event after all messages so far."""
        self.flush()
        body = json.dumps({"event": kind, **values}).encode("ascii")
        self._peer.sendall(HEADER.pack(EVENT, len(body)) + body)

    def channel(
        self, topic: str, kind: str, definition: Definition, offered: str, type_hash: str
    ) -> int:
        """Announces a channel for the messages of a topic; returns its number."""
        number, self._channels = self._channels, self._channels + 1
        self.event(
            "channel",
            number=number,
            topic=topic,
            type=kind,
            encoding=definition.encoding,
            definition=definition.text.decode("utf-8", "surrogateescape"),
            offered=offered,
            hash=type_hash,
        )
        return number

    def lost(
        self,
        topic: str,
        cause: str,
        count: int | None,
        *,
        times: Sequence[int] = (),
        detail: str = "",
    ) -> None:
        """Reports lost messages; `cause` is a value of `base.Cause`, `count` None if unknown.

        `times` are begin and end of the loss, ns since the epoch; without, it is now.
        """
        first, last = times or (time.time_ns(),) * 2
        values = {"count": count, "first": first, "last": last, "detail": detail}
        self.event("lost", topic=topic, cause=cause, **values)

    def say(self, text: str) -> None:
        """Reports a problem to the user, each text once."""
        if text not in self._said and len(self._said) < _MAX_REPORTS:
            self._said.add(text)
            self.event("say", text=text)


MAX_TOPICS = 10_000
"""Maximum number of topics and types; further ones are ignored."""

_TRY_AGAIN_S = 10.0
_MIXED = "mixed"


MAX_PUBLISHERS = 1024
"""Maximum number of publishers of a topic whose numbers are remembered after they are gone."""

MAX_GAP = MODULUS // 2
"""Largest number of missing messages; a number that is further on is one that went back."""

_MAX_MESSAGES = 1000
_BYTES_AT_ONCE = 8 << 20
_OLDEST = 60_000_000_000
_NEWEST = 1_000_000_000
_MAX_INT = 2**63 - 1


class Topic:
    """A topic and type that has, or had, publishers.

    Attributes:
        definition: Definition of the type, None if unknown.
        subscription: None without one.
        channel: Number of the channel of its messages; -1 before there is one.
        version: Hash of the type of the channel; `_MIXED` if publishers differ.
        profiles: Profiles that publishers have offered for the channel.
        numbered: Messages have numbers; True until one does not.
        gaps: The numbers of each publisher.
        tried_at: Monotonic time of the last attempt to subscribe.
    """

    def __init__(self, name: str, kind: str) -> None:
        self.name = name
        self.kind = kind
        self.offers: list[Offer] = []
        self.is_wanted = False
        self.definition: Definition | None = None
        self.subscription: Subscription | None = None
        self.channel = -1
        self.version = ""
        self.profiles: set[Profile] = set()
        self.numbered = True
        self.gaps: dict[bytes, SequenceGapDetector] = {}
        self.tried_at = 0.0

    def take(self, outbox: Outbox) -> tuple[int, int]:
        """Takes messages, up to a limit for other topics' sake; returns number and bytes."""
        assert self.subscription is not None
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
        gaps = self.gaps.get(publisher)
        if gaps is None:
            gaps = SequenceGapDetector()
            if publisher:
                gaps = SequenceGapDetector(trust_after=0, confirm_after=0, max_gap=MAX_GAP)
            self.gaps[publisher] = gaps
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


def _received(info: dict[str, Any]) -> int:
    """Receive time of a message, ns since the epoch.

    It is the present if the middleware does not provide it or the clock was set.
    """
    now = time.time_ns()
    received = info["received_timestamp"]
    return int(received) if now - _OLDEST <= received <= now + _NEWEST else now


_LOOK_S = 0.5
_FIRST_LOOKS_S = 0.1
_EAGER_S = 3.0
_IDLE_S = 0.5
_PAUSE_S = 0.001
_SMALL_COUNT = 64
_SMALL_BYTES = 1 << 20
_SHORT_WAIT_S = 0.01
_DRAIN_S = 0.5
_LEAVE_S = 4.0


class Child:
    """Follows the topics of the graph, and moves messages from ROS into the socket."""

    def __init__(self, middleware: Middleware, outbox: Outbox, definitions: Definitions) -> None:
        self._middleware = middleware
        self._outbox = outbox
        self._definitions = definitions
        self._topics: dict[tuple[str, str], Topic] = {}
        self._owners: dict[Subscription, Topic] = {}
        self._commands: deque[dict[str, Any]] = deque()
        self._is_stopping = False

    # From other threads.

    def command(self, command: dict[str, Any]) -> None:
        """Takes a command of the recorder."""
        self._commands.append(command)
        self._middleware.wake()

    def stop(self) -> None:
        """Ends `run` soon, after it has passed on all received messages."""
        self._is_stopping = True
        self._middleware.wake()

    # The main thread.

    def run(self) -> None:
        """Works until it is stopped; OSError if the recorder has ended."""
        began = next_look = time.monotonic()
        while not self._is_stopping:
            while self._commands:
                command = self._commands.popleft()
                self.subscribe(str(command.get("subscribe")), str(command.get("type")))
            now = time.monotonic()
            if now >= next_look:
                self.look()
                # A new recorder needs the existing topics at once.
                next_look = now + (_FIRST_LOOKS_S if now - began < _EAGER_S else _LOOK_S)
            count, size = self._take(max(0.0, min(_IDLE_S, next_look - time.monotonic())))
            if count < _SMALL_COUNT and size < _SMALL_BYTES:
                # A short pause, so that messages come in batches and not one per wake-up.
                time.sleep(_PAUSE_S)
        deadline = time.monotonic() + _DRAIN_S
        while self._take(_SHORT_WAIT_S)[0] >= _SMALL_COUNT and time.monotonic() < deadline:
            pass
        self.account(final=True)
        self._outbox.event("bye")

    def _take(self, wait: float) -> tuple[int, int]:
        """Takes messages, and waits `wait` seconds at most; returns their number and bytes."""
        count = size = 0
        for topic in [self._owners[found] for found in self._middleware.wait(wait)]:
            try:
                taken, taken_size = topic.take(self._outbox)
            except Exception as error:
                # rclpy raises errors of many kinds; each costs one message.
                self._outbox.lost(topic.name, "unreadable", 1, detail=str(error))
                self._outbox.say(f"{topic.name}: a message cannot be taken from ROS: {error}")
                continue
            count += taken
            size += taken_size
        self._outbox.flush()
        return count, size

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
        if topic.subscription is None:
            del self._topics[topic.name, topic.kind]
        if had and topic.is_wanted:
            others = (other for other in self._topics.values() if other.name == topic.name)
            if not any(other.offers and other.is_wanted for other in others):
                self._outbox.event("gone", topic=topic.name)

    def _update(self, topic: Topic, before: list[Offer]) -> None:
        """Handles the publishers of a wanted topic."""
        if not before:
            self._outbox.event("topic", topic=topic.name, type=topic.kind)
        if topic.subscription is None:
            if time.monotonic() - topic.tried_at >= _TRY_AGAIN_S:
                self._subscribe(topic)
            return
        requested, wanted = topic.subscription.profile, self._wanted(topic)
        # Volatile and best effort have greater numbers: a new publisher offers less.
        is_less = wanted.reliability > requested.reliability
        is_less = is_less or wanted.durability > requested.durability
        if is_less or (not before and wanted != requested):
            self._subscribe(topic)
        else:
            self._set_channel(topic)

    def _wanted(self, topic: Topic) -> Profile:
        """A profile that is compatible with all publishers."""
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
        """Subscribes, perhaps again: what comes between is missing in the numbers of messages."""
        topic.tried_at = time.monotonic()
        try:
            for other in self._topics.values():  # a program has one type of a topic
                if other is topic or (other.name == topic.name and not other.offers):
                    self._close(other)
            topic.definition = self._definitions.find(topic.kind)
            kind = parse_type(topic.kind)
            found = self._middleware.subscribe(topic.name, kind, self._wanted(topic))
        except Exception as error:
            # rclpy raises errors of many kinds; each concerns only this topic.
            problem = f"rclpy cannot subscribe: {error or type(error).__name__}"
            problem = str(error) if isinstance(error, UnknownTypeError) else problem
            self._outbox.say(f"{topic.name}: {topic.kind} cannot be recorded: {problem}")
            self._outbox.lost(topic.name, "unreadable", None, detail=problem)
        else:
            topic.subscription = found
            self._owners[found] = topic
            self._set_channel(topic)

    def _close(self, topic: Topic) -> None:
        """Ends a subscription, if there is one, after its messages were taken."""
        if topic.subscription is not None:
            topic.take(self._outbox)
            closed, topic.subscription = topic.subscription, None
            del self._owners[closed]
            self._middleware.close_one(closed)

    def _set_channel(self, topic: Topic) -> None:
        """Announces a channel for other profiles, or another version of the type."""
        assert topic.definition is not None
        hashes = {offer.type_hash for offer in topic.offers}
        version = topic.version if not hashes else hashes.pop() if len(hashes) == 1 else _MIXED
        profiles = [offer.profile for offer in topic.offers]
        is_same = version == topic.version and topic.profiles.issuperset(profiles)
        if topic.channel >= 0 and is_same:
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
        topic.channel = self._outbox.channel(topic.name, topic.kind, definition, offered, told)

    def account(self, *, final: bool = False) -> None:
        """Reports losses in transport."""
        report = self._outbox.lost
        for topic in self._owners.values():
            nodes = {offer.publisher: offer.node for offer in topic.offers}
            if len(topic.offers) == 1:
                nodes[b""] = topic.offers[0].node
            for publisher, gaps in topic.gaps.items():
                node = nodes.get(publisher, "")
                detail = f"from {node}" if node else ""
                for gap in gaps.finish() if final else gaps.confirmed():
                    # A message in fragments has the time of its first one; others may be between.
                    times = min(gap.first, gap.last), max(gap.first, gap.last)
                    report(topic.name, "transport", gap.missing, times=times, detail=detail)
            if len(topic.gaps) > MAX_PUBLISHERS:
                topic.gaps = {key: gaps for key, gaps in topic.gaps.items() if key in nodes}
            if not topic.numbered:
                self._outbox.say(
                    "this ROS does not number messages, so losses in transport cannot be counted"
                )


def run(number: int) -> int:
    """The program, with the file descriptor of its socket; returns the exit code."""
    peer = socket.socket(fileno=number)
    peer.set_inheritable(False)
    outbox = Outbox(peer)
    try:
        middleware = Middleware()
    except Exception as error:
        # The recorder reports any error of ROS.
        why = f"{type(error).__name__}: {error}"
        outbox.event("failed", missing=isinstance(error, ImportError), why=why)
        return 1
    child = Child(middleware, outbox, Definitions(share_folders()))
    outbox.event("hello", middleware=middleware.implementation)
    signal.signal(signal.SIGTERM, lambda _number, _frame: child.stop())
    threading.Thread(target=_listen, args=(peer, child), daemon=True).start()
    try:
        child.run()
    except (BrokenPipeError, ConnectionResetError):
        # The recorder has died.
        return 1
    finally:
        middleware.close()
    return 0


def _listen(peer: socket.socket, child: Child) -> None:
    """Reads the recorder's commands until the end of input."""
    with suppress(OSError), peer.makefile("rb") as lines:
        for line in lines:
            child.command(json.loads(line))
    child.stop()
    # Even if the middleware hangs, the child must not outlive the recorder.
    time.sleep(_LEAVE_S)
    os._exit(1)
