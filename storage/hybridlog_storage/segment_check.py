"""What in a sealed segment no checksum covers, held against what one does.

Chunks and the summary have checksums. Around the chunks stand records without one:
definitions, message indexes, metadata. hybridlog reads around damage in most of them,
but another MCAP reader may not, so they are to be as they were written.
"""

from __future__ import annotations

import os
from dataclasses import replace
from typing import TYPE_CHECKING, Self

from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Header, Metadata, Schema

from hybridlog_storage.append_file import BLOCK
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap_content import MESSAGE_HEAD, RECORD_HEAD, read_record
from hybridlog_storage.mcap_scan import MAGIC, read_summary
from hybridlog_storage.segment_format import (
    ARRIVAL_OPCODE,
    CHUNK_HEAD,
    PADDING_OPCODE,
    PROFILE,
    index_offsets,
    message_indexes,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from mcap.summary import Summary

    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.mcap_content import Record

_HEAD = RECORD_HEAD.size
_DATA_END_SIZE = _HEAD + 4
_FOOTER_SIZE = _HEAD + 20
_OF_CHUNKS = frozenset({int(Opcode.MESSAGE_INDEX), ARRIVAL_OPCODE})


class SegmentCheck:
    """Checks the records of one sealed segment; a context manager.

    Args:
        path: The segment.

    Raises:
        SegmentError: It cannot be opened, or has no readable summary.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file = path.open("rb")
        except OSError as error:
            raise SegmentError(f"Segment {path} cannot be opened: {error.strerror}.") from error
        self._size = os.fstat(self._file.fileno()).st_size
        summary = read_summary(self._file, self._size)
        if summary is None:
            self._file.close()
            raise SegmentError(f"Segment {path} has no readable summary.")
        self._summary: Summary = summary
        self._listed = {listed.chunk_start_offset: listed for listed in summary.chunk_indexes}

    def __enter__(self) -> Self:
        """The check itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self._file.close()

    def chunk(self, chunk: StoredChunk) -> str | None:
        """What is wrong around a chunk whose content is right.

        Args:
            chunk: As it was read from this segment.
        """
        batch = chunk.batch
        _, _, first, last, size, _ = CHUNK_HEAD.unpack(self._read(chunk.offset, CHUNK_HEAD.size))
        if (first, last) != (int(batch.log_time.min()), int(batch.log_time.max())):
            return "its head names other times than those of its messages"
        starts = batch.offset - MESSAGE_HEAD.itemsize
        indexes = message_indexes(batch.channel, batch.log_time, starts)
        want = b"".join(indexes.values())
        at = chunk.offset + chunk.length
        if self._read(at, len(want)) != want or self._head(at + len(want))[0] != ARRIVAL_OPCODE:
            return "its message indexes are damaged"
        listed = self._listed.get(chunk.offset)
        if listed is None or listed != replace(
            listed,
            message_start_time=first,
            message_end_time=last,
            message_index_offsets=index_offsets(
                {channel: len(index) for channel, index in indexes.items()}, at
            ),
            message_index_length=len(want),
            compressed_size=chunk.compressed_size,
            uncompressed_size=size,
        ):
            return "the summary lists it otherwise than it is"
        return None

    def between_chunks(self) -> Iterator[tuple[int, str]]:
        """Byte and description of all that is wrong outside of chunks and their indexes."""
        at, end = len(MAGIC), self._end_of_data()
        # A chunk that is said to lie behind the data is found by who reads it.
        starts = [*sorted(start for start in self._listed if start < end), end]
        if self._read(0, at) != MAGIC:
            yield 0, "the file does not start as an MCAP file"
        for start in starts:
            while at < start:
                opcode, length = self._head(at)
                if at + _HEAD + length > start:
                    yield at, "no record starts here"
                    break
                problem = self._problem(opcode, at, length)
                if problem is not None:
                    yield at, problem
                at += _HEAD + length
            listed = self._listed.get(start)
            at = end if listed is None else start + listed.chunk_length
        if self._head(end) != (Opcode.DATA_END, 4):
            yield end, "the record that ends the data is damaged"

    def _end_of_data(self) -> int:
        footer = self._size - len(MAGIC) - _FOOTER_SIZE
        start = int.from_bytes(self._read(footer + _HEAD, 8), "little")
        return start - _DATA_END_SIZE

    def _problem(self, opcode: int, at: int, length: int) -> str | None:
        if opcode in _OF_CHUNKS:
            return None  # `chunk` compares those
        if opcode == PADDING_OPCODE:
            damaged = length >= BLOCK or any(self._read(at + _HEAD, length))
            return "the padding before a chunk is damaged" if damaged else None
        try:
            record, _ = read_record(opcode, self._read(at + _HEAD, length))
        except SegmentError as error:
            return str(error)
        return self._misfit(record, at)

    def _misfit(self, record: Record | None, at: int) -> str | None:
        summary = self._summary
        if isinstance(record, Schema):
            if summary.schemas.get(record.id) != record:
                return "a schema differs from the summary's"
        elif isinstance(record, Channel):
            if summary.channels.get(record.id) != record:
                return "a channel differs from the summary's"
        elif isinstance(record, Metadata):
            if all((i.offset, i.name) != (at, record.name) for i in summary.metadata_indexes):
                return "a metadata record differs from the summary's index"
        elif isinstance(record, Header):
            if record.profile != PROFILE:
                return f"the header names the profile {record.profile!r}"
        elif record is None or isinstance(record, DataEnd):
            return "no segment has such a record here"
        return None

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode and length of the record at a byte; zeros at the end of the file."""
        opcode, length = RECORD_HEAD.unpack(self._read(at, _HEAD).ljust(_HEAD, b"\0"))
        return opcode, length

    def _read(self, at: int, length: int) -> bytes:
        try:
            return os.pread(self._file.fileno(), max(min(length, self._size - at), 0), at)
        except OSError as error:
            raise SegmentError(f"{self._path} cannot be read: {error.strerror}.") from error
