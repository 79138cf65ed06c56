"""Protocol between the child and the recorder, and the child's queue, in bounded memory.

Both ends come from one installation and share one socket. The child sends frames: kind and length,
then the body: a message, or a JSON object. The recorder sends lines of JSON. At the end of its
input the child passes on its remaining messages and ends.

Writes to the socket do not block. While the recorder does not read, the outbox fills up.
Messages that do not fit are counted by channel.
"""

from __future__ import annotations

import json
import socket
import struct
import time
from collections import deque
from itertools import islice
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.live.sources.ros2.child.definitions import Definition

BUDGET = 256 << 20
"""Maximum number of queued bytes."""

_BATCH = 1 << 20
_LARGE = 32 << 10
_MAX_BUFFERS = 64
_MAX_REPORTS = 10_000  # different ones


class Outbox:
    """Packs messages and events into frames, and sends them.

    Args:
        peer: The socket; it becomes non-blocking.
        budget: Maximum number of queued bytes.

    Attributes:
        waiting: Queued bytes.
        refused: Messages by channel that did not fit or were too large since the last report:
            their number, first and last receive time.
    """

    def __init__(self, peer: socket.socket, budget: int = BUDGET) -> None:
        peer.setblocking(False)
        self._peer = peer
        self._budget = budget
        self._buffers: deque[bytes | memoryview] = deque()
        self._batch: list[bytes] = []  # small messages
        self._small = 0  # their bytes
        self.waiting = 0
        self.refused: dict[int, list[int]] = {}
        self._channels: list[str] = []
        self._said: set[str] = set()

    def message(self, channel: int, payload: bytes, received: int, sent: int, number: int) -> None:
        """Adds a message; the arguments are those of `wire.ENTRY`."""
        size = len(payload)
        if (self.waiting and self.waiting + size > self._budget) or size > MAX_PAYLOAD:
            refused = self.refused.setdefault(channel, [0, received, received])
            refused[0] += 1
            refused[2] = received
            return
        head = HEADER.pack(MESSAGE, ENTRY.size + size)
        entry = ENTRY.pack(channel, size, received, sent, number)
        if size >= _LARGE:
            self.close_batch()
            self._put(head + entry)
            self._put(payload)
            return
        self._batch += (head, entry, payload)
        self._small += size
        if self._small >= _BATCH:
            self.close_batch()

    def event(self, kind: str, **values: object) -> None:
        """Adds an event after all messages so far, even beyond the budget."""
        self.close_batch()
        self._put(event_frame({"event": kind, **values}))

    def channel(
        self, topic: str, kind: str, definition: Definition, offered: str, type_hash: str
    ) -> int:
        """Announces a channel for the messages of a topic; returns its number."""
        self._channels.append(topic)
        number = len(self._channels) - 1
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

    def report_refused(self) -> None:
        """Reports messages that were refused."""
        detail = "the recorder did not take them from the ROS 2 child in time"
        for number, (count, *times) in self.refused.items():
            self.lost(self._channels[number], "queue", count, times=times, detail=detail)
        self.refused.clear()

    def say(self, text: str) -> None:
        """Reports a problem to the user, each text once."""
        if text not in self._said and len(self._said) < _MAX_REPORTS:
            self._said.add(text)
            self.event("say", text=text)

    def close_batch(self) -> None:
        """Queues the small messages so far."""
        if self._batch:
            self._put(b"".join(self._batch))
            self._batch.clear()
            self._small = 0

    def _put(self, data: bytes) -> None:
        self._buffers.append(data)
        self.waiting += len(data)

    def send(self) -> bool:
        """Sends as much as the socket takes without blocking; True if the queue is empty."""
        self.close_batch()
        buffers = self._buffers
        while buffers:
            try:
                done = self._peer.sendmsg(list(islice(buffers, _MAX_BUFFERS)))
            except BlockingIOError:
                return False
            self.waiting -= done
            while done:
                first = buffers[0]
                if done < len(first):
                    buffers[0] = memoryview(first)[done:]
                    break
                done -= len(first)
                buffers.popleft()
        return True


EVENT = 1
"""Body: a JSON object; its `event` names the kind of event."""

MESSAGE = 2
"""Body: one `ENTRY`, then the payload."""

HEADER = struct.Struct("<II")
"""Kind of the frame, and length of its body in bytes."""

ENTRY = struct.Struct("<IIqqq")
"""Channel, payload bytes, receive and send time (ns since the epoch), sequence number.

The send time is 0 and the number -1 if the middleware does not know them.
"""

MAX_PAYLOAD = 1 << 30
"""Bytes of the largest payload."""

MAX_EVENT = 16 << 20
"""Bytes of the largest event."""


class WireError(Exception):
    """The other end violates the protocol."""


def event_frame(event: dict[str, Any]) -> bytes:
    """The frame of an event."""
    body = json.dumps(event).encode("ascii")
    return HEADER.pack(EVENT, len(body)) + body


def parse_object(body: bytes) -> dict[str, Any]:
    """Parses a JSON object."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise WireError(f"invalid JSON: {error}") from error
    if not isinstance(found, dict):
        raise WireError("a JSON value that is not an object")
    return found


def check_frame(kind: int, length: int) -> None:
    """Checks the header of a frame."""
    if kind == EVENT:
        low, high = 2, MAX_EVENT
    elif kind == MESSAGE:
        low, high = ENTRY.size, ENTRY.size + MAX_PAYLOAD
    else:
        raise WireError(f"a frame of unknown kind {kind}")
    if not low <= length <= high:
        raise WireError(f"a frame of kind {kind} with an impossible length of {length} bytes")
