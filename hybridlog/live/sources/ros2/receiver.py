"""The recorder's end of the socket: turns frames of the child into calls of the sink."""

from __future__ import annotations

import io
import time
from json import dumps
from typing import TYPE_CHECKING, Annotated

import msgspec

from hybridlog.live.sources.base import Cause, Loss, one_line
from hybridlog.live.sources.ros2.child.wire import (
    ENTRY,
    EVENT,
    HEADER,
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
_Number = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]


class _Candidate(msgspec.Struct, tag_field="event", tag="candidate"):
    topic: str
    type: str


class _Channel(msgspec.Struct, tag_field="event", tag="channel"):
    number: _Number
    topic: str
    type: str
    encoding: str
    definition: str
    offered: str
    hash: str


class _Topic(msgspec.Struct, tag_field="event", tag="topic"):
    topic: str
    type: str


class _Gone(msgspec.Struct, tag_field="event", tag="gone"):
    topic: str


class _Lost(msgspec.Struct, tag_field="event", tag="lost"):
    topic: str
    cause: Cause
    count: _Number | None
    first: _Number
    last: _Number
    detail: str


class _Say(msgspec.Struct, tag_field="event", tag="say"):
    text: str


class _Bye(msgspec.Struct, tag_field="event", tag="bye"):
    pass


_Event = _Candidate | _Channel | _Topic | _Gone | _Lost | _Say | _Bye


class Receiver:
    """Reads from one child until it ends.

    Args:
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
        """Reads to the end; WireError for what breaks the protocol, OSError of the socket."""
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
                    self._event(_parsed(_read(file, length)))
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

    def _event(self, event: _Event) -> None:
        match event:
            case _Candidate(topic, kind):
                if self._sink.wants(topic, kind):
                    command = dumps({"subscribe": topic, "type": kind})
                    self._peer.sendall(command.encode("ascii") + b"\n")
            case _Channel():
                self._channel(event)
            case _Topic(topic, kind):
                self.present.add(topic)
                self._sink.topic_came(topic, kind)
            case _Gone(topic):
                self.present.discard(topic)
                self._sink.topic_gone(topic)
            case _Lost(topic, cause, count, first, last, detail):
                self._sink.lost(Loss(topic, cause, count, first, last, one_line(detail)))
            case _Say(text):
                self._sink.say(one_line(f"ROS 2: {text}"))
            case _Bye():
                self.said_bye = True

    def _channel(self, event: _Channel) -> None:
        try:
            definition = event.definition.encode("utf-8", "surrogateescape")
        except UnicodeEncodeError as error:
            raise WireError("a definition that is not text") from error
        metadata = {"offered_qos_profiles": event.offered}
        if event.hash:
            metadata["topic_type_hash"] = event.hash
        channel = self._channels[event.number] = Channel(
            topic=event.topic,
            message_encoding="cdr",
            schema=Schema(event.type, event.encoding, definition),
            metadata=metadata,
            has_publish_time=True,
        )
        self._sink.expect(channel)
        self.subscribed.add(event.topic)
        since = self._outages.pop(event.topic, None)
        if since is not None:
            report_outage(self._sink, event.topic, since)


def report_outage(sink: Sink, topic: str, since: int) -> None:
    """Reports that a topic was not recorded from some time, ns since the epoch, until now."""
    detail = "the ROS 2 child had ended"
    sink.lost(Loss(topic, Cause.CONNECTION, None, since, max(since, time.time_ns()), detail))


def _read(file: io.BufferedIOBase, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise WireError("it ended in the middle of a frame")
    return data


def _parsed(body: bytes) -> _Event:
    """The event in the body of a frame; a definition may have surrogates, so `json` reads it."""
    try:
        event: _Event = msgspec.convert(parse_object(body), _Event)
    except msgspec.ValidationError as error:
        raise WireError(f"a malformed event: {error}") from error
    return event
