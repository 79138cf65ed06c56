"""One segment as a file: whole records are appended, a summary seals it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from hybridlog_storage import durability
from hybridlog_storage.append_file import AppendFile
from hybridlog_storage.checksum import crc32
from hybridlog_storage.chunk import PackedChunk, StoredChunk
from hybridlog_storage.mcap_content import RECORD_HEAD
from hybridlog_storage.segment_format import (
    FORMAT_VERSION,
    LIBRARY,
    MAGIC,
    PROFILE,
    RECORDING_METADATA,
    ChunkSummary,
    arrival_record,
    channel_record,
    chunk_head,
    chunk_index_record,
    entries_of,
    json_metadata,
    padding_record,
    record_bytes,
    schema_record,
)

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer, Channel, Schema

OPEN_SUFFIX = ".mcap.open"
SEALED_SUFFIX = ".mcap"


class SegmentFile:
    """One open segment: appends whole records, keeps what the summary will say."""

    def __init__(self, path: Path, number: int, file: AppendFile) -> None:
        self.path = path
        self.number = number
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, tuple[int, Channel]] = {}
        self._file = file
        self.chunks = 0
        """Chunks in the file."""
        self._chunk_indexes = bytearray()  # as records: of a long segment there are many
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._first: int | None = None
        self._last = 0

    @classmethod
    def create(
        cls, directory: Path, number: int, recording: Mapping[str, object], next_seq: int = 0
    ) -> SegmentFile:
        """Start a new segment file.

        Args:
            directory: The recording's directory.
            number: Segment number, also the file's name.
            recording: Catalog entry of the recording, kept in the file for `reindex`.
            next_seq: No message of the segments before has this arrival number or a later one.
        """
        path = directory / f"{number:06d}{OPEN_SUFFIX}"
        try:
            file = AppendFile.create(path)
        except OSError as error:
            raise durability.explain(error, path, "creating") from error
        segment = cls(path, number, file)
        try:
            segment._write([MAGIC, record_bytes(Header(profile=PROFILE, library=LIBRARY))])
            segment.add_metadata(
                json_metadata(
                    RECORDING_METADATA,
                    {
                        **recording,
                        "segment": number,
                        "format": FORMAT_VERSION,
                        "next_seq": next_seq,
                    },
                )
            )
        except BaseException:
            file.close()
            path.unlink()  # or the next try would find it there
            raise
        return segment

    @property
    def position(self) -> int:
        """Bytes in the file."""
        return self._file.position

    @property
    def direct(self) -> bool:
        """Whether what was written is on the disk already, but for the file's length."""
        return self._file.direct

    def define(
        self, channel_id: int, schema_id: int, channel: Channel, *, write: bool = True
    ) -> None:
        """Make a channel known; its schema first if this is the first use in the file."""
        parts: list[bytes] = []
        if schema_id and channel.schema is not None and schema_id not in self.schemas:
            self.schemas[schema_id] = channel.schema
            parts.append(record_bytes(schema_record(schema_id, channel.schema)))
        self.channels[channel_id] = (schema_id, channel)
        parts.append(record_bytes(channel_record(channel_id, schema_id, channel)))
        if write:
            self._write(parts)

    def add_metadata(self, record: Metadata) -> None:
        """Append a metadata record."""
        data = record_bytes(record)
        self.note_metadata(record.name, self.position, len(data))
        self._write([data])

    def note_metadata(self, name: str, offset: int, length: int) -> None:
        """List a metadata record that is in the file already."""
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=length, name=name))

    def add_attachment(self, record: Attachment) -> None:
        """Append an attachment."""
        data = record_bytes(record)
        self.note_attachment(record, self.position, len(data))
        self._write([data])

    def note_attachment(self, record: Attachment, offset: int, length: int) -> None:
        """List an attachment that is in the file already."""
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=length,
                create_time=record.create_time,
                log_time=record.log_time,
                data_size=len(record.data),
                name=record.name,
                media_type=record.media_type,
            )
        )

    def append_chunks(self, chunks: Sequence[PackedChunk], end: int) -> list[StoredChunk]:
        """Append chunks, each with its message indexes and arrival numbers, in one go.

        Args:
            chunks: One at least.
            end: Byte of the file from which no chunk begins, but for the first.

        Returns:
            Those that were appended: the first ones.
        """
        parts: list[Buffer] = []
        stored: list[StoredChunk] = []
        at = self.position
        for chunk in chunks:
            if stored and at >= end:
                break
            head = chunk_head(
                first=chunk.first,
                last=chunk.last,
                uncompressed_size=chunk.uncompressed_size,
                crc=chunk.crc,
                compression=chunk.compression,
                compressed_size=len(chunk.data),
            )
            padding = self._padding(chunk.data, at, len(head))
            offset = at + len(padding)
            length = len(head) + len(chunk.data)
            trailer = [*chunk.indexes.values(), arrival_record(offset, chunk.arrivals)]
            trailer_length = sum(map(len, trailer))
            parts += [padding, head, chunk.data, *trailer]
            at = offset + length + trailer_length
            stored.append(
                StoredChunk(
                    self.number,
                    offset,
                    length,
                    trailer_length,
                    chunk.batch,
                    chunk.seq,
                    len(chunk.data),
                )
            )
        self._write(parts)
        for chunk, place in zip(chunks, stored, strict=False):
            summary = ChunkSummary(
                first=chunk.first,
                last=chunk.last,
                offset=place.offset,
                length=place.length,
                indexes={channel: len(data) for channel, data in chunk.indexes.items()},
                compression=chunk.compression,
                compressed_size=place.compressed_size,
                uncompressed_size=chunk.uncompressed_size,
            )
            counts = {channel: entries_of(data) for channel, data in chunk.indexes.items()}
            self.note_chunk(summary, counts)
        return stored

    def append_trailer(self, indexes: Mapping[int, bytes], arrivals: bytes) -> None:
        """Give a chunk the indexes and arrival numbers that a crash has cost it."""
        self._write([*indexes.values(), arrivals])

    def note_chunk(self, chunk: ChunkSummary, counts: Mapping[int, int]) -> None:
        """List a chunk that is in the file, with the messages of each channel in it."""
        self.chunks += 1
        self._chunk_indexes += chunk_index_record(chunk)
        for channel, count in counts.items():
            self._counts[channel] = self._counts.get(channel, 0) + count
        self._first = chunk.first if self._first is None else min(self._first, chunk.first)
        self._last = max(self._last, chunk.last)

    def cut(self, position: int) -> None:
        """Drop everything from a position on; the next record is written there."""
        try:
            self._file.cut(position)
        except OSError as error:
            raise durability.explain(error, self.path, "cutting") from error

    def sync(self) -> None:
        """Force what was written to the disk."""
        try:
            self._file.sync()
        except OSError as error:
            raise durability.explain(error, self.path, "syncing") from error

    def seal(self, *, sync: bool = True) -> Path:
        """Write the summary, close, and give the file its final name."""
        # In one go: where there is no room, the file is as before, and can be sealed again.
        end = record_bytes(DataEnd(data_section_crc=0))
        self._write([end, self._summary(self.position + len(end)), MAGIC])
        final = self.path.with_name(self.path.name.removesuffix(OPEN_SUFFIX) + SEALED_SUFFIX)
        try:
            self._file.finish(sync=sync)
            durability.publish(self.path, final)
        except OSError as error:
            raise durability.explain(error, final, "sealing") from error
        self.path = final
        return final

    def abandon(self) -> None:
        """Close without sealing; the next opening of the store recovers the file."""
        with suppress(OSError):
            self._file.finish(sync=False)

    def _padding(self, content: Buffer, at: int, head: int) -> bytes:
        """What must stand before a chunk record at a byte for its content to start at a block."""
        if not self._file.room_before(content, at + head):
            return b""
        least = RECORD_HEAD.size
        return padding_record(least + self._file.room_before(content, at + least + head))

    def _write(self, parts: Sequence[Buffer]) -> None:
        try:
            self._file.append(parts)
        except OSError as error:
            raise durability.explain(error, self.path, "writing") from error

    def _summary(self, start: int) -> bytes:
        groups: list[tuple[Opcode, bytes]] = [
            (Opcode.SCHEMA, _joined(schema_record(i, s) for i, s in self.schemas.items())),
            (
                Opcode.CHANNEL,
                _joined(channel_record(i, sid, c) for i, (sid, c) in self.channels.items()),
            ),
            (Opcode.STATISTICS, record_bytes(self._statistics())),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _joined(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _joined(self._metadata_indexes)),
        ]
        offsets: list[SummaryOffset] = []
        at = start
        for opcode, records in groups:
            if records:
                offsets.append(
                    SummaryOffset(group_opcode=opcode, group_start=at, group_length=len(records))
                )
            at += len(records)
        summary = b"".join((*(records for _, records in groups), _joined(offsets)))
        footer = Footer(summary_start=start, summary_offset_start=at, summary_crc=0)
        # The footer's checksum covers the summary and the footer up to the checksum itself.
        covered = record_bytes(footer)[:-4]
        footer.summary_crc = crc32(covered, crc32(summary))
        return summary + record_bytes(footer)

    def _statistics(self) -> Statistics:
        return Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self.channels),
            channel_message_counts=dict(sorted(self._counts.items())),
            chunk_count=self.chunks,
            message_count=sum(self._counts.values()),
            message_end_time=self._last,
            message_start_time=self._first or 0,
            metadata_count=len(self._metadata_indexes),
            schema_count=len(self.schemas),
        )


def _joined(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(record_bytes, records))
