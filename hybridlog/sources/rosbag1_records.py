"""The records of the ROS bag format 2.0, as bytes: headers, and whole runs of messages.

A record is `u32 header length, header, u32 data length, data`; a header is a list of
`u32 length, name=value`. Message records have headers that differ only in two values,
so a run of them is read by columns: one pass finds where each record starts, then
numpy checks all headers against a template and gathers the values. Whatever does not
look like the template takes the general way, one header at a time. Where messages are
small that one pass is numpy's too: it looks for the length of the template's headers and
one byte of theirs, and believes those places only where each record ends at the next one.

Nothing here trusts a size: a run stops at the first record that does not fit.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

OP_MESSAGE: Final = 2
OP_BAG_HEADER: Final = 3
OP_INDEX_DATA: Final = 4
OP_CHUNK: Final = 5
OP_CHUNK_INFO: Final = 6
OP_CONNECTION: Final = 7

MAX_HEADER = 1 << 20
"""Longest record header that is believed, bytes."""

_OP_FIELD = b"\x04\x00\x00\x00op="
_LOOK_BACK = 320
_TEMPLATE_HEADER = 512
_TEMPLATES = 16
_LEAST_HEADER = 8  # of the field `op` alone
_MANY = 100  # records in a run, from which on the next one is looked through by columns,
_SMALL = 4096  # if they have no more bytes than this each, in the mean
_SAMPLE = 1 << 16  # bytes that tell which values are rare
_MOST_HITS = 1 / 16  # places that may be a header's, of all: with more, columns cost too much

# What a header of each kind must hold to be believed: name and length of the value
# (None: any length).
_REQUIRED: dict[int, tuple[tuple[bytes, int | None], ...]] = {
    OP_MESSAGE: ((b"conn", 4), (b"time", 8)),
    OP_BAG_HEADER: ((b"index_pos", 8),),
    OP_INDEX_DATA: ((b"conn", 4), (b"count", 4)),
    OP_CHUNK: ((b"compression", None), (b"size", 4)),
    OP_CHUNK_INFO: ((b"chunk_pos", 8), (b"count", 4)),
    OP_CONNECTION: ((b"conn", 4), (b"topic", None)),
}

_u32 = struct.Struct("<I").unpack_from
_u64 = struct.Struct("<Q").unpack_from


@dataclass(frozen=True, slots=True)
class Header:
    """A record header that was believed.

    Attributes:
        op: Kind of record.
        fields: Where each value lies in the bytes it was read from, `[start, end)`.
    """

    op: int
    fields: dict[bytes, tuple[int, int]]

    def u32(self, data: bytes, name: bytes, default: int = 0) -> int:
        """A value as uint32, `default` when it is missing or of another length."""
        start, end = self.fields.get(name, (0, 0))
        return int(_u32(data, start)[0]) if end - start == 4 else default

    def u64(self, data: bytes, name: bytes, default: int = 0) -> int:
        """A value as uint64, `default` when it is missing or of another length."""
        start, end = self.fields.get(name, (0, 0))
        return int(_u64(data, start)[0]) if end - start == 8 else default

    def time(self, data: bytes, name: bytes) -> int:
        """A value as a time in ns, 0 when it is missing or of another length."""
        packed = self.u64(data, name)
        return (packed & 0xFFFFFFFF) * 1_000_000_000 + (packed >> 32)

    def raw(self, data: bytes, name: bytes) -> bytes:
        """A value as it stands, empty when it is missing."""
        start, end = self.fields.get(name, (0, 0))
        return data[start:end]


def parse_fields(data: bytes, pos: int, end: int) -> dict[bytes, tuple[int, int]] | None:
    """Splits `data[pos:end]` into its `name=value` fields; a later one wins.

    Returns:
        Where each value lies in `data`, or None when the bytes are no list of fields.
    """
    fields: dict[bytes, tuple[int, int]] = {}
    while pos < end:
        if pos + 4 > end:
            return None
        start = pos + 4
        pos = start + _u32(data, pos)[0]
        if pos > end:
            return None
        equals = data.find(b"=", start, pos)
        if equals < 0:
            return None
        fields[data[start:equals]] = (equals + 1, pos)
    return fields


def parse_header(data: bytes, pos: int, end: int) -> Header | None:
    """Reads the record header `data[pos:end]`.

    Returns:
        The header, or None when it lacks what a record of its kind must have. Kinds
        that the format does not know are returned, so that they can be skipped.
    """
    fields = parse_fields(data, pos, end)
    if not fields:
        return None
    start, stop = fields.get(b"op", (0, 0))
    if stop - start != 1:
        return None
    op = data[start]
    for name, length in _REQUIRED.get(op, ()):
        value = fields.get(name)
        if value is None or (length is not None and value[1] - value[0] != length):
            return None
    return Header(op, fields)


class Stop(Enum):
    """Why a run of records ended."""

    END = "end"
    """All bytes were used."""
    CUT = "cut"
    """The next record needs more bytes than there are."""
    FOREIGN = "foreign"
    """The next record is sound and is neither a message nor a connection."""
    BAD = "bad"
    """The next bytes are no record."""


@dataclass(slots=True)
class Run:
    """Message and connection records found in a row. n is the number of messages.

    Attributes:
        offset: int64[n], start of each payload.
        length: int64[n], bytes of each payload.
        connection: int64[n], connection id of each message.
        log_time: int64[n], ns.
        connections: Connection records: number of messages before it, its header, and
            `[start, end)` of its data.
        why: Why the run ended.
        end: Where it ended: the start of the record that is not part of it.
        need: When `why` is CUT, bytes that the next record takes as far as is known.
        last: Start of the data of the last record when that is a message, else None.
    """

    offset: NDArray[np.int64]
    length: NDArray[np.int64]
    connection: NDArray[np.int64]
    log_time: NDArray[np.int64]
    connections: list[tuple[int, Header, tuple[int, int]]]
    why: Stop
    end: int
    need: int
    last: int | None

    def without_last(self) -> None:
        """Drops the last message, whose length turned out to be wrong."""
        self.offset = self.offset[:-1]
        self.length = self.length[:-1]
        self.connection = self.connection[:-1]
        self.log_time = self.log_time[:-1]


class _Template:
    """The bytes that all message headers of one writer share."""

    def __init__(self, raw: bytes, conn: int, time: int) -> None:
        """Takes a sound message header and where its two values start in it."""
        self.size = len(raw)
        fixed = np.ones(self.size, np.bool_)
        fixed[conn : conn + 4] = False
        fixed[time : time + 8] = False
        self._columns = np.flatnonzero(fixed)
        self._bytes = np.frombuffer(raw, np.uint8)[self._columns]
        self._rare: int | None = None
        self._values = np.dtype(
            {
                "names": ["conn", "sec", "nsec"],
                "formats": ["<u4", "<u4", "<u4"],
                "offsets": [conn, time, time + 4],
                "itemsize": self.size,
            }
        )

    def read(
        self, data: NDArray[np.uint8], starts: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
        """Reads headers of this template's size at `starts`: fits, connection, log time."""
        headers = sliding_window_view(data, self.size)[starts]
        fits = (headers[:, self._columns] == self._bytes).all(axis=1)
        values = headers.view(self._values)[:, 0]
        seconds = values["sec"].astype(np.int64)
        return (
            fits,
            values["conn"].astype(np.int64),
            seconds * 1_000_000_000 + values["nsec"],
        )

    def find(self, data: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Every place where a record with such a header may start, ascending.

        Between them there may be others, and a payload may hold what looks like a header.
        """
        count = len(data) - self.size - 7  # the lengths of header and data must be there, too
        if count <= 0:
            return np.empty(0, np.int64)
        if self._rare is None:
            # Of all bytes that must be there the one that is seen least leaves least to look at.
            seen = np.bincount(data[:_SAMPLE], minlength=256)
            self._rare = int(seen[self._bytes].argmin())
        at = 4 + int(self._columns[self._rare])
        places = np.flatnonzero(data[at : at + count] == self._bytes[self._rare])
        if len(places) > _MOST_HITS * len(data):
            return np.empty(0, np.int64)
        # The rest of each header is looked at once, when it is known where records start.
        found: NDArray[np.int64] = places[_u32_at(data, places) == self.size]
        return found


class RunReader:
    """Reads runs of message records, and remembers what their headers look like."""

    def __init__(self) -> None:
        self._templates: list[_Template] = []
        self._usual: _Template | None = None

    def read(self, data: bytes) -> Run:
        """Reads the message and connection records at the start of `data`."""
        raw = np.frombuffer(data, np.uint8)
        found = None if self._usual is None else self._usual.find(raw)
        head, body, end, need = _walk(data) if found is None else _follow(data, raw, found)
        why = Stop.END if end == len(data) else _why_cut(data, end)
        n = len(head)
        conn = np.zeros(n, np.int64)
        time = np.zeros(n, np.int64)
        is_message = np.zeros(n, np.bool_)
        connections: list[tuple[int, Header]] = []

        todo = np.arange(n)
        self._usual = None
        for template in self._templates:
            left = _apply(template, raw, (head, body), todo, (is_message, conn, time))
            if len(todo) - len(left) > n / 2 and n >= _MANY and end <= _SMALL * n:
                self._usual = template
            todo = left
        while len(todo):
            row = int(todo[0])
            at, data_at = int(head[row]), int(body[row])
            header = parse_header(data, at + 4, data_at)
            if header is None or header.op not in {OP_MESSAGE, OP_CONNECTION}:
                why = Stop.BAD if header is None else Stop.FOREIGN
                end, need, n = at, 0, row
                break
            if header.op == OP_CONNECTION:
                connections.append((row, header))
                todo = todo[1:]
                continue
            learned = self._learn(data, at + 4, data_at, header)
            if learned is not None:
                todo = _apply(learned, raw, (head, body), todo, (is_message, conn, time))
                continue
            is_message[row] = True
            conn[row] = header.u32(data, b"conn")
            time[row] = header.time(data, b"time")
            todo = todo[1:]

        ends = np.append(head[1:], end)[:n] if n == len(head) else head[1 : n + 1]
        rows = np.flatnonzero(is_message[:n])
        offset = body[rows] + 4
        before = np.searchsorted(rows, [row for row, _ in connections])
        return Run(
            offset=offset,
            length=ends[rows] - offset,
            connection=conn[rows],
            log_time=time[rows],
            connections=[
                (int(count), header, (int(body[row]) + 4, int(ends[row])))
                for count, (row, header) in zip(before, connections, strict=True)
            ],
            why=why,
            end=end,
            need=need,
            last=int(body[n - 1]) + 4 if n and is_message[n - 1] else None,
        )

    def _learn(self, data: bytes, start: int, end: int, header: Header) -> _Template | None:
        if len(self._templates) >= _TEMPLATES or end - start > _TEMPLATE_HEADER:
            return None
        template = _Template(
            data[start:end], header.fields[b"conn"][0] - start, header.fields[b"time"][0] - start
        )
        self._templates.append(template)
        return template


_Records = tuple["NDArray[np.int64]", "NDArray[np.int64]", int, int]
"""Starts of the records, starts of their data lengths, where the first record that does
not fit starts, and how many bytes that one needs."""


def _walk(data: bytes, pos: int = 0, most: int | None = None) -> _Records:
    """Finds records by their lengths alone.

    Args:
        data: Where they lie, one after the other.
        pos: Where the first one starts.
        most: Most records; None for all. With so many, the place of the next is given.
    """
    u32 = _u32
    heads: list[int] = []
    bodies: list[int] = []
    need = 0
    size = len(data)
    while len(heads) != most:
        if pos + 4 > size:
            need = 4
            break
        body = pos + 4 + u32(data, pos)[0]
        if body - pos - 4 < _LEAST_HEADER:
            break  # else zeros would be a record every eight bytes
        if body + 4 > size:
            need = body + 4 - pos
            break
        after = body + 4 + u32(data, body)[0]
        if after > size:
            need = after - pos
            break
        heads.append(pos)
        bodies.append(body)
        pos = after
    return np.array(heads, np.int64), np.array(bodies, np.int64), pos, need


def _follow(data: bytes, raw: NDArray[np.uint8], head: NDArray[np.int64]) -> _Records:
    """Finds what `_walk` finds, from one to the next of places where records may start.

    Args:
        data: Where they lie, one after the other.
        raw: The same.
        head: Such places, ascending; a header and the length of the data are there.
    """
    body = head + 4 + _u32_at(raw, head)
    after = body + 4 + _u32_at(raw, body)
    whole = after <= len(raw)
    head, body, after = head[whole], body[whole], after[whole]
    # Each of these is the last of some of which one ends where the next starts.
    lasts = np.append(np.flatnonzero(after[:-1] != head[1:]), len(head) - 1)
    heads, bodies = [], []
    pos, need, most = 0, 0, 1
    while True:
        first = int(np.searchsorted(head, pos))
        if first < len(head) and head[first] == pos:
            stop = int(lasts[np.searchsorted(lasts, first)]) + 1
            heads.append(head[first:stop])
            bodies.append(body[first:stop])
            pos = int(after[stop - 1])
        # What lies between is walked over, in ever longer walks: to find the way back costs
        # as much as some records.
        more, more_bodies, pos, need = _walk(data, pos, most)
        heads.append(more)
        bodies.append(more_bodies)
        if len(more) < most:
            return np.concatenate(heads), np.concatenate(bodies), pos, need
        most *= 2


def _u32_at(data: NDArray[np.uint8], places: NDArray[np.int64]) -> NDArray[np.int64]:
    """The number at each of some places."""
    found = sliding_window_view(data, 4)[places]
    return found.view("<u4")[:, 0].astype(np.int64)


def _why_cut(data: bytes, pos: int) -> Stop:
    """Judges the incomplete record at `pos` by as much of its header as there is."""
    if pos + 4 > len(data):
        return Stop.CUT
    body = pos + 4 + _u32(data, pos)[0]
    if body - pos - 4 > MAX_HEADER:
        return Stop.BAD
    if body > len(data):
        return Stop.CUT
    header = parse_header(data, pos + 4, body)
    if header is None:
        return Stop.BAD
    return Stop.CUT if header.op in {OP_MESSAGE, OP_CONNECTION} else Stop.FOREIGN


def _apply(
    template: _Template,
    raw: NDArray[np.uint8],
    where: tuple[NDArray[np.int64], NDArray[np.int64]],
    todo: NDArray[np.intp],
    into: tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]],
) -> NDArray[np.intp]:
    """Reads the headers in rows `todo` that fit the template; returns the other rows."""
    head, body = where
    rows = todo[body[todo] - head[todo] - 4 == template.size]
    if not len(rows):
        return todo
    fits, conn, time = template.read(raw, head[rows] + 4)
    is_message, all_conn, all_time = into
    done = rows[fits]
    is_message[done] = True
    all_conn[done] = conn[fits]
    all_time[done] = time[fits]
    return todo[~is_message[todo]]


def find_record(data: bytes, limit: int, sound_at: Callable[[int], bool]) -> int | None:
    """Looks for the next place that looks like a record, after damage.

    A message is believed only when another record follows it. Pieces of messages stand
    in compressed chunks too, but nothing sound stands after those.

    Args:
        data: Bytes to search.
        limit: Length of the whole space that `data` is the start of: a record that
            goes past it is not believed, unless it is a chunk.
        sound_at: Whether a record, or the end of the space, is at a place past `data`'s
            start.

    Returns:
        Where the record starts in `data`, or None.
    """
    hit = data.find(_OP_FIELD)
    while hit >= 0:
        low = max(0, hit - _LOOK_BACK)
        # The header's length stands before its first field and must reach past the op.
        window = np.frombuffer(data, np.uint8, hit - low, low)
        if len(window) >= 4:
            lengths = sliding_window_view(window, 4).copy().view("<u4")[:, 0]
            reach = hit + 8 - (low + 4 + np.arange(len(lengths)))
            for index in np.flatnonzero((lengths >= reach) & (lengths <= 4096))[::-1]:
                place = low + int(index)
                body = place + 4 + int(lengths[index])
                if _believable(data, place, body, limit, sound_at):
                    return place
        hit = data.find(_OP_FIELD, hit + 1)
    return None


def _believable(
    data: bytes, place: int, body: int, limit: int, sound_at: Callable[[int], bool]
) -> bool:
    if body + 4 > len(data):
        return False
    header = parse_header(data, place + 4, body)
    if header is None or header.op not in _REQUIRED:
        return False
    # A chunk may have been cut short; all other records are small enough to be whole.
    end = body + 4 + int(_u32(data, body)[0])
    if header.op == OP_CHUNK:
        return True
    return end <= limit and (header.op != OP_MESSAGE or sound_at(end))
