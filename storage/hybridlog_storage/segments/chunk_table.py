"""The chunk table of a segment: positions and checksums of all its parts.

MCAP has checksums of a chunk's content and of the summary. It has none of chunk heads,
message indexes, metadata and definitions. The chunk table closes the gap: it is a record
of the summary with checksums that cover every byte before the summary. So a reader uses
only checked bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog_storage.checksum import crc32, crc32_combine
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.lazy import RowType
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.ordering import run_starts
from hybridlog_storage.segments.compression import decompress
from hybridlog_storage.segments.segment_format import checked_frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Batch, Buffer

CHUNK: Final = RowType(
    ("offset", "<u8"),
    ("length", "<u8"),
    ("trailer", "<u8"),
    ("crc", "<u4"),
    ("trailer_crc", "<u4"),
    ("first", "<i8"),
    ("last", "<i8"),
    ("parts", "<u4"),
)
"""A chunk: offset and bytes of its record, bytes of the message indexes and arrival record
behind it, CRC-32 of the record and of the part behind it, first and last log time in ns,
and its number of rows in `parts`."""
PART: Final = RowType(
    ("channel", "<u4"),
    ("messages", "<u4"),
    ("payload_bytes", "<u8"),
    ("first", "<i8"),
    ("last", "<i8"),
    ("first_publish", "<i8"),
    ("last_publish", "<i8"),
)
"""The messages of one channel in one chunk: number, bytes of their payloads, first and
last log time, first and last publish time, times in ns."""
OTHER: Final = RowType(("offset", "<u8"), ("length", "<u8"), ("crc", "<u4"))
"""A stretch of the file outside of chunks: its start, its bytes, its CRC-32."""

_HEAD = struct.Struct("<III")  # rows of chunks, parts and others
_CHUNK_ROW = struct.Struct("<QQQIIqqI")
_OTHER_ROW = struct.Struct("<QQI")
_DTYPES = (CHUNK, PART, OTHER)
_MAX_BYTES = 1 << 28
_MAX_FILE = 1 << 62
_MAX_CHANNEL = 65535
_MAX_LIST_MESSAGES = 32  # messages
_MERGED = 1 << 16  # bytes: checking one record reads its whole stretch


@dataclass(frozen=True, slots=True, eq=False)
class ChunkTable:
    """All parts of a segment before its summary.

    Chunks with their trailers, and the other stretches, cover every byte from 0 to `end`
    exactly once.

    Attributes:
        chunks: `CHUNK`[n], in file order; the row is the chunk's number.
        parts: `PART`[m], chunk by chunk, by channel id within one.
        others: `OTHER`[k], in file order.
        is_flushed: The segment is not sealed yet: publish times are unknown, and the table covers
            chunks and indexed records only.
    """

    chunks: NDArray[np.void]
    parts: NDArray[np.void]
    others: NDArray[np.void]
    is_flushed: bool = False

    @property
    def end(self) -> int:
        """Bytes covered by the table; the summary starts there."""
        ends = [0]
        if len(self.chunks):
            last = self.chunks[-1]
            ends.append(int(last["offset"]) + int(last["length"]) + int(last["trailer"]))
        if len(self.others):
            ends.append(int(self.others[-1]["offset"]) + int(self.others[-1]["length"]))
        return max(ends)

    def part_bounds(self) -> NDArray[np.int64]:
        """Bounds of each chunk's rows in `parts`.

        Returns:
            int64[n + 1]; the rows of chunk i are `[bounds[i], bounds[i + 1])`.
        """
        bounds = np.zeros(len(self.chunks) + 1, np.int64)
        np.cumsum(self.chunks["parts"], out=bounds[1:])
        return bounds

    def with_added(self, added: int) -> ChunkTable:
        """The table with all messages on channels whose ids are greater by a number."""
        parts = self.parts.copy()
        parts["channel"] += added
        return replace(self, parts=parts)

    def as_stored(self) -> ChunkTable:
        """The table as the file has it: expired messages on the channel that they came on."""
        parts = self.parts.copy()
        parts["channel"] %= EXPIRED_IDS
        return replace(self, parts=parts)

    def by_channel(self) -> NDArray[np.void]:
        """Totals of each channel.

        Returns:
            `PART`[c], by channel id; only channels with messages. `messages` is taken
            modulo 2^32, which no segment reaches.
        """
        if not len(self.parts):
            return self.parts
        rows = self.parts[np.argsort(self.parts["channel"], kind="stable")]
        starts = run_starts(rows["channel"])
        found = rows[starts].copy()
        for name in ("messages", "payload_bytes"):
            found[name] = np.add.reduceat(rows[name], starts)
        for name in ("first", "first_publish"):
            found[name] = np.minimum.reduceat(rows[name], starts)
        for name in ("last", "last_publish"):
            found[name] = np.maximum.reduceat(rows[name], starts)
        return found

    def stretch(self, offset: int, length: int) -> tuple[int, int, int] | None:
        """The stretch of `others` that holds a record.

        Returns:
            Byte at which it starts, its bytes and its CRC-32; None when there is none.
        """
        row = int(np.searchsorted(self.others["offset"], offset, side="right")) - 1
        if row < 0:
            return None
        start, size, crc = (int(value) for value in self.others[row])
        return (start, size, crc) if offset + length <= start + size else None

    def to_bytes(self) -> bytes:
        """The content of the table's record: row counts, then the rows as one zstd frame."""
        rows = (self.chunks, self.parts, self.others)
        return _HEAD.pack(*map(len, rows)) + checked_frame(b"".join(r.tobytes() for r in rows))

    @classmethod
    def from_bytes(cls, body: Buffer) -> ChunkTable:
        """Parse the output of `to_bytes`.

        Raises:
            SegmentError: It is damaged, or contradicts itself.
        """
        if len(body) < _HEAD.size:
            raise SegmentError("the chunk table is too short")
        counts = _HEAD.unpack_from(body)
        sizes = [n * dtype.itemsize for n, dtype in zip(counts, _DTYPES, strict=True)]
        try:
            raw = decompress("zstd", memoryview(body)[_HEAD.size :], sum(sizes), limit=_MAX_BYTES)
        except SegmentError as error:
            raise SegmentError(f"the chunk table is damaged: {error}") from error
        arrays: list[NDArray[np.void]] = []
        at = 0
        for count, size, dtype in zip(counts, sizes, _DTYPES, strict=True):
            arrays.append(np.frombuffer(raw, dtype, count, at))
            at += size
        table = cls(arrays[0], arrays[1], arrays[2])
        problem = _problem(table)
        if problem is not None:
            raise SegmentError(f"the chunk table is damaged: {problem}")
        return table


def _problem(table: ChunkTable) -> str | None:
    """The contradiction in a table, None if it is consistent."""
    chunks, parts, others = table.chunks, table.parts, table.others
    pieces = [(chunks["offset"], chunks["length"]), (others["offset"], others["length"])]
    pieces.append((chunks["offset"] + chunks["length"], chunks["trailer"]))
    starts, sizes = (np.concatenate(column) for column in zip(*pieces, strict=True))
    if (starts >= _MAX_FILE).any() or (sizes >= _MAX_FILE).any():
        return "a place lies beyond all files"
    if not sizes.all():
        return "something has no bytes"
    order = np.argsort(starts, kind="stable")
    ends = (starts + sizes)[order]
    if len(ends) and (starts[order][0] != 0 or (starts[order][1:] != ends[:-1]).any()):
        return "it does not cover each byte once"
    if (np.diff(chunks["offset"].astype(np.int64)) <= 0).any():
        return "its chunks are not in order"
    if (np.diff(others["offset"].astype(np.int64)) <= 0).any():
        return "its stretches are not in order"
    return _part_problem(table, parts)


def _part_problem(table: ChunkTable, parts: NDArray[np.void]) -> str | None:
    if not table.chunks["parts"].all() or int(table.chunks["parts"].sum()) != len(parts):
        return "its parts do not fit its chunks"
    if not len(parts):
        return None
    channel = parts["channel"].astype(np.int64)
    starts = table.part_bounds()[:-1]
    rising = np.diff(channel) > 0
    rising[starts[1:] - 1] = True
    if not rising.all() or int(channel.max()) > _MAX_CHANNEL:
        return "the channels of a chunk are not in order"
    first = np.minimum.reduceat(parts["first"], starts)
    last = np.maximum.reduceat(parts["last"], starts)
    same = bool((first == table.chunks["first"]).all() and (last == table.chunks["last"]).all())
    if not same or not parts["messages"].all() or (parts["first"] > parts["last"]).any():
        return "the times of its chunks and its parts differ"
    return None


def parts_of(batch: Batch, order: NDArray[np.intp]) -> tuple[NDArray[np.void], int, int]:
    """Statistics of each channel in a chunk.

    Args:
        batch: Its messages, one at least; `channel` holds channel ids.
        order: intp[n], rows by channel and, within one, by log time.

    Returns:
        `PART`[c], by channel id; the first and the last log time of all, ns.
    """
    first, last = order[0], order[-1]
    if batch.channel[first] == batch.channel[last]:  # as in most chunks
        few = len(order) <= _MAX_LIST_MESSAGES  # for few rows lists are faster
        length = batch.length.tolist() if few else batch.length
        publish = batch.publish_time.tolist() if few else batch.publish_time
        times = int(batch.log_time[first]), int(batch.log_time[last])
        spans = (min(publish), max(publish)) if few else (publish.min(), publish.max())
        size = sum(length) if few else length.sum()
        row = (int(batch.channel[first]), len(order), int(size), *times, *map(int, spans))
        return np.array([row], PART), *times
    channel = batch.channel[order]
    starts = run_starts(channel)
    parts = np.empty(len(starts), PART)
    ends = np.append(starts[1:], len(channel))
    log_time, publish = batch.log_time[order], batch.publish_time[order]
    parts["channel"] = channel[starts]
    parts["messages"] = ends - starts
    parts["payload_bytes"] = np.add.reduceat(batch.length[order], starts)
    parts["first"] = log_time[starts]
    parts["last"] = log_time[ends - 1]
    parts["first_publish"] = np.minimum.reduceat(publish, starts)
    parts["last_publish"] = np.maximum.reduceat(publish, starts)
    return parts, int(parts["first"].min()), int(parts["last"].max())


class TableBuilder:
    """Collects the rows of a chunk table as a segment grows."""

    def __init__(self) -> None:
        self.chunks = 0
        """Number of chunks so far, which is the number of the next one."""
        self.parts = 0
        """Rows of parts so far."""
        self.end = 0
        """Byte up to which the file is covered."""
        self.unproven = 0, 0
        """Bytes since the last arrival record, which the next one proves; their CRC-32."""
        self._chunks = bytearray()
        self._parts = bytearray()
        self._others = bytearray()
        self._last: tuple[int, int, int] | None = None  # the last stretch, which may still grow

    def chunk(
        self,
        *,
        offset: int,
        length: int,
        trailer: int,
        crc: int,
        trailer_crc: int,
        first: int,
        last: int,
        parts: NDArray[np.void],
    ) -> None:
        """Add a chunk that starts where the last piece ended.

        Args:
            offset: Byte of the chunk record.
            length: Bytes of the chunk record.
            trailer: Bytes of message indexes and arrival record behind it.
            crc: CRC-32 of the chunk record.
            trailer_crc: CRC-32 of the trailer.
            first: Smallest log time in it, ns.
            last: Largest log time in it, ns.
            parts: `PART`[c], from `parts_of`.
        """
        assert offset == self.end
        self._finish_stretch()
        self._chunks += _CHUNK_ROW.pack(
            offset, length, trailer, crc, trailer_crc, first, last, len(parts)
        )
        self._parts += parts.tobytes()
        self.chunks += 1
        self.parts += len(parts)
        self.unproven = 0, 0
        self.end = offset + length + trailer

    def other(self, content: Buffer, *, alone: bool = False) -> None:
        """Add a record outside of chunks that starts where the last piece ended.

        Small neighbours share a row. The division into rows depends only on the records, not
        on when they were written.

        Args:
            content: The record.
            alone: Give it a row of its own, so that reading it does not depend on neighbours.
        """
        if alone:
            self.stretch(len(content), crc32(content))
            return
        if not len(content):
            return
        last, self._last = self._last, None
        if last is not None and last[1] + len(content) <= _MERGED:
            self._last = last[0], last[1] + len(content), crc32(content, last[2])
        else:
            self._last = last
            self._finish_stretch()
            self._last = self.end, len(content), crc32(content)
        size, crc = self.unproven
        self.unproven = size + len(content), crc32(content, crc)
        self.end += len(content)

    def proof(self, record: Buffer) -> None:
        """Add an arrival record that follows no chunk."""
        self.other(record)
        self.unproven = 0, 0

    def stretch(self, length: int, crc: int) -> None:
        """Add bytes outside of chunks, in a row of their own."""
        self._finish_stretch()
        if length:
            self._others += _OTHER_ROW.pack(self.end, length, crc)
            size, before = self.unproven
            self.unproven = size + length, crc32_combine(before, crc, length)
            self.end += length

    def build(self, record: Buffer = b"") -> ChunkTable:
        """The table of all added pieces, and of a record that is about to follow."""
        before = self.end, self._last, self.unproven, len(self._others)
        self.other(record)
        others = bytes(self._others)
        if self._last is not None:
            others += _OTHER_ROW.pack(*self._last)
        self.end, self._last, self.unproven, length = before
        del self._others[length:]
        return ChunkTable(
            np.frombuffer(bytes(self._chunks), CHUNK),
            np.frombuffer(bytes(self._parts), PART),
            np.frombuffer(others, OTHER),
        )

    def _finish_stretch(self) -> None:
        if self._last is not None:
            self._others += _OTHER_ROW.pack(*self._last)
            self._last = None
