"""Checks every byte of a sealed segment against its digest, and finds what is damaged."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, Self

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.manifest import hasher
from hybridlog_storage.mcap.mcap_scan import ScanDamage, ScannedChunk, scan
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping
    from pathlib import Path

    from blake3 import blake3

    from hybridlog_storage.segments.chunk_table import ChunkTable
    from hybridlog_storage.segments.segment_reader import SegmentSummary


class SegmentCheck:
    """Checks one sealed segment; a context manager.

    Args:
        path: The file.
        digest: The one in the manifest; empty if it lists none.

    Raises:
        SegmentError: It cannot be opened.
    """

    def __init__(self, path: Path, digest: str = "") -> None:
        self._digest = digest
        self.summary: SegmentSummary | None = None
        """The segment's summary; None if it is damaged."""
        self._reader = SegmentReader(path, 0)
        self._table: ChunkTable | None = None
        self._problem = ""
        try:
            self._table = self._reader.table()
            self.summary = self._reader.summary()
        except SegmentError as error:
            self._problem = str(error)

    def __enter__(self) -> Self:
        """Return this object."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self._reader.close()

    def problems(self, progress: Callable[[int], None] | None = None) -> Iterator[tuple[int, str]]:
        """Find all damage.

        Without a summary only chunks and attachments can be checked, by their own checksums.

        Args:
            progress: Called with the number of bytes read so far.

        Yields:
                Byte and description, in file order; a damaged summary comes first.
        """
        if self._table is not None:
            yield from self._problems(self._table, progress)
            return
        yield max(self._reader.size - 1, 0), self._problem
        with self._reader.stream() as file:
            for offset, item in scan(file, size=self._reader.size):
                if isinstance(item, ScanDamage):
                    yield item.offset, item.reason
                elif isinstance(item, ScannedChunk):
                    try:
                        item.content_bytes()
                    except SegmentError as error:
                        yield offset, f"a chunk is damaged: {error}"
                if progress is not None:
                    progress(offset)

    def _problems(
        self, table: ChunkTable, progress: Callable[[int], None] | None
    ) -> Iterator[tuple[int, str]]:
        digest = hasher()
        pieces = damaged_pieces(self._reader, table, progress, self._names(), digest)
        problems = list(pieces)
        yield from problems
        if not problems and self.summary is None:
            yield table.end, self._problem
        elif not problems and self._digest:
            self._reader.checksum(table.end, self._reader.size - table.end, digest)
            if digest.hexdigest() != self._digest:
                yield table.end, "it is not the file that the manifest lists: their digests differ"

    def _names(self) -> dict[int, str]:
        """Descriptions of the records of the source, by their offset."""
        if self.summary is None:
            return {}
        named = {m.offset: f"the metadata record {m.name!r}" for m in self.summary.metadata}
        return named | {a.offset: f"the attachment {a.name!r}" for a in self.summary.attachments}


def damaged_pieces(
    reader: SegmentReader,
    table: ChunkTable,
    progress: Callable[[int], None] | None = None,
    names: Mapping[int, str] = MappingProxyType({}),
    digest: blake3 | None = None,
) -> Iterator[tuple[int, str]]:
    """Find the parts of a segment that differ from their checksums.

    Args:
        reader: The segment.
        table: The chunk table of its summary.
        progress: Called with the byte up to which the segment has been read.
        names: Descriptions of records outside of chunks, by their offset.
        digest: Gets all bytes before the summary.

    Yields:
        Byte and description, in file order.
    """
    for start, length, crc, what in _pieces(table, names):
        try:
            if reader.checksum(start, length, digest) != crc:
                yield start, f"{what} changed: the checksum of {length} bytes differs"
        except SegmentError as error:
            yield start, str(error)
        if progress is not None:
            progress(start + length)


def _pieces(table: ChunkTable, names: Mapping[int, str]) -> list[tuple[int, int, int, str]]:
    """Start, length, checksum and description of every part in a table."""
    found: list[tuple[int, int, int, str]] = []
    fields = ("offset", "length", "trailer", "crc", "trailer_crc")
    columns = (table.chunks[name].tolist() for name in fields)
    rows = zip(*columns, strict=True)
    for number, (offset, length, trailer, crc, trailer_crc) in enumerate(rows):
        found.append((offset, length, crc, f"chunk {number}"))
        what = f"the message indexes or arrival numbers of chunk {number}"
        found.append((offset + length, trailer, trailer_crc, what))
    for offset, length, crc in table.others.tolist():
        found.append((offset, length, crc, names.get(offset, "bytes between chunks")))
    return sorted(found)
