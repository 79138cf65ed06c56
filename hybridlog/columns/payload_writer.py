"""Writes the files of payloads of one topic.

The encoding of each column is chosen by trying them on the first rows.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hybridlog.columns.layout import (
    OWN_COLUMNS,
    RECIPE,
    Section,
    TopicCounts,
    payload_file,
    table_schema_of,
)
from hybridlog.columns.parquet_file import DICTIONARY, ParquetFileWriter, leaves
from hybridlog.columns.payload_rows import TopicColumns, field_of, rows_of, values_of
from hybridlog.columns.zones import Zone
from hybridlog_storage.disk import durability, files
from hybridlog_storage.journal import PayloadFile

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from hybridlog.columns.clouds import PointLayout
    from hybridlog.columns.field_files import FieldColumns
    from hybridlog.columns.payload_rows import Piece
    from hybridlog_storage.messages import Channel

GROUP_BYTES: Final = 4 << 20
"""Bytes of the messages of a row group: what is read for one message."""
FILE_BYTES: Final = 1 << 30
"""Bytes of the messages of a file."""
LEVEL: Final = 3
"""Level of zstd: the higher ones cost more time than they save room (9 takes 1 to 5 % less)."""
_PLAIN: Final = "PLAIN"
_SPLIT: Final = "BYTE_STREAM_SPLIT"
_DELTA: Final = "DELTA_BINARY_PACKED"
_TRIED = 1 << 18  # elements
_ELEMENT = ".list.element"
_MAX_OPEN = 8  # files of different columns: each row group of them waits in memory


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
        segments: Digests of its segments, by number.
    """

    name: str
    writer: ParquetFileWriter | None = None
    tables: list[pa.Table] = field(default_factory=list)
    waiting: int = 0
    size: int = 0
    pending: list[list[int]] = field(default_factory=list)
    chunks: list[list[list[int]]] = field(default_factory=list)
    zones: list[dict[str, list[Any]]] = field(default_factory=list)
    segments: dict[str, str] = field(default_factory=dict)
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
        columns: TopicColumns | FieldColumns,
        number: Callable[[], int],
    ) -> None:
        self._folder = folder
        self._recording = recording
        self.channel = channel
        self.columns = columns
        self._number = number
        self._open: dict[PointLayout | pa.Schema | None, _OpenFile] = {}
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
            schema = table_schema_of(self.channel)
            name = payload_file(self.columns.folder, schema, self._number())
            if len(self._open) >= _MAX_OPEN:
                first = next(iter(self._open))
                self._finish(self._open.pop(first), first)
            file = self._open[piece.layout] = _OpenFile(name)
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

    def _flush(self, file: _OpenFile) -> None:
        table = pa.concat_tables(file.tables).combine_chunks()
        path = self._folder / file.name
        try:
            if file.writer is None:
                files.make_folders(path.parent)
                file.writer = ParquetFileWriter(
                    path, table, encodings=encodings_of(table), level=LEVEL
                )
            file.writer.write(table)
        except OSError as error:
            raise durability.explain(error, path, "writing") from error
        file.chunks.append(file.pending)
        file.zones.append(self._zones(table))
        file.rows += table.num_rows
        file.tables, file.pending, file.waiting = [], [], 0

    def _zones(self, table: pa.Table) -> dict[str, list[Any]]:
        """The zones of the arrays in a row group, but for those of bytes."""
        fields = rows_of(table)[1]
        paths = [a.path for a in self.columns.arrays if a.dtype != np.uint8]
        return {path: Zone.of(*values_of(field_of(fields, path))).to_json() for path in paths}

    def _finish(self, file: _OpenFile, layout: PointLayout | pa.Schema | None) -> None:
        if file.tables:
            self._flush(file)
        assert file.writer is not None
        payloads: dict[str, Any] = {
            **self.columns.about(layout),
            "chunks": file.chunks,
            "zones": file.zones,
            "is_ordered": file.writer.is_ordered,
        }
        topics = {self.channel.topic: TopicCounts(file.rows)}
        section = Section(self._recording, 0, file.segments, topics)
        try:
            size, digest = file.writer.close([section], payloads=payloads, sync=True)
        except OSError as error:
            raise durability.explain(error, file.writer.path, "writing") from error
        self.written.append(PayloadFile(file.name, size, digest, self.channel.topic, file.rows))


def encodings_of(table: pa.Table) -> dict[str, str]:
    """The smallest encoding of each column of arrays, by its path in the file."""
    chosen = {f"{RECIPE}.rest": _PLAIN, f"{RECIPE}.padding": _PLAIN}
    rows = table.to_struct_array().combine_chunks()
    kinds = {leaf.path: leaf.kind for leaf in leaves(table.schema)}
    for path, kind in kinds.items():
        if path.partition(".")[0] in OWN_COLUMNS or path in chosen:
            continue
        if pa.types.is_binary(kind):
            chosen[path] = _PLAIN
        elif path.count(_ELEMENT) == 1 and path.endswith(_ELEMENT):
            array = field_of(rows, path.removesuffix(_ELEMENT))
            found = smallest(array.flatten().slice(0, _TRIED))
            if found:
                chosen[path] = found
    return {path: how for path, how in chosen.items() if path in kinds}


def smallest(values: pa.Array[Any]) -> str:
    """The encoding in which numbers take the fewest bytes; empty for values of other types."""
    sizes = {how: encoded_size(values, how) for how in _candidates(values.type)}
    return min(sizes, key=sizes.__getitem__, default="")


def _candidates(kind: pa.DataType) -> Sequence[str]:
    if pa.types.is_floating(kind):
        return (DICTIONARY, _PLAIN, _SPLIT)
    if pa.types.is_integer(kind):
        return (DICTIONARY, _DELTA, _SPLIT, _PLAIN)
    return ()


def encoded_size(values: pa.Array[Any], how: str, level: int = LEVEL) -> int:
    """Bytes of one column of Parquet with these values.

    Args:
        values: Numbers.
        how: `dictionary`, or the name of an encoding of Parquet.
        level: Level of zstd.
    """
    sink = io.BytesIO()
    pq.write_table(
        pa.table({"a": values}),
        sink,
        compression="zstd",
        compression_level=level,
        use_dictionary=how == DICTIONARY,
        column_encoding=None if how == DICTIONARY else {"a": how},
        write_statistics=False,
        store_schema=False,
    )
    return sink.tell()
