"""What waits to be handed to the recorder, in bounded memory.

The socket is written without waiting. While the recorder does not take what comes, the
outbox fills; what then finds no room is counted, topic by topic.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import socket
from collections import deque
from itertools import islice
from typing import Any

from hybridlog.live.sources.ros2.child.wire import (
    COUNT,
    ENTRY,
    HEADER,
    LARGE,
    MAX_PAYLOAD,
    MESSAGE,
    MESSAGES,
    event_frame,
)

BUDGET = 256 << 20
"""Bytes that may wait."""

_BATCH = 1 << 20
_AT_ONCE = 64


class Refusal:
    """Messages of one channel that were not handed over, since it was last told."""

    __slots__ = ("count", "first", "last")

    def __init__(self, received: int) -> None:
        self.count = 0
        self.first = received
        self.last = received


class Outbox:
    """Packs messages and events into frames, and sends them.

    Args:
        peer: The socket; it is made one that does not wait.
        budget: Bytes that may wait.

    Attributes:
        waiting: Bytes that wait.
        refused: By channel, what found no room, and what was too large for any.
    """

    def __init__(self, peer: socket.socket, budget: int = BUDGET) -> None:
        peer.setblocking(False)
        self._peer = peer
        self._budget = budget
        self._buffers: deque[bytes | memoryview] = deque()
        self._entries: list[bytes] = []
        self._payloads: list[bytes] = []
        self._small = 0
        self.waiting = 0
        self.refused: dict[int, Refusal] = {}

    def message(self, channel: int, payload: bytes, received: int, sent: int, number: int) -> None:
        """Puts a message in; the arguments are those of `ros2_wire.ENTRY`."""
        size = len(payload)
        if (self.waiting and self.waiting + size > self._budget) or size > MAX_PAYLOAD:
            refusal = self.refused.get(channel)
            if refusal is None:
                refusal = self.refused[channel] = Refusal(received)
            refusal.count += 1
            refusal.last = received
            return
        entry = ENTRY.pack(channel, size, received, sent, number)
        if size >= LARGE:
            self.close_batch()
            self._put(HEADER.pack(MESSAGE, ENTRY.size + size) + entry)
            self._put(payload)
            return
        self._entries.append(entry)
        self._payloads.append(payload)
        self._small += size + ENTRY.size
        if self._small >= _BATCH:
            self.close_batch()

    def event(self, event: dict[str, Any]) -> None:
        """Puts an event in, behind all messages so far, even where there is no room."""
        self.close_batch()
        self._put(event_frame(event))

    def close_batch(self) -> None:
        """Makes a frame of the small messages that have come."""
        if not self._entries:
            return
        length = COUNT.size + self._small
        count = COUNT.pack(len(self._entries))
        head = HEADER.pack(MESSAGES, length)
        self._put(b"".join((head, count, *self._entries, *self._payloads)))
        self._entries.clear()
        self._payloads.clear()
        self._small = 0

    def _put(self, data: bytes) -> None:
        self._buffers.append(data)
        self.waiting += len(data)

    def send(self) -> bool:
        """Sends what the socket takes at once; whether that is all.

        Raises:
            OSError: The recorder is gone.
        """
        self.close_batch()
        buffers = self._buffers
        while buffers:
            try:
                done = self._peer.sendmsg(list(islice(buffers, _AT_ONCE)))
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
