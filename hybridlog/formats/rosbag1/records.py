"""Parses records of the ROS bag format 2.0: headers, and runs of messages.

A record is `u32 header length, header, u32 data length, data`; a header is a list of
`u32 length, name=value`. Headers of message records differ in two values only, so a run of
them is read by columns: one pass finds the start of each record, then numpy checks all
headers against a template and gathers the values. Other headers are parsed one at a time.
For small messages numpy makes the first pass, too: it searches for the template's header
length and one byte of the template, and accepts positions only if each record ends at the
next one.

Sizes are not trusted: a run stops at the first record that does not fit.
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
"""Longest valid record header, bytes."""

_OP_FIELD = b"\x04\x00\x00\x00op="
_LOOK_BACK = 320
_TEMPLATE_HEADER = 512
_TEMPLATES = 16
_LEAST_HEADER = 8  # bytes of a header with the field `op` only
_MIN_COLUMN_RUN = 100  # records in a run from which the next run is searched by columns,
_SMALL = 4096  # if their mean size is at most this
_SAMPLE = 1 << 16  # bytes sampled to find rare values
_MAX_HITS = 1 / 16  # share of candidate positions above which columns cost too much

# Required fields of a header of each kind: name and length of the value (None: any
# length).
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
    """A valid record header.

    Attributes:
        op: Kind of record.
        fields: Position of each value in the parsed bytes, `[start, end)`.
    """

    op: int
    fields: dict[bytes, tuple[int, int]]

    def u32(self, data: bytes, name: bytes) -> int:
        """A value as uint32, 0 if it is missing or of another length."""
        start, end = self.fields.get(name, (0, 0))
        return int(_u32(data, start)[0]) if end - start == 4 else 0

    def u64(self, data: bytes, name: bytes) -> int:
        """A value as uint64, 0 if it is missing or of another length."""
        start, end = self.fields.get(name, (0, 0))
        return int(_u64(data, start)[0]) if end - start == 8 else 0

    def time(self, data: bytes, name: bytes) -> int:
        """A value as a time in ns, 0 if it is missing or of another length."""
        packed = self.u64(data, name)
        return (packed & 0xFFFFFFFF) * 1_000_000_000 + (packed >> 32)

    def raw(self, data: bytes, name: bytes) -> bytes:
        """A value as bytes, empty if it is missing."""
        start, end = self.fields.get(name, (0, 0))
        return data[start:end]


def parse_fields(data: bytes, pos: int, end: int) -> dict[bytes, tuple[int, int]] | None:
    """Split `data[pos:end]` into its `name=value` fields; the last of a name counts.

    Returns:
        Position of each value in `data`, or None if the bytes are not a list of fields.
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
    """Parse the record header `data[pos:end]`.

    Returns:
        The header, or None if it lacks a required field. Unknown kinds are returned, so
        that they can be skipped.
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
    """Reason for the end of a run of records."""

    END = "end"
    """All bytes were used."""
    CUT = "cut"
    """The next record needs more bytes than there are."""
    FOREIGN = "foreign"
    """The next record is valid, but neither a message nor a connection."""
    BAD = "bad"
    """The next bytes are not a record."""


@dataclass(slots=True)
class Run:
    """A run of n message records, and connection records between them.

    Attributes:
        offset: int64[n], start of each payload.
        length: int64[n], bytes of each payload.
        connection: int64[n], connection id of each message.
        log_time: int64[n], ns.
        connections: Connection records: number of messages before it, its header, and
            `[start, end)` of its data.
        why: Reason for the end of the run.
        end: End of the run: the start of the next record.
        need: If `why` is CUT, bytes of the next record as far as known.
        last: Start of the data of the last record if that is a message, else None.
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
        """The run without its last message, whose length is wrong."""
        self.offset = self.offset[:-1]
        self.length = self.length[:-1]
        self.connection = self.connection[:-1]
        self.log_time = self.log_time[:-1]


class _Template:
    """The bytes shared by all message headers of one writer."""

    def __init__(self, raw: bytes, conn: int, time: int) -> None:
        """Make a template of a valid message header and the positions of its two values."""
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
        """Read headers of this template's size at `starts`: match, connection, log time."""
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
        """Every position where a record with such a header may start, ascending.

        Other records may lie between them, and a payload may look like a header.
        """
        count = len(data) - self.size - 7  # the lengths of header and data must fit, too
        if count <= 0:
            return np.empty(0, np.int64)
        if self._rare is None:
            # The rarest of the template's bytes leaves the fewest candidates.
            seen = np.bincount(data[:_SAMPLE], minlength=256)
            self._rare = int(seen[self._bytes].argmin())
        at = 4 + int(self._columns[self._rare])
        places = np.flatnonzero(data[at : at + count] == self._bytes[self._rare])
        if len(places) > _MAX_HITS * len(data):
            return np.empty(0, np.int64)
        # The rest of each header is checked once, when the starts of records are known.
        found: NDArray[np.int64] = places[_u32_at(data, places) == self.size]
        return found


class RunReader:
    """Reads runs of message records, and learns the template of their headers."""

    def __init__(self) -> None:
        self._templates: list[_Template] = []
        self._usual: _Template | None = None

    def read(self, data: bytes) -> Run:
        """Read the message and connection records at the start of `data`."""
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
            if len(todo) - len(left) > n / 2 and n >= _MIN_COLUMN_RUN and end <= _SMALL * n:
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
"""Starts of the records, starts of their data lengths, start of the first record that does
not fit, and the bytes that it needs."""


def _walk(data: bytes, pos: int = 0, most: int | None = None) -> _Records:
    """Find records by their lengths only.

    Args:
        data: The consecutive records.
        pos: Start of the first one.
        most: Most records; None for all. At this number the position of the next is returned.
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
            break  # otherwise zeros would be a record every eight bytes
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
    """Find records like `_walk`, by following candidate positions.

    Args:
        data: The consecutive records.
        raw: The same bytes.
        head: Candidate positions, ascending; a header and the data length fit at each.
    """
    body = head + 4 + _u32_at(raw, head)
    after = body + 4 + _u32_at(raw, body)
    whole = after <= len(raw)
    head, body, after = head[whole], body[whole], after[whole]
    # Each of these is the last of a chain of records that end where the next starts.
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
        # Gaps are walked, in ever longer walks, since returning to columns costs as much as
        # some records.
        more, more_bodies, pos, need = _walk(data, pos, most)
        heads.append(more)
        bodies.append(more_bodies)
        if len(more) < most:
            return np.concatenate(heads), np.concatenate(bodies), pos, need
        most *= 2


def _u32_at(data: NDArray[np.uint8], places: NDArray[np.int64]) -> NDArray[np.int64]:
    """The number at each position."""
    found = sliding_window_view(data, 4)[places]
    return found.view("<u4")[:, 0].astype(np.int64)


def _why_cut(data: bytes, pos: int) -> Stop:
    """Classify the incomplete record at `pos` by the available part of its header."""
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
    """Read the headers in rows `todo` that match the template; return the other rows."""
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
    """Find the next position that looks like a record, after damage.

    A message counts only if another record follows it. Compressed chunks contain pieces of
    messages, too, but no valid record follows those.

    Args:
        data: Bytes to search.
        limit: Length of the whole space that starts with `data`: a record that exceeds it
            is invalid, unless it is a chunk.
        sound_at: Returns whether a record, or the end of the space, is at a position
            relative to the start of `data`.

    Returns:
        Start of the record in `data`, or None.
    """
    hit = data.find(_OP_FIELD)
    while hit >= 0:
        low = max(0, hit - _LOOK_BACK)
        # The header's length precedes its first field and must reach past the op.
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
    # A chunk may be truncated; all other records are small enough to be complete.
    end = body + 4 + int(_u32(data, body)[0])
    if header.op == OP_CHUNK:
        return True
    return end <= limit and (header.op != OP_MESSAGE or sound_at(end))
