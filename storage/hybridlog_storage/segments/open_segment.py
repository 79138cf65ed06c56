"""Reads a segment while another process writes it.

Its chunks follow one another, each with its message indexes and its arrival record behind it. A
chunk counts once its arrival record is in the file, and other records once an arrival record
proves them; what the writer has not finished yet is left out. The chunks become rows of a
`ChunkTable`, as those of a sealed segment are.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Metadata, MetadataIndex
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema as SchemaRecord

from hybridlog_storage.checksum import crc32
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import (
    MESSAGE_HEAD,
    RECORD_HEAD,
    Record,
    parse_content,
    read_record,
)
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.attachments import MAX_HEAD, parse_attachment
from hybridlog_storage.segments.chunk_table import CHUNK, OTHER, PART, ChunkTable, parts_of
from hybridlog_storage.segments.compression import FilePart
from hybridlog_storage.segments.segment_file import OPEN_SUFFIX, sealed_name
from hybridlog_storage.segments.segment_format import (
    ARRIVAL_OPCODE,
    CHUNK_HEAD,
    LOSSES_METADATA,
    MAGIC,
    OUR_NAMES,
    PADDING_OPCODE,
    PROOF,
    Proof,
    channel_of,
    compression_of,
    head_length,
    index_order,
    json_of,
    proof_of,
    split_trailer,
)
from hybridlog_storage.segments.segment_reader import (
    ChunkPlace,
    SegmentReader,
    check_arrivals,
    open_chunk,
)
from hybridlog_storage.segments.statements import loss_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Buffer

_WINDOW: Final = 4096  # bytes read at once around the heads of records
_MAX_RECORD: Final = 1 << 28  # bytes of what is read into memory as a whole
_MAX_TORN: Final = 1 << 20  # bytes looked at of a record that is not whole
_WRITING_S: Final = 0.02  # the time that a writer may take for the rest of a record
_LOOKS: Final = 5  # at what seems damaged, before it counts as damaged
_ARRIVALS_SIZE: Final = 96 + PROOF.size  # bytes of an arrival record without its numbers, at most
_CHUNK_HEAD_SIZE: Final = CHUNK_HEAD.size + 16  # with the longest name of a compression
_UNKNOWN: Final = np.iinfo(np.int64)  # publish times stand in the messages only
_TORN: Final = frozenset(
    {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX, Opcode.METADATA, Opcode.ATTACHMENT}
)
_HELD: Final = frozenset({Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.ATTACHMENT})
_PASSED: Final = frozenset({Opcode.HEADER, Opcode.METADATA_INDEX, PADDING_OPCODE})


class Flushed(NamedTuple):
    """Content of a segment at one moment, as the summary of a sealed one says it.

    Attributes:
        table: Its chunks.
        attachments: Attachments of the source, in file order.
        metadata: Metadata records of the source, in file order.
        reader: Reads its chunks.
    """

    table: ChunkTable
    attachments: Sequence[AttachmentIndex]
    metadata: Sequence[MetadataIndex]
    reader: SegmentReader


@dataclass(frozen=True, slots=True)
class Damage:
    """A flushed record that cannot be read.

    Attributes:
        offset: Byte of the file where it starts.
        length: Its bytes.
        reason: The damage.
    """

    offset: int
    length: int
    reason: str


class OpenSegment:
    """The content that a segment has at this moment.

    Args:
        recording: The recording's directory.
        number: Number of the segment; it may be sealed meanwhile.
        writing_s: How long to wait before a second look at what seems damaged.

    Attributes:
        number: Its number in the recording.
        reader: Reads its chunks.
        channels: Channels by id, as far as they are defined.
        losses: Rows of the loss ledger written so far.
        damaged: Chunks and other records that cannot be read.
        stopped: What is in place of the next record, if no writer leaves that; else None.
        end: Where the last arrival record ends; what is behind it is read again and again.

    Raises:
        SegmentError: It cannot be opened, or is no segment.
    """

    def __init__(self, recording: Path, number: int, *, writing_s: float = _WRITING_S) -> None:
        self.number = number
        self._writing_s = writing_s
        try:
            self.reader = SegmentReader(recording / f"{number:06d}{OPEN_SUFFIX}", number)
        except SegmentError:  # it may have been sealed just now
            self.reader = SegmentReader(recording / sealed_name(number), number)
        self._begin()

    def _begin(self) -> None:
        self.channels: dict[int, Channel] = {}
        self.losses: list[dict[str, Any]] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self.damaged: list[Damage] = []
        self.stopped: Damage | None = None
        self.end = len(MAGIC)
        self._damaged_before = 0  # of the damaged ones, those before `end`
        self._schemas: dict[int, SchemaRecord] = {}
        self._chunk: tuple[int, int] | None = None  # offset and length of the last chunk record
        self._chunks: list[tuple[int, ...]] = []
        self._head = self._last = b""  # heads of the last chunk record and of the last of them
        self._parts_so_far: list[NDArray[np.void]] = []
        self._others: list[tuple[int, int, int]] = []
        self._unproven: list[tuple[int, int, int]] = []  # opcode, start and length of records
        self._flushed: Flushed | None = None

    @property
    def flushed(self) -> Flushed:
        """Its content so far."""
        if self._flushed is None:
            parts = np.concatenate([np.empty(0, PART), *self._parts_so_far])
            self._parts_so_far = [parts]
            chunks, others = np.array(self._chunks, CHUNK), np.array(self._others, OTHER)
            table = ChunkTable(chunks, parts, others, is_flushed=True)
            self._flushed = Flushed(
                table, tuple(self._attachments), tuple(self._metadata), self.reader
            )
        return self._flushed

    def follow(self) -> bool:
        """Read what was flushed since, also if the segment was sealed meanwhile.

        A read beside a write may see a part of it, and zeros in place of the rest. So what
        seems damaged is looked at again, and counts only if it is still the same.

        Returns:
            True if there is anything new.

        Raises:
            SegmentError: The file cannot be read.
        """
        is_cut = self.is_cut()
        if is_cut:
            self._begin()
        before = self.end, self.stopped, len(self.damaged)
        known = len(self.damaged)
        self._read_on()
        for _ in range(_LOOKS):
            seen = list(self.damaged)
            if self.stopped is None and len(seen) <= known:
                break
            time.sleep(self._writing_s)
            if len(seen) > known:
                self._begin()
            self._read_on()
            if self.damaged == seen:
                break
        return is_cut or (self.end, self.stopped, len(self.damaged)) != before

    def next_seq(self) -> int:
        """One more than the greatest arrival number so far."""
        table, found = self.flushed.table, 0
        bounds = table.part_bounds().tolist()
        places = table.chunks[["offset", "length", "trailer"]].tolist()
        for number, (offset, length, size) in enumerate(places):
            count = int(table.parts["messages"][bounds[number] : bounds[number + 1]].sum())
            with suppress(SegmentError):
                trailer = self.reader.read(offset + length, size)
                found = max(found, int(check_arrivals(trailer, offset, count).max(initial=-1)) + 1)
        return found

    def is_cut(self) -> bool:
        """True if the writer took chunks back that were read, on a full disk."""
        self.reader.grow()
        if self.reader.size < self.end or not self._chunks:
            return self.reader.size < self.end
        return bytes(self.reader.read(self._chunks[-1][0], CHUNK_HEAD.size)) != self._last

    def _read_on(self) -> None:
        """Read the records behind the last arrival record.

        Nothing proves them before there is another one: a length may have been read beside the
        write of it.
        """
        self.reader.grow()
        self.stopped = self._chunk = None
        self._unproven.clear()
        del self.damaged[self._damaged_before :]
        size = self.reader.size
        window, start = memoryview(b""), 0
        at = self.end
        while at + RECORD_HEAD.size <= size:
            if at + CHUNK_HEAD.size > start + len(window):
                try:
                    start, window = at, self.reader.read(at, min(_WINDOW, size - at))
                except SegmentError:  # the writer has just cut the padding behind its last block
                    self.reader.grow()
                    if self.reader.size >= size:
                        raise
                    size = self.reader.size
                    continue
            opcode, length = RECORD_HEAD.unpack_from(window, at - start)
            behind = at + RECORD_HEAD.size + length
            try:
                if behind > size or not self._take(opcode, at, behind - at):
                    if not self._is_end(opcode, behind - at, at):
                        self.stopped = Damage(at, size - at, "there is no whole record")
                    break
            except SegmentError as error:
                self.damaged.append(Damage(at, behind - at, str(error)))
            else:
                if opcode == ARRIVAL_OPCODE:
                    self.end, self._damaged_before = behind, len(self.damaged)
            at = behind

    def _is_end(self, opcode: int, length: int, at: int) -> bool:
        """True if what is written ends so: with a part of a record, or room behind it.

        Args:
            opcode: Opcode of the next record.
            length: Its bytes.
            at: Byte of the file where it starts.
        """
        there = self.reader.size - at
        head = self.reader.read(at, min(there, _MAX_TORN))
        if opcode == 0:
            return not any(head)  # room behind the last block
        if length <= there:
            return opcode == Opcode.DATA_END  # the segment is being sealed
        if opcode == Opcode.CHUNK or there < _CHUNK_HEAD_SIZE:
            return there < _CHUNK_HEAD_SIZE or length == _chunk_length(head)
        if opcode == ARRIVAL_OPCODE and self._chunk is not None:
            return self._may_be_arrivals(at, length)
        try:
            is_whole = read_record(opcode, head[RECORD_HEAD.size :])[1] > 0
        except SegmentError:
            is_whole = False
        is_possible = length <= _MAX_TORN or opcode == Opcode.ATTACHMENT
        return opcode in _TORN and is_possible and not is_whole

    def _may_be_arrivals(self, at: int, length: int) -> bool:
        """True if an arrival record is not longer than message indexes allow."""
        assert self._chunk is not None
        indexes = at - sum(self._chunk)  # they have twice as many bytes for each message
        return length < _ARRIVALS_SIZE + indexes // 2

    def _check(self, opcode: int, at: int, length: int) -> None:
        """Check that a record fits what comes before it, and its own fields.

        Raises:
            SegmentError: It does not.
        """
        if self._chunk is not None and opcode not in {Opcode.MESSAGE_INDEX, ARRIVAL_OPCODE}:
            self.damaged.append(Damage(*self._chunk, "its arrival numbers are missing"))
            self._chunk = None
        elif opcode == ARRIVAL_OPCODE and self._chunk and not self._may_be_arrivals(at, length):
            raise SegmentError("the arrival numbers are too long")
        if opcode == Opcode.CHUNK and length > _CHUNK_HEAD_SIZE:
            self._head = bytes(self.reader.read(at, _CHUNK_HEAD_SIZE))
            if _chunk_length(self._head) != length:
                raise SegmentError("the lengths of a chunk contradict each other")

    def _take(self, opcode: int, at: int, length: int) -> bool:
        """Take a whole record; False for one that no open segment has."""
        self._check(opcode, at, length)
        if opcode == Opcode.CHUNK and length > _CHUNK_HEAD_SIZE:
            self._chunk = at, length
        elif opcode == Opcode.MESSAGE_INDEX and self._chunk is not None:
            pass  # read with the arrival numbers
        elif opcode == ARRIVAL_OPCODE and length > _MAX_RECORD:
            raise SegmentError("the arrival record is too large")
        elif opcode == ARRIVAL_OPCODE and self._chunk is not None:
            (offset, size), self._chunk = self._chunk, None
            if at > offset + size or proof_of(self._content(at, length)).chunk:
                self._add_chunk(offset, size, at, length)
            else:  # a chunk with definitions alone
                self._unproven.append((Opcode.CHUNK, offset, size))
                self._prove(proof_of(self._content(at, length)), at)
        elif opcode == ARRIVAL_OPCODE:
            self._prove(proof_of(self._content(at, length)), at)
        elif opcode in _HELD:
            self._unproven.append((opcode, at, length))
        else:
            return opcode in _PASSED
        return True

    def _prove(self, proof: Proof, end: int) -> None:
        """Compare the bytes before a chunk or an arrival record, and take the records in them."""
        start = end - proof.length
        records, self._unproven = self._unproven, []
        try:
            if start < 0 or self.reader.checksum(start, proof.length) != proof.before:
                raise SegmentError("definitions or metadata changed: their checksum differs")
        except SegmentError as error:
            self.damaged.append(Damage(max(start, 0), end - max(start, 0), str(error)))
            return
        for opcode, at, length in records:
            if at >= start:
                try:
                    self._take_record(opcode, at, length)
                except SegmentError as error:
                    self.damaged.append(Damage(at, length, str(error)))

    def _take_record(self, opcode: int, at: int, length: int) -> None:
        if opcode == Opcode.ATTACHMENT:
            self._add_attachment(at, length)
            return
        if length > _MAX_RECORD:
            raise SegmentError("the record is too large")
        if opcode == Opcode.CHUNK:
            content, _ = open_chunk(self.reader.read(at, length))
            for definition in parse_content(content).definitions:
                self._define(definition.record)
            return
        record, size = read_record(opcode, self._content(at, length))
        if size != length - RECORD_HEAD.size:
            raise SegmentError("the record is longer than its fields")
        if isinstance(record, Metadata):
            self._add_metadata(record, at, length)
        else:
            self._define(record)

    def _define(self, record: Record | None) -> None:
        if isinstance(record, SchemaRecord):
            self._schemas[record.id] = record
        elif isinstance(record, ChannelRecord):
            self.channels[record.id] = channel_of(record, self._schemas)

    def _content(self, at: int, length: int) -> memoryview:
        return self.reader.read(at + RECORD_HEAD.size, length - RECORD_HEAD.size)

    def _add_chunk(self, offset: int, length: int, arrivals: int, size: int) -> None:
        """Add a chunk; without messages, if its head or its arrival record is damaged.

        Args:
            offset: Byte of the chunk record.
            length: Its bytes.
            arrivals: Byte of the arrival record behind its message indexes.
            size: Bytes of the arrival record.
        """
        trailer = arrivals + size - offset - length
        parts, crc, trailer_crc = np.empty(0, PART), 0, 0
        try:
            if trailer > _MAX_RECORD:
                raise SegmentError("the message indexes are too large")
            behind = self.reader.read(offset + length, trailer)
            proof = proof_of(behind[trailer - size + RECORD_HEAD.size :])
            if proof.chunk != offset:
                raise SegmentError("its arrival record belongs to another chunk")
            self._prove(proof, offset)
            if crc32(self._head[: head_length(self._head)]) != proof.head:
                raise SegmentError("its head changed: its checksum differs")
            crc, trailer_crc = proof.record, crc32(behind[trailer - size :], proof.indexes)
            parts = self._parts(offset, length, behind, crc, trailer_crc)
        except SegmentError as error:
            self.damaged.append(Damage(offset, length, str(error)))
        is_known = np.isin(parts["channel"], list(self.channels))
        if not is_known.all():
            parts = parts[is_known]
            self.damaged.append(Damage(offset, length, "a channel is not defined"))
        first, last = (parts["first"].min(), parts["last"].max()) if len(parts) else (0, 0)
        row = (offset, length, trailer, crc, trailer_crc, first, last, len(parts))
        self._chunks.append(row)
        self._parts_so_far.append(parts)
        self._last = self._head[: CHUNK_HEAD.size]
        self._flushed = None

    def _parts(
        self, offset: int, length: int, trailer: memoryview, crc: int, trailer_crc: int
    ) -> NDArray[np.void]:
        """Statistics of each channel in a chunk; by its messages if its indexes are damaged."""
        if crc32(trailer) == trailer_crc:
            return _parts_by_index(trailer, CHUNK_HEAD.unpack_from(self._head)[4])
        place = ChunkPlace(
            number=len(self._chunks),
            offset=offset,
            length=length,
            trailer=len(trailer),
            first=0,
            last=0,
            channels=(),
            crc=crc,
            trailer_crc=trailer_crc,
        )
        batch = self.reader.read_chunk(place).batch
        return parts_of(batch, index_order(batch.channel, batch.log_time))[0]

    def _add_metadata(self, record: Metadata, at: int, length: int) -> None:
        if record.name == LOSSES_METADATA:
            self.losses += loss_rows(json_of(record))
        elif not record.name.startswith(OUR_NAMES):
            self._metadata.append(MetadataIndex(offset=at, length=length, name=record.name))
            self._add_other(at, length)

    def _add_attachment(self, at: int, length: int) -> None:
        head = self._content(at, min(length, MAX_HEAD))
        start, size = at + RECORD_HEAD.size, length - RECORD_HEAD.size
        with self.reader.stream() as file:
            found, _ = parse_attachment(head, FilePart(file, start, size), check_crc=False)
        self._attachments.append(found.index(at, length))
        self._add_other(at, length)

    def _add_other(self, at: int, length: int) -> None:
        self._others.append((at, length, self.reader.checksum(at, length)))
        self._flushed = None


def _parts_by_index(trailer: memoryview, size: int) -> NDArray[np.void]:
    """Statistics of each channel in a chunk, from its checked message indexes.

    Returns:
        `PART`[c], by channel id.
    """
    indexes, _ = split_trailer(trailer)
    times = [rows["log_time"].astype(np.int64) for _, rows in indexes]
    starts = np.concatenate([rows["offset"] for _, rows in indexes]).astype(np.int64)
    counts = np.array([len(rows) for _, rows in indexes])
    order = np.argsort(starts, kind="stable")
    sizes = np.empty(len(starts), np.int64)
    sizes[order] = np.diff(starts[order], append=size) - MESSAGE_HEAD.itemsize
    parts = np.empty(len(indexes), PART)
    parts["channel"], parts["messages"] = [channel for channel, _ in indexes], counts
    parts["payload_bytes"] = np.add.reduceat(sizes, np.cumsum(counts) - counts)
    parts["first"], parts["last"] = [t[0] for t in times], [t[-1] for t in times]
    parts["first_publish"], parts["last_publish"] = _UNKNOWN.min, _UNKNOWN.max
    return parts


def _chunk_length(head: Buffer) -> int:
    """Bytes of a chunk record, by the length of its content; -1 if the head is damaged."""
    try:
        return head_length(head) + compression_of(head)[1]
    except struct.error:
        return -1


def next_seq_in(recording: Path, numbers: Iterable[int]) -> int:
    """One more than the greatest arrival number in some segments of a recording."""
    found = 0
    for number in numbers:
        with suppress(SegmentError):
            segment = OpenSegment(recording, number, writing_s=0)
            segment.follow()
            found = max(found, segment.next_seq())
    return found
