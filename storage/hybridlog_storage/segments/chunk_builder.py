"""The open chunk of a cluster: message records are copied into it as batches arrive."""

from __future__ import annotations

import math
import struct
import time
from array import array
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
from mcap.opcode import Opcode

from hybridlog_storage.buffers import buffers
from hybridlog_storage.disk.copying import COPIED_AT_ONCE, copy_payloads, windows
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD, batch_of, heads_at
from hybridlog_storage.messages import Batch, Buffer, LooseBatch

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

_HEAD = MESSAGE_HEAD.itemsize
_ONE_HEAD = struct.Struct("<BQHIQQ")  # one `MESSAGE_HEAD`
_GROWTH = 4  # how many times larger than one chunk the next may grow before it is moved
_LARGE_SHARE = 8  # a large payload fills at least 1/8 of a chunk


class ChunkBuilder:
    """Collects messages until the writer takes them as one chunk.

    Args:
        capacity: Bytes at which the writer takes them, about.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        """Bytes at which the writer takes the chunk."""
        self._buffer = np.empty(0, np.uint8)
        self._used = 0
        self._expected = capacity  # expected bytes of the next chunk
        self._starts = array("q")  # of the message records
        self._seq = array("q")  # arrival numbers
        self.copying: list[Lock] = []
        """A lock for each placed message; it is held until the payload is copied."""
        self.messages = 0
        """Messages collected so far."""
        self.first_log_time = 0
        """Log time of the message that opened the chunk, nanoseconds."""
        self.opened = math.inf
        """Time of opening, seconds of `time.monotonic`; infinite while empty."""

    def __len__(self) -> int:
        """Bytes collected so far."""
        return self._used

    def append(self, batch: Batch | LooseBatch, seq: NDArray[np.int64]) -> None:
        """Append the messages of a batch; `batch.channel` holds the segment's channel ids.

        Args:
            batch: n messages, n > 0.
            seq: int64[n], their arrival numbers.
        """
        if not self._used:
            self.first_log_time = int(batch.log_time[0])
            self.opened = time.monotonic()
        ends = np.cumsum(batch.length + _HEAD) + self._used
        starts = ends - batch.length - _HEAD
        self._grow(int(ends[-1]))
        self._lay_heads(batch, starts)
        copy_payloads(batch, self._buffer.data, starts + _HEAD)
        self._used = int(ends[-1])
        self.messages += len(batch)
        self._starts.frombytes(starts.tobytes())
        self._seq.frombytes(seq.tobytes())

    def place_one(
        self,
        payload: Buffer,
        *,
        channel: int,
        log_time: int,
        publish_time: int,
        sequence: int,
        seq: int,
    ) -> Callable[[], None]:
        """Append one message with a large payload, at less cost than a batch of one.

        Args:
            payload: The serialized message.
            channel: The segment's channel id.
            log_time: Nanoseconds since the epoch.
            publish_time: Nanoseconds since the epoch.
            sequence: The sender's number.
            seq: Arrival number.

        Returns:
            A function that copies the payload into the chunk; it does nothing for one below
            `COPIED_AT_ONCE`, which is copied already. Call it once, on any thread; several may
            run at the same time, also while other messages are appended.
        """
        length = len(payload)
        start = self._used + _HEAD
        # The buffer must not move while payloads are copied into it.
        room = self.capacity if length >= COPIED_AT_ONCE else self._room()
        self._grow(max(start + length, room))
        if not self._used:
            self.first_log_time = log_time
            self.opened = time.monotonic()
        view = self._buffer.data  # without numpy this costs less
        _ONE_HEAD.pack_into(
            view,
            self._used,
            Opcode.MESSAGE,
            length + (_HEAD - 9),
            channel,
            sequence,
            log_time,
            publish_time,
        )
        self._starts.append(self._used)
        self._seq.append(seq)
        self._used = start + length
        self.messages += 1
        if length < COPIED_AT_ONCE:
            view[start : start + length] = payload
            return _nothing
        source, target = np.frombuffer(payload, np.uint8), self._buffer[start : start + length]
        copying = Lock()
        copying.acquire()
        self.copying.append(copying)

        def copy() -> None:
            try:
                target[:] = source
            finally:
                copying.release()

        return copy

    def take(self) -> tuple[Batch, NDArray[np.int64], int]:
        """Take all collected messages and empty the builder.

        The content is complete once each lock in the previous `copying` has been released.

        Returns:
            The messages, over the chunk's uncompressed content; their arrival numbers;
            the content's size in bytes (the batch's buffer may be longer).
        """
        content, used = self._buffer.data[: self._used], self._used
        starts, seq = np.array(self._starts), np.array(self._seq)
        self.copying, self.messages, self.opened = [], 0, math.inf
        self._buffer, self._used = np.empty(0, np.uint8), 0
        self._starts, self._seq = array("q"), array("q")
        self._expected = _GROWTH * used
        return batch_of(content, starts, heads_at(content, starts)), seq, used

    def _room(self) -> int:
        """Buffer size for the next chunk, from the size of the one before.

        A topic with few messages holds little memory, however much others send.
        """
        return min(self._expected, self.capacity)

    def _grow(self, size: int) -> None:
        if size <= len(self._buffer):
            return
        room = self._room()
        # With large payloads the buffer has room for the whole chunk, so nothing is copied
        # twice.
        if size * _LARGE_SHARE < room:
            room = 2 * size
        elif size > room:
            room = min(2 * size, self.capacity)
        larger = buffers.take(max(size, room))
        larger[: self._used] = self._buffer[: self._used]
        self._buffer = larger

    def _lay_heads(self, batch: Batch | LooseBatch, starts: NDArray[np.int64]) -> None:
        heads = np.empty(len(batch), MESSAGE_HEAD)
        heads["opcode"] = int(Opcode.MESSAGE)
        heads["length"] = batch.length + (_HEAD - 9)
        heads["channel"] = batch.channel
        heads["sequence"] = batch.sequence
        heads["log_time"] = batch.log_time
        heads["publish_time"] = batch.publish_time
        windows(self._buffer.data, _HEAD)[starts] = heads.view(f"V{_HEAD}")


def _nothing() -> None:
    """Do nothing: the payload was copied already."""
