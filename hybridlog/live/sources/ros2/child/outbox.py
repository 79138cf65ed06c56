"""Protocol between the child and the recorder, and the child's end of it.

Both ends come from one installation and share one socket. The child sends frames: kind and length,
then the body: a message, or a JSON object. The recorder sends lines of JSON. At the end of its
input the child passes on its remaining messages and ends.

While the recorder does not read, the child waits, and messages wait in the queue of the middleware.
"""

from __future__ import annotations

import json
import struct
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

    from hybridlog.live.sources.ros2.child.definitions import Definition

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
