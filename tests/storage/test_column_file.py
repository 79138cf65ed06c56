"""Files of columns: what was written is read, and what was changed is noticed."""

from __future__ import annotations

import json
import os
import struct
import zlib
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from hybridlog_storage.column_file import ColumnFile, ColumnFileWriter, Text, Values
from hybridlog_storage.errors import StoreError

TYPES = ["|b1", "|i1", "|u1", "<i2", "<u2", "<i4", "<u4", "<i8", "<u8", "<f4", "<f8"]


def text(strings: list[str]) -> Text:
    """A column of strings that does not begin at the first byte of its data."""
    cells = [s.encode() for s in strings]
    data = np.frombuffer(b"xy" + b"".join(cells), np.uint8)
    return Text(data, np.cumsum([2, *map(len, cells)]))


def strings(column: Values) -> list[str]:
    assert isinstance(column, Text)
    return [
        column.data[a:b].tobytes().decode()
        for a, b in zip(column.offset[:-1], column.offset[1:], strict=True)
    ]


def plain(path: Path) -> dict[str, dict[str, list[Any]]]:
    """What a file holds, read as its specification says, with `struct` alone."""
    content = path.read_bytes()
    magic = b"\x89HLC1\r\n\n"
    assert content.startswith(magic)
    assert content.endswith(magic)
    at = len(content) - 8 - 20
    length, count, crc = struct.unpack_from("<QQI", content, at)
    start = at - 32 * count - length
    assert zlib.crc32(content[start:at]) == crc
    tables = json.loads(content[start : start + length])["tables"]
    found: dict[str, dict[str, list[Any]]] = {
        t["name"]: {name: [] for name, *_ in t["columns"]} for t in tables
    }
    owners = [(t["name"], *c) for t in tables for c in t["columns"] for _ in range(c[2])]
    assert len(owners) == count
    for number, (table, name, kind, _) in enumerate(owners):
        entry = struct.unpack_from("<IIQQII", content, start + length + 32 * number)
        rows, same, offset, size, check, _ = entry
        block = content[offset : offset + size]
        assert zlib.crc32(block) == check
        stored = 1 if same else rows
        cells: list[Any]
        if kind == "text" and same:
            cells = [block.decode()]
        elif kind == "text":
            lengths = struct.unpack_from(f"<{rows}I", block)
            ends = [4 * rows + sum(lengths[: n + 1]) for n in range(rows)]
            cells = [block[e - n : e].decode() for e, n in zip(ends, lengths, strict=True)]
        else:
            code = {"b1": "?", "f4": "f", "f8": "d"}.get(kind[1:])
            code = code or {1: "b", 2: "h", 4: "i", 8: "q"}[int(kind[2:])]
            code = code.upper() if kind[1] == "u" else code
            cells = list(struct.unpack(f"<{stored}{code}", block))
        found[table][name] += cells * (rows if same else 1)
    return found


kinds = st.sampled_from([*TYPES, "text"])
counts = st.lists(st.integers(1, 6), min_size=1, max_size=3)


@st.composite
def tables(draw: st.DrawFn) -> list[dict[str, Values]]:
    """Some rows of one table at a time."""
    names = draw(st.lists(st.text(max_size=5), min_size=1, max_size=4, unique=True))
    types = {name: draw(kinds) for name in names}
    alike = draw(st.booleans())

    def column(kind: str, rows: int) -> Values:
        if kind == "text":
            cells = draw(st.lists(st.text(max_size=4), min_size=rows, max_size=rows))
            return text(cells[:1] * rows if alike else cells)
        found = draw(arrays.arrays(np.dtype(kind), rows))
        return np.repeat(found[:1], rows) if alike else found

    return [{n: column(k, rows) for n, k in types.items()} for rows in draw(counts)]


def bits(column: Values) -> Any:
    return strings(column) if isinstance(column, Text) else column.tobytes()


@given(one=tables(), two=tables())
def test_what_was_written_is_read(
    tmp_path_factory: pytest.TempPathFactory, one: list[Any], two: list[Any]
) -> None:
    path = tmp_path_factory.mktemp("columns") / "some"
    writer = ColumnFileWriter(path)
    for turn in range(3):
        for name, parts in (("one", one), ("two", two), ("dropped", one)):
            if turn < len(parts):
                writer.append(name, parts[turn])
    assert not path.exists()
    writer.close({"one": {"of": 1}, "two": {}})
    assert [p.name for p in path.parent.iterdir()] == ["some"]
    file = ColumnFile(path)
    file.check()
    assert list(file.tables()) == ["one", "two"]
    assert file.notes("one") == {"of": 1}
    assert file.rows("dropped") == 0
    assert not file.types("dropped")
    other = plain(path)
    for name, parts in (("one", one), ("two", two)):
        assert list(file.types(name)) == list(parts[0])
        for column in parts[0]:
            read = file.read(name, column)
            want = [bits(part[column]) for part in parts]
            joined = [*chain(*want)] if isinstance(want[0], list) else b"".join(want)
            assert bits(read) == joined
            assert file.rows(name) == len(other[name][column])
            if isinstance(read, Text):
                assert other[name][column] == strings(read)
            else:
                assert np.array_equal(
                    np.array(other[name][column], read.dtype),
                    read,
                    equal_nan=read.dtype.kind == "f",
                )


@given(part=tables(), places=st.lists(st.tuples(*[st.integers(0, 2)] * 2), min_size=3, max_size=3))
def test_rows_have_their_place(
    tmp_path_factory: pytest.TempPathFactory, part: list[Any], places: list[tuple[int, int]]
) -> None:
    path = tmp_path_factory.mktemp("columns") / "some"
    writer = ColumnFileWriter(path)
    placed = list(zip(part, places, strict=False))
    for columns, place in placed:
        writer.append("other", columns, place)
        writer.append("one", columns, place)
    writer.close({"one": {}})
    in_order = [columns for columns, _ in sorted(placed, key=lambda one: one[1])]
    file, wanted = ColumnFile(path), path.with_name("wanted")
    writer = ColumnFileWriter(wanted)
    for columns in in_order:
        writer.append("one", columns)
    writer.close({"one": {}})
    for name in part[0]:
        have, want = file.read("one", name), ColumnFile(wanted).read("one", name)
        assert bits(have) == bits(want)
    assert repr(plain(path)) == repr(plain(wanted))


def some(path: Path) -> dict[str, Values]:
    columns: dict[str, Values] = {
        "x": np.linspace(0, 1, 50),
        "same": np.full(50, 7, np.int32),
        "name": text([f"n{n}" for n in range(50)]),
        "frame": text(["base"] * 50),
    }
    writer = ColumnFileWriter(path)
    writer.append("poses", columns)
    writer.append("poses", columns)
    writer.close({"poses": {}})
    return columns


def test_what_is_the_same_in_all_rows_is_written_once(tmp_path: Path) -> None:
    some(tmp_path / "some")
    file = ColumnFile(tmp_path / "some")
    assert file.size("poses", ["same", "frame"]) == 2 * (4 + 4)
    assert file.size("poses", ["x"]) == 2 * 50 * 8


def test_every_changed_byte_and_every_cut_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "some"
    columns = some(path)
    content = path.read_bytes()
    for place in range(0, len(content), 7):
        changed = bytearray(content)
        changed[place] ^= 0x10
        path.write_bytes(changed)
        with pytest.raises(StoreError, match=r"some are damaged.*hybridlog reindex"):
            ColumnFile(path).check()
    for end in range(0, len(content), 13):
        path.write_bytes(content[:end])
        with pytest.raises(StoreError, match="some are damaged"):
            ColumnFile(path)
    path.write_bytes(content)
    assert bits(ColumnFile(path).read("poses", "x")) == 2 * bits(columns["x"])


@pytest.mark.parametrize(
    "directory",
    [
        b"",
        b"[]",
        b"{}",
        b"[" * 100_000,
        b'{"tables":3}',
        b'{"tables":[{"name":"a","columns":[["x","<f8"]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",0]],"notes":3}]}',
        b'{"tables":[{"name":"a","columns":[["x","O",0]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x",["<f8"],0]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",0],["x","<f8",0]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",0]],"notes":{}},'
        b'{"name":"a","columns":[["x","<f8",0]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",1]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",1],["y","<f8",-1]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",1e400]],"notes":{}}]}',
        b'{"tables":[{"name":"a","columns":[["x","<f8",null]],"notes":{}}]}',
        b"\xff",
    ],
)
def test_a_hostile_directory_is_refused(tmp_path: Path, directory: bytes) -> None:
    path = tmp_path / "some"
    magic = b"\x89HLC1\r\n\n"
    tail = struct.pack("<QQI", len(directory), 0, zlib.crc32(directory))
    path.write_bytes(magic + directory + tail + magic)
    with pytest.raises(StoreError, match="damaged"):
        ColumnFile(path)


@pytest.mark.parametrize(
    "entry",
    [
        ("x", 1, 0, 0, 1 << 40, 0, 0),
        ("x", 1, 0, (1 << 64) - 4, 8, 0, 0),
        ("x", (1 << 32) - 1, 0, 8, 8, 0, 0),
        ("x", 3, 0, 8, 8, zlib.crc32(bytes(8)), 0),
        ("x", 3, 1, 8, 7, zlib.crc32(bytes(7)), 0),
        ("s", 3, 0, 8, 8, zlib.crc32(bytes(8)), 0),
        ("s", 1, 0, 8, 8, zlib.crc32(bytes(8)), 0),
    ],
)
def test_hostile_blocks_are_refused(tmp_path: Path, entry: tuple[Any, ...]) -> None:
    path = tmp_path / "some"
    magic = b"\x89HLC1\r\n\n"
    column, *block = entry
    counts = {"x": 0, "s": 0, column: 1}
    directory = (
        b'{"tables":[{"name":"a","columns":[["x","<f8",%d],["s","text",%d]],"notes":{}}]}'
        % (counts["x"], counts["s"])
    )
    blocks = struct.pack("<IIQQII", *block)
    tail = struct.pack("<QQI", len(directory), 1, zlib.crc32(directory + blocks))
    path.write_bytes(magic + bytes(8) + directory + blocks + tail + magic)
    with pytest.raises(StoreError, match="damaged"):
        ColumnFile(path).read("a", column)


@pytest.mark.parametrize(("length", "count"), [((1 << 40) - 8, 0), (0, 1 << 27)])
def test_a_directory_of_gigabytes_is_not_read(tmp_path: Path, length: int, count: int) -> None:
    path, magic = tmp_path / "some", b"\x89HLC1\r\n\n"
    with path.open("wb") as file:
        file.write(magic)
        file.truncate(1 << 40)
        file.seek(0, os.SEEK_END)
        file.write(struct.pack("<QQI", length, count, 0) + magic)
    with pytest.raises(StoreError, match="its end is missing"):
        ColumnFile(path)


def test_without_a_table_there_is_no_file(tmp_path: Path) -> None:
    path = tmp_path / "some"
    some(path)
    writer = ColumnFileWriter(path)
    writer.append("poses", {"x": np.arange(3)})
    writer.close({})
    assert not list(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError):
        ColumnFile(path)


def test_what_is_discarded_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "some"
    some(path)
    before = path.read_bytes()
    writer = ColumnFileWriter(path)
    writer.append("poses", {"x": np.arange(3)})
    writer.discard()
    writer.discard()
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["some"]


def test_columns_of_a_table_do_not_change(tmp_path: Path) -> None:
    writer = ColumnFileWriter(tmp_path / "some")
    writer.append("poses", {"x": np.arange(3)})
    with pytest.raises(ValueError, match="poses"):
        writer.append("poses", {"x": np.arange(3.0)})
    writer.discard()


def test_no_file_is_left_open(tmp_path: Path) -> None:
    some(tmp_path / "some")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(5):
        ColumnFile(tmp_path / "some")
    assert len(list(Path("/proc/self/fd").iterdir())) == before
