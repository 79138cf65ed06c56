"""Reads ROS 1 bags (format 2.0) from the start.

Messages are found by walking the records, without the index. Unindexed bags
(`.bag.active`), truncated bags and damaged bags yield everything that is readable.

After damage the reader searches for the next valid record. What was lost is counted by
chunk: with the chunk list at the end of the bag, or with the index records behind the chunk.
"""

from __future__ import annotations

import bz2
from bisect import bisect_left
from collections import Counter
from dataclasses import dataclass, field
from tempfile import SpooledTemporaryFile
from typing import IO, TYPE_CHECKING, Any, BinaryIO, NamedTuple

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
    OP_BAG_HEADER,
    OP_CHUNK,
    OP_CHUNK_INFO,
    OP_CONNECTION,
    OP_INDEX_DATA,
    Record,
    Run,
    Space,
    parse_fields,
    read_run,
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

MAGIC = b"#ROSBAG V2.0\n"

_UNDEFINED = -1
_TOO_MANY = -2  # one more channel than a recording can have

_ENTRY_BYTES = {OP_INDEX_DATA: 12, OP_CHUNK_INFO: 8}  # of the lists in index records
_UNPACKERS: dict[bytes, tuple[Any, bytes]] = {
    b"bz2": (bz2.BZ2Decompressor, b"BZh"),
    b"lz4": (lz4.frame.LZ4FrameDecompressor, b"\x04\x22\x4d\x18"),
}

_WINDOW = 4 << 20
_MAX_DEFINITION = 64 << 20
_AT_ONCE = 64 << 20  # bytes of an unpacked chunk in memory; larger ones go to a file
_UNSTATED = 16 << 20  # bytes that a chunk may unpack to whatever its header says
_MAX_CHUNK_BYTES = 2 << 30  # and whatever it says
_STEP = 256 << 10  # bytes that are unpacked at once
_STREAMS = 1000  # compressed streams in a chunk, and as many bytes for each further one


@dataclass(slots=True)
class _Place:
    """A chunk with its index records, or the bytes in its place."""

    start: int
    end: int  # as far as known
    got: int = 0  # messages read in it
    indexed: int | None = None  # messages in its index records, None before the first one
    reasons: list[str] = field(default_factory=list)
    broken: bool = False  # messages may be missing
    torn_index: bool = False  # some of its index records could not be read
    cut: bool = False  # the file ends in it


class _Connection(NamedTuple):
    """The content of a connection record: its id, topic and data."""

    conn: int
    topic: bytes
    data: bytes

    @classmethod
    def of(cls, record: Record, data: bytes) -> _Connection:
        return cls(record.number(b"conn"), record.fields[b"topic"], data)

    def channel(self) -> Channel:
        """The channel of its messages."""
        fields = {k.decode(errors="replace"): v for k, v in parse_fields(self.data).items()}
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

    Raises:
        SourceError: It does not exist, is not a bag of version 2.0, or is encrypted.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, kind="ROS 1 bag", profile="ros1", files=[path])
        self._meaning: dict[int, _Connection] = {}  # of connection ids, at present
        self._fallback: dict[int, _Connection] = {}
        self._numbers: dict[_Connection, int] = {}
        self._undefined: Counter[int] = Counter()  # messages by connection id
        self._too_many: Counter[int] = Counter()
        self._chunks: list[tuple[int, int]] = []  # by the index: place and number of messages
        self._index_pos = 0
        self._index_is_short = False
        self._zeros: list[range] = []  # between records
        self._skipped = 0
        self._place: _Place | None = None
        try:
            self._file: BinaryIO = path.open("rb", buffering=1 << 16)
        except OSError as error:
            raise cannot_open(path, error) from error
        self._space = Space(self._file, self.size_bytes, _WINDOW)
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
        magic = self._space.read(0, len(MAGIC))
        if magic != MAGIC:
            raise SourceError(_not_version_2(self.path, magic))
        record = self._space.record(len(MAGIC))
        if record is None and self.size_bytes < len(MAGIC) + 4096:
            raise SourceError(
                f"{self.path}: the file ends in the bag header, before any message; "
                "copy it again from where it was recorded"
            )
        if record is None or record.op != OP_BAG_HEADER:
            return
        if encryptor := record.fields.get(b"encryptor"):
            raise SourceError(
                f"{self.path}: the bag is encrypted ({encryptor.decode(errors='replace')}); "
                "decrypt it with `rosbag decrypt` first"
            )
        self._index_pos = record.number(b"index_pos")
        if 0 < self._index_pos <= self.size_bytes:
            self._read_index(record)

    def _read_index(self, head: Record) -> None:
        """Read connections and chunk list; the list counts only if it is complete."""
        chunks: list[tuple[int, int]] = []
        times: list[int] = []
        connections, pos = 0, self._index_pos
        while pos < self.size_bytes:
            record = self._record(pos)
            if record is None and pos > self._index_pos and (end := self._behind_zeros(pos)):
                pos = end
                continue
            if record is None or record.end > self.size_bytes:
                return
            data = self._space.read(record.start, min(record.end - record.start, _MAX_DEFINITION))
            if record.op == OP_CONNECTION:
                connections += 1
                if len(data) == record.end - record.start:  # that in a chunk may be lost
                    self._fallback[record.number(b"conn")] = _Connection.of(record, data)
            elif record.op == OP_CHUNK_INFO:
                pairs = np.frombuffer(data, "<u4", len(data) // 8 * 2).reshape(-1, 2)
                chunks.append((record.number(b"chunk_pos"), int(pairs[:, 1].sum(dtype=np.int64))))
                times += record.time(b"start_time"), record.time(b"end_time")
            else:
                return
            pos = record.end
        wanted = head.number(b"conn_count"), head.number(b"chunk_count")
        # An index truncated between two records is recognized by their number only.
        self._index_is_short = connections < wanted[0] or len(chunks) < wanted[1]
        if (connections, len(chunks)) != wanted:
            return
        self._chunks = sorted(chunks)
        # A bag without chunks has no list of messages.
        if chunks or self._index_pos == head.end:
            self.message_count = sum(count for _, count in chunks)
        if self.message_count:
            self.time_range = (min(times), max(times) + 1)

    # Reading the file.

    def _record(self, pos: int) -> Record | None:
        """The record at a position of the file.

        Some recorders state a wrong length for the list in an index record. Its number of
        entries then says where the next record starts.
        """
        record = self._space.record(pos)
        if record is None or record.op not in _ENTRY_BYTES:
            return record
        end = record.start + _ENTRY_BYTES[record.op] * record.number(b"count")
        if record.end != end and self._space.record(record.end) is None:
            return record._replace(end=end) if self._space.is_sound(end) else record
        return record

    def _behind_zeros(self, pos: int) -> int | None:
        """Position of the record, or end of the file, behind zeros; None without one."""
        end = pos
        while data := self._space.read(end, _STEP):
            rest = data.lstrip(b"\0")
            end += len(data) - len(rest)
            if rest:
                break
        # The first bytes of a record may be zeros, too.
        starts = range(max(pos + 1, end - 3), end + 1)
        return next((start for start in starts if self._space.is_sound(start)), None)

    def _pieces(self) -> Iterator[Batch]:
        """Walk the file record by record and chunk by chunk."""
        pos = len(MAGIC)
        try:
            while pos < self.size_bytes:
                pos = yield from self._step(pos)
                self.bytes_read = min(pos, self.size_bytes)
        except OSError as error:
            place = self._place_at(pos)
            place.reasons.append(f"the system cannot read on: {error.strerror or error}")
            place.end, place.broken = self.size_bytes, True
        self.bytes_read = self.size_bytes
        was_cut = self._place is not None and self._place.cut
        self._finish_place()
        if (self._index_pos > self.size_bytes or self._index_is_short) and not was_cut:
            reason = f"the file ends before the end of its index, which starts at {self._index_pos}"
            lost = 0 if self._index_is_short else None
            self._report(self.size_bytes, None, f"{reason}: it was cut short", lost)
        self._report_rest()

    def _step(self, pos: int) -> Generator[Batch, None, int]:
        """Read one record, chunk or run of loose messages; returns the position behind it."""
        record = self._record(pos)
        # The length of a record that was only skipped may be wrong.
        skipped, self._skipped = self._skipped, 0
        if record is None:
            return self._skip_damage(pos, skipped or pos + 1)
        if record.op == OP_CHUNK:
            return (yield from self._chunk(pos, record))
        if record.in_chunk:
            # Also messages behind an uncompressed chunk whose length field is too small.
            return (yield from self._run(self._space, pos))
        if record.end > self.size_bytes:
            return self._skip_damage(pos, record.start)
        if record.op == OP_INDEX_DATA:
            place = self._place or self._place_at(pos)
            place.indexed = (place.indexed or 0) + record.number(b"count")
            place.end = record.end
        elif record.op == OP_CHUNK_INFO:
            self._finish_place()
        self._skipped = record.start
        return record.end

    def _skip_damage(self, pos: int, start: int) -> int:
        """Skip from damage at `pos` to the first valid record at or behind `start`."""
        behind = self._behind_zeros(pos)
        if self._chunks and behind is not None and not self._listed(pos, behind):
            self._zeros.append(range(pos, behind))
            return behind
        if self._place is not None:  # the record before, with a wrong length, is not its end
            self._place.end = min(self._place.end, start)
        place = self._place_at(pos)
        place.torn_index = place.start < pos
        return self._search(place, pos, start)

    def _search(self, place: _Place, pos: int, start: int) -> int:
        """Find the first record of the file at or behind `start`, after damage at `pos`."""
        found = self._space.search(start)
        place.cut = found is None
        place.broken |= place.indexed is None
        what = "the file ends in a record that starts" if place.cut else "bytes that are no record"
        place.reasons.append(f"{what} at byte {pos}")
        place.end = self.size_bytes if found is None else found
        return place.end

    # Chunks.

    def _chunk(self, pos: int, record: Record) -> Generator[Batch, None, int]:
        """Read a chunk; returns the position behind it."""
        self._finish_place()
        place = self._place = _Place(pos, min(record.end, self.size_bytes))
        form, size = record.fields[b"compression"], record.number(b"size")
        if form in _UNPACKERS:
            with SpooledTemporaryFile(max_size=_AT_ONCE) as file:
                return (yield from self._packed_chunk(place, record, file))
        if form != b"none":
            unknown = f"the chunk's compression {form.decode(errors='replace')!r} is not known"
            first = self._space.record(record.start)
            if first is None or not first.in_chunk:
                return self._pass_chunk(place, record, unknown)
            place.reasons.append(f"{unknown}; it has none")
        if size != record.end - record.start:
            place.reasons.append(
                f"the chunk's header says {size} bytes, its record {record.end - record.start}"
            )
        pos = yield from self._run(self._space, record.start, record.end)
        if pos == self.size_bytes < record.end and not place.cut:
            place.reasons.append("the file ends in a chunk")
            place.cut = True
        return pos

    def _packed_chunk(
        self, place: _Place, record: Record, file: IO[bytes]
    ) -> Generator[Batch, None, int]:
        """Read a compressed chunk; returns the position behind it."""
        try:
            used, place.cut = self._unpack(record, file)
        except (OSError, EOFError, RuntimeError, ValueError) as error:
            if isinstance(error, OSError) and error.errno:  # of the system, not of the format
                raise
            return self._pass_chunk(place, record, f"the chunk cannot be unpacked: {error}")
        length, size = record.end - record.start, record.number(b"size")
        if place.cut:
            place.reasons.append("the file ends in a chunk")
        elif used != length:
            place.reasons.append(
                f"the chunk's record says {length} compressed bytes, there are {used}"
            )
        if size != file.tell() and not place.cut:
            place.reasons.append(f"the chunk's header says {size} bytes, there are {file.tell()}")
        place.end = self.size_bytes if place.cut else record.start + used
        for batch in self._run(Space(file, file.tell(), _AT_ONCE, is_chunk=True), 0):
            if place.got > MIN_RECORDS + used:
                place.got -= len(batch)
                place.reasons.append("the chunk holds too many messages for its size")
                place.broken = True
                break
            yield batch
        return place.end

    def _unpack(self, record: Record, file: IO[bytes]) -> tuple[int, bool]:
        """Unpack a chunk into a file, also one whose record states too few bytes.

        Returns:
            Number of its compressed bytes, and whether the bag ends in them.

        Raises:
            ValueError: The chunk is damaged or too large; or another error of its format.
        """
        make, magic = _UNPACKERS[record.fields[b"compression"]]
        size = record.number(b"size")
        most = min(max(size, _UNSTATED), _MAX_CHUNK_BYTES)
        length = min(record.end, self.size_bytes) - record.start
        # In a valid bag index records follow, so a little more is enough.
        end = min(record.start + length + max(length, 1 << 20), self.size_bytes)
        pos, streams = record.start, 0
        while not streams or self._space.read(pos, len(magic)) == magic:
            streams += 1
            if streams > _STREAMS + length // _STREAMS:
                raise ValueError("it consists of too many streams")
            stream = make()
            while not stream.eof:
                data = self._space.read(pos, min(_STEP, end - pos)) if stream.needs_input else b""
                if stream.needs_input and not data:
                    if record.end < self.size_bytes:
                        raise ValueError("its compressed bytes end too early")
                    return pos - record.start, True
                pos += len(data)
                file.write(stream.decompress(data, _STEP))
                if file.tell() > most:
                    raise ValueError(f"its header says {size} bytes, it has more than {most}")
                if is_implausible(file.tell(), length):
                    raise ValueError(f"its {length} bytes become more than {file.tell()}")
            pos -= len(stream.unused_data or b"")
        return pos - record.start, False

    def _pass_chunk(self, place: _Place, record: Record, reason: str) -> int:
        """Go on behind an unreadable chunk; trust its length only if a record follows."""
        place.reasons.append(reason)
        is_right = record.end <= self.size_bytes and self._space.is_sound(record.end)
        return record.end if is_right else self._search(place, record.start, record.start)

    # Runs of messages.

    def _run(self, space: Space, pos: int, stop: int | None = None) -> Generator[Batch, None, int]:
        """Read message and connection records, up to another kind.

        Args:
            space: The bytes.
            pos: First byte.
            stop: Expected end of the run, which limits reading ahead.

        Returns:
            The position of the next record.
        """
        limit = space.size if stop is None else min(stop, space.size)
        need = 0
        while pos < limit:
            data = space.read(pos, max(min(space.window, limit - pos), need))
            if not data:
                break
            run, asked, need = read_run(data), need, 0
            place, end = self._place_at(pos), pos + run.end
            record = None if run.end == len(data) else space.record(end)
            is_over = record is not None and not record.in_chunk and not space.is_chunk
            go_on = end
            if is_over and stop is not None:
                place.reasons.append(f"a record that does not belong into a chunk at byte {end}")
            elif not is_over and run.end < len(data):
                if run.end or not asked:
                    need = self._need(space, record, end, stop)
                if not need:
                    run, go_on = self._resume(space, place, run, pos)
            batch = self._batch(data, run, place)
            if not space.is_chunk:
                place.end = max(place.end, go_on) if len(batch) else place.end
                self.bytes_read = go_on
            yield batch
            pos = go_on
            if is_over:
                break
        return pos

    def _need(self, space: Space, record: Record | None, pos: int, stop: int | None) -> int:
        """Bytes to read for an incomplete record of a run, 0 if it cannot be complete."""
        if record is None or not record.in_chunk or record.end > space.size:
            return 0
        # One that crosses the end of its chunk is right if another record follows.
        is_right = stop is None or record.end <= stop or space.is_sound(record.end)
        return record.end - pos if is_right and record.end - pos <= MAX_PAYLOAD else 0

    def _resume(self, space: Space, place: _Place, run: Run, pos: int) -> tuple[Run, int]:
        """The run without a last message of a wrong length, and the next record behind damage."""
        end = pos + run.end
        start = end + 1
        if run.columns.size and run.columns[:2, -1].sum() == run.end:
            start = pos + int(run.columns[0, -1])
        if not space.is_chunk:
            found = self._search(place, end, start)
        else:
            found, place.broken = space.search(start) or space.size, True
            if not place.cut:
                place.reasons.append(
                    f"bytes that are no record at byte {end} of the unpacked chunk"
                )
        return (run._replace(columns=run.columns[:, :-1]) if found < end else run), found

    def _batch(self, data: bytes, run: Run, place: _Place) -> Batch:
        """Assign channels to the messages of a run; count those without one."""
        offset, length, connection, times = run.columns
        channel = np.empty(len(offset), np.int32)
        done = 0
        for before, record in run.connections:
            meaning = _Connection.of(record, data[record.start : record.end])
            if self._meaning.get(meaning.conn, meaning) != meaning:
                # The id now has another meaning; earlier messages keep the old one.
                channel[done:before] = self._channels(connection[done:before])
                done = before
            self._meaning[meaning.conn] = meaning
        channel[done:] = self._channels(connection[done:])
        place.got += len(offset)
        zeros = np.zeros(len(offset), np.uint32)
        batch = Batch(data, offset, length, channel, times, times, zeros)
        if not len(batch) or channel.min() >= 0:
            return batch
        for number, counts in ((_UNDEFINED, self._undefined), (_TOO_MANY, self._too_many)):
            counts.update(connection[channel == number].tolist())
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
            self._finish_place()
            place = self._place = _Place(pos, pos)
        return place

    def _finish_place(self) -> None:
        """Report the losses of the current place."""
        place, self._place = self._place, None
        if place is None:
            return
        expected = None if place.torn_index else place.indexed
        if self._chunks:
            expected = self._listed(place.start, max(place.end, place.start + 1))
        lost = None if expected is None else max(0, expected - place.got)
        if not place.reasons:
            if not lost:
                return
            place.reasons.append(f"its index lists {expected} messages, {place.got} are there")
        if lost is None and not place.broken:
            lost = 0
        if place.cut and not 0 < self._index_pos <= self.size_bytes:
            lost = None  # the content behind the end is unknown
        self._report(place.start, max(place.end - place.start, 0), "; ".join(place.reasons), lost)

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
        if self._too_many:
            self._report(None, None, TOO_MANY_CHANNELS, self._too_many.total())
        if self._undefined:
            shown = listed(map(str, sorted(self._undefined)))
            reason = f"messages of connections that the bag does not define (id {shown})"
            self._report(None, None, reason, self._undefined.total())
        used = {connection.conn for connection in self._numbers} | set(self._too_many)
        known = {**self._fallback, **self._meaning}
        numbers = [self._number(conn) for conn in known if conn not in used]
        if left_out := numbers.count(_TOO_MANY):
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
