"""The chunk table of a segment: where its chunks lie, and what each channel has in them.

It is a record of the summary, whose checksum covers it. Other readers of MCAP have chunk indexes
there, which say less.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog_storage.cache import RowType
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import checked_frame, decompress
from hybridlog_storage.messages import EXPIRED_IDS, Batch, Buffer, run_starts

if TYPE_CHECKING:
    from numpy.typing import NDArray


CHUNK: Final = RowType(
    ("offset", "<u8"),
    ("length", "<u8"),
    ("trailer", "<u8"),
    ("first", "<i8"),
    ("last", "<i8"),
    ("parts", "<u4"),
)
"""A chunk: offset and bytes of its record, bytes of the message indexes and arrival record
behind it, first and last log time in ns, and its number of rows in `parts`."""
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
_HEAD = struct.Struct("<II")  # rows of chunks and parts
_CHUNK_ROW = struct.Struct("<QQQqqI")
_DTYPES = (CHUNK, PART)
_MAX_FILE = 1 << 62
_MAX_CHANNEL = 65535


class ChunkTable(Struct, frozen=True, eq=False):
    """The chunks of a segment.

    Attributes:
        chunks: `CHUNK`[n], in file order; the row is the chunk's number.
        parts: `PART`[m], chunk by chunk, by channel id within one.
    """

    chunks: NDArray[np.void]
    parts: NDArray[np.void]

    @property
    def end(self) -> int:
        """Byte of the file where the last chunk ends, with what belongs to it; 0 without one."""
        last = self.chunks[-1:][["offset", "length", "trailer"]].tolist()
        return sum(last[0]) if last else 0

    def part_bounds(self) -> NDArray[np.int64]:
        """Bounds of each chunk's rows in `parts`: int64[n + 1].

        The rows of chunk i are `[bounds[i], bounds[i + 1])`.
        """
        bounds = np.zeros(len(self.chunks) + 1, np.int64)
        np.cumsum(self.chunks["parts"], out=bounds[1:])
        return bounds

    def chunk_parts(self, number: int) -> NDArray[np.void]:
        """The rows of `parts` of one chunk."""
        end = int(self.chunks["parts"][: number + 1].sum())
        return self.parts[end - int(self.chunks["parts"][number]) : end]

    def as_stored(self) -> ChunkTable:
        """The table as the file has it: expired messages on the channel that they came on."""
        parts = self.parts.copy()
        parts["channel"] %= EXPIRED_IDS
        return replace(self, parts=parts)

    def by_channel(self) -> NDArray[np.void]:
        """Totals of each channel with messages, `PART`[c], by channel id.

        `messages` is taken modulo 2^32, which no segment reaches.
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

    def counts(self) -> dict[int, int]:
        """Messages of each channel that has any, by channel id."""
        return dict(self.by_channel()[["channel", "messages"]].tolist())

    def to_bytes(self) -> bytes:
        """The content of the table's record: row counts, then the rows as one zstd frame."""
        rows = self.chunks, self.parts
        return _HEAD.pack(*map(len, rows)) + checked_frame(b"".join(r.tobytes() for r in rows))

    @classmethod
    def from_bytes(cls, body: Buffer) -> ChunkTable:
        """Parse the output of `to_bytes`; `SegmentError` if it contradicts itself."""
        if len(body) < _HEAD.size:
            raise SegmentError("the chunk table is too short")
        counts = _HEAD.unpack_from(body)
        sizes = [n * dtype.itemsize for n, dtype in zip(counts, _DTYPES, strict=True)]
        try:
            raw = decompress("zstd", memoryview(body)[_HEAD.size :], sum(sizes))
        except SegmentError as error:
            raise SegmentError(f"the chunk table is damaged: {error}") from error
        arrays: list[NDArray[np.void]] = []
        at = 0
        for count, size, dtype in zip(counts, sizes, _DTYPES, strict=True):
            arrays.append(np.frombuffer(raw, dtype, count, at))
            at += size
        table = cls(arrays[0], arrays[1])
        if not _is_consistent(table):
            raise SegmentError("the chunk table is damaged: it contradicts itself")
        return table


class ChunkPlace(Struct, frozen=True, kw_only=True):
    """Position of a chunk in its segment.

    Attributes:
        number: Number of the chunk in its segment, from 0, in file order.
        offset: Byte of the chunk record.
        length: Bytes of the chunk record.
        trailer: Bytes of message indexes and arrival numbers behind it.
        first: Smallest log time in it, ns.
        last: Largest log time in it, ns.
        channels: Ids of the channels in it.
    """

    number: int
    offset: int
    length: int
    trailer: int
    first: int
    last: int
    channels: tuple[int, ...]

    @property
    def end(self) -> int:
        """Byte behind what belongs to it."""
        return self.offset + self.length + self.trailer


def places_of(table: ChunkTable) -> list[ChunkPlace]:
    """Position of each chunk of a table, in file order."""
    bounds = table.part_bounds()
    return [place_of(table, number, bounds) for number in range(len(table.chunks))]


def place_of(table: ChunkTable, number: int, bounds: NDArray[np.int64] | None = None) -> ChunkPlace:
    """Position of a chunk of a table; `bounds` are its `part_bounds`, if they are at hand."""
    bounds = table.part_bounds() if bounds is None else bounds
    offset, length, trailer, first, last, _ = table.chunks[number].item()
    return ChunkPlace(
        number=number,
        offset=offset,
        length=length,
        trailer=trailer,
        first=first,
        last=last,
        channels=tuple(table.parts["channel"][bounds[number] : bounds[number + 1]].tolist()),
    )


def _is_consistent(table: ChunkTable) -> bool:
    """True for a table as a writer makes it."""
    chunks, parts = table.chunks, table.parts
    sizes = [chunks[name] for name in ("offset", "length", "trailer")]
    if not all(size.all() and (size < _MAX_FILE).all() for size in sizes):
        return False
    is_ordered = ((sizes[0] + sizes[1] + sizes[2])[:-1] <= chunks["offset"][1:]).all()
    if not is_ordered or not chunks["parts"].all() or int(chunks["parts"].sum()) != len(parts):
        return False
    if not len(parts):
        return True
    starts = table.part_bounds()[:-1]
    rising = np.diff(parts["channel"].astype(np.int64)) > 0
    rising[starts[1:] - 1] = True
    return bool(
        rising.all()
        and parts["channel"].max() <= _MAX_CHANNEL
        and (np.minimum.reduceat(parts["first"], starts) == chunks["first"]).all()
        and (np.maximum.reduceat(parts["last"], starts) == chunks["last"]).all()
        and (parts["first"] <= parts["last"]).all()
        and parts["messages"].all()
    )


def check_parts(
    place: tuple[int, int, int], span: tuple[int, int], parts: NDArray[np.void], messages: int
) -> None:
    """Raise `SegmentError` unless parts fit their chunk; place and span as for `TableBuilder`."""
    table = ChunkTable(np.array([(*place, *span, len(parts))], CHUNK), parts)
    if not _is_consistent(table) or int(parts["messages"].sum()) != messages:
        raise SegmentError("what is said of its messages does not fit it")


def parts_of(batch: Batch, order: NDArray[np.intp]) -> tuple[NDArray[np.void], int, int]:
    """Statistics of each channel in a chunk, `PART`[c] by channel id; first and last log time, ns.

    `batch` has a message at least, and channel ids; `order` is intp[n], rows by channel and, within
    one, by log time.
    """
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
        self._chunks = bytearray()
        self._parts = bytearray()

    def chunk(
        self, place: tuple[int, int, int], span: tuple[int, int], parts: NDArray[np.void]
    ) -> None:
        """Add a chunk; `span` is its smallest and largest log time, ns, `parts` is from `parts_of`.

        `place` is byte and length of the chunk record, and bytes of message indexes and arrival
        record behind it.
        """
        self._chunks += _CHUNK_ROW.pack(*place, *span, len(parts))
        self._parts += parts.tobytes()
        self.chunks += 1
        self.parts += len(parts)

    def build(self) -> ChunkTable:
        """The table of all added chunks; see `ChunkTable`."""
        chunks, parts = bytes(self._chunks), bytes(self._parts)
        return ChunkTable(np.frombuffer(chunks, CHUNK), np.frombuffer(parts, PART))
