"""A cache of chunks that were read for single messages."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hybridlog.query.chunk_scan import ChunkKey
    from hybridlog_storage.segments.chunk import StoredChunk

_MOST_BYTES = 32 << 20
_ROW_BYTES = 44  # of a message's columns


class RecentChunks:
    """The most recently used chunks. Thread safe.

    The next message requested is usually close by, in the same chunk, and reading and
    decompressing the chunk dominates the cost. Chunks do not change, so the cached
    content equals the segment's; its buffer is read-only.

    Args:
        most_bytes: Maximum size of the cache; larger chunks are not cached.
    """

    def __init__(self, most_bytes: int = _MOST_BYTES) -> None:
        self._most_bytes = most_bytes
        self._bytes = 0
        self._chunks: OrderedDict[ChunkKey, StoredChunk] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: ChunkKey, read: Callable[[], StoredChunk]) -> StoredChunk:
        """A chunk, read if it is not cached.

        Args:
            key: Location of the chunk.
            read: Reads the chunk; the result has no other owner.
        """
        with self._lock:
            found = self._chunks.get(key)
            if found is not None:
                self._chunks.move_to_end(key)
                return found
        chunk = read()
        # Arrays of messages share the buffer: changes to them must not change the cache.
        chunk.batch.buffer = memoryview(chunk.batch.buffer).toreadonly()
        with self._lock:
            self._keep(key, chunk)
        return chunk

    def clear(self) -> None:
        """Forget all chunks."""
        with self._lock:
            self._chunks.clear()
            self._bytes = 0

    def _keep(self, key: ChunkKey, chunk: StoredChunk) -> None:
        size = _size(chunk)
        if key in self._chunks or size > self._most_bytes:
            return  # another thread has read it meanwhile, or it would evict all others
        self._chunks[key] = chunk
        self._bytes += size
        while self._bytes > self._most_bytes:
            _, oldest = self._chunks.popitem(last=False)
            self._bytes -= _size(oldest)


def _size(chunk: StoredChunk) -> int:
    return len(chunk.batch.buffer) + _ROW_BYTES * len(chunk.batch)
