"""Columns of payloads, read by the section of that name in `docs/format.md` alone.

`pyarrow` reads Parquet; what the columns mean is from the page.
"""

from __future__ import annotations

import hashlib
import json
import re
import struct
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq


class WrongColumnsError(Exception):
    """A file is missing, or not as the specification says."""


def demand(condition: bool, what: str) -> None:
    if not condition:
        raise WrongColumnsError(what)


class Columns:
    """The files of one recording.

    Args:
        folder: Its `payloads`.
        listed: The files that the journal lists, by path.
        recording: Id of the recording.
    """

    def __init__(
        self, folder: Path, listed: Mapping[str, Mapping[str, Any]], recording: str
    ) -> None:
        self._folder = folder
        self._listed = listed
        self._recording = recording
        self._records: dict[tuple[int, int], list[tuple[int, bytes]]] | None = None

    def content(self, segment: int, chunk: int) -> bytes:
        """The content of a moved chunk: the records of its messages, where each starts."""
        if self._records is None:
            found = defaultdict(list)
            columns = {p: f for p, f in self._listed.items() if not p.startswith("fields=")}
            for path, file in columns.items():
                for place, start, record in self._file(self._folder / path, file):
                    found[place].append((start, record))
            self._records = found
        content = b""
        for start, record in sorted(self._records.get((segment, chunk), [])):
            demand(start == len(content), "a record of a moved chunk starts elsewhere")
            content += record
        return content

    def left(self, segment: int, chunk: int) -> list[tuple[int, int, bytes]]:
        """What is left of the messages of an expired chunk, as records in its order.

        Each has the place where its record was, and the bytes that its payload had.
        """
        found: dict[int, tuple[int, int, bytes]] = {}
        for path, listed in self._listed.items():
            if not path.startswith("fields="):
                continue
            file, about = self._checked(self._folder / path, listed)
            for group, chunks in enumerate(about["payloads"]["chunks"]):
                rows = [(s, c) for s, c, count in chunks for _ in range(count)]
                if (segment, chunk) not in rows:
                    continue
                for place, row in zip(rows, file.read_row_group(group).to_pylist(), strict=True):
                    ref = row["ref"]
                    demand((ref["seg"], ref["chunk"]) == place, "the chunk of a row")
                    if place == (segment, chunk):
                        head = row["channel"], ref["sequence"], row["t"], row["pub"]
                        size = 22 + len(ref["left"])
                        record = struct.pack("<BQHIQQ", 5, size, *head) + ref["left"]
                        found[ref["off"]] = ref["off"] - 31, ref["len"], record
        return [found[at] for at in sorted(found)]

    def _checked(self, path: Path, listed: Mapping[str, Any]) -> tuple[pq.ParquetFile, Any]:
        """A file whose checksums are right, and what it says of itself."""
        demand(path.is_file(), "a file of columns is missing")
        data = path.read_bytes()
        demand(len(data) == listed["bytes"] and data[-4:] == b"PAR1", "the size of a file")
        begin = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
        footer = data[begin:]
        demand("sha256:" + hashlib.sha256(footer).hexdigest() == listed["digest"], "the digest")
        (seal,) = re.finditer(rb"hybridlog-footer:([0-9a-f]{8})", footer)
        blank = footer[: seal.start(1)] + b"0" * 8 + footer[seal.end(1) :]
        demand(seal[1] == b"%08x" % zlib.crc32(blank), "the checksum of a footer")
        file = pq.ParquetFile(pa.BufferReader(data))
        about = json.loads(file.metadata.metadata[b"hybridlog"])
        demand(about["version"] == 2 and about["body"] == begin, "the body of a file")
        (section,) = about["recordings"]
        demand(section["id"] == self._recording, "a file of another recording")
        blocks = [data[at : min(at + (32 << 10), begin)] for at in range(0, begin, 32 << 10)]
        checksums = "".join(f"{zlib.crc32(block):08x}" for block in blocks)
        demand(checksums == about["checksums"], "the checksum of a block")
        rows = {listed["topic"]: [listed["messages"], 0, 0]}
        demand(section["topics"] == rows, "the rows of a file")
        return file, about

    def _file(
        self, path: Path, listed: Mapping[str, Any]
    ) -> Iterator[tuple[tuple[int, int], int, bytes]]:
        """Segment and chunk, start, and bytes of each message record."""
        file, about = self._checked(path, listed)
        for group, chunks in enumerate(about["payloads"]["chunks"]):
            table = file.read_row_group(group)
            rows = [(segment, chunk) for segment, chunk, count in chunks for _ in range(count)]
            demand(len(rows) == table.num_rows == about["bounds"][group][0], "rows of a row group")
            own = {name: table.column(name).to_pylist() for name in ("t", "pub", "channel")}
            own |= {name: table.column(name).to_pylist() for name in ("sequence", "ref", "seq")}
            payloads = list(_payloads(table, about["payloads"]))
            order = list(zip(own["t"], own["seq"], strict=True))
            if about["payloads"]["is_ordered"]:
                demand(order == sorted(order), "rows out of order")
            demand([*order[0], *order[-1]] == about["bounds"][group][1:], "bounds of a row group")
            _check_zones(table, about["payloads"], group)
            for n, payload in enumerate(payloads):
                ref = own["ref"][n]
                demand((ref["seg"], ref["chunk"]) == rows[n], "the chunk of a row")
                demand(ref["len"] == len(payload), "the length of a payload")
                publish = own["t"][n] if own["pub"][n] is None else own["pub"][n]
                head = (own["channel"][n], own["sequence"][n], own["t"][n], publish)
                record = struct.pack("<BQHIQQ", 5, 22 + len(payload), *head) + payload
                yield rows[n], ref["off"] - 31, record


OURS = ("log_time", "t", "seq", "pub", "stamp", "channel", "state", "error", "ref")


def _in_columns(about: Mapping[str, Any]) -> list[str]:
    """Paths of the arrays, but for points that are unpacked."""
    return [path for path in about["order"] if about["layout"] is None or path != "data"]


def _array(table: pa.Table, path: str) -> Any:
    """The column of a field."""
    array: Any = None
    for name in path.split("."):
        fields = list(table.schema if array is None else array.type)
        (number,) = [
            number
            for number, field in enumerate(fields)
            if name == (field.metadata or {}).get(b"hybridlog.name", field.name.encode()).decode()
            and (array is not None or field.name not in OURS)
            and b"hybridlog.own" not in (field.metadata or {})
        ]
        array = table.column(number).combine_chunks() if array is None else array.field(number)
    return array


def _column(table: pa.Table, path: str) -> Any:
    name, *inner = path.split(".")
    array = table.column(name).combine_chunks()
    for part in inner:
        array = array.field(part)
    return array


def _values(array: Any, row: int) -> Any:
    """The elements of an array, or its bytes as such."""
    scalar = array[row]
    if pa.types.is_binary(array.type):
        return np.frombuffer(scalar.as_py(), np.uint8)
    demand(not array.type.value_field.nullable, "elements may be null")
    return scalar.values.to_numpy(zero_copy_only=False)


def _payloads(table: pa.Table, about: Mapping[str, Any]) -> Iterator[bytes]:
    """The payload of each row: its rest with the arrays put in."""
    recipes = table.column("recipe").to_pylist()
    columns = {path: _array(table, path) for path in _in_columns(about)}
    for row, recipe in enumerate(recipes):
        rest = recipe["rest"]
        is_big = about["wire"] == "cdr" and rest[:2] == b"\0\0"
        payload, at = b"", 0
        for place, path in zip(recipe["at"], about["order"], strict=True):
            if path in columns:
                values = _values(columns[path], row)
                data = (values.byteswap() if is_big else values).tobytes()
            else:
                data = _cloud(table, row, about["layout"], recipe["padding"])
            payload += rest[at:place] + data
            at = place
        yield payload + rest[at:]


def _cloud(table: pa.Table, row: int, layout: Mapping[str, Any], padding: bytes) -> bytes:
    """The data of a cloud: its points, `step` bytes each."""
    step = layout["step"]
    covered = np.zeros(step, bool)
    points: Any = None
    for column, first, kind, count in layout["fields"]:
        values = _values(_column(table, f"points.{column}"), row).astype(np.dtype(kind), copy=False)
        raw = np.ascontiguousarray(values.reshape(-1, count)).view(np.uint8)
        points = np.zeros((len(raw), step), np.uint8) if points is None else points
        points[:, first : first + raw.shape[1]] = raw
        covered[first : first + raw.shape[1]] = True
    if padding:
        points[:, ~covered] = np.frombuffer(padding, np.uint8).reshape(len(points), -1)
    return bytes(points.tobytes())


def _check_zones(table: pa.Table, about: Mapping[str, Any], group: int) -> None:
    """Each number of an array lies between the ends of its region."""
    zones = about["zones"][group]
    arrays = {path: _array(table, path) for path in _in_columns(about)}
    numbers = {path for path, array in arrays.items() if not pa.types.is_binary(array.type)}
    demand(zones.keys() == numbers, "the zones")
    for path, (width, low, high) in zones.items():
        array = arrays[path]
        ends: list[list[Any]] = [[None, None] for _ in low]
        for row in range(len(array)):
            values = _values(array, row)
            for region in range(-(-len(values) // width)):
                some = values[region * width : (region + 1) * width]
                some = some[some == some]
                if len(some):
                    known = [end for end in ends[region] if end is not None]
                    ends[region] = [min([*known, some.min()]), max([*known, some.max()])]
        _same_ends(low, [end[0] for end in ends])
        _same_ends(high, [end[1] for end in ends])


def _same_ends(said: Sequence[Any], found: Sequence[Any]) -> None:
    read = [None if end is None else float(end) for end in said]
    demand(read == [None if end is None else float(end) for end in found], "the ends of a zone")
