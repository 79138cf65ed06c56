"""Chunks that were read for one message each, kept for whoever looks around in a log."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.query.chunk_scan import ChunkKey
    from hybridlog_storage.chunk import StoredChunk

_MOST_BYTES = 32 << 20
_ROW_BYTES = 44  # of a message's columns


class RecentChunks:
    """The chunks that were asked for last. Thread safe.

    A message at a time is mostly followed by one close to it, which the same chunk holds:
    to read and unpack it takes longer than all else. Chunks do not change, so what is kept
    is what lies in the segment; its buffer cannot be written to.

    Args:
        most_bytes: Of all that are kept; a larger chunk is not.
    """

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._chunks: OrderedDict[ChunkKey, StoredChunk] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: ChunkKey, read: Callable[[], StoredChunk]) -> StoredChunk:
        """A chunk, read if it is not here.

        Args:
            key: Where it lies.
            read: Reads it; nobody else has it.
        """
        with self._lock:
            found = self._chunks.get(key)
            if found is not None:
                self._chunks.move_to_end(key)
                return found
        chunk = read()
        # Arrays of messages lie over the buffer: who changes one must not change what is kept.
        chunk.batch.buffer = memoryview(chunk.batch.buffer).toreadonly()
        with self._lock:
            self._keep(key, chunk)
        return chunk

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._chunks.clear()
            self._bytes = 0

    def _keep(self, key: ChunkKey, chunk: StoredChunk) -> None:
        size = _size(chunk)
        if key in self._chunks or size > self._most_bytes:
            return  # another thread has read it meanwhile, or all others would have to go
        self._chunks[key] = chunk
        self._bytes += size
        while self._bytes > self._most_bytes:
            _, oldest = self._chunks.popitem(last=False)
            self._bytes -= _size(oldest)


def _size(chunk: StoredChunk) -> int:
    return len(chunk.batch.buffer) + _ROW_BYTES * len(chunk.batch)
