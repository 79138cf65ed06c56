"""The recorder's end of the socket: turns frames of the child into calls of the sink."""

from __future__ import annotations

import io
import time
from json import dumps
from typing import TYPE_CHECKING, Any

from hybridlog.live.sources.base import Cause, Loss, one_line
from hybridlog.live.sources.ros2.child.outbox import (
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
_MAX_INT = 2**63 - 1


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
                    self._event(parse_object(_read(file, length)))
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

    def _event(self, event: dict[str, Any]) -> None:
        match event:
            case {"event": "candidate", "topic": str(topic), "type": str(kind)}:
                if self._sink.wants(topic, kind):
                    command = dumps({"subscribe": topic, "type": kind})
                    self._peer.sendall(command.encode("ascii") + b"\n")
            case {
                "event": "channel",
                "number": int(),
                "topic": str(),
                "type": str(),
                "encoding": str(),
                "definition": str(),
                "offered": str(),
                "hash": str(),
            }:
                self._channel(event)
            case {"event": "topic", "topic": str(topic), "type": str(kind)}:
                self.present.add(topic)
                self._sink.topic_came(topic, kind)
            case {"event": "gone", "topic": str(topic)}:
                self.present.discard(topic)
                self._sink.topic_gone(topic)
            case {
                "event": "lost",
                "topic": str(topic),
                "cause": str(cause),
                "count": int() | None as count,
                "first": int(first),
                "last": int(last),
                "detail": str(detail),
            } if cause in {*Cause} and all(0 <= n <= _MAX_INT for n in (count or 0, first, last)):
                self._sink.lost(Loss(Cause(cause), topic, count, first, last, one_line(detail)))
            case {"event": "say", "text": str(text)}:
                self._sink.say(one_line(f"ROS 2: {text}"))
            case {"event": "bye"}:
                self.said_bye = True
            case _:
                raise WireError(f"a malformed event: {one_line(repr(event))}")

    def _channel(self, event: dict[str, Any]) -> None:
        topic = event["topic"]
        try:
            definition = event["definition"].encode("utf-8", "surrogateescape")
        except UnicodeEncodeError as error:
            raise WireError("a definition that is not text") from error
        metadata = {"offered_qos_profiles": event["offered"]}
        if event["hash"]:
            metadata["topic_type_hash"] = event["hash"]
        channel = self._channels[event["number"]] = Channel(
            topic=topic,
            message_encoding="cdr",
            schema=Schema(event["type"], event["encoding"], definition),
            metadata=metadata,
            has_publish_time=True,
        )
        self._sink.expect(channel)
        self.subscribed.add(topic)
        since = self._outages.pop(topic, None)
        if since is not None:
            report_outage(self._sink, topic, since)


def report_outage(sink: Sink, topic: str, since: int) -> None:
    """Reports that a topic was not recorded from some time, ns since the epoch, until now."""
    detail = "the ROS 2 child had ended"
    sink.lost(Loss(Cause.CONNECTION, topic, None, since, max(since, time.time_ns()), detail))


def _read(file: io.BufferedIOBase, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise WireError("it ended in the middle of a frame")
    return data
