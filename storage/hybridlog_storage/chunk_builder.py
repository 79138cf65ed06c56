"""The open chunk of a cluster: message records are laid down here as batches arrive."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
from mcap.opcode import Opcode

from hybridlog_storage.copying import copy_payloads, windows
from hybridlog_storage.mcap_content import MESSAGE_HEAD
from hybridlog_storage.messages import Batch

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HEAD = MESSAGE_HEAD.itemsize


class ChunkBuilder:
    """Collects messages until its owner takes them as one chunk.

    Args:
        capacity: Bytes at which its owner takes them, about.
    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._buffer = np.empty(0, np.uint8)
        self._used = 0
        self._pieces: list[tuple[Batch, NDArray[np.int64]]] = []
        self.first_log_time = 0
        """Log time of the message that opened the chunk, nanoseconds."""
        self.opened = 0.0
        """When that was, seconds of `time.monotonic`."""

    def __len__(self) -> int:
        """Bytes laid down so far."""
        return self._used

    def append(self, batch: Batch, seq: NDArray[np.int64]) -> None:
        """Copy the messages of a batch in; `batch.channel` holds the segment's channel ids.

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
        self._pieces.append(
            (
                Batch(
                    self._buffer.data,
                    starts + _HEAD,
                    batch.length,
                    batch.channel,
                    batch.log_time,
                    batch.publish_time,
                    batch.sequence,
                ),
                seq,
            )
        )

    def take(self) -> tuple[Batch, NDArray[np.int64], int]:
        """Everything collected, and an empty builder again.

        Returns:
            The messages, over the chunk's uncompressed content; their arrival numbers;
            the content's size in bytes (the batch's buffer may be longer).
        """
        buffer, used, pieces = self._buffer, self._used, self._pieces
        self._buffer, self._used, self._pieces = np.empty(0, np.uint8), 0, []
        batches = [batch for batch, _ in pieces]
        content = buffer.data[:used]
        whole = Batch(
            content,
            np.concatenate([b.offset for b in batches]),
            np.concatenate([b.length for b in batches]),
            np.concatenate([b.channel for b in batches]),
            np.concatenate([b.log_time for b in batches]),
            np.concatenate([b.publish_time for b in batches]),
            np.concatenate([b.sequence for b in batches]),
        )
        return whole, np.concatenate([seq for _, seq in pieces]), used

    def _grow(self, size: int) -> None:
        if size <= len(self._buffer):
            return
        # Memory that is not used is not touched either, so where payloads are large there
        # is room for the whole chunk at once, and nothing is copied twice.
        large = size * 8 > self._capacity
        larger = np.empty(max(size, self._capacity if large else 2 * size), np.uint8)
        larger[: self._used] = self._buffer[: self._used]
        self._buffer = larger

    def _lay_heads(self, batch: Batch, starts: NDArray[np.int64]) -> None:
        heads = np.empty(len(batch), MESSAGE_HEAD)
        heads["opcode"] = int(Opcode.MESSAGE)
        heads["length"] = batch.length + (_HEAD - 9)
        heads["channel"] = batch.channel
        heads["sequence"] = batch.sequence
        heads["log_time"] = batch.log_time
        heads["publish_time"] = batch.publish_time
        windows(self._buffer.data, _HEAD)[starts] = heads.view(f"V{_HEAD}")
