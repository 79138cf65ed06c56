"""Connects to a Foxglove server; channels and subscriptions of one connection."""

from __future__ import annotations

import re
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from struct import Struct
from typing import Final

from hybridlog.live.sources.base import Cause, Loss, Sink, one_line
from hybridlog.live.sources.foxglove.connection import Connection
from hybridlog.live.sources.foxglove.handshake import StoppedError, open_websocket, websocket_uri
from hybridlog.live.sources.foxglove.protocol import (
    Address,
    Advertised,
    PeerError,
    parse_channel,
    parse_text,
    subscribe,
    unsubscribe,
)
from hybridlog.live.sources.sequence_gaps import (
    SequenceGap,
    SequenceGapDetector,
    has_sequence_numbers,
    joined_gap,
)
from hybridlog_storage.messages import Channel

_MAX_CHANNELS: Final = 1 << 16
_MAX_RETIRED: Final = 1 << 12
_MAX_NS: Final = 1 << 63
_MAX_COMPLAINTS: Final = 100
_NO_CHANNEL = re.compile(
    r"(?i)unknown channel\D{0,20}(\d{1,20})\b|channel\D{0,20}(\d{1,20}) is not available"
)
_MAX_REFUSALS: Final = 20
_RETRY_S: Final = 0.02
_NUMBER: Final = Struct("<I").unpack_from


class Notifier:
    """Reports problems of one server to the user, one line each."""

    def __init__(self, sink: Sink, name: str) -> None:
        self._sink = sink
        self._name = name
        self._complaints = 0

    def say(self, text: str) -> None:
        """Report a problem; the text may quote the server."""
        self._sink.say(f"{self._name}: {one_line(text)}")

    def complain(self, text: str) -> None:
        """Report a problem that the server can cause any number of times, up to a limit."""
        self._complaints += 1
        if self._complaints <= _MAX_COMPLAINTS:
            self.say(text)
        elif self._complaints == _MAX_COMPLAINTS + 1:
            self.say(f"has caused {_MAX_COMPLAINTS} complaints; further ones are not shown")


@dataclass(slots=True)
class _Subscription:
    """A subscription to a channel.

    Attributes:
        number: Number of the subscription.
        offer: The channel.
        refusals: Number of times that the server refused it.
    """

    number: int
    offer: Advertised
    refusals: int = 0


class Session:
    """The channels and subscriptions of one connection.

    Args:
        sink: Takes the messages.
        notifier: Reports problems.
        send: Sends a JSON message.
        missed: Topics of an earlier connection, with the time of its end, ns since the
            epoch. Topics that are available again are removed.
    """

    def __init__(
        self,
        sink: Sink,
        notifier: Notifier,
        send: Callable[[str], None],
        missed: dict[str, int],
    ) -> None:
        self._sink = sink
        self._take = sink.take
        self._notifier = notifier
        self._send = send
        self._missed = missed
        self._next = 0
        self._routes: dict[int, tuple[Channel, SequenceGapDetector | None]] = {}
        self._subscriptions: dict[int, _Subscription] = {}
        self._topics: dict[str, int] = {}
        self._retired: deque[int] = deque()
        self._is_full = False
        self._retries: set[int] = set()
        self._retry_at = 0.0

    # Messages.

    def data(self, subscription: int, log_time: int, payload: bytes) -> None:
        """Take a message."""
        route = self._routes.get(subscription)
        if route is None:
            self._ignored("of an unknown subscription")
            self._notifier.complain("sends messages of an unknown subscription; they are ignored")
            return
        channel, gaps = route
        received = time.time_ns()
        if log_time >= _MAX_NS:
            self._notifier.complain(
                f"gives {channel.topic!r} a time after the year 2262; it is replaced by the "
                "receive time"
            )
            log_time = received
        self._take(channel, payload, received=received, sent=log_time)
        if gaps is not None and len(payload) >= 4:
            gaps.see(_NUMBER(payload)[0], received)
            if gaps.waiting:
                self._report(channel.topic, gaps.confirmed())

    def time(self, now: int) -> None:
        """Take the server's time: that of a simulation, or of a log that it plays."""
        self._sink.clock(now, received=time.time_ns())

    def too_large(self, subscription: int, size: int) -> None:
        """Note a skipped message that is larger than the limit."""
        topic = self._topic_of(subscription)
        if topic is None:
            return
        now = time.time_ns()
        detail = f"a message of {size} bytes exceeds the limit of this source"
        self._sink.lost(Loss(topic, Cause.UNREADABLE, 1, now, now, detail))
        self._notifier.complain(
            f"{topic!r} has messages that exceed the limit of this source; they are skipped"
        )

    def cut(self, subscription: int) -> None:
        """Note that the connection broke in the middle of a message."""
        topic = self._topic_of(subscription)
        if topic is not None:
            now = time.time_ns()
            detail = "the connection broke in the middle of a message"
            self._sink.lost(Loss(topic, Cause.CONNECTION, 1, now, now, detail))

    def broken(self, reason: str) -> None:
        """Note a malformed binary message."""
        self._ignored("too short for a message")
        self._notifier.complain(f"sends {reason}; it is ignored")

    def _ignored(self, detail: str) -> None:
        """Note a lost message of an unknown topic."""
        now = time.time_ns()
        self._sink.lost(Loss("", Cause.UNREADABLE, 1, now, now, detail))

    def _topic_of(self, subscription: int) -> str | None:
        route = self._routes.get(subscription)
        return None if route is None else route[0].topic

    # JSON messages.

    def text(self, data: bytes) -> None:
        """Handle a JSON message; operations that do not matter to a recorder are ignored."""
        try:
            message = parse_text(data)
        except PeerError as error:
            self._notifier.complain(str(error))
            return
        match message["op"]:
            case "advertise":
                self._advertise(message.get("channels"))
            case "unadvertise":
                self._unadvertise(message.get("channelIds"))
            case "status":
                self._status(str(message.get("message")))

    def _advertise(self, channels: object) -> None:
        if not isinstance(channels, list):
            self._notifier.complain("advertises something else than a list of channels")
            return
        wanted: dict[int, int] = {}
        for entry in channels:
            try:
                offer = parse_channel(entry)
            except PeerError as error:
                self._notifier.complain(str(error))
                continue
            number = self._offered(offer)
            if number is not None:
                wanted[number] = offer.id
        if wanted:
            self._send(subscribe(wanted))

    def _offered(self, offer: Advertised) -> int | None:
        """Number of a new subscription to a channel, None if it needs none."""
        topic = offer.channel.topic
        known = self._subscriptions.get(offer.id)
        if known is not None:
            if _are_equal(known.offer.channel, offer.channel):
                return None
            self._send(unsubscribe(known.number))
            self._retire(offer.id)
        if not self._sink.wants(topic, offer.type_name):
            return None
        if len(self._subscriptions) >= _MAX_CHANNELS:
            if not self._is_full:
                self._notifier.say(f"has more than {_MAX_CHANNELS} channels; the rest is ignored")
            self._is_full = True
            return None
        if offer.problem:
            self._notifier.complain(
                f"the definition of {topic!r} {offer.problem}; its messages are recorded, but "
                "their fields cannot be searched"
            )
        gaps = SequenceGapDetector() if has_sequence_numbers(offer.channel) else None
        number = self._next
        self._next += 1
        self._subscriptions[offer.id] = _Subscription(number, offer)
        self._routes[number] = (offer.channel, gaps)
        self._topics[topic] = self._topics.get(topic, 0) + 1
        self._sink.topic_came(topic, offer.type_name, self._topics[topic])
        self._sink.expect(offer.channel)
        since = self._missed.pop(topic, None)
        if since is not None:
            detail = "the connection was down; messages of this time are unknown"
            self._sink.lost(Loss(topic, Cause.CONNECTION, None, since, time.time_ns(), detail))
        return number

    def _unadvertise(self, channels: object) -> None:
        if not isinstance(channels, list):
            self._notifier.complain("unadvertises something else than a list of channels")
            return
        for number in channels:
            if type(number) is int and number in self._subscriptions:
                self._retire(number)

    def _retire(self, channel_id: int) -> None:
        """Remove a channel. Late messages of it are still recorded."""
        gone = self._subscriptions.pop(channel_id)
        self._is_full = False
        self._retired.append(gone.number)
        if len(self._retired) > _MAX_RETIRED:
            self._routes.pop(self._retired.popleft(), None)
        topic = gone.offer.channel.topic
        self._topics[topic] -= 1
        if self._topics[topic]:
            self._sink.topic_came(topic, gone.offer.type_name, self._topics[topic])
        else:
            del self._topics[topic]
            self._sink.topic_gone(topic)

    def _status(self, text: str) -> None:
        """Handle a status message: retry a refused subscription, or show it to the user.

        A server may advertise a channel a moment before it accepts subscriptions.
        """
        found = _NO_CHANNEL.search(text)
        refused = self._subscriptions.get(int(found[found.lastindex or 1])) if found else None
        if refused is None:
            self._notifier.complain(f"says: {text}")
            return
        refused.refusals += 1
        if refused.refusals > _MAX_REFUSALS:
            topic = refused.offer.channel.topic
            self._notifier.complain(f"offers {topic!r}, but does not send it ({text})")
            return
        self._retries.add(refused.offer.id)
        self._retry_at = time.monotonic() + _RETRY_S * (refused.refusals - 1)
        self.look()

    def look(self) -> None:
        """Retry refused subscriptions when it is time."""
        if not self._retries or time.monotonic() < self._retry_at:
            return
        wanted = {
            self._subscriptions[number].number: number
            for number in self._retries
            if number in self._subscriptions
        }
        self._retries.clear()
        if wanted:
            self._send(subscribe(wanted))

    def _report(self, topic: str, gaps: list[SequenceGap]) -> None:
        """Notes messages that a publisher counted and that never came, in one row."""
        if gaps:
            gap = joined_gap(gaps)
            detail = f"header.seq went from {gap.before} to {gap.after}"
            self._sink.lost(Loss(topic, Cause.TRANSPORT, gap.missing, gap.first, gap.last, detail))

    def end(self, *, is_stopped: bool) -> None:
        """End the session.

        Args:
            is_stopped: The source was stopped; otherwise the connection ended.
        """
        now = time.time_ns()
        for channel, gaps in self._routes.values():
            if gaps is not None:
                self._report(channel.topic, gaps.finish())
        for topic in self._topics:
            if not is_stopped and len(self._missed) < _MAX_CHANNELS:
                self._missed[topic] = now
            self._sink.topic_gone(topic)
        self._topics.clear()
        self._subscriptions.clear()
        self._routes.clear()


def _are_equal(one: Channel, other: Channel) -> bool:
    """Tells whether two channels are equal."""
    return (one.topic, one.message_encoding, one.schema, one.metadata) == (
        other.topic,
        other.message_encoding,
        other.schema,
        other.metadata,
    )


_PAUSES_S: Final = (0.5, 1.0, 2.0, 4.0, 8.0, 15.0)
_STABLE_S: Final = 10.0  # after a connection of this length the pauses are short again


class Client:
    """The client, which runs in the thread of a Foxglove source.

    Raises:
        UsageError: The address is invalid.
    """

    def __init__(
        self,
        sink: Sink,
        address: Address,
        max_message_bytes: int,
        stop: threading.Event,
        reached: Callable[[], None],
    ) -> None:
        websocket_uri(address)
        self._sink = sink
        self._notifier = Notifier(sink, address.shown)
        self._address = address
        self._limit = max_message_bytes
        self._stop = stop
        self._reached = reached
        self._missed: dict[str, int] = {}

    def run(self) -> None:
        """Connect, read and reconnect until stopped."""
        try:
            self._run()
        except BaseException as error:
            if not self._stop.is_set():
                self._sink.ended(f"{self._address.shown}: reading failed ({error!r})")
            raise

    def _run(self) -> None:
        failures = 0
        while not self._stop.is_set():
            began = time.monotonic()
            reason = self._connect()
            if self._stop.is_set():
                return
            self._notifier.say(f"{reason}; trying again")
            if time.monotonic() - began > _STABLE_S:
                failures = 0
            self._stop.wait(_PAUSES_S[min(failures, len(_PAUSES_S) - 1)])
            failures += 1

    def _connect(self) -> str:
        """Make one connection, and read it to its end.

        Returns:
            The reason of the end, for the user.
        """
        try:
            opened = open_websocket(self._address, self._stop.is_set)
            with opened.socket:
                self._reached()
                connection = Connection(opened, self._limit, self._stop.is_set)
                session = Session(self._sink, self._notifier, connection.send, self._missed)
                try:
                    return connection.read(session)
                finally:
                    session.end(is_stopped=self._stop.is_set())
        except PeerError as error:
            return str(error)
        except StoppedError:
            return ""
