"""A file of columns: tables of many rows, of which each column can be read by itself.

What such a file holds follows from other files and can be made again. So nobody waits
until it is on the disk; checksums say whether it got there. It grows a block at a time, a
block being some rows of one column, and is visible under its name only when it is whole.

```
magic, blocks, directory, table of blocks, tail, magic
```
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Collection, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from hybridlog_storage import durability
from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import StoreError

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAGIC: Final = b"\x89HLC1\r\n\n"
TEXT: Final = "text"
"""Type of a column of strings; all others have a numpy type."""

_TAIL = struct.Struct("<QQI")  # bytes of the directory, number of blocks, checksum of both
_ENTRY = np.dtype(
    [
        ("table", "<u4"),
        ("column", "<u4"),
        ("rows", "<u4"),
        ("same", "<u4"),
        ("offset", "<u8"),
        ("size", "<u8"),
        ("crc", "<u4"),
        ("", "<u4"),
    ]
)
_TYPES = frozenset({"|b1", "|i1", "|u1", *(f"<{k}{n}" for k in "iu" for n in (2, 4, 8))})
_KNOWN = _TYPES | {"<f4", "<f8", TEXT}
_MOST_ROWS = 1 << 31  # of a block
_MOST_DIRECTORY = 256 << 20  # bytes of directory and table of blocks
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
    """Writes a file of columns under a name of its own until it is whole.

    Args:
        path: Its final name.

    Raises:
        OSError: It cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._part = part_of(path)
        # What lies there under that name is a crash's, or nothing to be written to.
        self._part.unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        self._fd = os.open(self._part, flags, 0o644)
        self._end = 0
        self._tables: dict[str, dict[str, str]] = {}
        self._numbers: dict[str, int] = {}
        self._blocks = bytearray()
        self._places: list[tuple[int, int]] = []  # of each block's rows
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
            place: Where they belong: after rows of a lower place and, of the same one, after
                those that were added before.

        Raises:
            OSError: They cannot be written.
            ValueError: Names or types are others than before.
        """
        types = {name: _type_of(values) for name, values in columns.items()}
        if self._tables.setdefault(table, types) != types:
            raise ValueError(f"other columns than before: {table}")
        number = self._numbers.setdefault(table, len(self._numbers))
        offset = self._end
        everything: list[Any] = []
        blocks: list[tuple[int, ...]] = []
        for column, values in enumerate(columns.values()):
            rows = _rows(values)
            same = rows > 1 and _is_same(values)
            parts = _packed(values, 1 if same else rows)
            size = sum(map(len, parts))
            crc = 0
            for part in parts:
                crc = crc32(part, crc)
            blocks.append((number, column, rows, same, offset, size, crc, 0))
            everything += parts
            offset += size
        self._blocks += np.array(blocks, _ENTRY).tobytes()
        self._places += [place] * len(blocks)
        self._write(everything)

    def close(self, tables: Mapping[str, Mapping[str, object]]) -> None:
        """Give the file its name; without any table there is no file.

        Args:
            tables: Names of those that are kept, and what is noted of each, as JSON.

        Raises:
            OSError: It cannot be written.
        """
        kept = [name for name in self._tables if name in tables]
        numbers = {self._numbers[name]: place for place, name in enumerate(kept)}
        in_order = sorted(range(len(self._places)), key=self._places.__getitem__)
        blocks = np.frombuffer(self._blocks, _ENTRY)[in_order]
        renumbered = np.full(len(self._numbers), -1, np.int64)
        renumbered[list(numbers)] = list(numbers.values())
        blocks = blocks[renumbered[blocks["table"]] >= 0]
        blocks["table"] = renumbered[blocks["table"]]
        directory = json.dumps(
            {
                "tables": [
                    {"name": name, "columns": [*self._tables[name].items()], "notes": tables[name]}
                    for name in kept
                ]
            },
            separators=(",", ":"),
        ).encode()
        crc = crc32(blocks.tobytes(), crc32(directory))
        if len(directory) + blocks.nbytes > _MOST_DIRECTORY:
            kept = []
        try:
            if kept:
                tail = _TAIL.pack(len(directory), len(blocks), crc)
                self._write([directory, blocks.tobytes(), tail, MAGIC])
                self._part.replace(self._path)
            else:
                self._path.unlink(missing_ok=True)
        finally:
            self.discard()

    def discard(self) -> None:
        """Leave nothing of what was not given its name, as far as the system lets us."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            with suppress(OSError):  # of a file that nobody will read
                os.close(fd)
            with suppress(OSError):
                self._part.unlink()

    def _write(self, parts: list[Any]) -> None:
        self._end += durability.write_all(self._fd, parts)


def part_of(path: Path) -> Path:
    """Name of a file of columns while it is written."""
    return path.with_name(f"{path.name}.part")


class ColumnFile:
    """Reads a file of columns. Thread safe.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: There is none.
        StoreError: It cannot be read, or is damaged.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._fd = -1
        try:
            self._fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
            size = os.fstat(self._fd).st_size
            self._tables, self._blocks = self._directory(size)
        except FileNotFoundError:
            raise
        except OSError as error:
            raise self._damaged(f"it cannot be read: {error.strerror}") from error

    def __del__(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)

    def rows(self, table: str) -> int:
        """Rows of a table; 0 when there is none of that name."""
        found = self._tables.get(table)
        return 0 if found is None else found.rows

    def memory(self, table: str, column: str) -> int:
        """Bytes that a column takes when it has been read, without where its strings begin."""
        blocks = self._of(table, column)
        times = np.where(blocks["same"] == 1, blocks["rows"], 1).astype(np.float64)
        return int((times * blocks["size"]).sum())

    def types(self, table: str) -> Mapping[str, str]:
        """Types of a table's columns by name."""
        found = self._tables.get(table)
        return {} if found is None else found.types

    def notes(self, table: str) -> Mapping[str, object]:
        """What is noted of a table."""
        return self._tables[table].notes

    def tables(self) -> AbstractSet[str]:
        """Names of all tables."""
        return self._tables.keys()

    def size(self, table: str, columns: Collection[str]) -> int:
        """Bytes to be read for some columns of a table."""
        return sum(int(self._of(table, name)["size"].sum()) for name in columns)

    def read(self, table: str, column: str) -> Values:
        """A whole column.

        Raises:
            StoreError: It is damaged.
        """
        found, blocks = self._tables[table], self._of(table, column)
        kind = found.types[column]
        if int(blocks["rows"].sum()) != found.rows:
            raise self._damaged(f"rows of {column!r} of {table!r} are missing")
        if kind == TEXT:
            return self._text(blocks)
        values = np.empty(found.rows, kind)
        at = 0
        for entry in blocks:
            rows = int(entry["rows"])
            self._fill(entry, values[at : at + rows])
            at += rows
        return values

    def check(self) -> None:
        """Read all of it.

        Raises:
            StoreError: Something is damaged.
        """
        for table in self._tables:
            for column in self._tables[table].types:
                for entry in self._of(table, column):
                    self._raw(entry)

    def _directory(self, size: int) -> tuple[dict[str, _Table], NDArray[np.void]]:
        least = len(MAGIC) * 2 + _TAIL.size
        if size < least or self._read(0, len(MAGIC)) != MAGIC:
            raise self._damaged("it is too short, or no file of columns")
        tail = self._read(size - least + len(MAGIC), _TAIL.size + len(MAGIC))
        length, count, crc = _TAIL.unpack_from(tail)
        whole = length + count * _ENTRY.itemsize
        start = size - least + len(MAGIC) - whole
        if tail[_TAIL.size :] != MAGIC or start < len(MAGIC) or whole > _MOST_DIRECTORY:
            raise self._damaged("its end is missing")
        data = self._read(start, whole)
        if crc32(data) != crc:
            raise self._damaged("the checksum of its directory differs")
        blocks = np.frombuffer(data[length:], _ENTRY)
        try:
            named = [
                (
                    str(table["name"]),
                    [(str(name), str(kind)) for name, kind in table["columns"]],
                    dict(table["notes"]),
                )
                for table in json.loads(data[:length])["tables"]
            ]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise self._damaged("its directory cannot be read") from error
        ends = blocks["offset"] + blocks["size"]
        beyond = (ends < blocks["offset"]) | (ends > start) | (blocks["rows"] >= _MOST_ROWS)
        if bool(beyond.any()):
            raise self._damaged("its directory names places outside of it")
        key = blocks["table"].astype(np.int64) << 32 | blocks["column"]
        order = np.argsort(key, kind="stable")
        self._keys, blocks = key[order], blocks[order]
        # A table has as many rows as its first column.
        first = np.arange(len(named), dtype=np.int64) << 32
        begin, end = np.searchsorted(self._keys, [first, first + 1])
        before = np.concatenate([np.zeros(1, np.int64), np.cumsum(blocks["rows"], dtype=np.int64)])
        rows_of = (before[end] - before[begin]).tolist()
        tables: dict[str, _Table] = {}
        for number, (name, columns, notes) in enumerate(named):
            types = dict(columns)
            if not types or len(types) != len(columns) or name in tables:
                raise self._damaged("its directory has a name twice, or none")
            if not _KNOWN.issuperset(types.values()):
                raise self._damaged("its directory has types that are not known")
            tables[name] = _Table(number, types, rows_of[number], notes)
        return tables, blocks

    def _range(self, table: int, column: int) -> slice:
        """Where the blocks of a column are among all."""
        key = table << 32 | column
        return slice(*np.searchsorted(self._keys, [key, key + 1]).tolist())

    def _of(self, table: str, column: str) -> NDArray[np.void]:
        """The blocks of a column, in order."""
        found = self._tables[table]
        blocks: NDArray[np.void] = self._blocks[
            self._range(found.number, list(found.types).index(column))
        ]
        return blocks

    def _fill(self, entry: np.void, values: NDArray[Any]) -> None:
        """Rows of a block of numbers, read to where they belong."""
        wanted = values.itemsize if entry["same"] else values.nbytes
        if int(entry["size"]) != wanted:
            raise self._damaged(f"the block at byte {entry['offset']} has the wrong length")
        if entry["same"]:
            values[:] = np.frombuffer(self._raw(entry), values.dtype)[0]
            return
        self._read_into(entry, values.view(np.uint8).data)

    def _text(self, blocks: NDArray[np.void]) -> Text:
        parts: list[NDArray[np.uint8]] = []
        lengths: list[NDArray[np.int64]] = []
        for entry in blocks:
            raw = np.frombuffer(self._raw(entry), np.uint8)
            rows = int(entry["rows"])
            if entry["same"]:
                parts.append(np.tile(raw, rows))
                lengths.append(np.full(rows, len(raw), np.int64))
                continue
            head = rows * 4
            each = raw[:head].view("<u4").astype(np.int64) if len(raw) >= head else None
            if each is None or int(each.sum()) != len(raw) - head:
                raise self._damaged(f"the block at byte {entry['offset']} has the wrong length")
            lengths.append(each)
            parts.append(raw[head:])
        offset = np.zeros(sum(map(len, lengths)) + 1, np.int64)
        np.cumsum(np.concatenate([np.empty(0, np.int64), *lengths]), out=offset[1:])
        return Text(np.concatenate([np.empty(0, np.uint8), *parts]), offset)

    def _raw(self, entry: np.void) -> memoryview:
        data = np.empty(int(entry["size"]), np.uint8).data
        self._read_into(entry, data)
        return data

    def _read_into(self, entry: np.void, data: memoryview) -> None:
        offset = int(entry["offset"])
        try:
            count = os.preadv(self._fd, [data], offset)
        except OSError as error:
            raise self._damaged(f"it cannot be read: {error.strerror}") from error
        if count != len(data) or crc32(data) != int(entry["crc"]):
            raise self._damaged(f"the checksum of the block at byte {offset} differs")

    def _read(self, offset: int, size: int) -> bytes:
        return os.pread(self._fd, size, offset)

    def _damaged(self, problem: str) -> StoreError:
        return StoreError(f"The columns in {self.path} are damaged: {problem}. {_CURE}")


class _Table(NamedTuple):
    number: int
    types: dict[str, str]
    rows: int
    notes: dict[str, object]


def _type_of(values: Values) -> str:
    return TEXT if isinstance(values, Text) else values.dtype.str


def _rows(values: Values) -> int:
    return len(values.offset) - 1 if isinstance(values, Text) else len(values)


def _is_same(values: Values) -> bool:
    """Whether all rows have the same bytes."""
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
    """The first rows as bytes; one string alone has no length."""
    if not isinstance(values, Text):
        return [np.ascontiguousarray(values[:rows]).view(np.uint8).data]
    first, last = int(values.offset[0]), int(values.offset[rows])
    data = np.ascontiguousarray(values.data[first:last]).data
    if rows != len(values.offset) - 1:
        return [data]
    return [np.diff(values.offset).astype("<u4").view(np.uint8).data, data]
