"""Writes the files of rows of a log."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from hashlib import sha256
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa

from hybridlog.columns.fields import FieldShape
from hybridlog.columns.layout import Section, TopicCounts, table_schema_of
from hybridlog.columns.left_rows import digest_in, with_rows
from hybridlog.columns.parquet_file import ParquetFileWriter
from hybridlog.columns.rows import Places, as_table, columns_from, piece_of
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.left import LeftCodec
from hybridlog.schema.states import State, state_of
from hybridlog_storage.manifest import Part, rows_line
from hybridlog_storage.ordering import distinct
from hybridlog_storage.segments.segment_file import rows_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from hybridlog.schema.codec import Codec
    from hybridlog_storage.manifest import File
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk

_GROUP_BYTES: Final = 4 << 20  # of a row group in memory
_LEVEL: Final = 3  # of zstd: 9 takes 1 to 5 % less, for much more time
_MAX_OPEN = 8  # files of different columns: each row group of them waits in memory
_Kind = tuple[str, str, bool]  # topic, hash of its definition, whether messages are reduced
_Part = tuple[int, int, int, int]  # messages, bytes, first and last time


@dataclass(slots=True)
class _OpenFile:
    """A file that is being written.

    Attributes:
        tables: Rows that wait for a row group.
        waiting: Their bytes.
        pending: Number and rows of each chunk among them.
        chunks: The same of each row group.
        parts: Messages, bytes, first and last time by channel.
    """

    name: str
    topic: str
    writer: ParquetFileWriter
    tables: list[pa.Table] = field(default_factory=list)
    waiting: int = 0
    pending: list[tuple[int, int]] = field(default_factory=list)
    chunks: list[list[tuple[int, int]]] = field(default_factory=list)
    parts: defaultdict[int, list[_Part]] = field(default_factory=lambda: defaultdict(list))


class RowsWriter:
    """Writes what is left of the messages of a log.

    Nobody else writes such files in `folder`, which is named by the id of the recording. `front`
    begins the first file (see `gone_log`), whose name has the number `version`; others follow.
    """

    def __init__(
        self,
        folder: Path,
        log: File,
        channels: Mapping[int, Channel],
        front: bytes,
        version: int = 0,
    ) -> None:
        self._folder = folder
        self._log = log
        self._channels = channels
        self._front = front
        self._version = version
        self._of_kind: dict[_Kind, tuple[Codec, FieldShape]] = {}
        self._open: dict[tuple[_Kind, pa.Schema], _OpenFile] = {}
        self.names: list[str] = []
        """Names of the files, the first one first."""
        self._written: list[File] = []

    def add(self, chunk: StoredChunk) -> None:
        """Add the messages of a chunk."""
        by_kind: dict[_Kind, list[int]] = {}
        for number in distinct(chunk.batch.channel).tolist():
            channel = self._channels[number]
            is_reduced = state_of(channel.message_encoding) is State.REDUCED
            kind = channel.topic, table_schema_of(channel), is_reduced
            by_kind.setdefault(kind, []).append(number)
        for kind, numbers in by_kind.items():
            if kind not in self._of_kind:
                self._of_kind[kind] = codec_for(self._channels[numbers[0]]), FieldShape()
            table = _table(chunk, numbers, *self._of_kind[kind])
            file = self._file(kind, table.schema)
            file.tables.append(table)
            file.waiting += table.nbytes
            file.pending.append((chunk.number, table.num_rows))
            for number in numbers:
                own = chunk.batch.channel == number
                times, size = chunk.batch.log_time[own], int(chunk.batch.places[1][own].sum())
                part = len(times), size, int(times.min()), int(times.max())
                file.parts[number].append(part)
            if file.waiting >= _GROUP_BYTES:
                self._flush(file)

    def close(self) -> tuple[File, ...]:
        """Finish all files, force them to the disk, and return their lines of the manifest."""
        while self._open:
            self._finish(self._open.popitem()[1])
        return tuple(sorted(self._written, key=lambda file: self.names.index(file.name)))

    def discard(self) -> None:
        """Remove the files that are not finished."""
        for file in self._open.values():
            file.writer.discard()

    def _file(self, kind: _Kind, schema: pa.Schema) -> _OpenFile:
        found = self._open.get((kind, schema))
        if found is None:
            if len(self._open) >= _MAX_OPEN:
                self._finish(self._open.pop(next(iter(self._open))))
            name = rows_name(self._log.number, self._version + len(self.names))
            front = b"" if self.names else self._front
            self.names.append(name)
            writer = ParquetFileWriter(self._folder / name, schema, level=_LEVEL, front=front)
            found = self._open[kind, schema] = _OpenFile(name, kind[0], writer)
        return found

    def _flush(self, file: _OpenFile) -> None:
        file.writer.write(pa.concat_tables(file.tables).combine_chunks())
        file.chunks.append(file.pending)
        file.tables, file.pending, file.waiting = [], [], 0

    def _finish(self, file: _OpenFile) -> None:
        if file.tables:
            self._flush(file)
        parts = {
            number: Part(sum(messages), sum(sizes), min(first), max(last))
            for number, own in sorted(file.parts.items())
            for messages, sizes, first, last in [zip(*own, strict=True)]
        }
        rows = sum(part.messages for part in parts.values())
        digests = {str(self._log.number): self._log.digest}
        section = Section(self._folder.name, file.topic, 0, digests, TopicCounts(rows))
        about = {
            "chunks": file.chunks,
            "parts": {n: [p.messages, p.bytes, p.first, p.last] for n, p in parts.items()},
        }
        size, digest = file.writer.close([section], rows=about, sync=True)
        self._written.append(rows_line(self._log, file.name, size, digest, parts))


def _table(
    chunk: StoredChunk, channels: Sequence[int], codec: Codec, shape: FieldShape
) -> pa.Table:
    """Rows of the messages of one type in a chunk, in its order."""
    rows = np.flatnonzero(np.isin(chunk.batch.channel, channels))
    batch = chunk.batch.take(rows)
    is_reduced = isinstance(codec, LeftCodec)
    batch = with_rows(batch) if is_reduced else batch
    piece = piece_of(
        chunk.segment,
        batch,
        Places.of([chunk]).take(rows),
        codec,
        State.REDUCED if is_reduced else State.EXPIRED,
        has_publish_time=dict.fromkeys(channels, True),  # those that have none repeat log times
        columns=lambda decoded: columns_from(decoded, shape),
    )
    surplus = np.zeros(len(rows), np.bool_)
    surplus[piece.surplus] = True
    if (left := batch.left) is None:
        about = [(len(p), sha256(p).digest()) for p in map(batch.payload, range(len(batch)))]
    else:
        about = [digest_in(left, row) for row in range(len(batch))]
    ref = piece.own["ref"]
    more = {
        **dict(zip([field.name for field in ref.type], ref.flatten(), strict=True)),
        "sequence": pa.array(batch.sequence),
        "size": pa.array([size for size, _ in about], pa.uint64()),
        "sha256": pa.array([digest for _, digest in about], pa.binary()),
        "surplus": pa.array(surplus),
    }
    return as_table({**piece.own, "ref": structs(more, len(rows))}, piece.fields)
