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

MAGIC = b"\x89HLC2\r\n\n"
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
    assert content.startswith(MAGIC)
    assert content.endswith(MAGIC)
    end = len(content) - 8 - 12
    length, crc = struct.unpack_from("<QI", content, end)
    assert zlib.crc32(content[end - length : end]) == crc
    found: dict[str, dict[str, list[Any]]] = {}
    for table, (at, about_length, count, crc) in json.loads(content[end - length : end]).items():
        page = content[at : at + about_length + 32 * count]
        assert zlib.crc32(page) == crc
        about = json.loads(page[:about_length])
        found[table] = {name: [] for name, _ in about["columns"]}
        each = count // len(found[table])
        owners = [c for c in about["columns"] for _ in range(each)]
        assert len(owners) == count
        for number, (name, kind) in enumerate(owners):
            entry = struct.unpack_from("<IIQQII", page, about_length + 32 * number)
            found[table][name] += cells_of(content, kind, entry)
    return found


def cells_of(content: bytes, kind: str, entry: tuple[int, ...]) -> list[Any]:
    """The rows of one block."""
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
    return cells * (rows if same else 1)


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


def file_of(path: Path, directory: bytes, page: bytes = b"", blocks: bytes = b"") -> ColumnFile:
    """A file made by hand; its directory may name the place of the page."""
    start = len(MAGIC) + len(blocks)
    told = directory.replace(b"START", b"%d" % start).replace(b"CRC", b"%d" % zlib.crc32(page))
    tail = struct.pack("<QI", len(told), zlib.crc32(told))
    path.write_bytes(MAGIC + blocks + page + told + tail + MAGIC)
    return ColumnFile(path)


@pytest.mark.parametrize(
    "directory", [b"", b"[]", b"3", b"[" * 100_000, b'{"a":' * 100_000, b"\xff", b"{1:2}"]
)
def test_a_hostile_directory_is_refused(tmp_path: Path, directory: bytes) -> None:
    with pytest.raises(StoreError, match="damaged"):
        file_of(tmp_path / "some", directory)


@pytest.mark.parametrize(
    "place",
    [
        b"3",
        b"null",
        b'"abcd"',
        b"[]",
        b"[8,0,0]",
        b"[8,0,0,0,0]",
        b"[8,0,0,null]",
        b"[8,true,0,0]",
        b"[8.0,0,0,0]",
        b"[1e400,0,0,0]",
        b"[-1,8,0,0]",
        b"[8,-8,0,0]",
        b"[8,0,-1,0]",
        b"[8,0,1000,0]",
        b"[1000000,0,0,0]",
        b"[8,10000000000000000000000000,0,0]",
        b"[8,0,0,1]",
        b"[8,0,0,0]",
        b'{"offset":8,"length":0,"blocks":0,"crc":0}',
    ],
)
def test_a_hostile_place_of_a_page_is_refused(tmp_path: Path, place: bytes) -> None:
    file = file_of(tmp_path / "some", b'{"a":' + place + b"}")
    for ask in (file.types, file.rows, file.notes):
        with pytest.raises(StoreError, match="damaged"):
            ask("a")
    with pytest.raises(StoreError, match="damaged"):
        file.check()
    assert not file.rows("b")


@pytest.mark.parametrize(
    ("about", "count"),
    [
        (b"", 1),
        (b"[]", 1),
        (b"{}", 1),
        (b"[" * 100_000, 1),
        (b'{"columns":3,"notes":{}}', 1),
        (b'{"columns":[],"notes":{}}', 0),
        (b'{"columns":[],"notes":{}}', 1),
        (b'{"columns":[["x","<f8"]],"notes":3}', 1),
        (b'{"columns":[["x","<f8"]],"notes":{}}', 0),
        (b'{"columns":[["x"]],"notes":{}}', 1),
        (b'{"columns":[["x","O"]],"notes":{}}', 1),
        (b'{"columns":[["x",["<f8"]]],"notes":{}}', 1),
        (b'{"columns":[["x","<f8"],["x","<f8"]],"notes":{}}', 1),
        (b'{"columns":[["x","<f8"],["x","<f8"]],"notes":{}}', 2),
        (b'{"columns":[["x","<f8"],["y","<f8"]],"notes":{}}', 3),
        (b"\xff", 1),
    ],
)
def test_a_hostile_page_is_refused(tmp_path: Path, about: bytes, count: int) -> None:
    page = about + struct.pack("<IIQQII", 1, 0, 8, 8, zlib.crc32(bytes(8)), 0) * count
    told = b'{"a":[START,%d,%d,CRC]}' % (len(about), count)
    file = file_of(tmp_path / "some", told, page, bytes(8))
    with pytest.raises(StoreError, match="damaged"):
        file.types("a")


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
    column, *block = entry
    kind = {"x": b"<f8", "s": b"text"}[column]
    about = b'{"columns":[["%s","%s"]],"notes":{}}' % (column.encode(), kind)
    told = b'{"a":[START,%d,1,CRC]}' % len(about)
    with pytest.raises(StoreError, match="damaged"):
        file_of(tmp_path / "some", told, about + struct.pack("<IIQQII", *block), bytes(8)).read(
            "a", column
        )


def test_columns_of_unequal_length_are_refused(tmp_path: Path) -> None:
    about = b'{"columns":[["x","<f8"],["y","<f8"]],"notes":{}}'
    crc = zlib.crc32(bytes(8))
    page = about + struct.pack("<IIQQII", 1, 0, 8, 8, crc, 0)
    page += struct.pack("<IIQQII", 2, 1, 8, 8, crc, 0)
    file = file_of(tmp_path / "some", b'{"a":[START,%d,2,CRC]}' % len(about), page, bytes(8))
    with pytest.raises(StoreError, match="unequal"):
        file.read("a", "x")


def test_a_directory_of_gigabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "some"
    with path.open("wb") as file:
        file.write(MAGIC)
        file.truncate(1 << 40)
        file.seek(0, os.SEEK_END)
        file.write(struct.pack("<QI", (1 << 40) - 8, 0) + MAGIC)
    with pytest.raises(StoreError, match="its end is missing"):
        ColumnFile(path)


def test_a_page_of_gigabytes_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "some"
    told = b'{"a":[8,0,%d,0]}' % (1 << 30)
    with path.open("wb") as file:
        file.write(MAGIC)
        file.truncate(1 << 40)
        file.seek(0, os.SEEK_END)
        file.write(told + struct.pack("<QI", len(told), zlib.crc32(told)) + MAGIC)
    with pytest.raises(StoreError, match="places outside of it"):
        ColumnFile(path).rows("a")


def test_one_damaged_page_leaves_the_others(tmp_path: Path) -> None:
    path = tmp_path / "some"
    writer = ColumnFileWriter(path)
    for name in ("one", "two"):
        writer.append(name, {"x": np.arange(3)})
    writer.close({"one": {}, "two": {}})
    content = path.read_bytes()
    place = json.loads(content[content.rindex(b'{"one"') : -20])["two"][0]
    path.write_bytes(content[:place] + b"?" + content[place + 1 :])
    file = ColumnFile(path)
    assert bits(file.read("one", "x")) == np.arange(3).tobytes()
    with pytest.raises(StoreError, match="what it says of 'two' differs"):
        file.types("two")


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
