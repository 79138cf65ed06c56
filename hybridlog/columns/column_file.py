"""One file of columns: written, read, and the columns to read for some fields.

Its pages have Parquet's checksums, and its footer has one of its own: the 4 bytes in front of
it, a CRC-32, which other readers ignore. Files are read with `pread`: truncation of a mapped
file would kill the process.
"""

from __future__ import annotations

import io
import os
import threading
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from itertools import accumulate, chain, count
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from hybridlog.columns.fields import (
    SUMMARY_FIELDS,
    has_summaries,
    original_name,
)
from hybridlog.columns.layout import ABOUT, OWN, OWN_COLUMNS, Section
from hybridlog.schema.arrow_types import is_bytes, is_list
from hybridlog.schema.column import names_of
from hybridlog_storage.cache import Cache, lazy
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.errors import HybridlogError, StoreError, exhausted
from hybridlog_storage.manifest import digest_of

_AT_ONCE: Final = 1 << 20  # bytes read together for a digest, and written together
_TAIL: Final = 8  # bytes: length of the footer, `PAR1`
_SEAL: Final = 4  # bytes: CRC-32 of the footer, in front of it
_MAX_FOOTER: Final = 256 << 20
_NUMBERS: Final = count()
_GROUP_ROWS: Final = 131_072  # of a row group, at most
_GROUP_BYTES: Final = 32 << 20  # of the columns of a row group in memory, at most
_RUNNING: Final = frozenset({"t", "log_time", "seq", "pub", "stamp", "ref.chunk", "ref.off"})
FIRST: Final = -(1 << 63)
"""Lower bound of all log times."""
LAST: Final = (1 << 63) - 1
"""Upper bound of all log times."""


class Leaf(NamedTuple):
    """A column in Parquet's order.

    Attributes:
        top: Name of the table's column that contains it.
        path: Its dotted path in the file.
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
        pending: list[tuple[pa.Field, str, tuple[str, ...], tuple[str, ...] | None]]
        pending = [(top, top.name, (original_name(top),), None)]
        while pending:
            field, path, names, array = pending.pop()
            kind = field.type
            while is_list(kind):
                path, kind = f"{path}.list.element", kind.value_type
            if not pa.types.is_struct(kind):
                yield Leaf(top.name, path, kind, is_own, names, array)
                continue
            array = names if has_summaries(field) else array
            pending += [
                (inner, f"{path}.{inner.name}", (*names, original_name(inner)), array)
                for inner in reversed(list(kind))
            ]


def _is_counter(leaf: Leaf) -> bool:
    return leaf.path.endswith(".seq") and pa.types.is_integer(leaf.kind)


class ColumnFileWriter:
    """Writes one file; no reader of Parquet looks at the bytes of `front`."""

    def __init__(
        self, path: Path, schema: pa.Schema, *, level: int = 1, front: bytes = b""
    ) -> None:
        self.path = path
        self.schema = schema
        self.rows = 0
        self._raw = _Raw(files.open_file(path, os.O_RDWR | os.O_CREAT | os.O_EXCL))
        running, ordered = [], []
        for leaf in leaves(schema):
            if leaf.path in _RUNNING or pa.types.is_timestamp(leaf.kind) or _is_counter(leaf):
                running.append(leaf.path)  # adjacent values differ by little
            # DuckDB answers wrongly from statistics of floats with NaN among them.
            if not (is_bytes(leaf.kind) or pa.types.is_floating(leaf.kind)):
                ordered.append(leaf.path)
        try:
            self._file = io.BufferedWriter(self._raw, _AT_ONCE)
            sink = pa.PythonFile(self._file, mode="w")
            self._parquet = pq.ParquetWriter(
                sink,
                schema,
                compression="zstd",
                compression_level=level,
                use_dictionary=[path for path in ordered if path not in running],
                column_encoding=dict.fromkeys(running, "DELTA_BINARY_PACKED"),
                write_statistics=ordered,
                write_page_checksum=True,
            )
            sink.write(front)
        except BaseException:
            self.discard()
            raise

    def write(self, table: pa.Table) -> None:
        """Write rows as row groups, one if they are few."""
        step = table.num_rows * _GROUP_BYTES // max(table.nbytes, 1)
        self._parquet.write_table(table, row_group_size=max(min(_GROUP_ROWS, step), 1))
        self.rows += table.num_rows

    def close(self, sections: Sequence[Section], *, sync: bool = False) -> None:
        """Finish the file, with its sections in order."""
        try:
            about = msgspec.json.encode(sections)
            self._parquet.add_key_value_metadata({ABOUT.decode(): about.decode()})
            body = self._file.tell()
            self._parquet.close()
            self._file.flush()
            self._raw.seal(body)
            if sync:
                files.system.sync(self._raw.fd)
            self._raw.abandon()
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Delete the unfinished file."""
        self._raw.abandon()
        with suppress(OSError):
            files.unlink(self.path)


class _Raw(io.RawIOBase):
    """Writes to a file; nothing once it is closed, since pyarrow ends what it collects."""

    def __init__(self, fd: int) -> None:
        self.fd = fd

    def writable(self) -> bool:
        return True

    def write(self, data: Any) -> int:
        return files.write_all(self.fd, [data]) if self.fd >= 0 else memoryview(data).nbytes

    def tell(self) -> int:
        return os.lseek(self.fd, 0, os.SEEK_CUR) if self.fd >= 0 else 0

    def seal(self, begin: int) -> None:
        """Put its checksum in front of the footer."""
        footer = os.pread(self.fd, self.tell() - begin, begin)
        os.lseek(self.fd, begin, os.SEEK_SET)
        files.write_all(self.fd, [crc32(footer).to_bytes(_SEAL, "little"), footer])

    def abandon(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)
        self.fd = -1


class TablePart(NamedTuple):
    """Rows of one topic in a row group from `begin` on; `first` and `last` bound log times, ns."""

    file: ColumnFile
    group: int
    begin: int
    rows: int
    first: int = FIRST
    last: int = LAST


class ColumnFile:
    """Reads one file, open while it is read; FileNotFoundError without it. Thread safe."""

    def __init__(self, path: Path, cache: Cache | None = None) -> None:
        self.path = path
        self.number = next(_NUMBERS)
        """Unique number of this reader."""
        self._cache = cache or Cache()
        self._lock = threading.Lock()
        self._chosen: dict[tuple[Any, ...], dict[str, tuple[int, ...]]] = {}
        try:
            self._source = _Source(path)
            metadata = pq.read_metadata(pa.BufferReader(b"PAR1" + self._source.footer))
            about = (metadata.metadata or {}).get(ABOUT, b"")
            self.sections = msgspec.json.decode(about, type=list[Section])
            """What the rows are, in their order."""
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
            self.rows = sum(self.groups)
            self.size_bytes = self._source.size
            if self.rows != sum(section.rows for section in self.sections):
                raise StoreError("its rows differ from its description")
        except FileNotFoundError:
            raise
        except (OSError, StoreError, pa.ArrowException, ValueError, RecursionError) as error:
            raise self._damaged(error) from error

    @property
    def was_replaced(self) -> bool:
        """True if another file has its name by now, as the last reading has found."""
        return self._source.was_replaced

    def size(self, group: int, leaves: Sequence[int]) -> int:
        """Stored bytes of some columns of a row group."""
        return sum(self._about(group, leaf).total_compressed_size for leaf in leaves)

    def summarises(self, group: int, array: tuple[str, ...]) -> bool:
        """False if no row of a row group is known to have a summary of an array."""
        if array not in self.summaries:
            return False
        column = self._about(group, self.summaries[array])
        found = column.statistics
        is_known = found is not None and found.has_null_count
        return not is_known or bool(found.null_count < column.num_values)

    def bounds(self, group: int, leaf: int) -> tuple[int, int] | None:
        """Least and greatest value in a column of a row group; None if unknown."""
        found = self._about(group, leaf).statistics
        return (found.min, found.max) if found is not None and found.has_min_max else None

    def _about(self, group: int, leaf: int) -> Any:
        return self._parquet.metadata.row_group(group).column(leaf)

    def numbers(self, *paths: str) -> list[int]:
        """Numbers of the columns at some paths in Parquet's order."""
        return [number for number, leaf in enumerate(self.leaves) if leaf.path in paths]

    def table(self, leaves: Sequence[int] | None = None) -> pa.Table:
        """All rows, or some columns of them."""
        numbers = range(len(self.leaves)) if leaves is None else leaves
        groups = [self.read(group, numbers) for group in range(len(self.groups))]
        table = pa.concat_tables(groups) if groups else self.schema.empty_table()
        return table.replace_schema_metadata(None)

    def columns(self, group: int, chosen: Mapping[str, Sequence[int]]) -> Mapping[str, Any]:
        """Columns of a row group, of each some of Parquet's, as arrays; cached as asked for."""
        leaves = [*chain.from_iterable(chosen.values())]

        def read() -> dict[str, Any]:
            table = self.read(group, leaves).combine_chunks()
            return {one: table.column(one).chunk(0) for one in chosen}

        def size_of(found: Mapping[str, Any]) -> int:
            return sum(one.nbytes for one in found.values())

        return self._cache.made("column", self.number, group, *leaves, make=read, size_of=size_of)

    def read(self, group: int | None, leaves: Sequence[int]) -> pa.Table:
        """Columns, numbered in Parquet's order (depth first), of a row group; None for no rows."""
        try:
            with self._lock, nullcontext() if group is None else self._source.opened():
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

    def digest(self) -> str:
        """BLAKE3 of all bytes."""
        try:
            with self._lock, self._source.opened():
                return self._source.digest()
        except (OSError, StoreError) as error:
            raise self._damaged(error) from error

    def check(self) -> str:
        """Read every value; returns BLAKE3 of all bytes."""
        self.table()
        return self.digest()

    def _damaged(self, error: Exception) -> HybridlogError:
        if isinstance(error, OSError):
            shortage = exhausted(error.errno, f"reading {self.path}")
            if shortage is not None:
                return shortage
        reason = error.strerror if isinstance(error, OSError) and error.strerror else error
        return StoreError(f"The table {self.path} is damaged: {reason}.")

    @lazy
    def leaves(self) -> list[Leaf]:
        """Its columns in Parquet's order."""
        return list(leaves(self.schema))

    @lazy
    def summaries(self) -> dict[tuple[str, ...], int]:
        """Paths of arrays with summaries, and the number of the column of each one's `n`."""
        leaves = reversed([*enumerate(self.leaves)])
        return {leaf.array: number for number, leaf in leaves if leaf.array is not None}

    @lazy
    def own(self) -> set[str]:
        """Columns of the table itself."""
        return {leaf.top for leaf in self.leaves if leaf.is_own}

    def choose(
        self, paths: Collection[str] | None, own: Collection[str]
    ) -> dict[str, tuple[int, ...]]:
        """Numbers of the columns of some fields, None for all, by the table's column around them.

        `own` are columns of the table itself. Of an array, and of its summary, there are both.
        """
        key = None if paths is None else frozenset(paths), frozenset(own)
        found = self._chosen.get(key)
        if found is None:
            wanted = None if paths is None else list(map(names_of, paths))
            found = {}
            for number, leaf in enumerate(self.leaves):
                if leaf.top in own if leaf.is_own else self._is_wanted(leaf, wanted):
                    found[leaf.top] = (*found.get(leaf.top, ()), number)
            self._chosen[key] = found
        return found

    def _is_wanted(self, leaf: Leaf, wanted: Sequence[tuple[str, ...]] | None) -> bool:
        if wanted is None or any(leaf.names[: len(path)] == path for path in wanted):
            return True
        if leaf.array is not None:  # it tells whether the array is there
            return any(path[: len(leaf.array)] == leaf.array for path in wanted)
        # A summary is worked out from the array where that is there.
        arrays = {path[:-1] for path in wanted if path[-1] in SUMMARY_FIELDS}
        return any(leaf.names[: len(one)] == one for one in arrays & self.summaries.keys())

    def has(self, recording: str) -> bool:
        """True if it has rows of a recording."""
        return any(one.id == recording for one in self.sections)

    def begins(self) -> Iterator[tuple[int, Section]]:
        """The sections, each with its first row."""
        before = accumulate((one.rows for one in self.sections), initial=0)
        return zip(before, self.sections, strict=False)

    def parts(self, begin: int, rows: int) -> Iterator[TablePart]:
        """Row groups with some rows of one topic."""
        (time,) = self.numbers("t")
        before = 0
        for group, own in enumerate(self.groups):
            low, high = max(begin, before), min(begin + rows, before + own)
            if low < high:
                bounds = self.bounds(group, time) or (FIRST, LAST)
                yield TablePart(self, group, low - before, high - low, *bounds)
            before += own


class _Source:
    """Provides Parquet's bytes, after verifying the checksum of the footer; open while it reads."""

    def __init__(self, path: Path) -> None:
        self.closed = False
        self.was_replaced = False
        self._path = path
        self._fd = -1
        self._position = 0
        self._same: tuple[int, ...] | None = None
        with self.opened():
            self.size = os.fstat(self._fd).st_size
            tail = self._raw(self.size - _TAIL, self.size) if self.size > 2 * _TAIL else b""
            length = int.from_bytes(tail[:4], "little") + _TAIL
            if tail[4:] != b"PAR1" or length > min(self.size - _SEAL, _MAX_FOOTER):
                raise StoreError("its end is missing")
            sealed = self._raw(self.size - length - _SEAL, self.size)
        self.footer = sealed[_SEAL:]
        if crc32(self.footer) != int.from_bytes(sealed[:_SEAL], "little"):
            raise StoreError("the checksum of its footer differs")

    @contextmanager
    def opened(self) -> Iterator[None]:
        """Open the file, which is the same as before, for one thread."""
        self._fd = files.open_file(self._path, os.O_RDONLY)
        try:
            same = files.identity(self._fd)
            self.was_replaced = self._same not in {None, same}
            if self.was_replaced:
                raise StoreError("it was replaced")
            self._same = same
            yield
        finally:
            os.close(self._fd)

    def digest(self) -> str:
        """BLAKE3 of all bytes."""
        begins = range(0, self.size, _AT_ONCE)
        return digest_of(self._raw(at, min(at + _AT_ONCE, self.size)) for at in begins)

    def fetch(self, group: Any, leaves: Iterable[int]) -> None:
        """Ask a bucket once for some columns of a row group."""
        if files.is_fetched(self._fd):
            ranges = []
            for column in map(group.column, leaves):
                begin = column.dictionary_page_offset or column.data_page_offset
                begin = min(begin, column.data_page_offset)
                ranges.append((begin, begin + column.total_compressed_size))
            files.fetch(self._fd, ranges)

    def read(self, size: int = -1) -> bytes:
        """Read from the current position."""
        begin = self._position
        end = self.size if size < 0 else min(begin + size, self.size)
        self._position = max(begin, end)
        return self._raw(begin, end) if begin < end else b""

    def _raw(self, begin: int, end: int) -> bytes:
        data = files.pread(self._fd, end - begin, begin)
        if len(data) != end - begin:
            raise StoreError("it was truncated")
        return data

    def seek(self, position: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: self.size}[whence]
        self._position = base + position
        return self._position

    def tell(self) -> int:
        return self._position

    def close(self) -> None:
        """Do nothing: it is opened to be read."""
