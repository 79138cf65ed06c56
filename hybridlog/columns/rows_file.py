"""Files of rows: what is left of the messages of a log that is gone.

Such a file has the columns of a table, in the order of the chunks. Its `ref` also has the
sender's sequence number, size and SHA-256 of the payload, and whether bytes were left over
behind the message. Unlike a table it is never made again.
"""

from __future__ import annotations

from hashlib import sha256
from operator import attrgetter
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.columns.column_file import ColumnFile, ColumnFileWriter
from hybridlog.columns.fields import side_by_side
from hybridlog.columns.layout import Section
from hybridlog.columns.rows import columns_from, digest_in, rows_of, with_rows
from hybridlog.index.indexing import ChunkIndexer
from hybridlog.schema.arrow_columns import structs
from hybridlog.schema.codec import LeftCodec
from hybridlog.schema.states import State
from hybridlog_storage.cache import Cache
from hybridlog_storage.errors import StoreError
from hybridlog_storage.manifest import File, Part, rows_line
from hybridlog_storage.segments.segment_file import rows_name

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from hybridlog.index.indexing import Messages
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk

_GROUP_BYTES: Final = 4 << 20  # of a row group in memory
_LEVEL: Final = 3  # of zstd: 9 takes 1 to 5 % less, for much more time
_MAX_OPEN = 8  # files of different columns: each row group of them waits in memory


class RowsFile(ColumnFile):
    """One file of rows: messages of a topic. Thread safe."""

    def __init__(self, folder: Path, listed: File, cache: Cache | None = None) -> None:
        self._listed = listed
        try:
            super().__init__(folder / listed.name, cache)
        except FileNotFoundError as error:
            raise StoreError(f"The file of rows {folder / listed.name} is missing.") from error
        rows = sum(part.messages for part in listed.parts.values())
        if (self.size_bytes, self.rows) != (listed.bytes, rows):
            raise self._other()

    def check(self) -> str:
        """As of `ColumnFile`; it is the file that the manifest lists."""
        digest = super().check()
        if digest != self._listed.digest:
            raise self._other()
        return digest

    def _other(self) -> StoreError:
        return StoreError(f"The file of rows {self.path} is not the one that the manifest lists.")

    def of_chunk(self, chunk: int) -> list[pa.StructArray]:
        """The rows of a chunk, by row group; a struct has all columns."""
        found = []
        (leaf,) = self.numbers("ref.chunk")
        for group in range(len(self.groups)):
            first, last = self.bounds(group, leaf) or (chunk, chunk)
            if first <= chunk <= last:
                rows = self._group(group)
                numbers = rows.field("ref").field("chunk").to_numpy()
                begin, end = np.searchsorted(numbers, [chunk, chunk + 1]).tolist()
                found.append(rows.slice(begin, end - begin))
        return [one for one in found if len(one)]

    def _group(self, group: int) -> pa.StructArray:
        def read() -> pa.StructArray:
            return self.read(group, range(len(self.leaves))).to_struct_array().combine_chunks()

        size_of = attrgetter("nbytes")
        return self._cache.made("column", self.number, group, make=read, size_of=size_of)


def line_of(folder: Path, log: File, name: str) -> File:
    """The line of a manifest for a file of rows of a log."""
    file = ColumnFile(folder / name)
    rows = file.table(file.numbers("t", "channel", "ref.len"))
    rows = rows.append_column("size", pc.struct_field(rows["ref"], "len"))
    about = [("t", "count"), ("size", "sum"), ("t", "min"), ("t", "max")]
    found = rows.drop_columns(["ref"]).group_by("channel").aggregate(about).sort_by("channel")
    keys = [f"{column}_{what}" for column, what in about]
    parts = {row["channel"]: Part(*(row[key] for key in keys)) for row in found.to_pylist()}
    return rows_line(log, name, file.size_bytes, file.digest(), parts)


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
        self._indexer = ChunkIndexer(folder.name)
        self._open: dict[tuple[str, pa.Schema], tuple[ColumnFileWriter, list[pa.Table]]] = {}
        self.names: list[str] = []
        """Names of the files, the first one first."""

    def add(self, chunk: StoredChunk) -> None:
        """Add the messages of a chunk."""
        for messages in self._indexer.messages_in([chunk], self._channels):
            table = _table(messages)
            self._waiting(messages.channel.topic, table.schema).append(table)
        for writer, tables in self._open.values():
            if sum(one.nbytes for one in tables) >= _GROUP_BYTES:
                _flush(writer, tables)

    def close(self) -> tuple[File, ...]:
        """Finish all files, force them to the disk, and return their lines of the manifest."""
        while self._open:
            self._finish(next(iter(self._open)))
        return tuple(line_of(self._folder, self._log, name) for name in self.names)

    def discard(self) -> None:
        """Remove the files that are not finished."""
        for writer, _ in self._open.values():
            writer.discard()

    def _waiting(self, topic: str, schema: pa.Schema) -> list[pa.Table]:
        """Rows that wait for a row group of a file, by topic and columns."""
        key = topic, schema
        if key not in self._open:
            if len(self._open) >= _MAX_OPEN:
                self._finish(next(iter(self._open)))
            name = rows_name(self._log.number, self._version + len(self.names))
            front = b"" if self.names else self._front
            self.names.append(name)
            writer = ColumnFileWriter(self._folder / name, schema, level=_LEVEL, front=front)
            self._open[key] = writer, []
        return self._open[key][1]

    def _finish(self, key: tuple[str, pa.Schema]) -> None:
        writer, tables = self._open.pop(key)
        if tables:
            _flush(writer, tables)
        digests = {str(self._log.number): self._log.digest}
        writer.close([Section(self._folder.name, key[0], digests, writer.rows)], sync=True)


def _flush(writer: ColumnFileWriter, tables: list[pa.Table]) -> None:
    writer.write(pa.concat_tables(tables).combine_chunks())
    tables.clear()


def _table(messages: Messages) -> pa.Table:
    """Rows of messages of one type in a chunk."""
    state, batch, decoded = State.EXPIRED, messages.placed.batch, messages.decoded
    if isinstance(messages.codec, LeftCodec):
        state, batch = State.REDUCED, with_rows(batch)
    own, fields = rows_of(
        messages.placed,
        decoded,
        state,
        has_publish_time=True,  # channels that have none repeat log times
        columns=columns_from,
    )
    surplus = np.zeros(len(batch), np.bool_)
    if decoded is not None:
        surplus[decoded.surplus] = True
    if (left := batch.left) is None:
        about = [(len(p), sha256(p).digest()) for p in map(batch.payload, range(len(batch)))]
    else:
        about = [digest_in(left, row) for row in range(len(batch))]
    more = {
        "sequence": pa.array(batch.sequence),
        "size": pa.array([size for size, _ in about], pa.uint64()),
        "sha256": pa.array([digest for _, digest in about], pa.binary()),
        "surplus": pa.array(surplus),
    }
    ref = dict(zip(own["ref"].type.names, own["ref"].flatten(), strict=True))
    own["ref"] = structs(ref | more, len(batch))
    return pa.Table.from_struct_array(side_by_side(own, fields))
