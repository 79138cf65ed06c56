"""A log that is gone: it answers from its first file of rows as if all its chunks were there.

In front of its columns this file has the line that the manifest has of the log, its metadata
records and its summary. So the same parser reads them, and pyarrow is loaded for messages only.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Protocol

import numpy as np

from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import decode_file, encode_file
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.ordering import distinct
from hybridlog_storage.segments.chunk import StoredChunk
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.stopping import check_wanted

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog_storage.manifest import File
    from hybridlog_storage.messages import Batch, Buffer
    from hybridlog_storage.segments.chunk_table import ChunkPlace
    from hybridlog_storage.segments.segment_reader import SegmentSummary

_HEAD = struct.Struct("<4s8sIIQ")  # magics, bytes of the line, CRC-32 and bytes of all behind
_MAGIC = b"PAR1", b"hbl-rows"
_STRETCH = struct.Struct("<QQ")  # its place in the log, its bytes
_MAX_FRONT = 1 << 30
_ADDED = {"expired": EXPIRED_IDS, "elsewhere": 2 * EXPIRED_IDS}


class Rows(Protocol):
    """Finds what is left of chunks. The caller checks it."""

    def left(self, log: int, chunk: int) -> tuple[Batch, NDArray[np.int64]]:
        """The rows that remain of a chunk of a log, and the arrival numbers of its messages."""


def front(reader: SegmentReader, summary: SegmentSummary, log: File) -> bytes:
    """Make what stands before the columns of the first file of rows of a log, behind its magic.

    `log` is its line of the manifest, which says that it is gone.
    """
    stretches = {one.offset: one.length for one in reader.records()}
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

    Without `rows` it has a summary only.
    """

    def __init__(self, path: Path, number: int, rows: Rows | None = None) -> None:
        super().__init__(path, number)
        self._rows = rows
        self._stretches: list[tuple[int, memoryview]] = []
        size, self.size = self.size, 0
        try:
            self.log = self._front(size)
        except BaseException:
            self.close()
            raise
        self.size = self.log.bytes
        self._added = _ADDED[str(self.log.gone)]

    def _front(self, size: int) -> File:
        problem = f"{self.path} is no whole file of rows of log {self.number}. Restore the file."
        self.size = size
        head = _HEAD.unpack(self.read(0, _HEAD.size)) if size >= _HEAD.size else (b"",) * 5
        *magic, line, crc, length = head
        if tuple(magic) != _MAGIC or length > min(size - _HEAD.size, _MAX_FRONT) or line > length:
            raise SegmentError(problem)
        data = self.read(_HEAD.size, length)
        if crc32(data) != crc:
            raise SegmentError(problem)
        try:
            log = decode_file(bytes(data[:line]))
        except ValueError as error:
            raise SegmentError(problem) from error
        at = line
        while at + _STRETCH.size <= length:
            place, own = _STRETCH.unpack_from(data, at)
            at += _STRETCH.size
            self._stretches.append((place, data[at : at + own]))
            at += own
        if log.number != self.number or log.gone not in _ADDED or at != length:
            raise SegmentError(problem)
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

    def read_chunk(self, place: ChunkPlace) -> StoredChunk:
        """The rows that are left of a chunk."""
        check_wanted()
        try:
            if self._rows is None:
                raise SegmentError("its rows are not at hand")
            batch, seq = self._rows.left(self.number, place.number)
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


def open_log(path: Path, number: int, rows: Rows | None = None) -> SegmentReader:
    """Open a sealed log, or what is left of it, by its first file of rows."""
    return GoneLog(path, number, rows) if path.suffix == ".parquet" else SegmentReader(path, number)
