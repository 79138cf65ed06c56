"""Reads ROS 1 bags (format 2.0) from the start: also unindexed, cut and damaged ones.

Records are read in the order of the file, without the index. Damage in a compressed chunk costs
that chunk; elsewhere reading goes on at the next record. What was lost is counted by the chunk
list at the end of the bag.
"""

from __future__ import annotations

import bz2
import struct
from collections import Counter
from contextlib import ExitStack
from io import BytesIO
from typing import TYPE_CHECKING, Any, BinaryIO, Final, NamedTuple

import lz4.frame
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from hybridlog.formats.reading import (
    BATCH_MESSAGES,
    Damage,
    Source,
    cannot_open,
)
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.mcap.mcap_content import is_implausible
from hybridlog_storage.messages import MAX_PAYLOAD, Batch, Channel, Schema

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterator
    from pathlib import Path

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

_MAX_HEADER: Final = 1 << 20
_OP: Final = b"\x04\0\0\0op="
_LOOK_BACK: Final = 320  # most bytes in front of this field in a header that is searched for
_MAX_FOUND: Final = 4096  # longest header that is searched for
_WINDOW = 4 << 20  # bytes of messages outside of compressed chunks that are read at once
_UNSTATED = 16 << 20  # bytes that a chunk may unpack to whatever its header says
_STEP: Final = 256 << 10  # bytes that are searched or unpacked at once

_NO_RECORD: Final = "bytes that are no record"
_VALUES: Final = b"\x09\0\0\0conn=", b"\x0d\0\0\0time="  # fields of a message: 4 and 8 bytes

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


_Row = tuple[int, int, int, int]
"""A message: begin and length of its payload, and where its connection id and its time lie."""


def walk(data: bytes, pos: int) -> tuple[list[_Row], int]:
    """The messages from a place in some bytes on, a batch of them at most, and where they end.

    Most headers are like the one before, but for their values.
    """
    rows: list[_Row] = []
    size, u32 = len(data), _u32
    unpack, length, conn, time = u32, size + 1, 0, 0
    first = second = third = b""
    while pos + 8 <= size and len(rows) < BATCH_MESSAGES:
        start = pos + length
        if start <= size:
            before, between, behind, count = unpack(data, pos)
            if before == first and between == second and behind == third:
                if start + count > size:
                    break
                rows.append((start, count, pos + conn, pos + time))
                pos = start + count
                continue
        record = _record_in(data, pos)
        if record is None or record.op != _MESSAGE:
            break
        start = record.start
        header = data[pos : start - 4]
        conn, time = (header.rindex(name) + len(name) for name in _VALUES)
        rows.append((start, record.end - start, pos + conn, pos + time))
        (low, low_end), (high, high_end) = sorted([(conn, conn + 4), (time, time + 8)])
        first, second, third = header[:low], header[low_end:high], header[high_end:]
        form = f"<{low}s{low_end - low}x{len(second)}s{high_end - high}x{len(third)}sI"
        unpack, length, pos = struct.Struct(form).unpack_from, start - pos, record.end
    return rows, pos


def _record_in(data: bytes, pos: int) -> _Record | None:
    """The whole record at a place in some bytes; None without one."""
    body = pos + 4 + _u32(data, pos)[0] if pos + 8 <= len(data) else len(data)
    if body + 4 > len(data):
        return None
    record = _parsed(data[pos + 4 : body], body + 4, body + 4 + _u32(data, body)[0])
    return record if record is not None and record.end <= len(data) else None


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
        self._undefined: Counter[int] = Counter()
        self._got = self._chunk_end = 0
        self._cut: tuple[str, int | None] | None = None  # why the file ends early, and what is lost
        try:
            with ExitStack() as held:
                self._file: BinaryIO = held.enter_context(path.open("rb", buffering=1 << 16))
                self._open()
                held.pop_all()
        except OSError as error:
            raise cannot_open(path, error) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    # Opening: the bag header, and the index if it exists.

    def _open(self) -> None:
        magic = self._file.read(len(MAGIC))
        record = self._record(len(MAGIC))
        if MAGIC.startswith(magic) and record is None and self.size_bytes < len(MAGIC) + 4096:
            raise SourceError(
                f"{self.path}: the file ends before any message; copy it again from where it was "
                "recorded"
            )
        if magic != MAGIC:
            version = magic.split(b"V", 1)[-1].strip().decode(errors="replace")
            raise SourceError(
                f"{self.path}: a ROS bag of version {version}, only 2.0 can be read; "
                "convert it with `rosbag fix` or `rosbag reindex` of ROS 1"
            )
        if record is None or record.op != _BAG_HEADER:
            return
        if encryptor := record.fields.get(b"encryptor"):
            raise SourceError(
                f"{self.path}: the bag is encrypted ({encryptor.decode(errors='replace')}); "
                "decrypt it with `rosbag decrypt` first"
            )
        if record.number(b"index_pos"):
            self._read_index(record)

    def _read_index(self, head: _Record) -> None:
        """Read connections and chunk list, where the bag header says that they are."""
        begin = head.number(b"index_pos")
        pos, count, chunks, connections = begin, 0, 0, 0
        times: list[int] = []
        while pos < self.size_bytes:
            record = self._record(pos)
            if record is None or record.end > min(self.size_bytes, record.start + MAX_PAYLOAD):
                pos = self._search(pos + 1)
                continue
            data = self._read(record.start, record.end - record.start)
            if record.op == _CONNECTION:  # that in a chunk may be lost
                connections += 1
                found = _Connection(record.number(b"conn"), record.fields[b"topic"], data)
                self._fallback[found.conn] = found
            elif record.op == _CHUNK_INFO:
                chunks += 1
                pairs = np.frombuffer(data, "<u4", len(data) // 8 * 2).reshape(-1, 2)
                count += int(pairs[:, 1].sum(dtype=np.int64))
                times += record.time(b"start_time"), record.time(b"end_time")
            else:
                break
            pos = record.end
        wanted = head.number(b"conn_count"), head.number(b"chunk_count")
        if pos != self.size_bytes or (connections, chunks) != wanted:
            reason = f"the index, which starts at {begin}, is not whole: the file was cut short"
            self._cut = reason, 0 if begin <= self.size_bytes else None
            return
        if chunks or begin == head.end:  # a bag without chunks has no list of messages
            self.message_count = count
        if count:
            self.time_range = (min(times), max(times) + 1)

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

    def _search(self, pos: int) -> int:
        """The first position at or behind one that looks like a record; the end without any."""
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
        return self.size_bytes

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

    def batches(self) -> Iterator[Batch]:
        """Yield all readable messages in file order."""
        pos = len(MAGIC)
        try:
            while pos < self.size_bytes:
                pos = yield from self._step(pos)
                self.bytes_read = min(pos, self.size_bytes)
        except OSError as error:
            self._tell(pos, None, f"the system cannot read on: {error.strerror or error}")
        self.bytes_read = self.size_bytes
        ends = ((one.offset or 0) + (one.length or 0) for one in self.damage)
        if self._cut and self.size_bytes > max(ends, default=0):
            self._tell(self.size_bytes, 0, *self._cut)
        if self._got == self.message_count and {one.reason for one in self.damage} == {_NO_RECORD}:
            self.damage.clear()  # some recorders write zeros there
            self.remarks.append(f"{self.path}: bytes between its records are no part of it")
        if self.message_count is not None:
            self.settle(self.message_count, self._got)
        if self._undefined:
            shown = listed(map(str, sorted(self._undefined)))
            reason = f"messages of connections that the bag does not define (id {shown})"
            self._tell(None, None, reason, self._undefined.total())
        used = {connection.conn for connection in self._numbers}
        for conn in {**self._fallback, **self._meaning}:  # without messages
            if conn not in used:
                self._number(conn)

    def _step(self, pos: int) -> Generator[Batch, None, int]:
        """Read one record, chunk or run of messages; returns the position behind it."""
        record = self._record(pos)
        if record is not None and record.op == _CHUNK:
            return (yield from self._chunk(pos, record))
        if record is None or record.end > min(self.size_bytes, record.start + MAX_PAYLOAD):
            end = self._search(pos if record is None else record.start)
            is_end = end == self.size_bytes
            reason, lost = self._cut if self._cut and is_end else (_NO_RECORD, None)
            self._tell(pos, end - pos, reason, lost)
            return end
        if record.op not in {_MESSAGE, _CONNECTION}:
            return record.end
        most = min(_WINDOW, self._chunk_end - pos) if self._chunk_end > pos else _WINDOW
        data = self._read(pos, max(most, record.end - pos))
        return pos + (yield from self._content(data, lambda end: self._is_sound(pos + end)))

    def _content(self, data: bytes, is_end: Callable[[int], bool]) -> Generator[Batch, None, int]:
        """Read messages and connections; returns where they end."""
        rows: list[_Row] = []
        pos, end = -1, 0
        while end > pos:
            more, end = walk(data, pos := end)
            rows += more
            record = _record_in(data, end)
            if rows and record is None and not is_end(end):
                start, length, *_ = rows[-1]
                if _OP in data[start : start + length + len(_OP)]:
                    rows.pop()  # its length is wrong: a record begins in it
                    end = start
            found = None
            if record is not None and record.op == _CONNECTION:
                content = data[record.start : record.end]
                found = _Connection(record.number(b"conn"), record.fields[b"topic"], content)
                end = record.end
            is_known = found is not None and self._meaning.get(found.conn, found) == found
            if rows and (not is_known or len(rows) >= BATCH_MESSAGES):
                yield self._batch(data, rows)
                rows = []
            if found is not None:
                self._meaning[found.conn] = found
        return end

    def _chunk(self, pos: int, record: _Record) -> Generator[Batch, None, int]:
        """Read a compressed chunk, or the beginning of another; returns the position behind it."""
        size, form = record.number(b"size"), record.fields[b"compression"]
        if form == b"none":
            if record.end > self.size_bytes:
                self._cut = self._cut or ("the file ends in a chunk", None)
            self._chunk_end = record.end
            return record.start
        try:
            if form not in _UNPACKERS:
                raise ValueError(f"its compression {form.decode(errors='replace')!r} is not known")
            data = self._unpacked(record)
        except (OSError, EOFError, RuntimeError, ValueError) as error:
            if isinstance(error, OSError) and error.errno:  # of the system, not of the format
                raise
            self._tell(pos, record.end - pos, f"a chunk cannot be unpacked: {error}")
        else:
            used = yield from self._content(data, lambda end: end == len(data))
            if len(data) != size:
                reason = f"a chunk says {size} bytes, there are {len(data)}"
                self._tell(pos, record.end - pos, reason)
            elif used < len(data):
                reason = f"bytes that are no record at byte {used} of a chunk"
                self._tell(pos, record.end - pos, reason)
        return record.end if self._is_sound(record.end) else self._search(record.start)

    def _unpacked(self, record: _Record) -> bytes:
        """The content of a chunk; less if the file or its compressed bytes end early."""
        size, length = record.number(b"size"), record.end - record.start
        most = min(max(size, _UNSTATED), MAX_PAYLOAD)
        self._file.seek(record.start)
        left, content, data = length, BytesIO(), b""
        stream = _UNPACKERS[record.fields[b"compression"]]()
        while not stream.eof:
            if stream.needs_input and not (data := self._file.read(min(_STEP, left))):
                break
            left -= len(data)
            content.write(stream.decompress(data, _STEP))
            data = b""
            if content.tell() > most:
                raise ValueError(f"its header says {size} bytes, it has more than {most}")
            if is_implausible(content.tell(), length):
                raise ValueError(f"its {length} bytes become more than {content.tell()}")
        return content.getvalue()

    def _batch(self, data: bytes, rows: list[_Row]) -> Batch:
        """The messages that have a channel."""
        table = np.array(rows, np.int64)
        words = sliding_window_view(np.frombuffer(data, np.uint8), 4)
        ids, seconds, rest = (
            words[places].view("<u4")[:, 0].astype(np.int64)
            for places in (table[:, 2], table[:, 3], table[:, 3] + 4)
        )
        times = seconds * 10**9 + rest
        distinct, where = np.unique(ids, return_inverse=True)
        channel = np.array([self._number(conn) for conn in distinct.tolist()], np.int32)[where]
        self._got += len(rows)
        zeros = np.zeros(len(rows), np.uint32)
        batch = Batch(data, table[:, 0], table[:, 1], channel, times, times, zeros)
        if channel.min() >= 0:
            return batch
        self._undefined.update(ids[channel < 0].tolist())
        return batch.take(channel >= 0)

    def _number(self, conn: int) -> int:
        """Channel index of a connection, -1 if it is not defined; equal ones share a channel."""
        connection = self._meaning.get(conn) or self._fallback.get(conn)
        if connection is None:
            return -1
        if connection not in self._numbers:
            self._numbers[connection] = self.add_channel(connection.channel())
        return self._numbers[connection]

    def _tell(
        self, offset: int | None, length: int | None, reason: str, lost: int | None = None
    ) -> None:
        self.note(Damage(self.path, offset, length, reason, lost))
