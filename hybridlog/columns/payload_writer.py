"""Writes the files of fields of one topic."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import pyarrow as pa

from hybridlog.columns.layout import (
    Section,
    TopicCounts,
    payload_file,
    table_schema_of,
)
from hybridlog.columns.parquet_file import ParquetFileWriter
from hybridlog_storage.disk import durability, files
from hybridlog_storage.manifest import Fields

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from hybridlog.columns.field_files import FieldColumns
    from hybridlog_storage.messages import Channel

GROUP_BYTES: Final = 4 << 20
"""Bytes of a row group in memory."""
FILE_BYTES: Final = 1 << 30
"""Bytes of the rows of a file in memory."""
LEVEL: Final = 3
"""Level of zstd: the higher ones cost more time than they save room (9 takes 1 to 5 % less)."""
_MAX_OPEN = 8  # files of different columns: each row group of them waits in memory


@dataclass(slots=True)
class _OpenFile:
    """A file that is being written.

    Attributes:
        name: Its path below the folder.
        tables: Rows that wait for a row group.
        waiting: Their bytes.
        size: Bytes of all its rows.
        chunks: For each row group, segment, number and rows of each chunk in it.
        segments: Digests of its segments, by number.
    """

    name: str
    writer: ParquetFileWriter | None = None
    tables: list[pa.Table] = field(default_factory=list)
    waiting: int = 0
    size: int = 0
    pending: list[list[int]] = field(default_factory=list)
    chunks: list[list[list[int]]] = field(default_factory=list)
    segments: dict[str, str] = field(default_factory=dict)
    rows: int = 0


class TopicWriter:
    """Writes what is left of messages of one topic and type.

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
        columns: FieldColumns,
        number: Callable[[], int],
    ) -> None:
        self._folder = folder
        self._recording = recording
        self.channel = channel
        self.columns = columns
        self._number = number
        self._open: dict[pa.Schema, _OpenFile] = {}
        self.written: list[Fields] = []
        """Complete files; they are on the disk."""

    def add(self, table: pa.Table, segment: int, chunk: int, digest: str) -> None:
        """Add the messages of a chunk.

        Args:
            table: Their rows; those with the same columns share a file.
            segment: Number of the segment.
            chunk: Number of the chunk.
            digest: Digest of the segment.

        Raises:
            HybridlogError: The file cannot be written.
        """
        file = self._open.get(table.schema)
        if file is None:
            schema = table_schema_of(self.channel)
            name = payload_file(self.columns.folder, schema, self._number())
            if len(self._open) >= _MAX_OPEN:
                first = next(iter(self._open))
                self._finish(self._open.pop(first))
            file = self._open[table.schema] = _OpenFile(name)
        file.tables.append(table)
        file.waiting += table.nbytes
        file.size += table.nbytes
        file.pending.append([segment, chunk, table.num_rows])
        file.segments[str(segment)] = digest
        if file.waiting >= GROUP_BYTES:
            self._flush(file)
        if file.size >= FILE_BYTES:
            self._finish(self._open.pop(table.schema))

    def close(self) -> None:
        """Finish all files.

        Raises:
            HybridlogError: One cannot be written.
        """
        while self._open:
            self._finish(self._open.popitem()[1])

    def _flush(self, file: _OpenFile) -> None:
        table = pa.concat_tables(file.tables).combine_chunks()
        path = self._folder / file.name
        try:
            if file.writer is None:
                files.make_folders(path.parent)
                file.writer = ParquetFileWriter(path, table, level=LEVEL)
            file.writer.write(table)
        except OSError as error:
            raise durability.explain(error, path, "writing") from error
        file.chunks.append(file.pending)
        file.rows += table.num_rows
        file.tables, file.pending, file.waiting = [], [], 0

    def _finish(self, file: _OpenFile) -> None:
        if file.tables:
            self._flush(file)
        assert file.writer is not None
        payloads = {"chunks": file.chunks}
        topics = {self.channel.topic: TopicCounts(file.rows)}
        section = Section(self._recording, 0, file.segments, topics)
        try:
            size, digest = file.writer.close([section], payloads=payloads, sync=True)
        except OSError as error:
            raise durability.explain(error, file.writer.path, "writing") from error
        self.written.append(Fields(file.name, size, digest, self.channel.topic, file.rows))
