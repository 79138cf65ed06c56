"""Writes a segment again without the content of some chunks, which *expire*.

Such a chunk keeps its number, its times, its message indexes and its arrival numbers. In place
of the chunk record stands a short record with the size and the checksum of the content.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability
from hybridlog_storage.disk.append_file import AppendFile
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.segments.segment_file import SegmentFile
from hybridlog_storage.segments.segment_format import (
    COMPACTED_METADATA,
    DATA_END_SIZE,
    json_metadata,
)
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.segments.segment_file import Sealed
    from hybridlog_storage.segments.segment_reader import SegmentSummary

_PIECE = 4 << 20  # bytes copied at once


class _Piece(NamedTuple):
    """A stretch of a segment: a chunk with what belongs to it, or bytes between chunks.

    Attributes:
        offset: Where it starts.
        length: Its bytes; of a chunk those of its record.
        crc: CRC-32 of these.
        chunk: Number of the chunk; None for bytes between chunks.
    """

    offset: int
    length: int
    crc: int
    chunk: int | None


def thin(
    reader: SegmentReader,
    target: Path,
    records: Mapping[int, Callable[[Buffer], bytes]],
    about: Mapping[str, Any],
) -> Sealed:
    """Write a segment without the content of some chunks.

    Args:
        reader: The segment.
        target: The new file; it must not exist.
        records: What makes the record in place of that of a chunk, by the chunk's number.
        about: Content of the metadata record that says so.

    Returns:
        The new segment; it is on the disk.

    Raises:
        SegmentError: The segment is damaged.
        DiskFullError: There is no room.
        StoreError: The new file cannot be written.
    """
    summary = reader.summary()
    try:
        file = AppendFile.create(target)
    except OSError as error:
        raise durability.explain(error, target, "creating") from error
    segment = SegmentFile(target, reader.number, file)
    try:
        _copy(reader, summary, segment, records)
        segment.add_metadata(json_metadata(COMPACTED_METADATA, about))
        sealed = segment.complete()
        segment.finish()
    except BaseException:
        segment.abandon()
        raise
    return sealed


def _copy(
    reader: SegmentReader,
    summary: SegmentSummary,
    segment: SegmentFile,
    records: Mapping[int, Callable[[Buffer], bytes]],
) -> None:
    ids = summary.schema_ids
    stored = summary.table.as_stored()
    channels = ((number, ids[number], summary.channels[number]) for number in ids)
    segment.define(channels, write=False)
    bounds = summary.table.part_bounds().tolist()
    places = summary.chunks
    old: list[int] = []
    new: list[int] = []
    for piece in _pieces(summary):
        old.append(piece.offset)
        new.append(segment.position)
        if piece.chunk is None:
            is_last = piece.offset + piece.length == summary.table.end
            _copy_stretch(reader, segment, piece, is_last=is_last)
            continue
        place = places[piece.chunk]
        record: Buffer = _checked(reader, place.offset, place.length, piece.crc)
        trailer = _checked(reader, place.offset + place.length, place.trailer, place.trailer_crc)
        if piece.chunk in records:
            record = records[piece.chunk](record)
        parts = stored.parts[bounds[piece.chunk] : bounds[piece.chunk + 1]]
        segment.append_copy(record, trailer, parts)

    def moved_to(offset: int) -> int:
        at = bisect_right(old, offset) - 1
        return new[at] + offset - old[at]

    metadata, attachments = reader.indexes()
    for index in metadata:
        if index.name != COMPACTED_METADATA:
            segment.note_metadata(index.name, moved_to(index.offset), index.length)
    for attachment in attachments:
        attachment.offset = moved_to(attachment.offset)
        segment.note_attachment_index(attachment)


def _pieces(summary: SegmentSummary) -> list[_Piece]:
    """All stretches in the order of the file; the last one holds the end of the data."""
    found = [_Piece(c.offset, c.length, c.crc, c.number) for c in summary.chunks]
    found += [
        _Piece(offset, length, crc, None) for offset, length, crc in summary.table.others.tolist()
    ]
    found.sort(key=lambda piece: piece.offset)
    if found[-1].chunk is not None or found[-1].length < DATA_END_SIZE:
        raise SegmentError("the segment does not end with the record of the end of its data")
    return found


def _copy_stretch(
    reader: SegmentReader, segment: SegmentFile, piece: _Piece, *, is_last: bool
) -> None:
    length = piece.length
    if reader.checksum(piece.offset, length) != piece.crc:
        raise SegmentError(f"{reader.path}: bytes at {piece.offset} are damaged")
    if is_last:
        length -= DATA_END_SIZE
    end = piece.offset + length
    starts = range(piece.offset, end, _PIECE)
    segment.append_stretch(reader.read(at, min(_PIECE, end - at)) for at in starts)


def _checked(reader: SegmentReader, offset: int, length: int, crc: int) -> memoryview:
    data = reader.read(offset, length)
    if crc32(data) != crc:
        raise SegmentError(f"{reader.path}: {length} bytes at {offset} are damaged")
    return data
