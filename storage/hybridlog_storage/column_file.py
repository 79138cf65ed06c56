"""A file of tables in which each column can be read separately.

The file is derived from other files and can be rebuilt. So it is not forced to the disk;
checksums show whether it is intact. It grows by blocks, each with some rows of one column,
and gets its final name when it is complete.

The description of each table is a page of its own, so a reader of one table need not read
those of others.

```
magic, blocks, pages, directory, tail, magic
```
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Collection, Iterable, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from hybridlog_storage import durability, files
from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAGIC: Final = b"\x89HLC2\r\n\n"
TEXT: Final = "text"
"""Type of a column of strings; all others have a numpy type."""

_TAIL = struct.Struct("<QI")  # bytes of the directory, its checksum


class _Block(NamedTuple):
    """Position and checksum of a block."""

    rows: int
    same: int
    offset: int
    size: int
    crc: int
    unused: int = 0


_ENTRY = np.dtype([*zip(_Block._fields, ("<u4", "<u4", "<u8", "<u8", "<u4", "<u4"), strict=True)])
_TYPES = frozenset({"|b1", "|i1", "|u1", *(f"<{k}{n}" for k in "iu" for n in (2, 4, 8))})
_KNOWN = _TYPES | {"<f4", "<f8", TEXT}
_MOST_ROWS = 1 << 31  # of a block
_MOST_DIRECTORY = 256 << 20  # bytes of the directory, and of all pages
_CURE = "Run `hybridlog reindex`; until then MongoDB answers."


class Text(NamedTuple):
    """A column of strings.

    Attributes:
        data: uint8, all strings one after the other.
        offset: int64[n + 1], where each begins and ends in it; offset[0] may be above 0.
    """

    data: NDArray[np.uint8]
    offset: NDArray[np.int64]


Values = np.ndarray[Any, Any] | Text
"""The rows of a column, native byte order."""


class ColumnFileWriter:
    """Writes a file of columns under a temporary name.

    Args:
        path: Its final name, in a recording's folder.

    Raises:
        OSError: It cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._part = part_of(path)
        # A file of that name is left from a crash, or must not be written.
        remove(self._part)
        self._fd = files.open_file(self._part, os.O_WRONLY | os.O_CREAT | os.O_EXCL)
        self._end = 0
        self._tables: dict[str, dict[str, str]] = {}
        self._blocks: dict[str, list[_Rows]] = {}
        try:
            self._write([MAGIC])
        except OSError:
            self.discard()
            raise

    def append(
        self, table: str, columns: Mapping[str, Values], place: tuple[int, int] = (0, 0)
    ) -> None:
        """Add rows to a table.

        Args:
            table: Its name.
            columns: By name, all of the same number of rows; the same names and types each
                time.
            place: Sort position: after rows of a lower place and, for the same place, after
            those added before.

        Raises:
            OSError: They cannot be written.
            ValueError: Names or types differ from those before.
        """
        types = {name: _type_of(values) for name, values in columns.items()}
        if self._tables.setdefault(table, types) != types:
            raise ValueError(f"other columns than before: {table}")
        offset = self._end
        everything: list[Any] = []
        blocks: list[_Block] = []
        for values in columns.values():
            rows = _rows(values)
            same = rows > 1 and _is_same(values)
            parts = _packed(values, 1 if same else rows)
            size = sum(map(len, parts))
            crc = 0
            for part in parts:
                crc = crc32(part, crc)
            blocks.append(_Block(rows, same, offset, size, crc))
            everything += parts
            offset += size
        self._blocks.setdefault(table, []).append(_Rows(place, np.array(blocks, _ENTRY)))
        self._write(everything)

    def close(self, tables: Mapping[str, Mapping[str, object]]) -> None:
        """Give the file its final name; without any table, create no file.

        Args:
            tables: The tables to write, each with its notes as JSON.

        Raises:
            OSError: It cannot be written.
        """
        pages = {name: self._page(name, tables[name]) for name in self._tables if name in tables}
        directory: dict[str, _Page] = {}
        at = self._end
        for name, (about, blocks) in pages.items():
            count = len(blocks) // _ENTRY.itemsize
            directory[name] = _Page(at, len(about), count, crc32(blocks, crc32(about)))
            at += directory[name].size
        told = _as_json(directory)
        try:
            if pages and at - self._end + len(told) <= _MOST_DIRECTORY:
                tail = _TAIL.pack(len(told), crc32(told))
                self._write([part for page in pages.values() for part in page])
                self._write([told, tail, MAGIC])
                files.rename(self._part, self._path)
            else:
                remove(self._path)
        finally:
            self.discard()

    def _page(self, name: str, notes: Mapping[str, object]) -> tuple[bytes, bytes]:
        """The description of a table and its blocks, column by column."""
        about = _as_json({"columns": [*self._tables[name].items()], "notes": notes})
        parts = sorted(self._blocks[name], key=lambda rows: rows.place)
        return about, np.array([rows.blocks for rows in parts]).T.tobytes()

    def discard(self) -> None:
        """Remove the temporary file, if possible."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):  # errors of a file that will not be read
                os.close(fd)
            with suppress(OSError):
                files.unlink(self._part)

    def _write(self, parts: list[Any]) -> None:
        self._end += durability.write_all(self._fd, parts)


def part_of(path: Path) -> Path:
    """The temporary name of a file of columns."""
    return path.with_name(f"{path.name}.part")


def remove(path: Path) -> None:
    """Remove a file of columns, if it exists.

    Raises:
        OSError: It cannot be removed.
    """
    with suppress(FileNotFoundError):
        files.unlink(path)


class ColumnFile:
    """Reads a file of columns. Thread safe.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: It does not exist.
        StoreError: It cannot be read, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = -1
        self._tables: dict[str, _Table] = {}
        try:
            self._fd = files.open_file(path, os.O_RDONLY | os.O_NONBLOCK)
            self._start, self._pages = self._directory(os.fstat(self._fd).st_size)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise self._unreadable(error) from error

    def __del__(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)

    def rows(self, table: str) -> int:
        """Number of rows of a table; 0 if it does not exist.

        Raises:
            StoreError: Its page is damaged; the other methods that name a table raise this, too.
        """
        return self._table(table).rows if table in self._pages else 0

    def memory(self, table: str, column: str) -> int:
        """Memory of a column in bytes, without the offsets of its strings."""
        blocks = self._table(table).blocks[column]
        times = np.where(blocks["same"] == 1, blocks["rows"], 1).astype(np.float64)
        return int((times * blocks["size"]).sum())

    def types(self, table: str) -> Mapping[str, str]:
        """Types of a table's columns by name; empty if it does not exist."""
        return self._table(table).types if table in self._pages else {}

    def notes(self, table: str) -> Mapping[str, object]:
        """Notes of a table."""
        return self._table(table).notes

    def tables(self) -> AbstractSet[str]:
        """Names of all tables."""
        return self._pages.keys()

    def size(self, table: str, columns: Collection[str]) -> int:
        """Bytes to read for some columns of a table."""
        found = self._table(table)
        return sum(int(found.blocks[name]["size"].sum()) for name in columns)

    def read(self, table: str, column: str) -> Values:
        """Read a whole column.

        Raises:
            StoreError: It is damaged.
        """
        found = self._table(table)
        kind, blocks = found.types[column], _blocks(found.blocks[column])
        if kind == TEXT:
            return self._text(blocks)
        values = np.empty(found.rows, kind)
        at = 0
        for block in blocks:
            self._fill(block, values[at : at + block.rows])
            at += block.rows
        return values

    def check(self) -> None:
        """Read and check the whole file.

        Raises:
            StoreError: Something is damaged.
        """
        for name in self._pages:
            table = self._table(name)
            for entries in table.blocks.values():
                for block in _blocks(entries):
                    self._raw(block)

    def _directory(self, size: int) -> tuple[int, dict[str, Any]]:
        """Start of the directory, and the position of each table's page."""
        least = len(MAGIC) * 2 + _TAIL.size
        if size < least or self._read(0, len(MAGIC)) != MAGIC:
            raise self._damaged("it is too short, or no file of columns")
        end = size - least + len(MAGIC)
        tail = self._read(end, _TAIL.size + len(MAGIC))
        length, crc = _TAIL.unpack_from(tail)
        start = end - length
        if tail[_TAIL.size :] != MAGIC or start < len(MAGIC) or length > _MOST_DIRECTORY:
            raise self._damaged("its end is missing")
        data = self._read(start, length)
        if crc32(data) != crc:
            raise self._damaged("the checksum of its directory differs")
        try:
            pages = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise self._damaged("its directory cannot be read") from error
        if not isinstance(pages, dict):
            raise self._damaged("its directory cannot be read")
        return start, pages

    def _page(self, name: str) -> _Page:
        try:
            page = _Page(*self._pages[name])
        except TypeError as error:
            raise self._damaged("its directory cannot be read") from error
        if not all(type(part) is int and part >= 0 for part in page):
            raise self._damaged("its directory cannot be read")
        if page.offset + page.size > self._start or page.size > _MOST_DIRECTORY:
            raise self._damaged("its directory names places outside of it")
        return page

    def _table(self, name: str) -> _Table:
        """The description of a table, read on first use."""
        table = self._tables.get(name)
        if table is None:
            table = self._tables[name] = self._read_table(name)
        return table

    def _read_table(self, name: str) -> _Table:
        page = self._page(name)
        data = self._read(page.offset, page.size)
        if crc32(data) != page.crc:
            raise self._damaged(f"the checksum of what it says of {name!r} differs")
        try:
            about = json.loads(data[: page.length])
            columns, notes = about["columns"], dict(about["notes"])
            types = {str(column): kind for column, kind in columns}
            # Each addition of rows gave every column a block.
            blocks = np.frombuffer(data, _ENTRY, offset=page.length).reshape(len(types), -1)
            is_known = (
                len(types) == len(columns) and blocks.size and _KNOWN.issuperset(types.values())
            )
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise self._damaged(f"what it says of {name!r} cannot be read") from error
        rows = blocks["rows"]
        if not is_known or (rows != rows[0]).any() or int(rows.max()) >= _MOST_ROWS:
            raise self._damaged(f"columns of {name!r} are unknown or unequal")
        offset, ends = blocks["offset"], blocks["offset"] + blocks["size"]
        # A sum that overflows 64 bits is less than its parts.
        if (ends < offset).any() or int(ends.max()) > self._start:
            raise self._damaged(f"it names places outside of it for {name!r}")
        return _Table(types, notes, int(rows[0].sum()), dict(zip(types, blocks, strict=True)))

    def _fill(self, block: _Block, values: NDArray[Any]) -> None:
        """Read the rows of a block of numbers into place."""
        wanted = values.itemsize if block.same else values.nbytes
        if block.size != wanted:
            raise self._damaged(f"the block at byte {block.offset} has the wrong length")
        if block.same:
            values[:] = np.frombuffer(self._raw(block), values.dtype)[0]
            return
        self._read_into(block, values.view(np.uint8).data)

    def _text(self, blocks: Iterable[_Block]) -> Text:
        parts: list[NDArray[np.uint8]] = []
        lengths: list[NDArray[np.int64]] = []
        for block in blocks:
            raw = np.frombuffer(self._raw(block), np.uint8)
            if block.same:
                parts.append(np.tile(raw, block.rows))
                lengths.append(np.full(block.rows, len(raw), np.int64))
                continue
            head = block.rows * 4
            each = raw[:head].view("<u4").astype(np.int64) if len(raw) >= head else None
            if each is None or int(each.sum()) != len(raw) - head:
                raise self._damaged(f"the block at byte {block.offset} has the wrong length")
            lengths.append(each)
            parts.append(raw[head:])
        offset = np.zeros(sum(map(len, lengths)) + 1, np.int64)
        np.cumsum(np.concatenate([np.empty(0, np.int64), *lengths]), out=offset[1:])
        return Text(np.concatenate([np.empty(0, np.uint8), *parts]), offset)

    def _raw(self, block: _Block) -> memoryview:
        data = np.empty(block.size, np.uint8).data
        self._read_into(block, data)
        return data

    def _read_into(self, block: _Block, data: memoryview) -> None:
        try:
            count = os.preadv(self._fd, [data], block.offset)
        except OSError as error:
            raise self._unreadable(error) from error
        if count != len(data) or crc32(data) != block.crc:
            raise self._damaged(f"the checksum of the block at byte {block.offset} differs")

    def _read(self, offset: int, size: int) -> bytes:
        try:
            return os.pread(self._fd, size, offset)
        except OSError as error:
            raise self._unreadable(error) from error

    def _unreadable(self, error: OSError) -> StoreError:
        return self._damaged(f"it cannot be read: {error.strerror}")

    def _damaged(self, problem: str) -> StoreError:
        return StoreError(f"The columns in {self.path} are damaged: {problem}. {_CURE}")


class _Page(NamedTuple):
    """Position of a table's page: a description in JSON, followed by its blocks."""

    offset: int
    length: int  # of the description, bytes
    blocks: int  # their number
    crc: int

    @property
    def size(self) -> int:
        """Bytes of the page."""
        return self.length + self.blocks * _ENTRY.itemsize


class _Table(NamedTuple):
    """The description of a table."""

    types: dict[str, str]  # types of its columns, by name
    notes: dict[str, object]
    rows: int
    blocks: dict[str, NDArray[np.void]]  # blocks of each column, in order


class _Rows(NamedTuple):
    """Rows of a table that were added together, with one block for each column."""

    place: tuple[int, int]
    blocks: NDArray[np.void]


def _as_json(value: object) -> bytes:
    return json.dumps(value, separators=(",", ":")).encode()


def _blocks(entries: NDArray[np.void]) -> Iterable[_Block]:
    return map(_Block._make, entries.tolist())


def _type_of(values: Values) -> str:
    return TEXT if isinstance(values, Text) else values.dtype.str


def _rows(values: Values) -> int:
    return len(values.offset) - 1 if isinstance(values, Text) else len(values)


def _is_same(values: Values) -> bool:
    """True if all rows are equal byte for byte."""
    if isinstance(values, Text):
        size = np.diff(values.offset)
        if bool((size != size[0]).any()):
            return False
        first, last = int(values.offset[0]), int(values.offset[-1])
        rows = values.data[first:last].reshape(len(size), int(size[0]))
        return bool((rows == rows[0]).all())
    bits = values.view(f"u{values.itemsize}")
    return bool(bits[0] == bits[-1]) and bool((bits == bits[0]).all())


def _packed(values: Values, rows: int) -> list[Any]:
    """The first rows as bytes; a single string has no length."""
    if not isinstance(values, Text):
        return [np.ascontiguousarray(values[:rows]).view(np.uint8).data]
    first, last = int(values.offset[0]), int(values.offset[rows])
    data = np.ascontiguousarray(values.data[first:last]).data
    if rows != len(values.offset) - 1:
        return [data]
    return [np.diff(values.offset).astype("<u4").view(np.uint8).data, data]
