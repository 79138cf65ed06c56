"""A chunk that is not closed yet: messages wait in it, and one join makes its content."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np
from mcap.opcode import Opcode

from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD
from hybridlog_storage.messages import Batch, Buffer, LooseBatch

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HEAD = MESSAGE_HEAD.itemsize
_LARGE = 1 << 15  # mean bytes of heads and payloads


class OpenChunk:
    """Messages, each in a buffer of its own.

    `opened` is seconds of `time.monotonic`; `size` is the bytes of its content.
    """

    def __init__(self, first_log_time: int) -> None:
        self.first_log_time = first_log_time
        self.opened = time.monotonic()
        self.size = 0
        self._payloads: list[Buffer] = []
        self._batches: list[LooseBatch] = []
        self._seq: list[NDArray[np.int64]] = []

    def append(self, batch: LooseBatch, seq: NDArray[np.int64]) -> None:
        """Append messages with the channel ids of the segment, and their arrival numbers."""
        self.size += batch.payload_bytes + _HEAD * len(batch)
        self._payloads += batch.payloads.tolist()
        batch.payloads = batch.payloads[:0].copy()  # a view keeps the whole array
        self._batches.append(batch)
        self._seq.append(seq)

    def laid_out(self) -> tuple[Batch, NDArray[np.int64]]:
        """The messages over the content of the chunk, and their arrival numbers."""
        length = self._column("length")
        heads = np.empty(len(length), MESSAGE_HEAD)
        heads["opcode"] = int(Opcode.MESSAGE)
        heads["length"] = length + (_HEAD - 9)
        heads["channel"] = channel = self._column("channel")
        heads["log_time"] = log_time = self._column("log_time")
        heads["publish_time"] = publish_time = self._column("publish_time")
        heads["sequence"] = sequence = self._column("sequence")
        parts: list[Buffer] = [b""] * (2 * len(length))
        parts[::2] = heads.view(f"V{_HEAD}").tolist()
        parts[1::2] = self._payloads
        content = _joined(parts, self.size)
        offset = np.cumsum(length + _HEAD) - length
        batch = Batch(content, offset, length, channel, log_time, publish_time, sequence)
        return batch, np.concatenate(self._seq)

    def _column(self, name: str) -> NDArray[Any]:
        return np.concatenate([getattr(batch, name) for batch in self._batches])


def _joined(parts: list[Buffer], size: int) -> Buffer:
    """The parts in one buffer. Large ones are copied without the interpreter lock."""
    if size < _LARGE * len(parts):
        return b"".join(parts)
    content = np.empty(size, np.uint8)
    at = 0
    for part in parts:
        content[at : at + len(part)] = np.frombuffer(part, np.uint8)
        at += len(part)
    return content.data
