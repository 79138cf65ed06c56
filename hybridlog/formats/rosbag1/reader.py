"""Reads ROS 1 bags (format 2.0) from the start: also unindexed, cut and damaged ones.

Records are read in the order of the file, without the index. Damage in a compressed chunk costs
the rest of the chunk; elsewhere reading goes on at the next record. What was lost is counted by
the chunk list at the end of the bag, or by the index records behind a chunk.
"""

from __future__ import annotations

import bz2
import re
import struct
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field
from io import BytesIO
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

import lz4.frame
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hybridlog.formats.reading import (
    TOO_MANY_CHANNELS,
    TOO_MANY_SILENT,
    Damage,
    Source,
    cannot_open,
    regroup,
)
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.mcap.mcap_content import MIN_RECORDS
from hybridlog_storage.messages import MAX_CHANNELS, MAX_PAYLOAD, Batch, Channel, Schema
from hybridlog_storage.segments.compression import is_implausible

if TYPE_CHECKING:
    from collections.abc import Generator, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

MAGIC: Final = b"#ROSBAG V2.0\n"

_MESSAGE, _BAG_HEADER, _INDEX_DATA, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_NEEDED: Final[dict[int, dict[bytes, int | None]]] = {
    _MESSAGE: {b"conn": 4, b"time": 8},
    _BAG_HEADER: {b"index_pos": 8},
    _INDEX_DATA: {b"conn": 4, b"count": 4},
    _CHUNK: {b"compression": None, b"size": 4},
    _CHUNK_INFO: {b"chunk_pos": 8, b"count": 4},
    _CONNECTION: {b"conn": 4, b"topic": None},
}
"""Fields that a kind of record has, and the length of their values; None for any."""
_ENTRY_BYTES: Final = {_INDEX_DATA: 12, _CHUNK_INFO: 8}  # of the lists in index records
_UNPACKERS: Final[dict[bytes, Any]] = {
    b"bz2": bz2.BZ2Decompressor,
    b"lz4": lz4.frame.LZ4FrameDecompressor,
}
_UNDEFINED, _TOO_MANY = -1, -2  # in the place of a channel

_MAX_HEADER: Final = 1 << 20
_OP: Final = b"\x04\0\0\0op="
_LOOK_BACK: Final = 320  # most bytes in front of this field in a header that is searched for
_MAX_INDEX: Final = 64 << 20  # of an index that is not where the bag header says
_MAX_FOUND: Final = 4096  # longest header that is searched for
_WINDOW = 4 << 20  # bytes of messages outside of compressed chunks that are read at once
_UNSTATED = 16 << 20  # bytes that a chunk may unpack to whatever its header says
_STEP: Final = 256 << 10  # bytes that are searched or unpacked at once

_USUAL: Final = re.compile(
    rb"(?s)\x26\0\0\0"
    rb"(?:\x04\0\0\0op=\x02|\x09\0\0\0conn=(....)|\x0d\0\0\0time=(........)){3}...."
)
"""The header of a message without further fields, in any order, and the length of its data."""
_USUAL_BYTES: Final = 46
_SORTED: Final = struct.Struct("<13s4x17s8xI").unpack_from
_SORTED_NAMES: Final = b"\x26\0\0\0\x09\0\0\0conn=", b"\x04\0\0\0op=\x02\x0d\0\0\0time="
"""The same in the order of rosbag: what is around the values, and the length of the data."""

_u32 = struct.Struct("<I").unpack_from


class _Record(NamedTuple):
    """A record: its kind, the values of its header, and `[start, end)` of its data."""

    op: int
    fields: dict[bytes, bytes]
    start: int
    end: int

    def number(self, name: bytes) -> int:
        return int.from_bytes(self.fields.get(name, b""), "little")

    def time(self, name: bytes) -> int:
        packed = self.number(name)
        return (packed & 0xFFFFFFFF) * 10**9 + (packed >> 32 & 0xFFFFFFFF)


def _fields(data: bytes) -> dict[bytes, bytes]:
    """The values of `name=value` fields, the last of each name; empty if they are damaged."""
    found: dict[bytes, bytes] = {}
    pos, end = 0, len(data)
    while pos < end:
        start = pos + 4
        if start > end or (pos := start + _u32(data, pos)[0]) > end:
            return {}
        name, equals, value = data[start:pos].partition(b"=")
        if not equals:
            return {}
        found[name] = value
    return found


def _parsed(header: bytes, start: int, end: int) -> _Record | None:
    """The record with this header; None if it lacks a field that its kind needs."""
    fields = _fields(header)
    op = fields.get(b"op", b"")
    needed = _NEEDED.get(op[0], {}) if len(op) == 1 else {b"op": 1}
    if all(n in fields and size in {None, len(fields[n])} for n, size in needed.items()):
        return _Record(op[0], fields, start, end)
    return None


class _Walk(NamedTuple):
    """The messages at the beginning of some bytes.

    Attributes:
        rows: Of each, begin and length of its payload, and the places of its connection and time.
        connections: Connection records, and the number of messages before each.
        end: The end of the last whole record.
    """

    rows: list[tuple[int, int, int, int]]
    connections: list[tuple[int, _Record]]
    end: int

    def without_wrong(self, data: bytes) -> int:
        """Leave out a last message of wrong length: a record begins in it; returns the end."""
        if self.rows and sum(self.rows[-1][:2]) == self.end:
            start = self.rows[-1][0]
            if _OP in data[start : self.end + len(_OP)]:
                self.rows.pop()
                return start
        return self.end


def walk(data: bytes, most: int) -> _Walk:
    """Read the whole message and connection records at the beginning of some bytes."""
    rows: list[tuple[int, int, int, int]] = []
    connections: list[tuple[int, _Record]] = []
    pos, size, u32, usual, in_order = 0, len(data), _u32, _USUAL.match, _SORTED
    first, second = _SORTED_NAMES
    while pos + 8 <= size and len(rows) < most:
        start = pos + _USUAL_BYTES
        if start <= size:
            conn = time = 0
            before, between, count = in_order(data, pos)
            if before == first and between == second:
                conn, time = pos + 13, pos + 34
            elif (head := usual(data, pos)) is not None and head.end() == start:
                conn, time = head.start(1), head.start(2)
            if conn > 0 and time > 0:
                if start + count > size:
                    break
                rows.append((start, count, conn, time))
                pos = start + count
                continue
        body = pos + 4 + u32(data, pos)[0]
        if body + 4 > size:
            break
        header, start = data[pos + 4 : body], body + 4
        record = _parsed(header, start, start + u32(data, body)[0])
        if record is None or record.end > size or record.op not in {_MESSAGE, _CONNECTION}:
            break
        if record.op == _CONNECTION:
            connections.append((len(rows), record))
        else:
            conn, time = (
                pos + 4 + header.rindex(field) + len(field)
                for field in (b"\x09\0\0\0conn=", b"\x0d\0\0\0time=")
            )
            rows.append((start, record.end - start, conn, time))
        pos = record.end
    return _Walk(rows, connections, pos)


@dataclass(slots=True)
class _Place:
    """A chunk with its index records, or the bytes in its place."""

    start: int
    end: int  # of the chunk, as it says
    got: int = 0  # messages read in it
    indexed: int | None = None  # messages in its index records, None before the first one
    reasons: list[str] = field(default_factory=list)
    is_torn: bool = False  # some of its index records could not be read
    is_cut: bool = False  # the file ends in it


class _Connection(NamedTuple):
    """The content of a connection record: its id, topic and data."""

    conn: int
    topic: bytes
    data: bytes

    def channel(self) -> Channel:
        """The channel of its messages."""
        fields = {k.decode(errors="replace"): v for k, v in _fields(self.data).items()}
        definition = fields.pop("message_definition", None)
        name = fields.pop("type", b"").decode(errors="replace")
        fields.pop("topic", None)
        metadata = {key: value.decode(errors="replace") for key, value in fields.items()}
        encoding = "" if definition is None else "ros1msg"
        schema = Schema(name, encoding, definition or b"") if name else None
        topic = self.topic.decode(errors="replace")
        return Channel(topic, "ros1", schema, metadata, has_publish_time=False)


class Rosbag1Source(Source):
    """A ROS 1 bag.

    Each connection with messages becomes a channel of its own.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, kind="ROS 1 bag", profile="ros1", files=[path])
        self._meaning: dict[int, _Connection] = {}  # of connection ids, at present
        self._fallback: dict[int, _Connection] = {}  # by the index of the bag
        self._numbers: dict[_Connection, int] = {}
        self._left_out: dict[int, Counter[int]] = {_UNDEFINED: Counter(), _TOO_MANY: Counter()}
        self._chunks: list[tuple[int, int]] = []  # by the index: place and number of messages
        self._index_pos = self._index_said = 0  # the place by the bag header, if it is another
        self._got = 0
        self._index_is_short = False
        self._zeros: list[range] = []  # between records
        self._passed = 0  # behind the header of the last record, whose length may be wrong
        self._place: _Place | None = None
        try:
            self._file: BinaryIO = path.open("rb", buffering=1 << 16)
        except OSError as error:
            raise cannot_open(path, error) from error
        try:
            self._open()
        except BaseException as error:
            self.close()
            if isinstance(error, OSError):
                raise cannot_open(path, error) from error
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def batches(self) -> Iterator[Batch]:
        """Yield all readable messages in file order."""
        return regroup(self._pieces())

    # Opening: the bag header, and the index if it exists.

    def _open(self) -> None:
        magic = self._file.read(len(MAGIC))
        if magic != MAGIC:
            raise SourceError(_not_version_2(self.path, magic))
        record = self._record(len(MAGIC))
        if record is None and self.size_bytes < len(MAGIC) + 4096:
            raise SourceError(
                f"{self.path}: the file ends in the bag header, before any message; "
                "copy it again from where it was recorded"
            )
        if record is None or record.op != _BAG_HEADER:
            return
        if encryptor := record.fields.get(b"encryptor"):
            raise SourceError(
                f"{self.path}: the bag is encrypted ({encryptor.decode(errors='replace')}); "
                "decrypt it with `rosbag decrypt` first"
            )
        self._index_pos = record.number(b"index_pos")
        if self._index_pos and not self._reads_index(record):
            self._find_index(record)

    def _find_index(self, head: _Record) -> None:
        """Read the index from another place: it moves if bytes before it are missing."""
        start = max(head.end, self.size_bytes - _MAX_INDEX)
        last = self._read(start, _MAX_INDEX).rfind(_OP + bytes([_INDEX_DATA]))
        found = None if last < 0 else self._search(start + last)
        if found is None:
            return
        said, self._index_pos = self._index_pos, found
        if found != said and self._reads_index(head):
            self._index_said = said
            self._chunks = []  # their places are wrong
        else:
            self._index_pos = said

    def _reads_index(self, head: _Record) -> bool:
        """Read connections and chunk list; False if they are not complete."""
        if self._index_pos > self.size_bytes:
            return False
        chunks: list[tuple[int, int]] = []
        times: list[int] = []
        connections, pos = 0, self._index_pos
        while pos < self.size_bytes:
            record = self._record(pos)
            if record is None and pos > self._index_pos:  # zeros, as some recorders write them
                end = self._search(pos) or self.size_bytes
                if not self._are_zeros(pos, end):
                    return False
                pos = end
                continue
            if record is None or record.end > min(self.size_bytes, record.start + MAX_PAYLOAD):
                return False
            data = self._read(record.start, record.end - record.start)
            if record.op == _CONNECTION:  # that in a chunk may be lost
                connections += 1
                conn = record.number(b"conn")
                self._fallback[conn] = _Connection(conn, record.fields[b"topic"], data)
            elif record.op == _CHUNK_INFO:
                pairs = np.frombuffer(data, "<u4", len(data) // 8 * 2).reshape(-1, 2)
                chunks.append((record.number(b"chunk_pos"), int(pairs[:, 1].sum(dtype=np.int64))))
                times += record.time(b"start_time"), record.time(b"end_time")
            else:
                return False
            pos = record.end
        wanted = head.number(b"conn_count"), head.number(b"chunk_count")
        # An index truncated between two records is recognized by their number only.
        self._index_is_short = connections < wanted[0] or len(chunks) < wanted[1]
        if (connections, len(chunks)) != wanted:
            return False
        self._chunks = sorted(chunks)
        # A bag without chunks has no list of messages.
        if chunks or self._index_pos == head.end:
            self.message_count = sum(count for _, count in chunks)
        if self.message_count:
            self.time_range = (min(times), max(times) + 1)
        return True

    # Records of the file.

    def _read(self, pos: int, count: int) -> bytes:
        self._file.seek(pos)
        return self._file.read(count)

    def _plain_record(self, pos: int) -> _Record | None:
        """The record at a position, None without one; its data may end past the file."""
        length = int.from_bytes(self._read(pos, 4), "little")
        if not 0 < length <= min(_MAX_HEADER, self.size_bytes - pos - 8):
            return None
        raw = self._file.read(length + 4)
        start = pos + 8 + length
        return _parsed(raw[:length], start, start + _u32(raw, length)[0])

    def _record(self, pos: int) -> _Record | None:
        """The record at a position, also if it states a wrong length of the list in it.

        Some recorders do so in index records. The number of entries then says where the next
        record starts.
        """
        record = self._plain_record(pos)
        if record is None or record.op not in _ENTRY_BYTES:
            return record
        end = record.start + _ENTRY_BYTES[record.op] * record.number(b"count")
        is_wrong = record.end != end and self._plain_record(record.end) is None
        return record._replace(end=end) if is_wrong and self._is_sound(end) else record

    def _is_sound(self, pos: int) -> bool:
        """True if a record starts at a position, or the file ends there."""
        return pos == self.size_bytes or self._plain_record(pos) is not None

    def _are_zeros(self, pos: int, end: int) -> bool:
        return 0 < end - pos <= _WINDOW and not self._read(pos, end - pos).strip(b"\0")

    def _search(self, pos: int) -> int | None:
        """First position at or behind `pos` that looks like a record."""
        for start in range(pos, self.size_bytes, _STEP):
            data = self._read(start, _STEP + _LOOK_BACK + len(_OP))
            hit = data.find(_OP)
            while hit >= 0:
                # The header's length precedes its first field and must reach past the op.
                for place in range(min(hit - 4, _STEP - 1), max(0, hit - _LOOK_BACK) - 1, -1):
                    is_long = hit + 4 - place <= _u32(data, place)[0] <= _MAX_FOUND
                    if is_long and self._is_believable(start + place):
                        return start + place
                hit = data.find(_OP, hit + 1)
        return None

    def _is_believable(self, pos: int) -> bool:
        """True if what looks like a record is one.

        A message counts only if another record follows it. Compressed chunks contain pieces of
        messages, too, but no valid record follows those. Only a chunk may be cut.
        """
        record = self._plain_record(pos)
        if record is None or record.op not in _NEEDED:
            return False
        if record.op == _MESSAGE:
            return self._is_sound(record.end)
        return record.op == _CHUNK or record.end <= self.size_bytes

    # Reading the file.

    def _pieces(self) -> Iterator[Batch]:
        pos = len(MAGIC)
        try:
            while pos < self.size_bytes:
                pos = yield from self._step(pos)
                self.bytes_read = min(pos, self.size_bytes)
        except OSError as error:
            place = self._place_at(pos)
            place.reasons.append(f"the system cannot read on: {error.strerror or error}")
        self.bytes_read = self.size_bytes
        was_cut = self._finish_place(self.size_bytes)
        if (self._index_pos > self.size_bytes or self._index_is_short) and not was_cut:
            reason = f"the file ends before the end of its index, which starts at {self._index_pos}"
            lost = 0 if self._index_is_short else None
            self._report(self.size_bytes, None, f"{reason}: it was cut short", lost)
        if self._index_said:
            told = sum(damage.messages_lost or 0 for damage in self.damage)
            missing = max(0, (self.message_count or 0) - self._got - told)
            reason = (
                f"the bag header says that the index starts at {self._index_said}, it starts at "
                f"{self._index_pos}: bytes have been lost, added or changed"
            )
            self._report(None, None, reason, missing)
        self._report_rest()

    def _step(self, pos: int) -> Generator[Batch, None, int]:
        """Read one record, chunk or run of messages; returns the position behind it."""
        record = self._record(pos)
        passed, self._passed = self._passed, 0
        if record is None:
            return self._skip(pos, passed or pos)
        if record.op == _CHUNK:
            return (yield from self._chunk(pos, record))
        if record.end > min(self.size_bytes, record.start + MAX_PAYLOAD):
            return self._skip(pos, record.start)
        if record.op in {_MESSAGE, _CONNECTION}:
            return (yield from self._run(pos, record.end))
        if record.op == _INDEX_DATA:
            place = self._place or self._place_at(pos)
            place.indexed = (place.indexed or 0) + record.number(b"count")
        elif record.op == _CHUNK_INFO:
            self._finish_place(pos)
        self._passed = record.start
        return record.end

    def _run(self, pos: int, end: int) -> Generator[Batch, None, int]:
        """Read messages outside of compressed chunks, the first of which ends at `end`."""
        place = self._place_at(pos)
        most = min(_WINDOW, place.end - pos) if place.end > pos else _WINDOW
        data = self._read(pos, max(most, end - pos))
        found = walk(data, len(data))
        behind = pos + found.end
        if not self._is_sound(behind):
            behind = pos + found.without_wrong(data)
        yield self._batch(data, found, place)
        return behind

    def _skip(self, pos: int, start: int) -> int:
        """Go from damage at `pos` to the first record at or behind `start`."""
        found = self._search(start)
        end = found or self.size_bytes
        if self._chunks and self._are_zeros(pos, end) and not self._listed(pos, end):
            self._zeros.append(range(pos, end))
            return end
        place = self._place_at(start)
        place.is_torn = place.start < start and place.end <= start
        place.is_cut = found is None
        what = "bytes that are no record" if found else "the file ends in a record that starts"
        place.reasons.append(f"{what} at byte {pos}")
        return end

    # Chunks.

    def _chunk(self, pos: int, record: _Record) -> Generator[Batch, None, int]:
        """Read a compressed chunk, or the beginning of another; returns the position behind it."""
        self._finish_place(pos)
        place = self._place = _Place(pos, record.end)
        form, length = record.fields[b"compression"], record.end - record.start
        if form not in _UNPACKERS:
            if form != b"none":
                name = form.decode(errors="replace")
                place.reasons.append(f"the chunk's compression {name!r} is not known")
            if (size := record.number(b"size")) != length:
                place.reasons.append(f"the chunk's header says {size} bytes, its record {length}")
            return record.start
        try:
            data, used = self._unpacked(record, place)
        except (OSError, EOFError, RuntimeError, ValueError) as error:
            if isinstance(error, OSError) and error.errno:  # of the system, not of the format
                raise
            place.reasons.append(f"the chunk cannot be unpacked: {error}")
            if record.end <= self.size_bytes and self._is_sound(record.end):
                return record.end
            return self._skip(record.start, record.start)
        place.end = record.start + used
        most = MIN_RECORDS + used
        found = walk(data, most + 1)
        if len(found.rows) > most:
            place.reasons.append("the chunk holds too many messages for its size")
            return place.end
        if found.end < len(data) and not place.is_cut:
            place.reasons.append(f"bytes that are no record at byte {found.end} of the chunk")
            found.without_wrong(data)
        yield self._batch(data, found, place)
        return self.size_bytes if place.is_cut else place.end

    def _unpacked(self, record: _Record, place: _Place) -> tuple[bytes, int]:
        """Content of a chunk, also if its record states too few bytes, and compressed size."""
        size, length = record.number(b"size"), record.end - record.start
        most = min(max(size, _UNSTATED), MAX_PAYLOAD)
        # In a valid bag index records follow, so a little more is enough.
        there = min(record.end, self.size_bytes) - record.start
        end = min(record.start + there + max(there, 1 << 20), self.size_bytes)
        self._file.seek(record.start)
        pos, content = record.start, BytesIO()
        stream = _UNPACKERS[record.fields[b"compression"]]()
        while not stream.eof:
            data = self._file.read(min(_STEP, end - pos)) if stream.needs_input else b""
            if stream.needs_input and not data:
                if record.end < self.size_bytes:
                    raise ValueError("its compressed bytes end too early")
                place.is_cut = True
                place.reasons.append("the file ends in a chunk")
                return content.getvalue(), pos - record.start
            pos += len(data)
            content.write(stream.decompress(data, _STEP))
            if content.tell() > most:
                raise ValueError(f"its header says {size} bytes, it has more than {most}")
            if is_implausible(content.tell(), there):
                raise ValueError(f"its {there} bytes become more than {content.tell()}")
        used = pos - len(stream.unused_data or b"") - record.start
        if used != length:
            place.reasons.append(
                f"the chunk's record says {length} compressed bytes, there are {used}"
            )
        if size != content.tell():
            place.reasons.append(
                f"the chunk's header says {size} bytes, there are {content.tell()}"
            )
        return content.getvalue(), used

    def _batch(self, data: bytes, found: _Walk, place: _Place) -> Batch:
        """The messages of a run with a known channel."""
        table = np.array(found.rows, np.int64).reshape(-1, 4)
        count = len(table)
        ids, stamps = np.empty(0, np.int64), np.empty((0, 2), np.int64)
        if count:
            words = sliding_window_view(np.frombuffer(data, np.uint8), 4)
            ids = words[table[:, 2]].view("<u4")[:, 0].astype(np.int64)
            stamps = np.stack([words[table[:, 3] + n].view("<u4")[:, 0] for n in (0, 4)], axis=1)
        times = stamps[:, 0].astype(np.int64) * 10**9 + stamps[:, 1]
        channel = np.empty(count, np.int32)
        done = 0
        for before, record in found.connections:
            conn = record.number(b"conn")
            meaning = _Connection(conn, record.fields[b"topic"], data[record.start : record.end])
            if self._meaning.get(conn, meaning) != meaning:
                # The id now has another meaning; earlier messages keep the old one.
                channel[done:before] = self._channels(ids[done:before])
                done = before
            self._meaning[conn] = meaning
        channel[done:] = self._channels(ids[done:])
        place.got += count
        self._got += count
        batch = Batch(
            data, table[:, 0], table[:, 1], channel, times, times, np.zeros(count, np.uint32)
        )
        if not count or channel.min() >= 0:
            return batch
        for number, counts in self._left_out.items():
            counts.update(ids[channel == number].tolist())
        return batch.take(channel >= 0)

    def _channels(self, connection: NDArray[np.int64]) -> NDArray[np.int32]:
        """Channel indexes of connection ids, negative for undefined ids or too many."""
        ids, where = np.unique(connection, return_inverse=True)
        return np.array([self._number(conn) for conn in ids.tolist()], np.int32)[where]

    def _number(self, conn: int) -> int:
        """Channel index of a connection with messages; equal ones share a channel."""
        connection = self._meaning.get(conn) or self._fallback.get(conn)
        if connection is None:
            return _UNDEFINED
        number = self._numbers.get(connection)
        if number is None and len(self.channels) >= MAX_CHANNELS:
            return _TOO_MANY
        if number is None:
            number = self._numbers[connection] = len(self.channels)
            self.channels.append(connection.channel())
        return number

    # Losses.

    def _place_at(self, pos: int) -> _Place:
        """The place of `pos`: the current one unless its index covers all its messages."""
        place = self._place
        if place is None or (place.indexed is not None and place.indexed >= place.got):
            self._finish_place(pos)
            place = self._place = _Place(pos, pos)
        return place

    def _finish_place(self, pos: int) -> bool:
        """Report the losses of the current place, which ends at `pos`; True if the file does."""
        place, self._place = self._place, None
        if place is None:
            return False
        if place.end > pos == self.size_bytes and not place.is_cut:
            place.is_cut = True
            place.reasons.append("the file ends in a chunk")
        expected = None if place.is_torn else place.indexed
        if self._chunks:
            expected = self._listed(place.start, max(pos, place.start + 1))
        lost = None if expected is None else max(0, expected - place.got)
        if not place.reasons and lost:
            place.reasons.append(f"its index lists {expected} messages, {place.got} are there")
        if place.is_cut and not 0 < self._index_pos <= self.size_bytes:
            lost = None  # the content behind the end is unknown
        if place.reasons:
            self._report(place.start, pos - place.start, "; ".join(place.reasons), lost)
        return place.is_cut

    def _listed(self, start: int, end: int) -> int:
        """Number of messages in some bytes by the chunk list at the end of the bag."""
        first, stop = (bisect_left(self._chunks, (pos, 0)) for pos in (start, end))
        return sum(count for _, count in self._chunks[first:stop])

    def _report(
        self, offset: int | None, length: int | None, reason: str, lost: int | None
    ) -> None:
        self.note(Damage(self.path, offset, length, reason, lost))

    def _report_rest(self) -> None:
        """Report messages without a channel and zeros, and add channels without messages."""
        undefined, too_many = self._left_out.values()
        if too_many:
            self._report(None, None, TOO_MANY_CHANNELS, too_many.total())
        if undefined:
            shown = listed(map(str, sorted(undefined)))
            reason = f"messages of connections that the bag does not define (id {shown})"
            self._report(None, None, reason, undefined.total())
        used = {connection.conn for connection in self._numbers} | set(too_many)
        silent = [
            self._number(conn) for conn in {**self._fallback, **self._meaning} if conn not in used
        ]
        if left_out := silent.count(_TOO_MANY):
            self._report(None, None, f"{left_out} {TOO_MANY_SILENT}", 0)
        if self._zeros:
            self.remarks.append(
                f"{sum(map(len, self._zeros))} bytes between records are zeros, the first at byte "
                f"{self._zeros[0].start}; by the index of the bag nothing is missing there"
            )


def _not_version_2(path: Path, magic: bytes) -> str:
    if MAGIC.startswith(magic):
        what = f"ends after {len(magic)} bytes, before any message" if magic else "is empty"
        return f"{path}: the file {what}; copy it again from where it was recorded"
    if magic.startswith((b"#ROSBAG V", b"#ROSRECORD")):
        version = magic.split(b"V", 1)[-1].strip().decode(errors="replace")
        return (
            f"{path}: a ROS bag of version {version}, only 2.0 can be read; "
            "convert it with `rosbag fix` or `rosbag reindex` of ROS 1"
        )
    return f"{path}: no ROS 1 bag; it does not start with {MAGIC.decode().strip()!r}"
