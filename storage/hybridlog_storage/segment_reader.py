"""Reading segments: their summary, and chunks one at a time.

A sealed segment never changes, so a reader may be used by several threads: every read
names its place.
"""

from __future__ import annotations

import os
import stat
import struct
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata, MetadataIndex

from hybridlog_storage.append_file import BLOCK, DIRECT
from hybridlog_storage.buffers import buffers
from hybridlog_storage.checksum import crc32
from hybridlog_storage.chunk import StoredChunk
from hybridlog_storage.compression import decompress
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap_scan import (
    parse_content,
    read_summary,
)
from hybridlog_storage.messages import Buffer, Channel
from hybridlog_storage.segment_format import (
    ARRIVAL_HEAD,
    ARRIVAL_OPCODE,
    CHUNK_HEAD,
    END_METADATA,
    FORMAT_VERSION,
    LOSSES_METADATA,
    RECORDING_METADATA,
    arrivals_of,
    channel_of,
    json_of,
    message_starts,
    message_times,
    messages_at,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class ChunkPlace:
    """Where a chunk lies in its segment.

    Attributes:
        offset: Byte of the chunk record.
        length: Bytes of the chunk record.
        trailer: Bytes of message indexes and arrival numbers behind it, -1 if unknown.
        first: Smallest log time in it, ns.
        last: Largest log time in it, ns.
        channels: Ids of the channels in it.
    """

    offset: int
    length: int
    trailer: int
    first: int
    last: int
    channels: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class SegmentSummary:
    """What a sealed segment says of itself.

    Attributes:
        recording: Catalog entry of the recording, as when the segment was started.
        end: How the recording ended; None in all but a recording's last segment.
        channels: By channel id.
        chunks: In file order.
        counts: Messages by channel id.
        losses: Rows of the loss ledger that were written with its messages.
    """

    recording: dict[str, object]
    end: dict[str, object] | None
    channels: dict[int, Channel]
    chunks: list[ChunkPlace]
    counts: dict[int, int]
    losses: list[dict[str, Any]]


class SegmentReader:
    """One sealed segment file.

    Args:
        path: The file.
        number: Its number in the recording.
        direct: Read past the page cache, if the file system allows it: for what was just
            written that way, and will not be read again soon.

    Raises:
        SegmentError: the file is missing or cannot be opened.
    """

    def __init__(self, path: Path, number: int, *, direct: bool = False) -> None:
        self.path = path
        self.number = number
        self._direct = direct and bool(DIRECT)
        cure = "Restore the file, or run `hybridlog verify` for a list of what is affected."
        try:
            # Whatever lies there, opening it must not wait.
            self._fd = self._open(path)
        except OSError as error:
            problem = f"Segment {path} cannot be opened: {error.strerror}. {cure}"
            raise SegmentError(problem) from error
        about = os.fstat(self._fd)
        if not stat.S_ISREG(about.st_mode):
            self.close()
            raise SegmentError(f"Segment {path} is no ordinary file. {cure}")
        self.size = about.st_size
        self.bytes_read = 0

    def _open(self, path: Path) -> int:
        flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
        if self._direct:
            with suppress(OSError):
                return os.open(path, flags | DIRECT)
            self._direct = False
        return os.open(path, flags)

    def close(self) -> None:
        """Give the file back."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        if hasattr(self, "_fd"):
            self.close()

    def __enter__(self) -> Self:
        """The reader itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def grow(self) -> None:
        """Take note of what was appended since the file was opened."""
        self.size = os.fstat(self._fd).st_size

    def summary(self) -> SegmentSummary:
        """Channels, chunks and metadata, from the summary at the end of the file.

        Raises:
            SegmentError: there is none, or it is damaged.
        """
        with self.path.open("rb") as file:
            summary = read_summary(file, self.size)
        if summary is None or summary.statistics is None:
            raise SegmentError(
                f"Segment {self.path} has no readable summary. It was sealed and has changed "
                "since: restore it, or see what is left with `mcap recover`."
            )
        metadata = {
            index.name: self._metadata(index.offset, index.length)
            for index in summary.metadata_indexes
            if index.name in {RECORDING_METADATA, END_METADATA}
        }
        if RECORDING_METADATA not in metadata:
            raise SegmentError(f"{self.path} is no segment of a hybridlog store.")
        recording = json_of(metadata[RECORDING_METADATA])
        check_format(recording, self.path)
        end = metadata.get(END_METADATA)
        return SegmentSummary(
            recording,
            json_of(end) if end is not None else None,
            {i: channel_of(record, summary.schemas) for i, record in summary.channels.items()},
            [_place(index) for index in summary.chunk_indexes],
            dict(summary.statistics.channel_message_counts),
            self._losses(summary.metadata_indexes),
        )

    def _losses(self, indexes: Iterable[MetadataIndex]) -> list[dict[str, Any]]:
        rows: list[dict[str, Any]] = []
        for index in indexes:
            if index.name == LOSSES_METADATA:
                found = json_of(self._metadata(index.offset, index.length)).get("rows")
                if not isinstance(found, list) or not all(isinstance(r, dict) for r in found):
                    raise SegmentError(
                        f"{self.path}: the loss ledger at byte {index.offset} is damaged."
                    )
                rows.extend(found)
        return rows

    def read_chunk(self, place: ChunkPlace) -> StoredChunk:
        """Read, decompress and check one chunk.

        Raises:
            SegmentError: it is not there, or it is damaged; names file and offset.
        """
        data = self._read(place.offset, place.length + max(place.trailer, 0))
        try:
            content, compressed = open_chunk(memoryview(data)[: place.length])
            if place.trailer >= 0:
                trailer = memoryview(data)[place.length :]
            else:
                trailer = self._trailer(place)
            # The indexes say where messages start; walking the records is the slow way.
            batch = messages_at(content, message_starts(trailer))
            if batch is None:
                batch = parse_content(content).batch
            seq = _arrivals(trailer, place.offset, len(batch))
        except SegmentError as error:
            raise self._damaged(place, error) from error
        return StoredChunk(
            self.number, place.offset, place.length, len(trailer), batch, seq, compressed
        )

    def _damaged(self, place: ChunkPlace, error: SegmentError) -> SegmentError:
        return SegmentError(f"Chunk at byte {place.offset} of {self.path} is damaged: {error}")

    def read_times(self, place: ChunkPlace) -> dict[int, NDArray[np.int64]]:
        """Log times of a chunk's messages by channel, from its message indexes alone.

        Returns:
            int64[n], ns, by channel id; unchecked: an index has no checksum of its own.

        Raises:
            SegmentError: they are not there; names file and offset.
        """
        if place.trailer >= 0:
            return message_times(self._read(place.offset + place.length, place.trailer))
        try:
            return message_times(self._trailer(place))
        except SegmentError as error:
            raise self._damaged(place, error) from error

    def _read(self, offset: int, length: int) -> memoryview:
        if offset + length > self.size:
            raise SegmentError(
                f"{self.path} ends at byte {self.size}, but bytes {offset} to "
                f"{offset + length} are referred to: the file was cut short."
            )
        # Direct reads start and end at whole blocks, in the file and in memory.
        ahead = offset % BLOCK if self._direct else 0
        wanted = ahead + length
        size = wanted + -wanted % BLOCK if self._direct else wanted
        buffer = buffers.take(size, whole_pages=self._direct).data
        try:
            count = os.preadv(self._fd, [buffer[:size]], offset - ahead)
        except OSError as error:
            raise SegmentError(f"{self.path} cannot be read: {error.strerror}.") from error
        if count < wanted:
            raise SegmentError(f"{self.path} gives {count - ahead} bytes of {length} at {offset}.")
        self.bytes_read += length
        return buffer[ahead:wanted]

    def _trailer(self, place: ChunkPlace) -> memoryview:
        """Walk the records behind a chunk as far as its arrival numbers."""
        start = at = place.offset + place.length
        while at + 9 <= self.size:
            opcode, length = struct.unpack("<BQ", self._read(at, 9))
            at += 9 + length
            if opcode == ARRIVAL_OPCODE:
                return self._read(start, at - start)
            if opcode != Opcode.MESSAGE_INDEX:
                break
        raise SegmentError("its arrival numbers are missing")

    def _metadata(self, offset: int, length: int) -> Metadata:
        try:
            body = ReadDataStream(BytesIO(self._read(offset, length)[9:]))
            record: Metadata = Metadata.read(body)
        except (McapError, ValueError, struct.error, EOFError) as error:
            raise SegmentError(f"Metadata at byte {offset} of {self.path} is damaged.") from error
        return record


def check_format(recording: Mapping[str, object], path: Path) -> None:
    """Refuse a segment of a newer format."""
    version = recording.get("format")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise SegmentError(
            f"{path} has segment format {version}, this hybridlog knows up to "
            f"{FORMAT_VERSION}. Install a newer hybridlog."
        )


def open_chunk(record: memoryview) -> tuple[Buffer, int]:
    """The content of a whole chunk record, checksum verified, and its compressed size.

    Raises:
        SegmentError: it is no chunk record, or damaged.
    """
    if len(record) < CHUNK_HEAD.size + 4:
        raise SegmentError("the record is too short")
    opcode, length, _, _, size, crc = CHUNK_HEAD.unpack_from(record)
    if opcode != Opcode.CHUNK or length + 9 != len(record):
        raise SegmentError("no chunk record is there")
    at = CHUNK_HEAD.size
    (name_length,) = struct.unpack_from("<I", record, at)
    at += 4
    if name_length > 16 or at + name_length + 8 > len(record):
        raise SegmentError("its compression cannot be read")
    compression = bytes(record[at : at + name_length]).decode("ascii", "replace")
    at += name_length + 8
    content = decompress(compression, record[at:], size)
    if crc32(content) != crc:
        raise SegmentError("its checksum differs")
    return content, len(record) - at


def _arrivals(trailer: memoryview, chunk_offset: int, count: int) -> NDArray[np.int64]:
    at = 0
    while at + ARRIVAL_HEAD.size <= len(trailer):
        opcode, length = struct.unpack_from("<BQ", trailer, at)
        if opcode == ARRIVAL_OPCODE:
            owner, seq = arrivals_of(trailer[at + 9 : at + 9 + length], count)
            if owner != chunk_offset:
                raise SegmentError("its arrival numbers belong to another chunk")
            return seq
        at += 9 + length
    raise SegmentError("its arrival numbers are missing")


def _place(index: ChunkIndex) -> ChunkPlace:
    return ChunkPlace(
        index.chunk_start_offset,
        index.chunk_length,
        -1,
        index.message_start_time,
        index.message_end_time,
        tuple(sorted(index.message_index_offsets)),
    )
