"""Recovers and seals segments that a crash left open.

Such a segment may end in the middle of a record. Recovery cuts the file behind the last
arrival record, which proves what stands before it. It rebuilds missing indexes of the last
chunk from its content, and seals the segment. A complete segment without its final name only
gets that name.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np
from mcap.records import Channel as ChannelRecord
from mcap.records import DataEnd, Header, MessageIndex, Metadata
from mcap.records import Schema as SchemaRecord

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.append_file import BLOCK, AppendFile
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.mcap.mcap_content import RECORD_HEAD
from hybridlog_storage.mcap.mcap_scan import (
    Item,
    PrivateRecord,
    ScanDamage,
    ScannedChunk,
    parse_content,
    scan,
)
from hybridlog_storage.messages import Batch, Schema
from hybridlog_storage.segments.attachments import Attachment
from hybridlog_storage.segments.chunk_table import parts_of
from hybridlog_storage.segments.segment_check import damaged_pieces
from hybridlog_storage.segments.segment_file import (
    OPEN_SUFFIX,
    OnSealing,
    Sealed,
    SegmentFile,
    sealed_channels,
    sealed_name,
)
from hybridlog_storage.segments.segment_format import (
    ARRIVAL_OPCODE,
    END_METADATA,
    LOSSES_METADATA,
    MAGIC,
    PROOF,
    RECORDING_METADATA,
    ChunkSummary,
    Proof,
    arrival_record,
    channel_of,
    group_of,
    index_order,
    json_metadata,
    json_of,
    pack_arrivals,
    proof_of,
)
from hybridlog_storage.segments.segment_reader import (
    SegmentReader,
    check_arrivals,
    check_format,
    indexes_of,
    right_head,
)
from hybridlog_storage.segments.statements import loss_rows

if TYPE_CHECKING:
    from hybridlog_storage.segments.segment_reader import SegmentSummary

_PIECE = 1 << 20  # bytes read at once for a checksum


@dataclass(slots=True)
class Recovered:
    """The result of recovering an open segment.

    Attributes:
        path: The sealed file, None for an empty one, which is removed.
        messages: Recovered messages.
        cut_bytes: Bytes of records cut from the end, without an incomplete summary.
        damage: Descriptions of unreadable parts.
    """

    path: Path | None
    messages: int = 0
    cut_bytes: int = 0
    damage: list[str] = field(default_factory=list)


_RECORDS = (
    Attachment,
    ChannelRecord,
    Header,
    MessageIndex,
    Metadata,
    PrivateRecord,
    SchemaRecord,
)


@dataclass(slots=True)
class _Whole:
    """A chunk with valid content.

    Attributes:
        scanned: The record.
        batch: Its messages.
        head: The correct head of the record.
        indexes: The correct message indexes, by channel id.
    """

    scanned: ScannedChunk
    batch: Batch
    head: bytes
    indexes: dict[int, bytes]

    @property
    def place(self) -> str:
        return f"chunk at byte {self.scanned.offset}"

    @property
    def end(self) -> int:
        return self.scanned.offset + self.scanned.length


class _DamagedError(SegmentError):
    """A record contradicts its content."""


class _Rebuilder:
    """Reads the records of an open segment and rebuilds its writer's state."""

    def __init__(self, segment: SegmentFile, fd: int, damage: list[str]) -> None:
        self.segment = segment
        self.good_end = 0
        self.messages = 0
        self.has_recording = False
        self.has_end = False  # the recorder had written everything, and only the summary is missing
        self.is_empty = True  # no chunk or attachment was found, whole or not
        self.resume: int | None = None  # start of the record behind the last chunk
        self._next_seq = 0
        self._torn: _Whole | None = None  # the last chunk, while only its trailer may be incomplete
        self._why_torn = ""
        self._last_chunk = 0  # its start
        self._unproven: list[tuple[int, Item, int]] = []  # start and end of records
        self._proven = 0  # byte up to which records outside of chunks were checked
        self._fd = fd
        self._size = segment.position
        self._schemas: dict[int, SchemaRecord] = {}
        self._damage = damage
        self._take_magic()

    def _take_magic(self) -> None:
        found = os.pread(self._fd, len(MAGIC), 0)
        if len(found) < len(MAGIC):
            return
        if found != MAGIC:
            self._damage.append("byte 0: the file did not start as an MCAP file, and is mended")
            self.segment.rewrite(0, MAGIC)
        self.segment.table.other(MAGIC)
        self.good_end = len(MAGIC)

    def take(self, offset: int, item: Item) -> None:
        """Process the next item of a scan."""
        behind = offset + 1
        if isinstance(item, ScanDamage):
            behind = self._size if item.length is None else offset + item.length
        if behind <= self.segment.table.end:
            return  # it lies in the trailer of a chunk, which was checked as a whole
        if isinstance(item, ScanDamage):
            self._damage.append(f"byte {item.offset}: {item.reason}")
        elif isinstance(item, ScannedChunk):
            self._drop_torn()
            self.is_empty = False
            self.good_end = offset + item.length
            self._last_chunk = offset
            self._take_chunk(item)
        elif isinstance(item, _RECORDS):
            end = _record_end(self._fd, offset)
            if self._torn is not None and _is_of_chunk(item):
                self.good_end = end
                return
            self._drop_torn()
            if isinstance(item, PrivateRecord) and item.opcode == ARRIVAL_OPCODE:
                self._take_proof(offset, end)
            else:
                self._unproven.append((offset, item, end))

    def _take_proof(self, offset: int, end: int) -> None:
        """Take an arrival record that follows no listed chunk."""
        self.good_end = end
        try:
            proof = proof_of(os.pread(self._fd, end - offset, offset)[RECORD_HEAD.size :])
        except SegmentError as error:
            self._damage.append(f"byte {offset}: {error}")
            return
        if proof.chunk not in {0, self._last_chunk}:
            self._damage.append(f"chunk at byte {proof.chunk}: its head is damaged")
        self._prove(proof, proof.chunk or offset)
        if not proof.chunk:
            self._cover(offset)
            self.segment.table.proof(os.pread(self._fd, end - offset, offset))

    def _prove(self, proof: Proof, end: int) -> None:
        """Check the bytes before a chunk or an arrival record, and take the records in them."""
        start = end - proof.length
        if end <= self._proven:
            return  # the chunk was taken, and not listed
        self._proven = end
        if start >= 0 and _crc_of(self._fd, start, proof.length) == proof.before:
            self._take_records(start)
            return
        self._unproven = []
        self._damage.append(f"byte {start}: {proof.length} bytes before byte {end} changed")

    def _take_records(self, start: int = 0) -> None:
        """Take the records since a byte; those before it cannot be checked."""
        records, self._unproven = self._unproven, []
        for offset, item, end in records:
            try:
                if offset < start and not _is_of_chunk(item):
                    raise _DamagedError("its checksum is lost")
                self._take_record(offset, item, end)
            except _DamagedError as error:
                self._damage.append(f"byte {offset}: {error}")

    def _drop_torn(self) -> None:
        """Drop a chunk without arrival numbers that is followed by a whole record."""
        if self._torn is not None:
            reason = self._why_torn or "its arrival numbers are missing"
            self._damage.append(f"{self._torn.place}: {reason}")
            self._torn = None
            self._take_records()

    def _take_record(self, offset: int, item: Item, end: int) -> None:
        length = end - offset
        if isinstance(item, ScannedChunk):
            for definition in parse_content(item.content_bytes()).definitions:
                self._define(definition.record)
        elif isinstance(item, Metadata):
            self._take_metadata(item)
            self.segment.note_metadata(item.name, offset, length)
        else:
            self._define(item)
        self._cover(offset)
        if isinstance(item, Attachment):
            self.is_empty = False
            self.segment.note_attachment(item, offset, length)
            self.segment.table.stretch(length, _crc_of(self._fd, offset, length))
            return
        record = os.pread(self._fd, length, offset)
        self.segment.table.other(record, alone=isinstance(item, Metadata))

    def _define(self, item: object) -> None:
        if isinstance(item, SchemaRecord):
            self._schemas[item.id] = item
            # The crash may have come before its channel was written.
            schema = Schema(item.name, item.encoding, bytes(item.data))
            self.segment.schemas.setdefault(item.id, schema)
        elif isinstance(item, ChannelRecord):
            try:
                channel = channel_of(item, self._schemas)
            except SegmentError as error:
                raise _DamagedError(str(error)) from error
            self.segment.define([(item.id, item.schema_id, channel)], write=False)

    def _take_metadata(self, item: Metadata) -> None:
        if item.name not in {RECORDING_METADATA, END_METADATA, LOSSES_METADATA}:
            return
        try:
            value = json_of(item)
            if item.name == LOSSES_METADATA:
                loss_rows(value)
        except SegmentError as error:
            raise _DamagedError(str(error)) from error
        if item.name == RECORDING_METADATA:
            check_format(value, self.segment.path)
            started = value.get("next_seq")
            self._next_seq = max(self._next_seq, started if isinstance(started, int) else 0)
            self.segment.group = group_of(value, self.segment.number)
            self.has_recording = True
        self.has_end |= item.name == END_METADATA

    def _cover(self, end: int) -> None:
        """Add bytes up to `end` that belong to no record."""
        start = self.segment.table.end
        if end > start:
            self.segment.table.stretch(end - start, _crc_of(self._fd, start, end - start))

    def _take_chunk(self, item: ScannedChunk) -> None:
        try:
            chunk = self._whole(item)
            if chunk is None:
                self._unproven.append((item.offset, item, item.offset + item.length))
                return
        except SegmentError as error:
            self._damage.append(f"chunk at byte {item.offset}: {error}")
            return
        indexes = b"".join(chunk.indexes.values())
        trailer = self._trailer(chunk.end, len(indexes))
        try:
            seq = check_arrivals(indexes + trailer[len(indexes) :], item.offset, len(chunk.batch))
        except SegmentError as error:
            self._torn, self._why_torn = chunk, str(error) if trailer else ""
            return
        proof: Proof | None = None
        try:
            proof = proof_of(trailer[len(indexes) + RECORD_HEAD.size :])
            self._prove(proof, item.offset)
        except SegmentError:  # it is mended below
            self._take_records()
        if not self._is_defined(chunk):
            return
        self._mend_head(chunk)
        if trailer[: len(indexes)] != indexes:
            self._damage.append(f"{chunk.place}: its message indexes were damaged, and are mended")
            self.segment.rewrite(chunk.end, indexes)
        record = trailer[len(indexes) :]
        right = self._arrivals(chunk, record[RECORD_HEAD.size + PROOF.size :], proof)
        if right != record:
            self._damage.append(f"{chunk.place}: its checksums were damaged, and are mended")
            self.segment.rewrite(chunk.end + len(indexes), right)
        self._note(chunk, len(trailer), int(seq.max()))

    def _is_defined(self, chunk: _Whole) -> bool:
        lost = set(chunk.batch.channel.tolist()) - self.segment.channels.keys()
        if lost:
            self._damage.append(f"{chunk.place}: the definition of its channel {min(lost)} is lost")
        return not lost

    def _arrivals(self, chunk: _Whole, packed: bytes, proof: Proof | None = None) -> bytes:
        """The arrival record of a chunk whose head is right.

        Args:
            chunk: The chunk.
            packed: Its arrival numbers.
            proof: What its arrival record says of the bytes before it; None if it is damaged.
        """
        offset, length = chunk.scanned.offset, chunk.scanned.length
        self._cover(offset)
        proof = proof or Proof(offset, *self.segment.table.unproven)
        right = proof._replace(
            head=crc32(chunk.head),
            record=_crc_of(self._fd, offset, length),
            indexes=crc32(b"".join(chunk.indexes.values())),
        )
        return arrival_record(right, packed)

    def _whole(self, item: ScannedChunk) -> _Whole | None:
        """The chunk, after checking its content; None for one with definitions alone."""
        content = item.content_bytes(check_crc=False)
        if item.uncompressed_crc != crc32(content):
            raise SegmentError("its checksum differs")
        parsed = parse_content(content)
        batch = parsed.batch
        if not len(batch) and parsed.definitions:
            return None
        if not len(batch):
            raise SegmentError("it holds no message")
        head = right_head(
            batch, len(content), item.uncompressed_crc, item.compression, len(item.part)
        )
        if item.length != len(head) + len(item.part):
            raise SegmentError("the length of its record is wrong")
        return _Whole(item, batch, head, indexes_of(batch))

    def _mend_head(self, chunk: _Whole) -> None:
        if os.pread(self._fd, len(chunk.head), chunk.scanned.offset) != chunk.head:
            self._damage.append(f"{chunk.place}: its head was damaged, and is mended")
            self.segment.rewrite(chunk.scanned.offset, chunk.head)

    def _trailer(self, start: int, indexes: int) -> bytes:
        """Bytes at the position of a chunk's trailer; empty if it cannot be complete."""
        head = os.pread(self._fd, RECORD_HEAD.size, start + indexes)
        if len(head) < RECORD_HEAD.size:
            return b""
        opcode, length = RECORD_HEAD.unpack_from(head)
        size = indexes + RECORD_HEAD.size + length
        if opcode != ARRIVAL_OPCODE or start + size > self._size:
            return b""
        return os.pread(self._fd, size, start)

    def finish(self, other_seq: Callable[[int], int]) -> None:
        """Cut incomplete records; rebuild the last chunk's trailer if only that is incomplete."""
        chunk, self._torn = self._torn, None
        if chunk is not None:
            if self._why_torn:
                self._damage.append(f"{chunk.place}: {self._why_torn}, and are made anew")
            self._take_records()
        if chunk is None or not self._is_defined(chunk):
            self.segment.cut(self.good_end)
            self._cover(self.good_end)
            return
        count = len(chunk.batch)
        # Those of other segments of the group may be greater than its own.
        start = max(self._next_seq, other_seq(self.segment.group))
        seq = np.arange(start, start + count, dtype=np.int64)
        self.segment.cut(chunk.end)
        self._mend_head(chunk)
        arrivals = self._arrivals(chunk, pack_arrivals(seq))
        trailer = b"".join((*chunk.indexes.values(), arrivals))
        self.segment.append_trailer(trailer)
        self._note(chunk, len(trailer), int(seq.max()))

    def _note(self, chunk: _Whole, trailer: int, last_seq: int) -> None:
        scanned, batch = chunk.scanned, chunk.batch
        self._cover(scanned.offset)
        parts, first, last = parts_of(batch, index_order(batch.channel, batch.log_time))
        self.segment.note_chunk(
            ChunkSummary(
                first=first,
                last=last,
                offset=scanned.offset,
                length=scanned.length,
                indexes={channel: len(index) for channel, index in chunk.indexes.items()},
                compression=scanned.compression,
                compressed_size=len(scanned.part),
                uncompressed_size=scanned.uncompressed_size,
            ),
            parts,
            trailer=trailer,
            crc=_crc_of(self._fd, scanned.offset, scanned.length),
            trailer_crc=_crc_of(self._fd, chunk.end, trailer),
        )
        self.messages += len(batch)
        self._next_seq = max(self._next_seq, last_seq + 1)
        self.good_end = self.resume = chunk.end + trailer


def recover_segment(
    path: Path,
    on_sealing: OnSealing | None = None,
    *,
    recording: Mapping[str, object] | None = None,
    other_seq: Callable[[int], int] = lambda _: 0,
) -> Recovered:
    """Cut, complete and seal one open segment.

    Args:
        path: A file whose name ends in `.mcap.open`, without a writer.
        on_sealing: Called when the segment is complete and on the disk, before it gets its
            final name. If it fails, the file stays, and this can be called again.
        recording: Catalog entry of the recording, for a segment whose own is damaged.
        other_seq: Returns one more than the greatest arrival number in the other segments of a
            group; called if a chunk has lost its own.

    Raises:
        StoreError: It cannot be written, has another format, or is sealed already under its
            final name. The file is unchanged.
        DiskFullError: No room for the summary; all whole records stay.
    """
    on_sealed = on_sealing or (lambda _: None)
    number = int(path.name.removesuffix(OPEN_SUFFIX))
    final = path.with_name(sealed_name(number))
    try:
        with suppress(FileNotFoundError):
            files.status(final)
            raise StoreError(
                f"{final} is sealed, and {path} lies beside it. Move one of them out of the store."
            )
        found = _complete(path, number)
        if found is None:
            return _rebuild(path, number, on_sealed, recording, other_seq)
        on_sealed(found)
        durability.publish(path, final)
        return Recovered(final, sum(channel.messages for channel in found.channels))
    except OSError as error:
        raise durability.explain(error, path, "recovering") from error


def _complete(path: Path, number: int) -> Sealed | None:
    """Check a segment that may lack only its final name, and force it to the disk.

    Returns:
        None if a part is missing or damaged.
    """
    file = AppendFile.reopen(path)
    try:
        summary = _proven_summary(path, number)
        if summary is None:
            return None
        if summary.size < file.position:
            file.cut(summary.size)
        file.sync()
        digest = file.digest()
    finally:
        file.close()
    channels = sealed_channels(summary.table, summary.channels)
    group, has_losses = group_of(summary.recording, number), bool(summary.losses)
    name = sealed_name(number)
    return Sealed(number, name, summary.size, digest, channels, group, has_losses)


def _proven_summary(path: Path, number: int) -> SegmentSummary | None:
    """The summary of an open segment, if every byte matches its checksums."""
    with SegmentReader(path, number) as reader:
        # Zeros that fill the last block of a direct write do not belong to the segment.
        last = min(reader.size, BLOCK)
        reader.size -= last - len(bytes(reader.read(reader.size - last, last)).rstrip(b"\0"))
        try:
            summary = reader.summary()
        except SegmentError:
            return None
        return None if any(damaged_pieces(reader, summary.table)) else summary


def _rebuild(
    path: Path,
    number: int,
    on_sealed: OnSealing,
    recording: Mapping[str, object] | None,
    other_seq: Callable[[int], int],
) -> Recovered:
    """Seal a segment with its readable records."""
    damage: list[str] = []
    segment = SegmentFile(path, number, AppendFile.reopen(path))
    try:
        with os.fdopen(files.open_file(path, os.O_RDONLY), "rb") as file:
            rebuilder = _Rebuilder(segment, file.fileno(), damage)
            end = _follow(file, segment.position, rebuilder)
            if not rebuilder.has_recording and rebuilder.is_empty:
                segment.abandon()
                files.unlink(path)
                files.sync_folder(path.parent)
                return Recovered(None, cut_bytes=end, damage=damage)
            if not rebuilder.has_recording and recording is None:
                raise SegmentError(
                    f"{path} was left open, and what it says of its recording is damaged. "
                    "Move it out of the store, and see what is left with `mcap recover`."
                )
            cut_bytes = end - rebuilder.good_end
            rebuilder.finish(other_seq)
        if not rebuilder.has_recording:
            segment.add_recording(recording or {})
        if damage or not rebuilder.has_end:
            end_note = {"status": "recovered", "cut_bytes": cut_bytes, "damage": damage}
            segment.add_metadata(json_metadata(END_METADATA, end_note))
        sealed = segment.seal(sync=True, on_sealing=on_sealed)
    finally:
        segment.abandon()
    return Recovered(sealed, rebuilder.messages, cut_bytes, damage)


def rebuild_summary(path: Path, digest: str) -> bool:
    """Rebuild the damaged summary of a sealed segment, if its digest comes out unchanged.

    The summary is a function of the data before it. It is rebuilt in a copy, which replaces
    the segment only if it has the original digest.

    Returns:
        Whether the segment was repaired; otherwise it is unchanged.

    Raises:
        StoreError: It cannot be read, or the copy cannot be written.
        DiskFullError: No room for the copy.
    """
    number = int(path.name.partition(".")[0])
    copy = path.with_name(f".{path.name}.rebuilt")
    try:
        _copy(path, copy)
        try:
            if not _is_rebuilt(copy, number, digest):
                return False
            durability.publish(copy, path)
            return True
        finally:
            with suppress(FileNotFoundError):
                files.unlink(copy)
    except OSError as error:
        raise durability.explain(error, path, "rebuilding") from error


def _is_rebuilt(path: Path, number: int, digest: str) -> bool:
    """Rebuild the end of a copy of a segment; return whether its digest is right."""
    damage: list[str] = []
    segment = SegmentFile(path, number, AppendFile.reopen(path))
    try:
        with os.fdopen(files.open_file(path, os.O_RDONLY), "rb") as file:
            rebuilder = _Rebuilder(segment, file.fileno(), damage)
            _follow(file, segment.position, rebuilder)
            if damage or not rebuilder.has_recording:
                return False
            rebuilder.finish(lambda _: 0)
        if segment.complete().digest != digest:
            return False
        segment.sync()
    finally:
        segment.abandon()
    with SegmentReader(path, number) as reader:
        return not any(damaged_pieces(reader, reader.summary().table))


def _copy(source: Path, target: Path) -> None:
    fd = files.open_file(source, os.O_RDONLY)
    try:
        out = files.open_file(target, os.O_RDWR | os.O_CREAT | os.O_TRUNC)
        try:
            while piece := os.read(fd, 8 << 20):
                durability.write_all(out, [piece])
        finally:
            os.close(out)
    finally:
        os.close(fd)


def _follow(file: BinaryIO, size: int, rebuilder: _Rebuilder) -> int:
    """Pass every record to a rebuilder; return the byte where the data ends.

    If a damaged record behind a chunk misleads the scan, it restarts at the position of
    the next record.
    """
    start: int | None = len(MAGIC)
    while start is not None:
        first, start = start, None
        for offset, item in scan(file, size=size, start=first):
            if rebuilder.resume is not None and offset >= rebuilder.resume:
                expected, rebuilder.resume = rebuilder.resume, None
                if offset > expected:
                    start = expected
                    break
            if isinstance(item, ScanDamage) and _is_padding(file.fileno(), item.offset, size):
                size = item.offset
            elif isinstance(item, DataEnd):
                return offset  # a summary follows, whole or not, which is rebuilt
            else:
                rebuilder.take(offset, item)
    return size


def _is_of_chunk(item: Item) -> bool:
    """True if a record belongs to the chunk before it."""
    is_arrivals = isinstance(item, PrivateRecord) and item.opcode == ARRIVAL_OPCODE
    return is_arrivals or isinstance(item, MessageIndex)


def _is_padding(fd: int, offset: int, size: int) -> bool:
    """True if only the zeros that fill the last block of an `AppendFile` follow."""
    return size - offset < BLOCK and not any(os.pread(fd, size - offset, offset))


def _record_end(fd: int, offset: int) -> int:
    """End of the record at `offset`, by its length field."""
    head = os.pread(fd, RECORD_HEAD.size, offset)
    if len(head) < RECORD_HEAD.size:
        return offset
    return offset + RECORD_HEAD.size + int(RECORD_HEAD.unpack(head)[1])


def _crc_of(fd: int, offset: int, length: int) -> int:
    """CRC-32 of a range of bytes of a file."""
    crc = 0
    while length > 0:
        piece = os.pread(fd, min(length, _PIECE), offset)
        if not piece:
            raise OSError(0, "it has become shorter")
        crc = crc32(piece, crc)
        offset += len(piece)
        length -= len(piece)
    return crc
