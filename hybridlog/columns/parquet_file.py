"""Parquet files whose pages have Parquet's checksums, and whose footer has one of its own.

Other readers ignore both.

Files are read with `pread`: truncation of a mapped file would kill the process.
"""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from hybridlog.columns.fields import has_summaries, original_name
from hybridlog.columns.layout import ABOUT, OWN, OWN_COLUMNS, About, Section
from hybridlog.schema.arrow_types import is_bytes, is_list
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.errors import HybridlogError, StoreError, exhausted
from hybridlog_storage.manifest import hasher

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer

_WRITTEN: Final = 1 << 20  # bytes buffered before a write
_TAIL: Final = 8  # bytes: length of the footer, `PAR1`
_MAX_FOOTER: Final = 256 << 20
_RUNNING: Final = frozenset({"t", "log_time", "seq", "pub", "stamp", "ref.chunk", "ref.off"})
_SEAL: Final = re.compile(rb"hybridlog-footer:([0-9a-f]{8})")
_BLANK: Final = b"hybridlog-footer:00000000"
_SEALED_BY: Final = "hybridlog.footer"
_NUMBERS: Final = count()


class ReusedBytes(NamedTuple):
    """The row groups of the file that a new one replaces.

    They keep their place in the new file, where nothing refers to them: DuckDB reads the
    footer, and opens the file again by its name for the rows.

    Attributes:
        offset: Where they lie.
        data: The bytes.
    """

    offset: int
    data: bytes


class NoRoomError(Exception):
    """Row groups do not fit in front of the kept ones."""


class ParquetFileWriter:
    """Writes one file of a table.

    Args:
        path: The file, in the folder of a recording's unfinished tables.
        schema: Its columns.
        level: Level of zstd.
        reused: Row groups of the file that this one replaces.
        in_front: True to write the new row groups in front of the kept ones.
        front: Bytes in front of the row groups, which no reader of Parquet looks at.

    Raises:
        OSError: the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        schema: pa.Schema,
        *,
        level: int = 1,
        reused: ReusedBytes | None = None,
        in_front: bool = False,
        front: bytes = b"",
    ) -> None:
        self.path = path
        self._sink = _Sink(path)
        kinds = {leaf.path: leaf.kind for leaf in leaves(schema)}
        running = [path for path, kind in kinds.items() if _runs(path, kind)]
        # DuckDB answers wrongly from statistics of floats with NaN among them.
        ordered = [
            path
            for path, kind in kinds.items()
            if not (is_bytes(kind) or pa.types.is_floating(kind))
        ]
        repeating = [path for path in ordered if path not in running and kinds[path] != pa.bool_()]
        try:
            self._file = pa.PythonFile(self._sink, mode="w")
            self._writer = pq.ParquetWriter(
                self._file,
                schema,
                compression="zstd",
                compression_level=level,
                use_dictionary=repeating,
                column_encoding=dict.fromkeys(running, "DELTA_BINARY_PACKED"),
                write_statistics=ordered,
                write_page_checksum=True,
            )
            if front:
                self._file.write(front)
            self._behind = reused if in_front else None
            if reused is not None and not in_front:
                self._put(reused)
            self._begin = self._file.tell()
        except BaseException:
            self.discard()
            raise

    def write(self, table: pa.Table) -> None:
        """Write a row group.

        Raises:
            OSError: the row group cannot be written.
        """
        self._writer.write_table(table, row_group_size=max(table.num_rows, 1))

    def close(
        self,
        sections: Sequence[Section],
        *,
        rows: Mapping[str, Any] | None = None,
        sync: bool = False,
    ) -> tuple[int, str]:
        """Finish the file.

        Args:
            sections: The rows in it, in its order.
            rows: What a file of rows says of them besides.
            sync: True to force it to the disk.

        Returns:
            Its bytes, and BLAKE3 of them.

        Raises:
            OSError: the file cannot be written.
            NoRoomError: the row groups do not fit in front of the kept ones.
            StoreError: some text in it looks like the checksum of a footer.
        """
        try:
            span = self._begin, self._file.tell()
            if self._behind is not None:
                if span[1] > self._behind.offset:
                    raise NoRoomError
                self._put(self._behind)
            self._sink.end_body()
            about = About(sections, span, of_rows=dict(rows or {}))
            self._writer.add_key_value_metadata(
                {ABOUT.decode(): about.to_json(), _SEALED_BY: _BLANK.decode()}
            )
            self._writer.close()
            return self._sink.finish(sync=sync)
        except BaseException:
            self.discard()
            raise

    def _put(self, reused: ReusedBytes) -> None:
        """Write kept bytes at their place."""
        self._file.write(bytes(reused.offset - self._file.tell()))
        self._file.write(reused.data)

    def discard(self) -> None:
        """Delete the unfinished file."""
        self._sink.abandon()
        with suppress(OSError):
            files.unlink(self.path)


class _Sink:
    """Receives Parquet's bytes: the body goes to the disk, the footer to memory until sealed."""

    def __init__(self, path: Path) -> None:
        self.closed = False
        self._is_abandoned = False
        self._fd = files.open_file(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self._waiting = bytearray()
        self._position = 0
        self._footer: bytearray | None = None
        self._digest = hasher()

    def write(self, data: Buffer) -> int:
        """Write bytes."""
        data = memoryview(data).cast("B")
        if self._is_abandoned:
            return len(data)  # pyarrow closes its writer when it is collected
        self._position += len(data)
        if self._footer is not None:
            self._footer += data
            return len(data)
        self._waiting += data
        if len(self._waiting) >= _WRITTEN:
            self._flush()
        return len(data)

    def end_body(self) -> None:
        """Begin the footer."""
        self._footer = bytearray()

    def finish(self, *, sync: bool) -> tuple[int, str]:
        """Seal the footer, write all remaining bytes; return size and digest of the file."""
        assert self._footer is not None
        marks = [found.start(1) for found in _SEAL.finditer(self._footer)]
        if len(marks) != 1:
            raise StoreError("the table holds text that looks like the checksum of its footer")
        at = marks[0]
        self._footer[at : at + 8] = _checksum(self._footer).encode()
        self._waiting += self._footer
        self._flush()
        if sync:
            files.system.sync(self._fd)
        os.close(self._fd)
        self._fd = -1
        return self._position, self._digest.hexdigest()

    def abandon(self) -> None:
        self._is_abandoned = True
        self._waiting.clear()
        if self._fd >= 0:
            os.close(self._fd)
        self._fd = -1

    def _flush(self) -> None:
        data = bytes(self._waiting)
        durability.write_all(self._fd, [data])
        self._digest.update(data)
        self._waiting.clear()

    def flush(self) -> None:
        """Do nothing: buffered bytes are written in larger pieces."""

    def tell(self) -> int:
        return self._position

    def close(self) -> None:
        """Do nothing: the footer follows."""


class ParquetFileReader:
    """Reads one file of a table. Thread safe.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: the file does not exist.
        StoreError: the file cannot be read, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.number = next(_NUMBERS)
        """Unique number of this reader."""
        self._lock = threading.Lock()
        try:
            self._source = _Source(path)
            metadata = pq.read_metadata(pa.BufferReader(b"PAR1" + self._source.footer))
            self.about = About.from_json(metadata.metadata.get(ABOUT, b""))
            self._parquet = pq.ParquetFile(
                pa.PythonFile(self._source, mode="r"),
                metadata=metadata,
                pre_buffer=False,
                buffer_size=0,
                page_checksum_verification=True,
            )
            self.schema: pa.Schema = self._parquet.schema_arrow
            numbers = range(metadata.num_row_groups)
            self.groups = [int(metadata.row_group(number).num_rows) for number in numbers]
            """Rows of each row group."""
            if sum(self.groups) != sum(section.rows for section in self.about.sections):
                raise StoreError("its rows differ from its description")
        except FileNotFoundError:
            raise
        except (OSError, StoreError, pa.ArrowException, KeyError) as error:
            raise self._damaged(error) from error

    def release(self) -> None:
        """Close the file until it is read again."""
        self._source.release()

    @property
    def size_bytes(self) -> int:
        """Bytes of the file."""
        return self._source.size

    @property
    def rows(self) -> int:
        """Rows of all recordings."""
        return sum(self.groups)

    def size(self, group: int, leaves: Sequence[int]) -> int:
        """Stored bytes of some columns of a row group."""
        found = self._parquet.metadata.row_group(group)
        return sum(found.column(leaf).total_compressed_size for leaf in leaves)

    def nulls(self, group: int, leaf: int) -> int | None:
        """Number of nulls in a column of a row group; None if unknown."""
        found = self._parquet.metadata.row_group(group).column(leaf).statistics
        return found.null_count if found is not None and found.has_null_count else None

    def bounds(self, group: int, leaf: int) -> tuple[int, int] | None:
        """Least and greatest value in a column of a row group; None if unknown."""
        found = self._parquet.metadata.row_group(group).column(leaf).statistics
        return (found.min, found.max) if found is not None and found.has_min_max else None

    def values(self, group: int, leaf: int) -> int:
        """Number of values in a column of a row group, nulls included."""
        return int(self._parquet.metadata.row_group(group).column(leaf).num_values)

    def reusable(self) -> ReusedBytes:
        """The bytes of its row groups.

        Raises:
            StoreError: they cannot be read.
        """
        begin, end = self.about.span
        try:
            return ReusedBytes(begin, self._source.raw(begin, end))
        except (OSError, StoreError) as error:
            raise self._damaged(error) from error

    def table(self) -> pa.Table:
        """All rows.

        Raises:
            StoreError: they are damaged.
        """
        numbers = range(len(list(leaves(self.schema))))
        groups = [self.read(group, numbers) for group in range(len(self.groups))]
        table = pa.concat_tables(groups) if groups else self.schema.empty_table()
        return table.replace_schema_metadata(None)

    def read(self, group: int | None, leaves: Sequence[int]) -> pa.Table:
        """Some columns of a row group.

        Args:
            group: Its number; None for no rows.
            leaves: Column numbers in Parquet's order: single values, depth first.

        Raises:
            StoreError: the columns are damaged.
        """
        try:
            with self._lock:
                if group is not None:
                    self._source.fetch(self._parquet.metadata.row_group(group), leaves)
                reader: Any = self._parquet.reader
                table: pa.Table = reader.read_row_groups(
                    [] if group is None else [group],
                    column_indices=list(leaves),
                    use_threads=False,
                )
        except (OSError, StoreError, pa.ArrowException, ValueError) as error:
            raise self._damaged(error) from error
        if group is not None and table.num_rows != self.groups[group]:
            raise self._damaged(StoreError("a row group has the wrong number of rows"))
        return table

    def check(self) -> str:
        """Read every value; returns BLAKE3 of all bytes.

        Raises:
            StoreError: a part is damaged.
        """
        try:
            digest = self._source.digest()
        except (OSError, StoreError) as error:
            raise self._damaged(error) from error
        self.table()
        return digest

    def _damaged(self, error: Exception) -> HybridlogError:
        if isinstance(error, OSError):
            shortage = exhausted(error.errno, f"reading {self.path}")
            if shortage is not None:
                return shortage
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        return StoreError(f"The table {self.path} is damaged: {reason}.")


class _Source:
    """Provides Parquet's bytes, after verifying the checksum of the footer."""

    def __init__(self, path: Path) -> None:
        self.closed = False
        self._path = path
        self._lock = threading.Lock()
        self._fd = -1
        self._position = 0
        self._same: tuple[int, ...] | None = None
        with self._lock:
            self._open()
        self.size = os.fstat(self._fd).st_size
        tail = self.raw(self.size - _TAIL, self.size) if self.size > 2 * _TAIL else b""
        length = int.from_bytes(tail[:4], "little") + _TAIL
        if tail[4:] != b"PAR1" or length > min(self.size - 4, _MAX_FOOTER):
            raise StoreError("its end is missing")
        self.footer = self.raw(self.size - length, self.size)
        found = list(_SEAL.finditer(self.footer))
        if len(found) != 1:
            raise StoreError("its footer has no checksum")
        begin, end = found[0].span(1)
        blank = self.footer[:begin] + b"0" * 8 + self.footer[end:]
        if _checksum(blank).encode() != found[0][1]:
            raise StoreError("the checksum of its footer differs")

    def digest(self) -> str:
        """BLAKE3 of all bytes."""
        digest = hasher()
        for at in range(0, self.size, _WRITTEN):
            digest.update(self.raw(at, min(at + _WRITTEN, self.size)))
        return digest.hexdigest()

    def fetch(self, group: Any, leaves: Iterable[int]) -> None:
        """Ask a bucket once for some columns of a row group."""
        with self._lock:
            if self._fd < 0:
                self._open()
            if files.is_fetched(self._fd):
                ranges = []
                for column in map(group.column, leaves):
                    begin = column.dictionary_page_offset or column.data_page_offset
                    begin = min(begin, column.data_page_offset)
                    end = begin + column.total_compressed_size
                    ranges.append((begin, end))
                files.fetch(self._fd, ranges)

    def read(self, size: int = -1) -> bytes:
        """Read from the current position."""
        begin = self._position
        end = self.size if size < 0 else min(begin + size, self.size)
        self._position = max(begin, end)
        return self.raw(begin, end) if begin < end else b""

    def raw(self, begin: int, end: int) -> bytes:
        """Some bytes of the file."""
        with self._lock:
            if self._fd < 0:
                self._open()
            data = files.pread(self._fd, end - begin, begin)
        if len(data) != end - begin:
            raise StoreError("it was truncated")
        return data

    def __del__(self) -> None:
        self.release()

    def release(self) -> None:
        """Close the file until it is read again."""
        with self._lock:
            if self._fd >= 0:
                os.close(self._fd)
            self._fd = -1

    def _open(self) -> None:
        self._fd = files.open_file(self._path, os.O_RDONLY)
        same = files.identity(self._fd)
        if self._same is not None and same != self._same:
            os.close(self._fd)
            self._fd = -1
            raise StoreError("it was replaced")
        self._same = same

    def seek(self, position: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self.size}[whence]
        self._position = base + position
        return self._position

    def tell(self) -> int:
        return self._position

    def seekable(self) -> bool:
        return True

    def readable(self) -> bool:
        return True

    def close(self) -> None:
        """Do nothing: the file remains open as long as its reader."""


class Leaf(NamedTuple):
    """A column in Parquet's order.

    Attributes:
        top: Name of the table's column that contains it.
        path: Its dotted path in the file.
        kind: Type of its values.
        is_own: True for a column of the table itself, not of a field.
        names: Names of the fields on the path to it, without lists.
        array: Names of the fields on the path to the array whose summary it is part of.
    """

    top: str
    path: str
    kind: pa.DataType
    is_own: bool
    names: tuple[str, ...]
    array: tuple[str, ...] | None = None


def leaves(schema: pa.Schema) -> Iterator[Leaf]:
    """The columns of a file in Parquet's order."""
    for top in schema:
        is_own = top.name in OWN_COLUMNS or OWN in (top.metadata or {})
        for path, kind, names, array in _leaves(top, top.name, (), None):
            yield Leaf(top.name, path, kind, is_own, names, array)


def _leaves(
    field: pa.Field, path: str, above: tuple[str, ...], array: tuple[str, ...] | None
) -> Iterator[tuple[str, pa.DataType, tuple[str, ...], tuple[str, ...] | None]]:
    names, kind = (*above, original_name(field)), field.type
    while is_list(kind):
        path, kind = f"{path}.list.element", kind.value_type
    if not pa.types.is_struct(kind):
        yield path, kind, names, array
        return
    for number in range(kind.num_fields):
        inner = kind.field(number)
        of_array = names if has_summaries(field) else array
        yield from _leaves(inner, f"{path}.{inner.name}", names, of_array)


def _runs(path: str, kind: pa.DataType) -> bool:
    """True if adjacent values differ by little: times and counters."""
    if path in _RUNNING or pa.types.is_timestamp(kind):
        return True
    return path.endswith(".seq") and bool(pa.types.is_integer(kind))


def _checksum(data: Buffer) -> str:
    return f"{crc32(data):08x}"
