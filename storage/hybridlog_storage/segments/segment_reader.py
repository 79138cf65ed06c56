"""Reads segments, and rows of those that are gone: their summary, and chunks one at a time.

A sealed segment never changes and every read names its position, so several threads may
share a reader.
"""

from __future__ import annotations

import os
import stat
import struct
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Metadata, MetadataIndex
from msgspec import Struct

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import SegmentError, exhausted
from hybridlog_storage.manifest import File, Loss, decode_file, encode_file, hasher
from hybridlog_storage.mcap.mcap_content import (
    MAGIC,
    MAX_CHUNK_HEAD,
    RECORD_HEAD,
    TAIL,
    ChunkHead,
    chunk_head_of,
    decompress,
    footer_of,
    parse_summary,
)
from hybridlog_storage.messages import EXPIRED_IDS, Batch, Buffer, Channel, distinct, with_expired
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.chunk_table import ChunkPlace, ChunkTable, places_of
from hybridlog_storage.segments.segment_format import (
    CHUNK_TABLE_OPCODE,
    FORMAT_VERSION,
    LOSSES_METADATA,
    MAX_HEAD,
    OUR_NAMES,
    RECORDING_METADATA,
    Attachment,
    FilePart,
    channel_of,
    json_of,
    losses_in,
    metadata_of,
    parse_attachment,
    reader_of,
    schema_of,
    trailer_of,
)
from hybridlog_storage.stopping import check_wanted

if TYPE_CHECKING:
    from mcap.summary import Summary
    from numpy.typing import NDArray

    Left = Callable[[int, int], tuple[Batch, NDArray[np.int64]]]


_MAX_SUMMARY = 1 << 30
_PIECE = 4 << 20  # bytes read at once for a checksum
_AHEAD = 64 << 20  # bytes that are announced at once; a multiple of the former


class SegmentSummary(Struct, frozen=True, kw_only=True):
    """The checked summary of a sealed segment.

    Attributes:
        recording: Catalog entry of the recording at the start of the segment.
        channels: Channels by id, and those of messages without payload, see `EXPIRED_IDS`.
        losses: Rows of the loss ledger written with its messages.
        attachments: Attachments of the source, in file order.
        records: All metadata records, in file order.
        table: The chunk table.
        start: Byte where the summary starts.
        size: Bytes of the file.
    """

    recording: dict[str, object]
    channels: dict[int, Channel]
    losses: list[Loss]
    attachments: list[AttachmentIndex]
    records: list[MetadataIndex]
    table: ChunkTable
    start: int
    size: int

    @property
    def metadata(self) -> list[MetadataIndex]:
        """Metadata records of the source, in file order."""
        return [one for one in self.records if not one.name.startswith(OUR_NAMES)]

    @property
    def chunks(self) -> list[ChunkPlace]:
        """Position of each chunk, in file order."""
        return places_of(self.table)


class SegmentReader:
    """One sealed segment file."""

    _added = 0  # to ids of channels

    def __init__(self, path: Path, number: int) -> None:
        self.path = path
        self.number = number
        cure = "Restore the file, or run `hybridlog verify` for a list of what is affected."
        try:
            # Opening must not block, for example on a named pipe.
            self._fd = files.open_file(path, os.O_RDONLY)
        except OSError as error:
            problem = f"Segment {path} cannot be opened: {error.strerror}. {cure}"
            raise (exhausted(error.errno, f"opening {path}") or SegmentError(problem)) from error
        about = os.fstat(self._fd)
        if not stat.S_ISREG(about.st_mode):
            self.close()
            raise SegmentError(f"Segment {path} is not an ordinary file. {cure}")
        self.size = about.st_size
        self.bytes_read = 0

    def close(self) -> None:
        """Close the file."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __del__(self) -> None:
        if hasattr(self, "_fd"):
            self.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def grow(self) -> None:
        """Update the file's size after an append."""
        self.size = os.fstat(self._fd).st_size

    def summary(self) -> SegmentSummary:
        """Channels, chunks and metadata, from the summary at the end of the file."""
        try:
            records, table, start = self._records()
        except SegmentError as error:
            raise SegmentError(
                f"Segment {self.path} has no readable summary: {error}. It was sealed and has "
                "changed since. A repair makes the summary again if all chunks are whole; else "
                "restore the file, or see what is left with `mcap recover`."
            ) from error
        recording: dict[str, object] | None = None
        losses: list[Loss] = []
        for index in records.metadata_indexes:
            if index.name == RECORDING_METADATA:
                recording = json_of(self.metadata(index))
                check_format(recording, self.path)
            elif index.name == LOSSES_METADATA:
                losses += losses_in(self.metadata(index))
        if recording is None:
            raise SegmentError(f"{self.path} is no segment of a hybridlog store.")
        if self._added:
            parts = table.parts.copy()
            parts["channel"] += self._added
            table = ChunkTable(table.chunks, parts)
        schemas = {i: schema_of(r) for i, r in records.schemas.items()}
        channels = {i: channel_of(r, schemas) for i, r in records.channels.items()}
        return SegmentSummary(
            recording=recording,
            channels=with_expired(channels, {*table.parts["channel"].tolist()}),
            losses=losses,
            attachments=records.attachment_indexes,
            records=records.metadata_indexes,
            table=table,
            start=start,
            size=self.size,
        )

    def _records(self) -> tuple[Summary, ChunkTable, int]:
        """The checked summary, its chunk table, and where it starts."""
        end = self.size - TAIL
        footer = footer_of(self.read(end, TAIL)) if end >= len(MAGIC) else None
        if footer is None:
            raise SegmentError("its end is damaged or missing")
        start, offsets, crc = footer
        if not len(MAGIC) <= start <= offsets <= end or end - start > _MAX_SUMMARY:
            raise SegmentError("its footer is damaged")
        data = self.read(start, self.size - start)
        if crc32(data[: len(data) - len(MAGIC) - 4]) != crc:
            raise SegmentError("its checksum differs")
        # The chunk table says more than chunk indexes, and is faster to read.
        found, others = parse_summary(data[: len(data) - TAIL], skipped=Opcode.CHUNK_INDEX)
        table = ChunkTable.from_bytes(others.get(CHUNK_TABLE_OPCODE, b""))
        if table.end > start:
            raise SegmentError("its chunk table is of another file")
        stated = found.statistics.channel_message_counts if found.statistics else {}
        is_known = {*table.parts["channel"].tolist()} <= found.channels.keys()
        if table.counts() != {c: n for c, n in stated.items() if n} or not is_known:
            raise SegmentError("its statistics and its chunk table differ")
        return found, table, start

    def metadata(self, index: MetadataIndex) -> Metadata:
        """A metadata record."""
        try:
            return metadata_of(self.read(index.offset, index.length), index.offset)
        except SegmentError as error:
            raise self._lost("metadata record", index, str(error)) from error

    def attachment(self, index: AttachmentIndex) -> Attachment:
        """An attachment, after checking all its bytes; they are read again later."""
        try:
            found = self.attachment_at(index.offset, index.length)
        except SegmentError as error:
            raise self._lost("attachment", index, str(error)) from error
        if found.index(index.offset, index.length) != index:
            raise self._lost("attachment", index, "another one is there")
        return found

    def attachment_at(self, offset: int, length: int) -> Attachment:
        """The attachment of a record, after checking all its bytes."""
        start, size = offset + RECORD_HEAD.size, length - RECORD_HEAD.size
        head = self.read(start, max(min(size, MAX_HEAD), 0))
        found, used = parse_attachment(
            head, FilePart(reader_of(self._fd), start, size), needs_crc=True
        )
        if used != size:
            raise SegmentError("an attachment record is longer than its fields")
        return found

    def _lost(self, what: str, index: MetadataIndex | AttachmentIndex, why: str) -> SegmentError:
        return SegmentError(
            f"The {what} {index.name!r} at byte {index.offset} of {self.path} is damaged: {why}. "
            "Restore the file."
        )

    def read_chunk(self, place: ChunkPlace) -> StoredChunk:
        """Read, decompress and check one chunk."""
        check_wanted()
        data = self.read(place.offset, place.length + place.trailer)
        try:
            content, head = open_chunk(data[: place.length])
            if (head.first, head.last) != (place.first, place.last):
                raise SegmentError("its times are not those of the chunk table")
            trailer = trailer_of(data[place.length :], place.offset)
            batch, seq = trailer.batch(content), trailer.arrivals()[1]
            if len(seq) != len(batch):
                raise SegmentError(f"it has {len(seq)} arrival numbers for {len(batch)} messages")
        except SegmentError as error:
            raise self._damaged(place, error) from error
        return StoredChunk(self.number, place, batch, seq)

    def _damaged(self, place: ChunkPlace, error: SegmentError) -> SegmentError:
        is_open = self.path.suffix == ".open"
        cure = ". `hybridlog verify --repair` seals all else of a crash" if is_open else ""
        return SegmentError(
            f"Chunk at byte {place.offset} of {self.path} is damaged: {error}{cure}"
        )

    def read_times(self, place: ChunkPlace) -> dict[int, NDArray[np.int64]]:
        """Log times of a chunk's messages, int64[n], ns, ascending, by channel id."""
        check_wanted()
        behind = self.read(place.offset + place.length, place.trailer)
        try:
            indexes = trailer_of(behind, place.offset).indexes
        except SegmentError as error:
            raise self._damaged(place, error) from error
        return {channel: rows["log_time"].astype(np.int64) for channel, rows in indexes}

    def digest(self, progress: Callable[[int], None] | None = None) -> str:
        """BLAKE3 of all bytes, which are read for it; `progress` gets the number read so far."""
        found = hasher()
        for at in range(0, self.size, _PIECE):
            if at % _AHEAD == 0:
                with suppress(OSError):  # what is missing is told when it is read
                    files.fetch(self._fd, [(at, at + _AHEAD)])
            found.update(self.read(at, min(_PIECE, self.size - at)))
            if progress is not None:
                progress(at)
        return found.hexdigest()

    def fetch(self, places: Iterable[ChunkPlace]) -> None:
        """Announce chunks that will be read, so that a bucket is asked once for all of them."""
        with suppress(OSError):  # what is missing is told when it is read
            files.fetch(self._fd, ((at.offset, at.end) for at in places))

    def read(self, offset: int, length: int) -> memoryview:
        """Unchecked bytes of the file; `SegmentError` if it is too short."""
        if offset + length > self.size:
            raise SegmentError(
                f"{self.path} ends at byte {self.size}, but bytes {offset} to "
                f"{offset + length} are referred to: the file was cut short."
            )
        buffer = np.empty(length, np.uint8).data
        try:
            count = files.preadv(self._fd, [buffer], offset)
        except OSError as error:
            raise SegmentError(f"{self.path} cannot be read: {error.strerror}.") from error
        if count < length:
            raise SegmentError(f"{self.path} gives {count} bytes of {length} at {offset}.")
        self.bytes_read += length
        return buffer


def check_format(recording: Mapping[str, object], path: Path) -> None:
    """Raise `SegmentError` if a segment has another format."""
    version = recording.get("format")
    if version != FORMAT_VERSION:
        raise SegmentError(
            f"{path} is of format {version}, and this hybridlog knows format {FORMAT_VERSION}. "
            "Use the hybridlog that wrote it."
        )


def open_chunk(record: memoryview) -> tuple[Buffer, ChunkHead]:
    """Content of a whole chunk record, and what stands before it; else `SegmentError`."""
    head = chunk_head_of(record[:MAX_CHUNK_HEAD])
    if head is None or head.opcode != Opcode.CHUNK or head.length != len(record):
        raise SegmentError("no chunk record is there")
    if head.end != len(record):
        raise SegmentError("the length of its records is wrong")
    content = decompress(head.codec, record[head.start :], head.size)
    if crc32(content) != head.crc:
        raise SegmentError("its checksum differs")
    return content, head


_HEAD = struct.Struct("<4s8sIIQ")  # magics, bytes of the line, CRC-32 and bytes of all behind
_MAGIC = b"PAR1", b"hbl-rows"
_STRETCH = struct.Struct("<QQ")  # its place in the log, its bytes
_MAX_FRONT = 1 << 30
_ADDED = {"expired": EXPIRED_IDS, "elsewhere": 2 * EXPIRED_IDS}


def front(reader: SegmentReader, summary: SegmentSummary, log: File) -> bytes:
    """Make what stands before the columns of the first file of rows of a log, behind its magic.

    `log` is its line of the manifest, which says that it is gone.
    """
    stretches = {one.offset: one.length for one in summary.records}
    stretches[summary.start] = reader.size - summary.start
    line = encode_file(log)
    body: list[Buffer] = [line]
    for at, size in sorted(stretches.items()):
        body += [_STRETCH.pack(at, size), reader.read(at, size)]
    data = b"".join(body)
    head = _HEAD.pack(*_MAGIC, len(line), crc32(data), len(data))
    return head[len(_MAGIC[0]) :] + data


class GoneLog(SegmentReader):
    """A log that is gone, by its first file of rows; `log` is its line of the manifest.

    `left` gives, unchecked, the rows that remain of a chunk (numbers of log and chunk), and the
    arrival numbers of its messages; without it there is a summary only.
    """

    def __init__(self, path: Path, number: int, left: Left | None = None) -> None:
        super().__init__(path, number)
        self._left = left
        self._stretches: list[tuple[int, memoryview]] = []
        try:
            self.log = self._front()
        except (SegmentError, ValueError, struct.error) as error:
            self.close()
            raise SegmentError(
                f"{path} is no whole file of rows of log {number}. Restore the file."
            ) from error
        self.size, self._added = self.log.bytes, _ADDED[str(self.log.gone)]

    def _front(self) -> File:
        *magic, line, crc, length = _HEAD.unpack(self.read(0, _HEAD.size))
        if tuple(magic) != _MAGIC or not line <= length <= _MAX_FRONT:
            raise SegmentError("it begins with something else")
        data = self.read(_HEAD.size, length)
        if crc32(data) != crc:
            raise SegmentError("its checksum differs")
        log, at, stretches = decode_file(bytes(data[:line])), line, []
        while at < length:
            place, own = _STRETCH.unpack_from(data, at)
            at += _STRETCH.size + own
            stretches.append((place, data[at - own : at]))
        if log.number != self.number or log.gone not in _ADDED:
            raise SegmentError("it is of another log")
        self._stretches = stretches
        return log

    def read(self, offset: int, length: int) -> memoryview:
        """Bytes of the log, of which there are metadata records and the summary only."""
        if not self._stretches:
            return super().read(offset, length)
        for place, data in self._stretches:
            if place <= offset and offset + length <= place + len(data):
                return data[offset - place : offset - place + length]
        raise SegmentError(f"Byte {offset} of log {self.number} is gone: {self.path} has its rows.")

    def digest(self, _: object = None) -> str:
        """BLAKE3 of the log, as the manifest had it."""
        return self.log.digest

    def fetch(self, places: Iterable[ChunkPlace]) -> None:
        """Nothing: rows are read in larger pieces."""

    def read_times(self, place: ChunkPlace) -> dict[int, NDArray[np.int64]]:
        """As of a segment."""
        batch = self.read_chunk(place).batch
        channels = distinct(batch.channel).tolist()
        return {c: np.sort(batch.log_time[batch.channel == c]) for c in channels}

    def read_chunk(self, place: ChunkPlace) -> StoredChunk:
        """The rows that are left of a chunk."""
        check_wanted()
        try:
            if self._left is None:
                raise SegmentError("its rows are not at hand")
            batch, seq = self._left(self.number, place.number)
            channels = {channel % EXPIRED_IDS for channel in place.channels}
            times = (place.first, place.last)
            is_all = (
                len(batch)
                and {*distinct(batch.channel).tolist()} == channels
                and (int(batch.log_time.min()), int(batch.log_time.max())) == times
            )
            if not is_all:
                raise SegmentError("its messages are not those in the files of rows")
        except SegmentError as error:
            raise SegmentError(
                f"Chunk {place.number} of log {self.number}, which is gone, is damaged: {error}"
            ) from error
        batch.channel = batch.channel + np.int32(self._added)
        return StoredChunk(self.number, place, batch, seq)


def open_log(path: Path, number: int, left: Left | None = None) -> SegmentReader:
    """Open a sealed log, or what is left of it, by its first file of rows; `left` of `GoneLog`."""
    return GoneLog(path, number, left) if path.suffix == ".parquet" else SegmentReader(path, number)
