"""The recorder's end of the socket: turns frames of the child into calls of the sink."""

from __future__ import annotations

import io
import time
from json import dumps
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.base import Cause, Loss, one_line
from hybridlog.live.sources.ros2.child.wire import (
    COUNT,
    ENTRY,
    EVENT,
    HEADER,
    MESSAGES,
    WireError,
    check_frame,
    parse_object,
)
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    import socket

    from hybridlog.live.sources.base import Sink

# Reads of whole multiples of this size bypass the buffer.
_BUFFER = 32 << 10
_CAUSES = {
    "transport": Cause.TRANSPORT,
    "queue": Cause.QUEUE,
    "unreadable": Cause.UNREADABLE,
}
_MAX_INT = 2**63


class Receiver:
    """Reads from one child until it ends.

    Args:
        peer: The socket to the child.
        sink: Takes messages and events.
        outages: Topics that an earlier child recorded, with the time of its end, ns since
            the epoch. Topics that are recorded again are removed.

    Attributes:
        subscribed: Topics that the child has subscribed to.
        present: Topics with publishers, as reported to the sink.
        last_received: Time of the last frame, ns since the epoch.
        said_bye: The child has ended regularly.
    """

    def __init__(self, peer: socket.socket, sink: Sink, outages: dict[str, int]) -> None:
        self._peer = peer
        self._sink = sink
        self._outages = outages
        self._channels: dict[int, Channel] = {}
        self.subscribed: set[str] = set()
        self.present: set[str] = set()
        self.last_received = time.time_ns()
        self.said_bye = False

    def run(self) -> None:
        """Reads to the end.

        Raises:
            WireError: The child violates the protocol, or ends in the middle of a frame.
            OSError: The socket is broken.
        """
        # A large payload is read directly into the bytes object for the sink, without a
        # copy.
        raw = io.FileIO(self._peer.fileno(), closefd=False)
        with io.BufferedReader(raw, _BUFFER) as file:
            while header := file.read(HEADER.size):
                if len(header) < HEADER.size:
                    raise WireError("it ended in the middle of a frame")
                kind, length = HEADER.unpack(header)
                check_frame(kind, length)
                if kind == EVENT:
                    self._event(parse_object(_read(file, length)))
                elif kind == MESSAGES:
                    self._messages(_read(file, length))
                else:
                    self._message(file, length)
                self.last_received = time.time_ns()

    def _message(self, file: io.BufferedIOBase, length: int) -> None:
        number, size, received, sent, sequence = ENTRY.unpack(_read(file, ENTRY.size))
        if size != length - ENTRY.size:
            raise WireError("a payload that is not as long as its frame")
        channel = self._channels.get(number)
        if channel is None:
            raise WireError("a message of an unknown channel")
        self._sink.take(
            channel,
            _read(file, size),
            received=received,
            sent=sent or None,
            sequence=sequence if sequence >= 0 else None,
        )

    def _messages(self, body: bytes) -> None:
        count = COUNT.unpack_from(body)[0]
        at = COUNT.size + count * ENTRY.size
        if at > len(body):
            raise WireError("more messages than the frame has room for")
        take = self._sink.take
        channels = self._channels
        for number, size, received, sent, sequence in ENTRY.iter_unpack(
            memoryview(body)[COUNT.size : at]
        ):
            end = at + size
            if end > len(body) or number not in channels:
                raise WireError("a message longer than its frame, or of an unknown channel")
            take(
                channels[number],
                body[at:end],
                received=received,
                sent=sent or None,
                sequence=sequence if sequence >= 0 else None,
            )
            at = end

    # Events.

    def _event(self, event: dict[str, Any]) -> None:
        kind = event.get("event")
        if kind == "candidate":
            self._candidate(_text(event, "topic"), _text(event, "type"))
        elif kind == "channel":
            self._channel(event)
        elif kind == "topic":
            topic = _text(event, "topic")
            self.present.add(topic)
            self._sink.topic_came(topic, _text(event, "type"), _number(event, "publishers"))
        elif kind == "gone":
            topic = _text(event, "topic")
            self.present.discard(topic)
            self._sink.topic_gone(topic)
        elif kind == "lost":
            self._lost(event)
        elif kind == "say":
            self._sink.say(one_line(f"ROS 2: {_text(event, 'text')}"))
        elif kind == "bye":
            self.said_bye = True
        else:
            raise WireError("an unknown event")

    def _candidate(self, topic: str, kind: str) -> None:
        if self._sink.wants(topic, kind):
            command = dumps({"subscribe": topic, "type": kind})
            self._peer.sendall(command.encode("ascii") + b"\n")

    def _channel(self, event: dict[str, Any]) -> None:
        topic = _text(event, "topic")
        try:
            definition = _text(event, "definition").encode("utf-8", "surrogateescape")
        except UnicodeEncodeError as error:
            raise WireError("a definition that is not text") from error
        metadata = {"offered_qos_profiles": _text(event, "offered")}
        type_hash = _text(event, "hash")
        if type_hash:
            metadata["topic_type_hash"] = type_hash
        number = _number(event, "number")
        self._channels[number] = Channel(
            topic=topic,
            message_encoding="cdr",
            schema=Schema(_text(event, "type"), _text(event, "encoding"), definition),
            metadata=metadata,
            has_publish_time=True,
        )
        self._sink.expect(self._channels[number])
        self.subscribed.add(topic)
        since = self._outages.pop(topic, None)
        if since is not None:
            report_outage(self._sink, topic, since)

    def _lost(self, event: dict[str, Any]) -> None:
        cause = _CAUSES.get(_text(event, "cause"))
        if cause is None:
            raise WireError("a loss without a cause")
        count = None if event.get("count") is None else _number(event, "count")
        self._sink.lost(
            Loss(
                _text(event, "topic"),
                cause,
                count,
                first=_number(event, "first"),
                last=_number(event, "last"),
                detail=one_line(_text(event, "detail")),
            )
        )


def report_outage(sink: Sink, topic: str, since: int) -> None:
    """Reports that a topic was not recorded from some time until now.

    Args:
        sink: Takes the report.
        topic: The topic.
        since: Begin of the outage, ns since the epoch.
    """
    detail = "the ROS 2 child had ended"
    sink.lost(Loss(topic, Cause.CONNECTION, None, since, max(since, time.time_ns()), detail))


def _read(file: io.BufferedIOBase, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise WireError("it ended in the middle of a frame")
    return data


def _text(event: dict[str, Any], name: str) -> str:
    value = event.get(name)
    if not isinstance(value, str):
        raise WireError(f"an event without {name}")
    return value


def _number(event: dict[str, Any], name: str) -> int:
    value = event.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < _MAX_INT:
        raise WireError(f"an event without {name}")
    return value
