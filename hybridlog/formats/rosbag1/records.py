"""Finds records of the ROS bag format 2.0 in files and chunks, and reads runs of messages.

A record is `u32 header length, header, u32 data length, data`; a header is a list of
`u32 length, name=value`. Headers of message records differ in two values only, so a run of
them is read by columns: one pass finds the start of each record, then numpy checks all
headers of a length against the first one and gathers the values.

Sizes are not trusted: a run stops at the first record that does not fit.
"""

from __future__ import annotations

import struct
from typing import IO, TYPE_CHECKING, Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

if TYPE_CHECKING:
    from numpy.typing import NDArray

OP_MESSAGE: Final = 2
OP_BAG_HEADER: Final = 3
OP_INDEX_DATA: Final = 4
OP_CHUNK: Final = 5
OP_CHUNK_INFO: Final = 6
OP_CONNECTION: Final = 7

# Required fields of each kind: name and length of the value (None: any length).
_REQUIRED: dict[int, dict[bytes, int | None]] = {
    OP_MESSAGE: {b"conn": 4, b"time": 8},
    OP_BAG_HEADER: {b"index_pos": 8},
    OP_INDEX_DATA: {b"conn": 4, b"count": 4},
    OP_CHUNK: {b"compression": None, b"size": 4},
    OP_CHUNK_INFO: {b"chunk_pos": 8, b"count": 4},
    OP_CONNECTION: {b"conn": 4, b"topic": None},
}
_MAX_HEADER = 1 << 20
_LEAST_HEADER = 8  # bytes of a header with the field `op` only
_OP_FIELD = b"\x04\x00\x00\x00op="
_LOOK_BACK = 320  # most bytes in front of this field in a header that is searched for
_MAX_FOUND = 4096  # longest header that is searched for
_SEARCH = 1 << 20

_u32 = struct.Struct("<I").unpack_from


class Record(NamedTuple):
    """A valid record: its kind, the values of its header, and `[start, end)` of its data."""

    op: int
    fields: dict[bytes, bytes]
    start: int
    end: int

    @property
    def in_chunk(self) -> bool:
        """True if it is of a kind that chunks hold."""
        return self.op in {OP_MESSAGE, OP_CONNECTION}

    def number(self, name: bytes) -> int:
        """A value as a number, 0 if it is missing."""
        return int.from_bytes(self.fields.get(name, b""), "little")

    def time(self, name: bytes) -> int:
        """A value as a time in ns, 0 if it is missing."""
        packed = self.number(name)
        return (packed & 0xFFFFFFFF) * 1_000_000_000 + (packed >> 32 & 0xFFFFFFFF)


def parse_fields(data: bytes) -> dict[bytes, bytes]:
    """The values of `name=value` fields, the last of each name; empty if they are damaged."""
    fields: dict[bytes, bytes] = {}
    pos, end = 0, len(data)
    while pos < end:
        start = pos + 4
        if start > end or (pos := start + _u32(data, pos)[0]) > end:
            return {}
        name, equals, value = data[start:pos].partition(b"=")
        if not equals:
            return {}
        fields[name] = value
    return fields


def parse_record(header: bytes, start: int, end: int) -> Record | None:
    """The record with this header and data; None if it lacks a field that its kind needs."""
    fields = parse_fields(header)
    op = fields.get(b"op", b"")
    if len(op) != 1:
        return None
    for name, length in _REQUIRED.get(op[0], {}).items():
        if name not in fields or length not in {None, len(fields[name])}:
            return None
    return Record(op[0], fields, start, end)


class Space(NamedTuple):
    """Bytes with records: a bag, or an unpacked chunk.

    Attributes:
        file: The bytes.
        size: Number of bytes.
        window: Bytes of messages to read at once.
        is_chunk: Whether they come from a compressed chunk.
    """

    file: IO[bytes]
    size: int
    window: int
    is_chunk: bool = False

    def read(self, pos: int, count: int) -> bytes:
        """Up to `count` bytes."""
        self.file.seek(pos)
        return self.file.read(count)

    def record(self, pos: int) -> Record | None:
        """The record at a position, None without a valid one; its data may end past the space."""
        size = int.from_bytes(self.read(pos, 4), "little")
        if not 0 < size <= min(_MAX_HEADER, self.size - pos - 8):
            return None
        raw = self.read(pos + 4, size + 4)
        if len(raw) < size + 4:
            return None
        start = pos + 8 + size
        return parse_record(raw[:size], start, start + _u32(raw, size)[0])

    def is_sound(self, pos: int) -> bool:
        """True if a record starts at a position, or the space ends there."""
        return pos == self.size or self.record(pos) is not None

    def search(self, pos: int) -> int | None:
        """First position at or behind `pos` that looks like a record."""
        while pos < self.size:
            data = self.read(pos, _SEARCH + _LOOK_BACK + len(_OP_FIELD))
            hit = data.find(_OP_FIELD)
            while hit >= 0:
                # The header's length precedes its first field and must reach past the op.
                places = np.arange(max(0, hit - _LOOK_BACK), max(0, hit - 3))
                lengths = np.ndarray(
                    len(places), "<u4", data, int(places[0]) if len(places) else 0, (1,)
                )
                fits = (lengths >= hit + 4 - places) & (lengths <= _MAX_FOUND)
                for place in places[fits][::-1].tolist():
                    if place < _SEARCH and self._is_believable(pos + place):
                        return int(pos + place)
                hit = data.find(_OP_FIELD, hit + 1)
            pos += _SEARCH
        return None

    def _is_believable(self, pos: int) -> bool:
        """True if what looks like a record is one.

        A message counts only if another record follows it. Compressed chunks contain pieces of
        messages, too, but no valid record follows those. Only a chunk may be cut.
        """
        record = self.record(pos)
        if record is None or record.op not in _REQUIRED:
            return False
        if record.op == OP_CHUNK:
            return True
        return record.end <= self.size and (record.op != OP_MESSAGE or self.is_sound(record.end))


class Run(NamedTuple):
    """A run of n message records, and connection records between them.

    Attributes:
        columns: int64[4, n], start and length of each payload, connection id, log time in ns.
        connections: Connection records, and the number of messages before each.
        end: Start of the next record.
    """

    columns: NDArray[np.int64]
    connections: list[tuple[int, Record]]
    end: int


def read_run(data: bytes) -> Run:
    """Read the whole message and connection records at the start of `data`."""
    head, body, end = _walk(data)
    size, count = body - head - 4, len(head)
    columns = np.zeros((4, count), np.int64)
    columns[0] = body + 4
    columns[1] = np.append(head[1:], end)[:count] - columns[0]
    others: list[int] = []  # records with other headers
    order = np.argsort(size, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(size[order])) + 1):
        others += _gather(data, head, body, rows, columns)
    connections: list[tuple[int, Record]] = []
    skipped: list[int] = []
    for row in sorted(others):
        start, length = columns[:2, row].tolist()
        record = parse_record(data[head[row] + 4 : body[row]], start, start + length)
        if record is None or not record.in_chunk:
            end, count = int(head[row]), row
            break
        if record.op == OP_MESSAGE:
            columns[2:, row] = record.number(b"conn"), record.time(b"time")
        else:
            connections.append((row - len(skipped), record))
            skipped.append(row)
    return Run(np.delete(columns[:, :count], skipped, axis=1), connections, end)


def _walk(data: bytes) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Find records by their lengths only: their starts, those of their data lengths, the end."""
    u32, size = _u32, len(data)
    heads: list[int] = []
    bodies: list[int] = []
    pos = 0
    try:
        while True:
            body = pos + 4 + u32(data, pos)[0]
            after = body + 4 + u32(data, body)[0]
            # Without a least header, zeros would be a record every eight bytes.
            if after > size or body - pos - 4 < _LEAST_HEADER:
                break
            heads.append(pos)
            bodies.append(body)
            pos = after
    except struct.error:  # a length lies behind the end
        pass
    return np.array(heads, np.int64), np.array(bodies, np.int64), pos


def _gather(
    data: bytes,
    head: NDArray[np.int64],
    body: NDArray[np.int64],
    rows: NDArray[np.intp],
    columns: NDArray[np.int64],
) -> list[int]:
    """Read the headers of one size that are like the first of a message; returns other rows."""
    others: list[int] = []
    for row in rows:
        first = data[head[row] + 4 : body[row]]
        record = parse_record(first, 0, 0)
        if record is not None and record.op == OP_MESSAGE:
            break
        others.append(int(row))
    names = (b"\x09\x00\x00\x00conn=", b"\x0d\x00\x00\x00time=")
    rows = rows[len(others) :]
    if not len(rows) or any(first.count(name) != 1 for name in names):
        return others + [int(row) for row in rows]
    headers = sliding_window_view(np.frombuffer(data, np.uint8), len(first))[head[rows] + 4]
    conn, time = (first.index(name) + 9 for name in names)
    ids = headers[:, conn : conn + 4].copy().view("<u4")
    times = headers[:, time : time + 8].copy().view("<u4").astype(np.int64)
    headers[:, conn : conn + 4] = headers[:, time : time + 8] = 0
    columns[2, rows] = ids[:, 0]
    columns[3, rows] = times[:, 0] * 1_000_000_000 + times[:, 1]
    return others + [int(row) for row in rows[(headers != headers[0]).any(axis=1)]]
