"""Reads ROS 1 bags (format 2.0) from the start.

Messages are found by walking the records, without the index. Unindexed bags
(`.bag.active`), truncated bags and damaged bags yield everything that is readable. The
index at the end only serves to count missing messages.

After damage the reader searches for the next valid record. Lost messages are counted with
the index records behind each chunk, or with the chunk list at the end of the bag.
"""

from __future__ import annotations

import bz2
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from tempfile import SpooledTemporaryFile
from typing import IO, TYPE_CHECKING, BinaryIO, NamedTuple, Protocol

import lz4.frame
import numpy as np

from hybridlog.formats.reading import (
    TOO_MANY_CHANNELS,
    TOO_MANY_SILENT,
    Damage,
    Source,
    cannot_open,
    regroup,
)
from hybridlog.formats.rosbag1.records import (
    MAX_HEADER,
    OP_BAG_HEADER,
    OP_CHUNK,
    OP_CHUNK_INFO,
    OP_CONNECTION,
    OP_INDEX_DATA,
    OP_MESSAGE,
    Header,
    Run,
    RunReader,
    Stop,
    find_record,
    parse_fields,
    parse_header,
)
from hybridlog.wording import listed
from hybridlog_storage.errors import SourceError
from hybridlog_storage.mcap.mcap_content import MIN_RECORDS
from hybridlog_storage.messages import MAX_CHANNELS, MAX_PAYLOAD, Batch, Channel, Schema
from hybridlog_storage.segments.compression import is_implausible

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

MAGIC = b"#ROSBAG V2.0\n"

_UNDEFINED = -1
_TOO_MANY = -2  # one more channel than a recording can have

_ENTRY_BYTES = {OP_INDEX_DATA: 12, OP_CHUNK_INFO: 8}  # of the lists in index records

_WINDOW = 4 << 20
_SEARCH = 1 << 20
_OVERLAP = 8 << 10
_MAX_DEFINITION = 64 << 20
_AT_ONCE = 64 << 20  # bytes of an unpacked chunk in memory; larger ones go to a file
_UNSTATED = 16 << 20  # bytes that a chunk may unpack to whatever its header says
_MAX_CHUNK_BYTES = 2 << 30  # and whatever it says
_STEP = 64 << 10  # bytes that are unpacked at once
_STREAMS = 1000  # compressed streams in a chunk, and as many bytes for each further one


@dataclass(frozen=True, slots=True)
class _Record:
    """One record of the file: its header, and `[start, end)` of its data."""

    raw: bytes
    header: Header
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class _Space:
    """Bytes with records: the file, or an unpacked chunk.

    Attributes:
        read: `read(pos, n)` returns up to n bytes.
        size: Number of bytes.
        packed: Whether the bytes come from a compressed chunk.
        cut: Whether the bytes are known to end too early.
    """

    read: Callable[[int, int], bytes]
    size: int
    packed: bool
    cut: bool


@dataclass(slots=True)
class _Place:
    """A chunk with its index records, or the bytes in its place.

    Attributes:
        start: Byte in the file.
        end: Byte after it, as far as known.
        got: Number of messages read in it.
        indexed: Number of messages in its index records, None before the first one.
        reasons: Descriptions of its damage.
        broken: Whether messages may be missing.
        torn_index: Whether some of its index records could not be read.
        cut: Whether the file ends in it.
    """

    start: int
    end: int
    got: int = 0
    indexed: int | None = None
    reasons: list[str] = field(default_factory=list)
    broken: bool = False
    torn_index: bool = False
    cut: bool = False

    def blame(self, reason: str) -> None:
        """Note damage that may have lost messages."""
        self.reasons.append(reason)
        self.broken = True

    @property
    def is_complete(self) -> bool:
        """True if its index records cover all its messages, so another place follows."""
        return self.indexed is not None and self.indexed >= self.got


@dataclass(frozen=True, slots=True)
class _Unpacked:
    """The result of unpacking a compressed chunk.

    Attributes:
        file: The bytes, in memory up to `_AT_ONCE`; an intact prefix if `state` is `short`,
            empty if `broken`.
        used: Compressed bytes of the stream.
        state: `whole`, `short` (the stream continues past its bytes) or `broken`.
        reason: Description of the damage of a broken one.
    """

    file: IO[bytes]
    used: int
    state: str
    reason: str = ""

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.file.seek(0, 2)

    def space(self) -> _Space:
        """The bytes as a space with records."""
        size = self.size
        self.file.seek(0)
        if size > _AT_ONCE:
            return _Space(self._read, size, packed=True, cut=self.state == "short")
        data = self.file.read()

        def read(pos: int, count: int) -> bytes:
            return data if pos == 0 and count >= size else data[pos : pos + count]

        return _Space(read, size, packed=True, cut=self.state == "short")

    def _read(self, pos: int, count: int) -> bytes:
        self.file.seek(pos)
        return self.file.read(count)


class _Connection(NamedTuple):
    """The content of a connection record.

    Attributes:
        conn: Id of the connection.
        topic: Its topic.
        fields: Its data.
    """

    conn: int
    topic: bytes
    fields: bytes

    @classmethod
    def of(cls, data: bytes, header: Header, span: tuple[int, int]) -> _Connection:
        return cls(header.u32(data, b"conn"), header.raw(data, b"topic"), data[slice(*span)])

    def channel(self) -> Channel:
        """The channel of its messages."""
        data = self.fields
        fields = parse_fields(data, 0, len(data)) or {}
        values = {
            name.decode(errors="replace"): data[start:end] for name, (start, end) in fields.items()
        }
        definition = values.pop("message_definition", None)
        name = values.pop("type", b"").decode(errors="replace")
        values.pop("topic", None)
        metadata = {key: value.decode(errors="replace") for key, value in values.items()}
        encoding = "" if definition is None else "ros1msg"
        schema = Schema(name, encoding, definition or b"") if name else None
        topic = self.topic.decode(errors="replace")
        return Channel(topic, "ros1", schema, metadata, has_publish_time=False)


class Rosbag1Source(Source):
    """A ROS 1 bag.

    Each connection with messages becomes a channel of its own.

    Raises:
        SourceError: It does not exist, is not a bag of version 2.0, or is encrypted.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, kind="ROS 1 bag", profile="ros1", files=[path])
        try:
            self._file: BinaryIO = path.open("rb", buffering=1 << 16)
        except OSError as error:
            raise cannot_open(path, error) from error
        self._space = _Space(self._read, self.size_bytes, packed=False, cut=False)
        self._runs = RunReader()
        self._meaning: dict[int, _Connection] = {}  # of connection ids, at present
        self._numbers: dict[_Connection, int] = {}
        self._fallback: dict[int, _Connection] = {}
        self._undefined: Counter[int] = Counter()
        self._undefined_at: int | None = None
        self._refused: set[int] = set()  # connections that there is no room for
        self._too_many = 0
        self._chunk_positions: list[int] = []
        self._chunk_counts: list[int] = []
        self._index_pos = 0
        self._index_is_short = False
        self._place: _Place | None = None
        self._pos = len(MAGIC)
        self._skipped: int | None = None
        try:
            self._open()
        except OSError as error:
            self.close()
            raise cannot_open(path, error) from error
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def batches(self) -> Iterator[Batch]:
        """Yield all readable messages in file order."""
        return regroup(self._pieces())

    # Opening: the bag header, and the index if it exists.

    def _open(self) -> None:
        magic = self._read(0, len(MAGIC))
        if not magic:
            raise SourceError(
                f"{self.path}: the file is empty; record or copy it again, there is nothing in it"
            )
        if magic != MAGIC:
            raise SourceError(_not_version_2(self.path, magic))
        record = self._record(len(MAGIC))
        if record is None:
            if self.size_bytes < len(MAGIC) + 4096:
                raise SourceError(
                    f"{self.path}: the file ends in the bag header, before any message; "
                    "copy it again from where it was recorded"
                )
            return
        if record.header.op != OP_BAG_HEADER:
            return
        encryptor = record.header.raw(record.raw, b"encryptor")
        if encryptor:
            raise SourceError(
                f"{self.path}: the bag is encrypted ({encryptor.decode(errors='replace')}); "
                "decrypt it with `rosbag decrypt` first"
            )
        self._index_pos = record.header.u64(record.raw, b"index_pos")
        if not 0 < self._index_pos <= self.size_bytes:
            return
        conn_count = record.header.u32(record.raw, b"conn_count")
        chunk_count = record.header.u32(record.raw, b"chunk_count")
        self._read_index(conn_count, chunk_count, is_bare=self._index_pos == record.end)

    def _read_index(self, conn_count: int, chunk_count: int, *, is_bare: bool) -> None:
        """Read connections and chunk list; the index counts only if it is complete."""
        chunks: list[tuple[int, int]] = []
        begins: list[int] = []
        ends: list[int] = []
        pos = self._index_pos
        connections = 0
        while pos < self.size_bytes:
            record = self._record(pos)
            if record is None or record.end > self.size_bytes:
                return
            if record.header.op == OP_CONNECTION:
                self._store_definition(record)
                connections += 1
            elif record.header.op == OP_CHUNK_INFO:
                data = self._read(record.start, min(record.end - record.start, 1 << 26))
                pairs = np.frombuffer(data, "<u4", len(data) // 8 * 2).reshape(-1, 2)
                place = record.header.u64(record.raw, b"chunk_pos")
                chunks.append((place, int(pairs[:, 1].sum(dtype=np.int64))))
                begins.append(record.header.time(record.raw, b"start_time"))
                ends.append(record.header.time(record.raw, b"end_time"))
            else:
                return
            pos = record.end
        # An index truncated between two records is recognized by their number only.
        self._index_is_short = connections < conn_count or len(chunks) < chunk_count
        if connections != conn_count or len(chunks) != chunk_count:
            return
        chunks.sort()
        self._chunk_positions = [place for place, _ in chunks]
        self._chunk_counts = [count for _, count in chunks]
        # A bag without chunks has no list of messages.
        if chunks or is_bare:
            self.message_count = sum(self._chunk_counts)
        if chunks and self.message_count:
            self.time_range = (min(begins), max(ends) + 1)

    def _store_definition(self, record: _Record) -> None:
        """Store a connection of the index: its definition in a chunk may be lost."""
        if record.end - record.start > _MAX_DEFINITION:
            return
        data = self._read(record.start, record.end - record.start)
        raw = record.raw + data
        span = (len(record.raw), len(raw))
        connection = _Connection.of(raw, record.header, span)
        self._fallback[connection.conn] = connection

    # Reading the file.

    def _read(self, pos: int, count: int) -> bytes:
        self._file.seek(pos)
        return self._file.read(count)

    def _record(self, pos: int) -> _Record | None:
        """The valid record at a position of the file, see `_record_in`.

        Some recorders state a wrong length for the list in an index record. Its number of
        entries then says where the next record starts.
        """
        record = _record_in(self._space, pos)
        entry = None if record is None else _ENTRY_BYTES.get(record.header.op)
        if record is None or entry is None:
            return record
        end = record.start + entry * record.header.u32(record.raw, b"count")
        is_last = record.end == self.size_bytes
        if record.end == end or (not is_last and self._starts_record(record.end)):
            return record
        return replace(record, end=end) if self._starts_record(end) else record

    def _starts_record(self, pos: int) -> bool:
        return _is_sound(self._space, 0, pos)

    def _pieces(self) -> Iterator[Batch]:
        """Walk the file record by record and chunk by chunk."""
        try:
            while self._pos < self.size_bytes:
                yield from self._step()
                self.bytes_read = min(self._pos, self.size_bytes)
        except OSError as error:
            place = self._place_at(self._pos)
            place.blame(f"the system cannot read on: {error.strerror or error}")
            place.end = self.size_bytes
        self.bytes_read = self.size_bytes
        was_cut = self._place is not None and self._place.cut
        self._finish_place()
        if self._index_pos > self.size_bytes and not was_cut:
            self._report(
                self.size_bytes,
                None,
                f"the file ends before its index, which should start at byte {self._index_pos}: "
                "it was cut short",
                None,
            )
        elif self._index_is_short and not was_cut:
            self._report(
                self.size_bytes,
                None,
                "the file ends within its index, which should hold more records: it was cut short",
                0,
            )
        self._report_undefined()
        self._add_silent()

    def _step(self) -> Iterator[Batch]:
        """Read one record, chunk or run of loose messages at `_pos` and advance it."""
        pos = self._pos
        record = self._record(pos)
        # The length of a record that was only skipped may be wrong.
        skipped, self._skipped = self._skipped, None
        if record is None:
            self._skip_damage(pos, skipped or pos + 1)
        elif record.header.op == OP_CHUNK:
            yield from self._chunk(pos, record)
        elif record.header.op in {OP_MESSAGE, OP_CONNECTION}:
            # Also messages behind an uncompressed chunk whose length field is too small.
            yield from self._run(self._space, pos, None)
        else:
            self._skip_record(pos, record)

    def _skip_record(self, pos: int, record: _Record) -> None:
        """Skip a record without messages; count those that an index record lists."""
        if record.end > self.size_bytes:
            self._skip_damage(pos, record.start)
            return
        if record.header.op == OP_INDEX_DATA:
            place = self._place_at(pos, has_index=True)
            place.indexed = (place.indexed or 0) + record.header.u32(record.raw, b"count")
            place.end = record.end
        elif record.header.op == OP_CHUNK_INFO:
            self._finish_place()
        self._skipped = record.start
        self._pos = record.end

    def _skip_damage(self, pos: int, start: int) -> None:
        """Skip from damage at `pos` to the first valid record at or behind `start`."""
        if self._place is not None:  # the record before, with a wrong length, is not its end
            self._place.end = min(self._place.end, start)
        place = self._place_at(pos)
        place.torn_index = place.start < pos
        place.broken |= place.indexed is None
        found = self._search(self._space, start)
        if found is None:
            place.cut = True
            place.reasons.append(f"the file ends in a record that starts at byte {pos}")
            self._pos = place.end = self.size_bytes
            return
        place.reasons.append(f"bytes that are no record at byte {pos}")
        self._pos = place.end = found

    def _search(self, space: _Space, pos: int) -> int | None:
        """First position at or behind `pos` that looks like a record."""
        while pos < space.size:
            data = space.read(pos, min(_SEARCH + _OVERLAP, space.size - pos))
            found = find_record(data, space.size - pos, partial(_is_sound, space, pos))
            if found is not None and (found < _SEARCH or len(data) <= _SEARCH):
                return pos + found
            if len(data) <= _SEARCH:
                return None
            pos += _SEARCH
        return None

    # Chunks.

    def _chunk(self, pos: int, record: _Record) -> Iterator[Batch]:
        self._finish_place()
        place = self._place = _Place(pos, min(record.end, self.size_bytes))
        compression = record.header.raw(record.raw, b"compression")
        size = record.header.u32(record.raw, b"size")
        if compression not in _UNPACKERS:
            yield from self._plain_chunk(place, record, compression, size)
            return
        with SpooledTemporaryFile(max_size=_AT_ONCE) as file:
            yield from self._packed_chunk(place, record, self._unpack(record, file), size)

    def _packed_chunk(
        self, place: _Place, record: _Record, unpacked: _Unpacked, size: int
    ) -> Iterator[Batch]:
        """Read an unpacked chunk."""
        if unpacked.state == "broken":
            place.blame(unpacked.reason)
            self._after_broken_chunk(record)
            return
        end = record.start + unpacked.used
        if unpacked.state == "short":
            place.blame("the file ends in a chunk")
            place.cut = True
            end = self.size_bytes
        elif end != record.end:
            place.reasons.append(
                f"the chunk's record says {record.end - record.start} compressed bytes, "
                f"there are {unpacked.used}"
            )
        if unpacked.state == "whole" and unpacked.size != size:
            place.reasons.append(f"the chunk's header says {size} bytes, there are {unpacked.size}")
        space = unpacked.space()
        for batch in self._run(space, 0, space.size):
            if place.got > MIN_RECORDS + unpacked.used:
                place.got -= len(batch)
                place.blame("the chunk holds too many messages for its size")
                break
            yield batch
        self._pos = place.end = end

    def _plain_chunk(
        self, place: _Place, record: _Record, compression: bytes, size: int
    ) -> Iterator[Batch]:
        """Read a chunk without compression, or with an unknown one."""
        if compression != b"none":
            name = compression.decode(errors="replace")
            first = self._record(record.start)
            if first is None or first.header.op not in {OP_MESSAGE, OP_CONNECTION}:
                place.blame(f"the chunk's compression {name!r} is not known")
                self._after_broken_chunk(record)
                return
            place.reasons.append(f"the chunk's compression {name!r} is not known; it has none")
        if size != record.end - record.start:
            place.reasons.append(
                f"the chunk's header says {size} bytes, its record {record.end - record.start}"
            )
        yield from self._run(self._space, record.start, record.end)

    def _unpack(self, record: _Record, file: IO[bytes]) -> _Unpacked:
        """Unpack a chunk; read further if its record states too few bytes."""
        length = min(record.end, self.size_bytes) - record.start
        if length > MAX_PAYLOAD:
            return _broken(length, "the chunk is too large to be one")
        unpack = _UNPACKERS[record.header.raw(record.raw, b"compression")]
        size = record.header.u32(record.raw, b"size")
        unpacked = unpack(self._read(record.start, length), size, file)
        rest = self.size_bytes - record.end
        if unpacked.state == "short" and rest > 0:
            # In a valid bag index records follow, so a little more is enough.
            more = min(length + max(length, 1 << 20), self.size_bytes - record.start)
            file.seek(0)
            file.truncate()
            unpacked = unpack(self._read(record.start, more), size, file)
            if unpacked.state == "short":
                return _broken(length, "the chunk's compressed bytes end too early")
        return unpacked

    def _after_broken_chunk(self, record: _Record) -> None:
        """Continue after an unreadable chunk; trust its length only if a record follows."""
        place = self._place_at(record.start)
        if record.end == self.size_bytes or (
            record.end < self.size_bytes and self._record(record.end) is not None
        ):
            self._pos = place.end = record.end
            return
        found = self._search(self._space, record.start)
        self._pos = place.end = self.size_bytes if found is None else found
        place.cut = found is None

    # Runs of messages.

    def _run(self, space: _Space, pos: int, soft_end: int | None) -> Iterator[Batch]:
        """Read message and connection records from `pos` on, up to another kind.

        Args:
            space: The bytes. In the file, `_pos` moves to the end of the run.
            pos: First byte.
            soft_end: Expected end of the run, which limits reading ahead.
        """
        need = 0
        while pos < space.size and (soft_end is None or pos < soft_end):
            stop = space.size if soft_end is None else soft_end
            at_once = space.packed and space.size <= _AT_ONCE
            count = space.size if at_once else max(min(_WINDOW, stop - pos), need)
            data = space.read(pos, count)
            if not data:
                break
            run = self._runs.read(data)
            go_on, need = self._after_run(space, run, pos, soft_end)
            batch = self._batch(space, data, run, pos)
            if len(batch):
                yield batch
            if go_on is None:
                pos += run.end
                break
            pos = go_on
            if not space.packed:
                self.bytes_read = min(pos, space.size)
        if not space.packed:
            self._pos = pos

    def _after_run(
        self, space: _Space, run: Run, pos: int, soft_end: int | None
    ) -> tuple[int | None, int]:
        """Find the position to continue at after a run that started at `pos`.

        Returns:
            The next position (None: the run ends where it stopped), and the least number of
            bytes to read there.
        """
        end = pos + run.end
        if run.why is Stop.END:
            return end, 0
        if run.why is Stop.FOREIGN and not space.packed:
            if soft_end is not None:
                reason = "a record that does not belong into a chunk"
                self._place_at(end).blame(f"{reason} at byte {end}")
            return None, 0
        if run.why is Stop.CUT:
            need = self._need(space, run, end, soft_end)
            if need:
                return end, need
            if space.cut:
                return space.size, 0
            if not space.packed and end + run.need > space.size:
                return self._cut_in_file(space, end), 0
        self._trouble(space, end, "bytes that are no record")
        return self._resume(space, run, pos), 0

    def _need(self, space: _Space, run: Run, end: int, soft_end: int | None) -> int:
        """Bytes to read for the incomplete record at `end`, 0 if it cannot be complete."""
        if end + run.need > space.size or run.need > MAX_PAYLOAD:
            return 0
        if soft_end is None or end + run.need <= soft_end:
            return run.need
        # It crosses the end of its chunk: the chunk's length or its own is wrong. The right
        # one is followed by another record.
        record = self._record(end)
        if record is None or record.end - end > MAX_PAYLOAD or not _is_sound(space, 0, record.end):
            return 0
        return record.end - end

    def _cut_in_file(self, space: _Space, end: int) -> int:
        """Handle a record past the end of the file: truncated, or with a wrong length."""
        found = self._search(space, end + 8)
        if found is not None:
            self._trouble(space, end, "a record whose length is wrong")
            self._place_at(end).end = found
            return found
        place = self._place_at(end)
        place.blame(f"the file ends in a record that starts at byte {end}")
        place.cut = True
        place.end = space.size
        return space.size

    def _resume(self, space: _Space, run: Run, pos: int) -> int:
        """Position of the next record after bad bytes; drops a last message that reaches it."""
        end = pos + run.end
        found = self._search(space, end + 1 if run.last is None else pos + run.last)
        if found is None:
            found = space.size
        elif found < end:
            run.without_last()
        if not space.packed:
            place = self._place_at(end)
            place.end = max(place.end, found)
        return found

    def _trouble(self, space: _Space, pos: int, reason: str) -> None:
        """Note damage in the current place."""
        place = self._place_at(pos) if not space.packed else self._place
        assert place is not None
        where = f"at byte {pos}" + (" of the unpacked chunk" if space.packed else "")
        place.blame(f"{reason} {where}")

    def _batch(self, space: _Space, data: bytes, run: Run, pos: int) -> Batch:
        """Assign channels to the messages of a run; count those without one."""
        channel = np.full(len(run.offset), _UNDEFINED, np.int32)
        done = 0
        for before, header, span in run.connections:
            meaning = _Connection.of(data, header, span)
            if self._meaning.get(meaning.conn, meaning) != meaning and before > done:
                # The id now has another meaning; earlier messages keep the old one.
                channel[done:before] = self._channels(run.connection[done:before])
                done = before
            self._meaning[meaning.conn] = meaning
        channel[done:] = self._channels(run.connection[done:])
        if len(run.offset):
            place = self._place if space.packed else self._place_at(pos)
            assert place is not None
            place.got += len(run.offset)
            if not space.packed:
                place.end = max(place.end, pos + run.end)
        zeros = np.zeros(len(run.offset), np.uint32)
        times = run.log_time
        batch = Batch(data, run.offset, run.length, channel, times, times, zeros)
        known = channel >= 0
        if not known.all():
            self._too_many += int((channel == _TOO_MANY).sum())
            undefined = run.connection[channel == _UNDEFINED]
            self._undefined.update(undefined.tolist())
            if self._undefined_at is None and len(undefined):
                self._undefined_at = self._pos if space.packed else pos
            batch = batch.take(known)
        return batch

    def _channels(
        self, connection: np.ndarray[tuple[int], np.dtype[np.int64]]
    ) -> np.ndarray[tuple[int], np.dtype[np.int32]]:
        """Channel indexes of connection ids, negative for undefined ids or too many."""
        ids, where = np.unique(connection, return_inverse=True)
        numbers = np.empty(len(ids), np.int32)
        for row, conn in enumerate(ids.tolist()):
            numbers[row] = self._number(self._meaning.get(conn) or self._fallback.get(conn))
        return numbers[where]

    def _number(self, connection: _Connection | None) -> int:
        """Channel index of a connection with messages; equal ones share a channel."""
        if connection is None:
            return _UNDEFINED
        number = self._numbers.get(connection)
        if number is None and len(self.channels) >= MAX_CHANNELS:
            self._refused.add(connection.conn)
            return _TOO_MANY
        if number is None:
            number = self._numbers[connection] = len(self.channels)
            self.channels.append(connection.channel())
        return number

    def _add_silent(self) -> None:
        """Add the channels of connections without messages."""
        used = {connection.conn for connection in self._numbers} | self._refused
        known = {**self._fallback, **self._meaning}
        numbers = [self._number(known[conn]) for conn in known if conn not in used]
        if left_out := numbers.count(_TOO_MANY):
            self._report(None, None, f"{left_out} {TOO_MANY_SILENT}", 0)

    # Losses.

    def _place_at(self, pos: int, *, has_index: bool = False) -> _Place:
        """The place of `pos`: the current one unless that is complete."""
        place = self._place
        if place is None or (not has_index and place.is_complete):
            self._finish_place()
            place = self._place = _Place(pos, pos)
        return place

    def _finish_place(self) -> None:
        """Report the losses of the current place."""
        place, self._place = self._place, None
        if place is None:
            return
        expected = self._listed(place)
        if expected is None and not place.torn_index:
            expected = place.indexed
        lost = None if expected is None else max(0, expected - place.got)
        if not place.reasons:
            if not lost:
                return
            place.reasons.append(f"its index lists {expected} messages, {place.got} are there")
        if lost is None and not place.broken:
            lost = 0
        if place.cut and not 0 < self._index_pos <= self.size_bytes:
            # The content behind the end is unknown.
            lost = None
        self._report(place.start, max(place.end - place.start, 0), "; ".join(place.reasons), lost)

    def _listed(self, place: _Place) -> int | None:
        """Number of messages in a place by the chunk list at the end of the bag."""
        if not self._chunk_positions:
            return None
        first = bisect_left(self._chunk_positions, place.start)
        stop = bisect_left(self._chunk_positions, max(place.end, place.start + 1))
        return sum(self._chunk_counts[first:stop])

    def _report(
        self, offset: int | None, length: int | None, reason: str, lost: int | None
    ) -> None:
        self.note(Damage(self.path, offset, length, reason, lost))

    def _report_undefined(self) -> None:
        """Report messages of undefined connections, and of too many."""
        if self._too_many:
            self._report(None, None, TOO_MANY_CHANNELS, self._too_many)
        if not self._undefined:
            return
        ids = sorted(self._undefined)
        shown = listed(map(str, ids))
        self._report(
            self._undefined_at or 0,
            None,
            f"messages of connections that the bag does not define (id {shown})",
            self._undefined.total(),
        )


def _record_in(space: _Space, pos: int) -> _Record | None:
    """The record at a position, None without a valid one.

    The end of its data may lie past the end of the space.
    """
    size = int.from_bytes(space.read(pos, 4), "little")
    if not 0 < size <= min(MAX_HEADER, space.size - pos - 8):
        return None
    raw = space.read(pos + 4, size + 4)
    if len(raw) < size + 4:
        return None
    header = parse_header(raw, 0, size)
    if header is None:
        return None
    start = pos + 8 + size
    return _Record(raw, header, start, start + int.from_bytes(raw[size:], "little"))


def _is_sound(space: _Space, base: int, pos: int) -> bool:
    """True if a record starts at `base + pos`, or the space ends there."""
    return base + pos == space.size or _record_in(space, base + pos) is not None


def _not_version_2(path: Path, magic: bytes) -> str:
    if MAGIC.startswith(magic):
        return (
            f"{path}: the file ends after {len(magic)} bytes, before any message; "
            "copy it again from where it was recorded"
        )
    if magic.startswith((b"#ROSBAG V", b"#ROSRECORD")):
        version = magic.split(b"V", 1)[-1].strip().decode(errors="replace")
        return (
            f"{path}: a ROS bag of version {version}, only 2.0 can be read; "
            "convert it with `rosbag fix` or `rosbag reindex` of ROS 1"
        )
    return f"{path}: no ROS 1 bag; it does not start with {MAGIC.decode().strip()!r}"


# Compressed chunks.


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...
    @property
    def needs_input(self) -> bool: ...
    @property
    def unused_data(self) -> bytes | None: ...
    def decompress(self, data: bytes, max_length: int = -1) -> bytes: ...


class _Streams:
    """The compressed streams at the start of some bytes.

    Attributes:
        count: Number of streams found.
        used: Bytes of them.
        is_short: Whether the last one continues past the bytes.
    """

    def __init__(self, make: Callable[[], _Decompressor], data: bytes, magic: bytes) -> None:
        self.count = self.used = 0
        self.is_short = False
        self._make = make
        self._data = data
        self._magic = magic

    def parts(self) -> Iterator[bytes]:
        """Yield the unpacked bytes in small parts.

        Raises:
            ValueError: There are too many streams; or another error of the format.
        """
        size = len(self._data)
        while self._data.startswith(self._magic, self.used):
            self.count += 1
            if self.count > _STREAMS + size // _STREAMS:
                raise ValueError("it consists of too many streams")
            stream = self._make()
            while not stream.eof:
                taken = self._data[self.used : self.used + _STEP] if stream.needs_input else b""
                if stream.needs_input and not taken:
                    self.is_short = True
                    return
                yield stream.decompress(taken, _STEP)
                self.used += len(taken)
            self.used -= len(stream.unused_data or b"")


def _unpack_with(
    make: Callable[[], _Decompressor], magic: bytes, data: bytes, size: int, file: IO[bytes]
) -> _Unpacked:
    """Unpack the streams at the start of `data`, at most `size` or `_UNSTATED` bytes."""
    most = min(max(size, _UNSTATED), _MAX_CHUNK_BYTES)
    streams = _Streams(make, data, magic)
    total = 0
    try:
        for part in streams.parts():
            total += file.write(part)
            if total > most:
                raise ValueError(f"its header says {size} bytes, it has more than {most}")
            if is_implausible(total, len(data)):
                raise ValueError(f"its {len(data)} bytes become more than {total}")
    except (OSError, EOFError, RuntimeError, ValueError) as error:
        return _broken(len(data), f"the chunk cannot be unpacked: {error}")
    if not streams.count and data and not magic.startswith(data):
        return _broken(0, "the chunk cannot be unpacked: it has another format")
    is_short = streams.is_short or not streams.count
    return _Unpacked(file, streams.used, "short" if is_short else "whole")


def _broken(used: int, reason: str) -> _Unpacked:
    return _Unpacked(BytesIO(), used, "broken", reason)


_UNPACKERS: dict[bytes, Callable[[bytes, int, IO[bytes]], _Unpacked]] = {
    b"bz2": partial(_unpack_with, bz2.BZ2Decompressor, b"BZh"),
    b"lz4": partial(_unpack_with, lz4.frame.LZ4FrameDecompressor, b"\x04\x22\x4d\x18"),
}
