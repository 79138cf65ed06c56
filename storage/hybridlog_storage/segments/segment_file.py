"""A segment file: records are appended, and a summary seals it."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    ChunkIndex,
    DataEnd,
    Footer,
    McapRecord,
    Metadata,
    MetadataIndex,
    Statistics,
    SummaryOffset,
)

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.disk.append_file import AppendFile
from hybridlog_storage.errors import HybridlogError, StoreError
from hybridlog_storage.manifest import Channel as ListedChannel
from hybridlog_storage.manifest import File, Loss, Part
from hybridlog_storage.mcap.mcap_content import MAGIC, RECORD_HEAD, ChunkHead, chunk_head_of
from hybridlog_storage.messages import EXPIRED_IDS, Buffer, Channel, Schema, schema_hash
from hybridlog_storage.segments.chunk import PackedChunk
from hybridlog_storage.segments.chunk_table import ChunkTable, TableBuilder
from hybridlog_storage.segments.segment_format import (
    CHUNK_TABLE_OPCODE,
    FORMAT_VERSION,
    LOSSES_METADATA,
    OUR_NAMES,
    RECORDING_METADATA,
    START,
    Attachment,
    arrival_record,
    channel_record,
    definitions_chunk,
    json_metadata,
    losses_in,
    metadata_record,
    record_bytes,
    schema_record,
    sealed_name,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


OPEN_SUFFIX = ".mcap.open"
ROWS_SUFFIX = ".rows.parquet"
_SEALED = re.compile(r"(?P<number>[0-9]{6})\.mcap")
_ROWS = re.compile(r"[0-9]{6}(\.[1-9][0-9]{0,9})?\.rows\.parquet")


class Sealed(NamedTuple):
    """A complete segment, for the manifest of its recording, of which `file` is a line.

    `channels` are by id, also those without messages; without totals.
    """

    file: File
    channels: dict[int, ListedChannel]

    @classmethod
    def of(
        cls,
        place: tuple[int, int],
        content: tuple[int, str],
        table: ChunkTable,
        channels: Mapping[int, Channel],
        *,
        extras: tuple[int, int],
        losses: Iterable[Loss],
    ) -> Sealed:
        """A segment as a manifest lists it.

        `place` is its number, and that of the first segment of its group; `content` is its bytes,
        and their digest; `extras` are the numbers of its attachments and metadata records of the
        source; `losses` are its rows of the loss ledger.
        """
        (number, group), (size, digest) = place, content
        spans = table.chunks[["first", "last"]]
        file = File(
            number,
            group,
            sealed_name(number),
            "log",
            size,
            digest,
            time.time_ns(),
            int(spans["first"].min()) if len(spans) else None,
            int(spans["last"].max()) if len(spans) else None,
            listed_parts(table),
            len(table.chunks),
            *extras,
            tuple(losses),
        )
        known = {n: _listed(one) for n, one in sorted(channels.items()) if n < EXPIRED_IDS}
        return cls(file, known)


def number_of(name: str) -> int | None:
    """Number of a sealed segment, by the name of its file; None for other files."""
    found = _SEALED.fullmatch(name)
    return None if found is None else int(found["number"])


def is_rows(name: str) -> bool:
    """True for the name of a file of rows."""
    return _ROWS.fullmatch(name) is not None


def rows_name(number: int, version: int = 0) -> str:
    """Name of a file with what is left of the messages of a log that is gone."""
    return f"{number:06d}{f'.{version}' if version else ''}{ROWS_SUFFIX}"


def listed_parts(table: ChunkTable) -> dict[int, Part]:
    """The content that a segment has of each channel, as a manifest lists it."""
    rows = table.by_channel()[["channel", "messages", "payload_bytes", "first", "last"]]
    return {channel: Part(*values) for channel, *values in rows.tolist()}


def _listed(channel: Channel) -> ListedChannel:
    schema = channel.schema
    kind, digest = ("", "") if schema is None else (schema.name, schema_hash(schema))
    return ListedChannel(
        channel.topic,
        channel.message_encoding,
        kind,
        dict(channel.metadata),
        schema=digest,
        has_publish_time=channel.has_publish_time,
        is_indexed=channel.is_indexed,
    )


class Content:
    """What a segment has so far: noted as it is written, or as its records are walked over.

    Attributes:
        schemas: By id.
        channels: By id.
        table: The chunk table.
        losses: Rows of the loss ledger.
        attachments: Their places, in file order.
        metadata: The same of all metadata records.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.table = TableBuilder()
        self.losses: list[Loss] = []
        self.attachments: list[AttachmentIndex] = []
        self.metadata: list[MetadataIndex] = []
        self._chunk_indexes = bytearray()  # as records: a long segment has many

    def note_chunk(
        self,
        offset: int,
        head: ChunkHead,
        parts: NDArray[np.void],
        indexes: Mapping[int, int],
        trailer: int,
    ) -> None:
        """Note a chunk that starts at a byte; `parts` is from `parts_of`.

        `indexes` is the bytes of each message index, by channel id; `trailer` those of all records
        behind it.
        """
        self.table.chunk((offset, head.length, trailer), (head.first, head.last), parts)
        starts = accumulate(indexes.values(), initial=offset + head.length)
        self._chunk_indexes += record_bytes(
            ChunkIndex(
                message_start_time=head.first,
                message_end_time=head.last,
                chunk_start_offset=offset,
                chunk_length=head.length,
                message_index_offsets=dict(zip(indexes, starts, strict=False)),
                message_index_length=sum(indexes.values()),
                compression=head.codec,
                compressed_size=head.end - head.start,
                uncompressed_size=head.size,
            )
        )

    def note_metadata(self, record: Metadata, offset: int, length: int) -> None:
        """Note a metadata record that starts at a byte."""
        if record.name == LOSSES_METADATA:
            self.losses += losses_in(record)
        self.metadata.append(MetadataIndex(offset=offset, length=length, name=record.name))

    @property
    def of_source(self) -> list[MetadataIndex]:
        """Places of the metadata records of the source, in file order."""
        return [one for one in self.metadata if not one.name.startswith(OUR_NAMES)]

    def tail(self, at: int) -> bytes:
        """The last records of a file with `at` bytes of data: the end of data, the summary."""
        end = record_bytes(DataEnd(data_section_crc=0))
        start = at = at + len(end)
        table = self.table.build()
        body = table.to_bytes()
        ids = {schema: number for number, schema in self.schemas.items()}
        groups: list[tuple[int, bytes]] = [
            (Opcode.SCHEMA, _joined(schema_record(i, s) for i, s in self.schemas.items())),
            (
                Opcode.CHANNEL,
                _joined(
                    channel_record(i, ids[c.schema] if c.schema else 0, c)
                    for i, c in self.channels.items()
                ),
            ),
            (Opcode.STATISTICS, record_bytes(self._statistics(table))),
            (Opcode.CHUNK_INDEX, bytes(self._chunk_indexes)),
            (Opcode.ATTACHMENT_INDEX, _joined(self.attachments)),
            (Opcode.METADATA_INDEX, _joined(self.metadata)),
            (CHUNK_TABLE_OPCODE, RECORD_HEAD.pack(CHUNK_TABLE_OPCODE, len(body)) + body),
        ]
        offsets: list[SummaryOffset] = []
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
        return end + summary + record_bytes(footer) + MAGIC

    def _statistics(self, table: ChunkTable) -> Statistics:
        counts = table.counts()
        times = table.chunks[["first", "last"]]
        return Statistics(
            attachment_count=len(self.attachments),
            channel_count=len(self.channels),
            channel_message_counts=counts,
            chunk_count=self.table.chunks,
            message_count=sum(counts.values()),
            message_end_time=int(times["last"].max(initial=0)),
            message_start_time=int(times["first"].min()) if len(times) else 0,
            metadata_count=len(self.metadata),
            schema_count=len(self.schemas),
        )


class SegmentFile:
    """An open segment, `.mcap.open`: appends whole records and collects the summary.

    `file` is a new one, or has some `content` already. `group` is the number of the first segment
    of its group; its own by default.
    """

    def __init__(
        self,
        path: Path,
        number: int,
        file: AppendFile,
        *,
        group: int | None = None,
        content: Content | None = None,
    ) -> None:
        self.path = path
        self.number = number
        self.group = number if group is None else group
        self.content = content or Content()
        self._file = file
        self._sealed: Sealed | None = None  # once the file is complete
        self._finished = False  # once it is closed

    @classmethod
    def create(
        cls,
        directory: Path,
        number: int,
        recording: Mapping[str, object],
        *,
        group: int | None = None,
        sync: bool = False,
    ) -> SegmentFile:
        """Start a new segment file; if there is no room for it, no file remains.

        `recording` is the catalog entry, stored in the file. With `sync` the file's name is on the
        disk when this returns.
        """
        path = directory / f"{number:06d}{OPEN_SUFFIX}"
        with files.explained(path, "creating"):
            file = AppendFile.create(path)
        segment = cls(path, number, file, group=group)
        try:
            segment._append([START])
            segment.add_recording(recording)
            if sync:
                with segment._explained("creating"):
                    files.sync_folder(directory)
        except BaseException:
            file.close()
            with suppress(OSError):
                files.unlink(path)  # or the next attempt would find it
            raise
        return segment

    @property
    def is_complete(self) -> bool:
        """True if the summary is written, so nothing can be added."""
        return self._sealed is not None

    @property
    def position(self) -> int:
        """Bytes in the file."""
        return self._file.position

    def define(self, channels: Iterable[tuple[int, int, Channel]]) -> None:
        """Write channels (id, id of the schema, channel) as a chunk, schemas on first use."""
        defined = [*channels]
        schemas = {number: one.schema for _, number, one in defined if one.schema is not None}
        records: list[McapRecord] = [
            schema_record(number, schema)
            for number, schema in schemas.items()
            if number not in self.content.schemas
        ]
        records += [channel_record(*one) for one in defined]
        if records:
            self._append([definitions_chunk(_joined(records), self.position)])
        self.content.schemas |= schemas
        self.content.channels |= {number: channel for number, _, channel in defined}

    def add_recording(self, recording: Mapping[str, object]) -> None:
        """Append the metadata of the recording and of the segment."""
        about = {"segment": self.number, "group": self.group, "format": FORMAT_VERSION}
        self.add_metadata(json_metadata(RECORDING_METADATA, {**recording, **about}))

    def add_metadata(self, record: Metadata) -> None:
        """Append a metadata record."""
        offset = self.position
        data = metadata_record(record, offset)
        self._append([data])
        self.content.note_metadata(record, offset, len(data))

    def add_attachment(self, attachment: Attachment) -> None:
        """Append an attachment, piece by piece."""
        offset = self.position
        try:
            for piece in attachment.record():
                self._append([piece])
        except BaseException:
            with suppress(HybridlogError):  # later records overwrite it
                self.cut(offset)
            raise
        self.content.attachments.append(attachment.index(offset, self.position - offset))

    def append_chunk(self, chunk: PackedChunk) -> None:
        """Append a chunk with its message indexes and arrival numbers in one write."""
        offset = self.position
        indexes = b"".join(chunk.indexes.values())
        arrivals = arrival_record(offset, crc32(chunk.head), crc32(indexes), chunk.arrivals)
        self._append([chunk.head, chunk.data, indexes, arrivals])
        head = chunk_head_of(chunk.head)
        assert head is not None
        sizes = {number: len(data) for number, data in chunk.indexes.items()}
        trailer = len(indexes) + len(arrivals)
        self.content.note_chunk(offset, head, chunk.parts, sizes, trailer)

    def rewrite(self, position: int, data: Buffer) -> None:
        """Overwrite bytes damaged by a crash or the disk."""
        with self._explained("recovering"):
            self._file.rewrite(position, data)

    def cut(self, position: int) -> None:
        """Truncate the file at a position; the next record is written there."""
        with self._explained("cutting"):
            self._file.cut(position)

    def sync(self) -> None:
        """Force the written bytes to the disk."""
        with self._explained("syncing"):
            self._file.sync()

    def prepare(self, *, sync: bool) -> Sealed:
        """Write the summary, and close the file; may be repeated.

        If there is no room for the summary, the file is unchanged.
        """
        final = self.path.with_name(sealed_name(self.number))
        with self._explained("sealing"):
            if self.path != final:
                with suppress(FileNotFoundError):
                    files.status(final)
                    raise StoreError(
                        f"{final} is there already, so {self.path} cannot be sealed. "
                        "Move one of them out of the store."
                    )
            if self._sealed is None:
                # In one write: without room the file is unchanged, and can be sealed again.
                content = self.content
                self._append([content.tail(self.position)])
                self._sealed = Sealed.of(
                    (self.number, self.group),
                    (self.position, self._file.digest()),
                    content.table.build(),
                    content.channels,
                    extras=(len(content.attachments), len(content.of_source)),
                    losses=content.losses,
                )
            if not self._finished:
                self._file.finish(sync=sync)
                self._finished = True
        return self._sealed

    def publish(self, *, sync: bool = True) -> Path:
        """Give a prepared file its final name, with `sync` also on the disk; may be repeated."""
        final = self.path.with_name(sealed_name(self.number))
        with self._explained("sealing"):
            if self.path != final:
                files.rename(self.path, final)
                self.path = final
            if sync:
                files.sync_folder(final.parent)
        return final

    def abandon(self) -> None:
        """Close without sealing; the next opening of the store recovers the file."""
        with suppress(OSError):
            self._file.finish(sync=False)

    def _append(self, parts: Sequence[Buffer]) -> None:
        with self._explained("writing"):
            self._file.append(parts)

    def _explained(self, doing: str) -> AbstractContextManager[None]:
        return files.explained(self.path, doing)


def _joined(records: Iterable[McapRecord]) -> bytes:
    return b"".join(map(record_bytes, records))
