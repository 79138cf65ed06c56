"""Sealing what a crash left open.

A segment that was being written when its recorder died ends somewhere, perhaps in the
middle of a record. Everything before that is kept: the file is cut behind its last
whole record, what is missing of the last chunk's indexes is written again from the
chunk itself, and the segment is sealed like any other.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.records import Attachment, DataEnd, Header, MessageIndex, Metadata
from mcap.records import Channel as ChannelRecord
from mcap.records import Schema as SchemaRecord

from hybridlog_storage import durability
from hybridlog_storage.append_file import BLOCK, AppendFile
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap_content import MESSAGE_HEAD, RECORD_HEAD
from hybridlog_storage.mcap_scan import (
    PrivateRecord,
    ScanDamage,
    ScannedChunk,
    parse_content,
    scan,
)
from hybridlog_storage.messages import Batch, Schema
from hybridlog_storage.segment_file import OPEN_SUFFIX, SegmentFile
from hybridlog_storage.segment_format import (
    ARRIVAL_OPCODE,
    END_METADATA,
    RECORDING_METADATA,
    ChunkSummary,
    arrival_record,
    arrivals_of,
    channel_of,
    json_metadata,
    json_of,
    message_indexes,
    pack_arrivals,
)
from hybridlog_storage.segment_reader import check_format


@dataclass(slots=True)
class Recovered:
    """What became of an open segment.

    Attributes:
        path: The sealed file, None when nothing at all was in it (it is removed then).
        messages: Messages kept.
        cut_bytes: Bytes cut from the end.
        damage: What inside the file could not be read, in words.
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
    ScannedChunk,
    SchemaRecord,
)


@dataclass(slots=True)
class _Pending:
    """The last chunk, while the records that belong to it are still to come."""

    scanned: ScannedChunk
    batch: Batch
    indexes: dict[int, int]


class _Rebuilder:
    """Follows the records of an open segment and remembers what a writer would have."""

    def __init__(self, segment: SegmentFile, damage: list[str]) -> None:
        self.segment = segment
        self.good_end = 0
        self.messages = 0
        self.next_seq = 0
        self.has_recording = False
        self.has_end = False  # the recorder had written all, and only the summary is missing
        self.pending: _Pending | None = None
        self._schemas: dict[int, SchemaRecord] = {}
        self._damage = damage

    def take(self, offset: int, item: object, end: int) -> None:
        if isinstance(item, ScanDamage):
            self._damage.append(f"byte {item.offset}: {item.reason}")
        if not isinstance(item, _RECORDS):
            return
        if isinstance(item, SchemaRecord):
            self._schemas[item.id] = item
            # The crash may have come before the channel that it was written for.
            schema = Schema(item.name, item.encoding, bytes(item.data))
            self.segment.schemas.setdefault(item.id, schema)
        elif isinstance(item, ChannelRecord):
            channel = channel_of(item, self._schemas)
            self.segment.define(item.id, item.schema_id, channel, write=False)
        elif isinstance(item, Metadata):
            if item.name == RECORDING_METADATA:
                recording = json_of(item)
                check_format(recording, self.segment.path)
                started = recording.get("next_seq")
                self.next_seq = started if isinstance(started, int) else 0
                self.has_recording = True
            self.has_end |= item.name == END_METADATA
            self.segment.note_metadata(item.name, offset, end - offset)
        elif isinstance(item, Attachment):
            self.segment.note_attachment(item, offset, end - offset)
        elif isinstance(item, ScannedChunk):
            self._take_chunk(item)
        elif isinstance(item, MessageIndex) and self.pending is not None:
            self.pending.indexes[item.channel_id] = end - offset
        elif isinstance(item, PrivateRecord) and item.opcode == ARRIVAL_OPCODE:
            self._take_arrivals(item)
        self.good_end = end

    def _take_chunk(self, item: ScannedChunk) -> None:
        if self.pending is not None:
            place = self.pending.scanned.offset
            self._damage.append(f"chunk at byte {place}: its arrival numbers are missing")
        try:
            batch = parse_content(item.content_bytes()).batch
        except SegmentError as error:
            self._damage.append(f"chunk at byte {item.offset}: {error}")
            return
        self.pending = _Pending(item, batch, {})

    def _take_arrivals(self, item: PrivateRecord) -> None:
        pending, self.pending = self.pending, None
        if pending is None:
            return
        try:
            _, seq = arrivals_of(item.data, len(pending.batch))
        except SegmentError as error:
            self._damage.append(f"chunk at byte {pending.scanned.offset}: {error}")
            return
        self.next_seq = max(self.next_seq, int(seq.max()) + 1)
        self._note(pending)

    def finish_torn(self) -> None:
        """Complete the last chunk when the crash came between it and its indexes."""
        pending, self.pending = self.pending, None
        if pending is None:
            return
        chunk, batch = pending.scanned, pending.batch
        seq = np.arange(self.next_seq, self.next_seq + len(batch), dtype=np.int64)
        indexes = message_indexes(
            batch.channel, batch.log_time, batch.offset - MESSAGE_HEAD.itemsize
        )
        self.segment.cut(chunk.offset + chunk.length)
        self.segment.append_trailer(indexes, arrival_record(chunk.offset, pack_arrivals(seq)))
        pending.indexes = {channel: len(data) for channel, data in indexes.items()}
        self._note(pending)

    def _note(self, pending: _Pending) -> None:
        chunk = pending.scanned
        self.messages += len(pending.batch)
        log_time = pending.batch.log_time
        ids, counts = np.unique(pending.batch.channel, return_counts=True)
        summary = ChunkSummary(
            first=int(log_time.min()),
            last=int(log_time.max()),
            offset=chunk.offset,
            length=chunk.length,
            indexes=pending.indexes,
            compression=chunk.compression,
            compressed_size=len(chunk.data),
            uncompressed_size=chunk.uncompressed_size,
        )
        self.segment.note_chunk(summary, dict(zip(ids.tolist(), counts.tolist(), strict=True)))


def recover_segment(path: Path) -> Recovered:
    """Cut, complete and seal one open segment.

    Args:
        path: A file whose name ends in `.mcap.open`, which nobody is writing.

    Raises:
        StoreError: it cannot be written, or is of a newer format.
        DiskFullError: no room for the summary; the file stays as it was.
    """
    number = int(path.name.removesuffix(OPEN_SUFFIX))
    damage: list[str] = []
    try:
        segment = SegmentFile(path, number, AppendFile.reopen(path))
    except OSError as error:
        raise durability.explain(error, path, "recovering") from error
    size = segment.position
    rebuilder = _Rebuilder(segment, damage)
    try:
        with path.open("rb") as file:
            fd = file.fileno()
            for offset, item in scan(file, size=size):
                if isinstance(item, ScanDamage) and _is_padding(fd, item.offset, size):
                    size = item.offset
                    continue
                if isinstance(item, DataEnd):
                    break  # behind it is a summary, whole or not, which is made anew
                if isinstance(item, ScannedChunk):
                    end = offset + item.length
                else:
                    end = _record_end(fd, offset)
                rebuilder.take(offset, item, end)
        if not rebuilder.has_recording:
            segment.abandon()
            path.unlink()
            durability.sync_directory(path.parent)
            return Recovered(None, cut_bytes=size, damage=damage)
        cut_bytes = size - rebuilder.good_end
        segment.cut(rebuilder.good_end)
        rebuilder.finish_torn()
    except OSError as error:
        segment.abandon()
        raise durability.explain(error, path, "recovering") from error
    if damage or not rebuilder.has_end:
        end_note = {"status": "recovered", "cut_bytes": cut_bytes, "damage": damage}
        segment.add_metadata(json_metadata(END_METADATA, end_note))
    sealed = segment.seal()
    return Recovered(sealed, rebuilder.messages, cut_bytes, damage)


def _is_padding(fd: int, offset: int, size: int) -> bool:
    """Whether nothing follows but what fills the last block of an `AppendFile`."""
    return size - offset < BLOCK and not any(os.pread(fd, size - offset, offset))


def _record_end(fd: int, offset: int) -> int:
    """Where the record that starts at `offset` ends, by its own length field."""
    head = os.pread(fd, RECORD_HEAD.size, offset)
    if len(head) < RECORD_HEAD.size:
        return offset
    return offset + RECORD_HEAD.size + int(RECORD_HEAD.unpack(head)[1])
