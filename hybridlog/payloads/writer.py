"""Writes the files of payloads of one topic."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa

from hybridlog.payloads.columns import TopicColumns, column_at, values_of
from hybridlog.payloads.encodings import LEVEL, encodings_of
from hybridlog.payloads.layout import IN_PAYLOADS, payload_file
from hybridlog.payloads.zones import Zone
from hybridlog.tables.layout import (
    About,
    Section,
    TopicCounts,
    table_schema_of,
    topic_folder,
)
from hybridlog.tables.parquet_file import ParquetFileWriter
from hybridlog_storage import durability, files
from hybridlog_storage.journal import PayloadFile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from hybridlog.payloads.clouds import PointLayout
    from hybridlog.payloads.columns import Piece
    from hybridlog_storage.messages import Channel

GROUP_BYTES: Final = 4 << 20
"""Bytes of the messages of a row group: what is read for one message."""
FILE_BYTES: Final = 1 << 30
"""Bytes of the messages of a file."""


@dataclass(slots=True)
class _OpenFile:
    """A file that is being written.

    Attributes:
        name: Its path below the folder.
        tables: Rows that wait for a row group.
        waiting: Their bytes.
        size: Bytes of all its messages.
        zones: For each row group, the zone of each array, by path.
        chunks: For each row group, segment, number and rows of each chunk in it.
        bounds: See `About`.
        segments: See `About`.
        last: Time and arrival number of the last row.
        is_ordered: True if rows are in order of time and arrival.
    """

    name: str
    columns: list[list[str]] = field(default_factory=list)
    writer: ParquetFileWriter | None = None
    tables: list[pa.Table] = field(default_factory=list)
    waiting: int = 0
    size: int = 0
    pending: list[list[int]] = field(default_factory=list)
    chunks: list[list[list[int]]] = field(default_factory=list)
    zones: list[dict[str, list[Any]]] = field(default_factory=list)
    bounds: list[tuple[int, int, int, int, int]] = field(default_factory=list)
    segments: dict[str, str] = field(default_factory=dict)
    last: tuple[int, int] = (-(1 << 63), -1)
    is_ordered: bool = True
    rows: int = 0


class TopicWriter:
    """Writes the messages of one topic and type.

    Args:
        folder: The folder of unfinished files.
        recording: Id of the recording.
        channel: A channel of the topic.
        columns: Makes the rows.
        number: Returns a number for a new file of the topic.
    """

    def __init__(
        self,
        folder: Path,
        recording: str,
        channel: Channel,
        columns: TopicColumns,
        number: Callable[[], int],
    ) -> None:
        self._folder = folder
        self._recording = recording
        self._channel = channel
        self._columns = columns
        self._number = number
        self._open: dict[PointLayout | None, _OpenFile] = {}
        self.written: list[PayloadFile] = []
        """Complete files; they are on the disk."""

    def add(self, piece: Piece, segment: int, chunk: int, digest: str) -> None:
        """Add the messages of a chunk.

        Args:
            piece: Their rows.
            segment: Number of the segment.
            chunk: Number of the chunk.
            digest: Digest of the segment.

        Raises:
            HybridlogError: The file cannot be written.
        """
        file = self._open.get(piece.layout)
        if file is None:
            schema = table_schema_of(self._channel)
            name = payload_file(topic_folder(self._channel.topic), schema, self._number())
            file = self._open[piece.layout] = _OpenFile(name)
            file.columns = [column.to_json() for column in self._columns.columns]
        file.tables.append(piece.table)
        file.waiting += piece.size
        file.size += piece.size
        file.pending.append([segment, chunk, piece.table.num_rows])
        file.segments[str(segment)] = digest
        if file.waiting >= GROUP_BYTES:
            self._flush(file)
        if file.size >= FILE_BYTES:
            del self._open[piece.layout]
            self._finish(file, piece.layout)

    def close(self) -> None:
        """Finish all files.

        Raises:
            HybridlogError: One cannot be written.
        """
        while self._open:
            layout, file = self._open.popitem()
            self._finish(file, layout)

    def discard(self) -> None:
        """Delete what is unfinished."""
        for file in self._open.values():
            if file.writer is not None:
                file.writer.discard()
        self._open.clear()

    def _flush(self, file: _OpenFile) -> None:
        table = pa.concat_tables(file.tables).combine_chunks()
        path = self._folder / file.name
        try:
            if file.writer is None:
                files.make_folders(path.parent, depth=IN_PAYLOADS - 1)
                file.writer = ParquetFileWriter(
                    path, table, depth=IN_PAYLOADS, encodings=encodings_of(table), level=LEVEL
                )
            file.writer.write(table)
        except OSError as error:
            raise durability.explain(error, path, "writing") from error
        time, seq = (column_at(table, name).to_numpy() for name in ("t", "seq"))
        first, last = (int(time[0]), int(seq[0])), (int(time[-1]), int(seq[-1]))
        is_next = (time[1:] > time[:-1]) | ((time[1:] == time[:-1]) & (seq[1:] > seq[:-1]))
        file.is_ordered &= file.last < first and bool(is_next.all())
        file.last = last
        file.bounds.append((len(time), *first, *last))
        file.chunks.append(file.pending)
        file.zones.append(_zones(table, file.columns))
        file.rows += len(time)
        file.tables, file.pending, file.waiting = [], [], 0

    def _finish(self, file: _OpenFile, layout: PointLayout | None) -> None:
        if file.tables:
            self._flush(file)
        assert file.writer is not None
        payloads: dict[str, Any] = {
            "wire": self._channel.message_encoding,
            "arrays": file.columns,
            "order": [array.path for array in self._columns.arrays],
            "layout": layout.to_json() if layout is not None else None,
            "chunks": file.chunks,
            "zones": file.zones,
            "is_ordered": file.is_ordered,
        }
        topics = {self._channel.topic: TopicCounts(file.rows)}
        path = self._folder / file.name
        try:
            file.writer.close(
                About(
                    [Section(self._recording, 0, file.segments, topics)],
                    bounds=tuple(file.bounds),
                    payloads=payloads,
                )
            )
            size, digest = synced(path)
        except OSError as error:
            raise durability.explain(error, path, "writing") from error
        self.written.append(PayloadFile(file.name, size, digest, self._channel.topic, file.rows))


def _zones(table: pa.Table, columns: Sequence[Sequence[str]]) -> dict[str, list[Any]]:
    """The zones of the arrays in a row group, but for those of bytes."""
    found = {}
    for path, column, dtype in columns:
        if dtype != "u1":
            values, bounds = values_of(column_at(table, column))
            found[path] = Zone.of(values, bounds).to_json()
    return found


def synced(path: Path) -> tuple[int, str]:
    """Force a file to the disk; return its size, and the digest of its footer.

    Raises:
        OSError: It cannot be read or synced.
    """
    fd = files.open_file(path, os.O_RDONLY, depth=IN_PAYLOADS)
    try:
        durability.sync_file(fd)
        return footer_digest(fd)
    finally:
        os.close(fd)


def footer_digest(fd: int) -> tuple[int, str]:
    """Size of a Parquet file, and SHA-256 of its footer, which has checksums of the rest."""
    size = os.fstat(fd).st_size
    tail = os.pread(fd, 8, max(size - 8, 0))
    length = min(int.from_bytes(tail[:4], "little") + 8, size)
    footer = os.pread(fd, length, size - length)
    return size, f"sha256:{hashlib.sha256(footer).hexdigest()}"
