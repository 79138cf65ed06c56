"""Walks over the records of a segment without a summary: one being written, or left by a crash.

Each record has a checksum of its own, so what is whole is known at once. Behind damage the walk
goes on at the next record that proves itself. Of a segment that is being written, what the writer
has not finished yet is left out.

What a crash left is sealed in place: cut behind its last whole record; what is damaged before
becomes a record that readers skip; then the summary is written, as the recorder would have done.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, MetadataIndex
from mcap.records import Schema as SchemaRecord
from msgspec import Struct, field

from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import files
from hybridlog_storage.disk.append_file import AppendFile
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.mcap.mcap_content import (
    HEAD,
    MAX_CHUNK_HEAD,
    RECORD_HEAD,
    ChunkHead,
    Damage,
    RecordFile,
    chunk_head_of,
    parse_content,
)
from hybridlog_storage.segments.chunk_table import ChunkTable, check_parts
from hybridlog_storage.segments.segment_file import (
    OPEN_SUFFIX,
    Content,
    Sealed,
    SegmentFile,
)
from hybridlog_storage.segments.segment_format import (
    ARRIVAL_OPCODE,
    DAMAGED_OPCODE,
    INDEX_HEAD,
    RECORDING_METADATA,
    START,
    Trailer,
    channel_of,
    group_of,
    json_of,
    metadata_of,
    schema_of,
    sealed_name,
    trailer_of,
)
from hybridlog_storage.segments.segment_reader import SegmentReader, check_format, open_chunk

if TYPE_CHECKING:
    from hybridlog_storage.messages import Buffer

MENDED: Final = "it was damaged when the recording was recovered"
"""Reason of a place that readers skip."""
_PROVABLE: Final = frozenset({Opcode.CHUNK, Opcode.METADATA})
_INDEX: Final = bytes([Opcode.MESSAGE_INDEX])
_WINDOW: Final = 4096  # bytes read at once around the heads of records
_SEARCHED: Final = 1 << 20  # bytes searched at once for the next record
_MAX_RECORD: Final = 1 << 28  # bytes of what is read into memory as a whole
_WRITING_S: Final = 0.02  # the time that a writer may take for the rest of a record
_LOOKS: Final = 5  # at what seems damaged, before it counts as damaged


class Flushed(NamedTuple):
    """Content of a segment at one moment, as the summary of a sealed one says it.

    Attachments and metadata are those of the source, in file order.
    """

    table: ChunkTable
    attachments: Sequence[AttachmentIndex]
    metadata: Sequence[MetadataIndex]
    reader: SegmentReader


class _TornError(SegmentError):
    """A record whose end is not in the file."""


class Walk(Content):
    """The records of a segment so far, in file order.

    Args:
        reader: The segment.
        reads: Whether the content of all chunks is read, too.

    Attributes:
        reader: As above.
        recording: What it says of its recording; None without.
        is_complete: Whether the end of the data was reached: the writer had begun the summary.
        end: Where the last whole record ends, or damage before a later one.
    """

    def __init__(self, reader: SegmentReader, *, reads: bool = False) -> None:
        self.reader = reader
        self._reads = reads
        self._bytes = RecordFile(reader.read, reader.size, _WINDOW)
        self._begin()

    @classmethod
    def opened(cls, recording: Path, number: int) -> Walk:
        """The content that a segment has at this moment; it may be sealed meanwhile."""
        try:
            return cls(SegmentReader(recording / f"{number:06d}{OPEN_SUFFIX}", number))
        except SegmentError:  # it may have been sealed just now
            return cls(SegmentReader(recording / sealed_name(number), number))

    def _begin(self) -> None:
        super().__init__()
        self.recording: dict[str, Any] | None = None
        self._damaged: list[Damage] = []
        self._stopped: Damage | None = None  # at the end of the file, if no writer leaves that
        self._flushed: Flushed | None = None
        self.is_complete = False
        self.end = len(START)

    @property
    def damaged(self) -> list[Damage]:
        """Places that cannot be read, in file order."""
        return [*self._damaged, *([] if self._stopped is None else [self._stopped])]

    def go_on(self) -> None:
        """Read what follows the last whole record."""
        self._stopped, self.is_complete = None, False
        self._bytes.size = self.reader.size
        self._bytes.forget()
        while not self.is_complete and self.end < self.reader.size:
            at = self.end
            try:
                self.end = self._record(at)
            except SegmentError as error:
                size = self.reader.size
                behind = self._bytes.search(at + 1, size, _PROVABLE, self._proves_itself)
                if behind is None:
                    if not isinstance(error, _TornError):
                        self._stopped = Damage(at, size - at, str(error))
                    return
                self._damaged.append(Damage(at, behind - at, str(error)))
                self.end = behind

    def _head(self, at: int) -> tuple[int, int]:
        """Opcode of a record, and where it ends."""
        head = self._bytes.at(at, HEAD, move=True)
        if len(head) < HEAD:
            raise _TornError("the file ends in the middle of a record")
        opcode, length = RECORD_HEAD.unpack(head)
        return opcode, at + HEAD + length

    def _record(self, at: int) -> int:
        """Take a record; return where it ends, with what belongs to it."""
        opcode, end = self._head(at)
        if opcode == Opcode.DATA_END and end - at == HEAD + 4:
            self.is_complete = True
            return at
        if opcode == Opcode.CHUNK:
            return self._take_chunk(at, end)
        if opcode in {Opcode.METADATA, Opcode.ATTACHMENT, DAMAGED_OPCODE}:
            if opcode == Opcode.METADATA and end - at > _MAX_RECORD:
                raise SegmentError("the record is too large")
            if end > self.reader.size:
                raise _TornError("the file ends in the middle of a record")
            if opcode == Opcode.METADATA:
                self._take_metadata(at, end)
            elif opcode == Opcode.ATTACHMENT:
                found = self.reader.attachment_at(at, end - at)
                self.attachments.append(found.index(at, end - at))
            else:
                self._damaged.append(Damage(at, end - at, MENDED))
            return end
        why = "it belongs to no chunk"
        if opcode not in {Opcode.MESSAGE_INDEX, ARRIVAL_OPCODE}:
            why = f"a record of kind {opcode}" if opcode else "no record starts here"
        raise (_TornError if opcode == 0 and self._is_room(at) else SegmentError)(why)

    def _take_metadata(self, at: int, end: int) -> None:
        try:
            record = metadata_of(self.reader.read(at, end - at), at)
        except SegmentError as error:
            raise SegmentError(f"a metadata record is damaged: {error}") from error
        if record.name == RECORDING_METADATA:
            self.recording = json_of(record)
        self.note_metadata(record, at, end - at)

    # Chunks

    def _take_chunk(self, at: int, end: int) -> int:
        """Take a chunk, if it is whole with all that belongs to it."""
        head, trailer = self._proven_chunk(at, end)
        parts, seq = trailer.arrivals()
        if not len(seq):
            self._define(at, end)
            return end + trailer.length
        check_parts((at, head.length, trailer.length), (head.first, head.last), parts, len(seq))
        if self._reads:
            self._content(at, end)
        lost = {*parts["channel"].tolist()} - self.channels.keys()
        if lost:
            raise SegmentError(f"the definition of its channel {min(lost)} is lost")
        sizes = {channel: INDEX_HEAD.size + rows.nbytes for channel, rows in trailer.indexes}
        self.note_chunk(at, head, parts, sizes, trailer.length)
        return end + trailer.length

    def _proven_chunk(self, at: int, end: int) -> tuple[ChunkHead, Trailer]:
        """A chunk record before its content, and what is behind it; they prove each other."""
        head, size = chunk_head_of(self._bytes.at(at, MAX_CHUNK_HEAD, move=True)), self.reader.size
        is_right = head is not None and at + head.end == end
        if end > size and (head is None or is_right):
            raise _TornError("the file ends in the middle of a chunk")
        if head is None or not is_right:
            raise SegmentError("the lengths of a chunk contradict each other")
        behind = end
        while (raw := self._bytes.at(behind, INDEX_HEAD.size, move=True))[:1] == _INDEX:
            if len(raw) == INDEX_HEAD.size:
                _, length, _, entries = INDEX_HEAD.unpack(raw)
                if entries + 6 != length:
                    raise SegmentError("the lengths of a message index contradict each other")
            behind = self._head(behind)[1]
        if not len(raw) or self._is_room(behind):
            raise _TornError("the file ends behind a chunk")
        behind = self._head(behind)[1]
        if behind > size:
            raise _TornError("the file ends behind a chunk")
        if behind - end > _MAX_RECORD:
            raise SegmentError("its message indexes are too large")
        trailer = trailer_of(self.reader.read(end, behind - end), at)
        if crc32(self._bytes.at(at, head.start, move=True)) != trailer.head_crc:
            raise SegmentError("the head of a chunk changed: its checksum differs")
        return head, trailer

    def _define(self, at: int, end: int) -> None:
        """Take a chunk of definitions."""
        for definition in parse_content(self._content(at, end)).definitions:
            record = definition.record
            if isinstance(record, SchemaRecord):
                self.schemas[record.id] = schema_of(record)
            else:
                self.channels[record.id] = channel_of(record, self.schemas)

    def _content(self, at: int, end: int) -> Buffer:
        if end - at > _MAX_RECORD:
            raise SegmentError("a chunk is too large")
        return open_chunk(self.reader.read(at, end - at))[0]

    # Behind damage

    def _is_room(self, at: int) -> bool:
        """True if zeros follow, as a writer leaves behind its last block."""
        if any(self._bytes.at(at, HEAD, move=True)):
            return False
        rest = self.reader.read(at, min(self.reader.size - at, _SEARCHED))
        return not np.frombuffer(rest, np.uint8).any()

    def _proves_itself(self, at: int) -> bool:
        try:
            opcode, end = self._head(at)
            if end > self.reader.size or end - at > _MAX_RECORD:
                return False
            if opcode == Opcode.METADATA:
                metadata_of(self.reader.read(at, end - at), at)
                return True
            self._proven_chunk(at, end)
        except SegmentError:
            return False
        return True

    # While it is written

    @property
    def flushed(self) -> Flushed:
        """Its content so far."""
        if self._flushed is None:
            table, attachments = self.table.build(), tuple(self.attachments)
            self._flushed = Flushed(table, attachments, self.of_source, self.reader)
        return self._flushed

    def follow(self) -> bool:
        """Read what was flushed since, also if it was sealed meanwhile; True if there is anything.

        A read beside a write may see a part of it, and zeros in place of the rest. So what seems
        damaged is looked at again, and counts only if it is still the same.
        """
        before, known = self.end, self.damaged
        self._read_on()
        for _ in range(_LOOKS):
            seen = self.damaged
            if seen == known:
                break
            time.sleep(_WRITING_S)
            self._begin()
            self._read_on()
            if self.damaged == seen:
                break
        return (self.end, self.damaged) != (before, known)

    def _read_on(self) -> None:
        self.reader.grow()
        size, end = self.reader.size, self.end
        try:
            self.go_on()
        except SegmentError:  # the writer has just cut the padding behind its last block
            self.reader.grow()
            if self.reader.size >= size:
                raise
            self.go_on()
        if self.end != end:
            self._flushed = None


class Recovered(Struct):
    """The result of recovering an open segment; `path` is None for an empty one, which is removed.

    `damage` says what was wrong before the last whole record.
    """

    path: Path | None
    messages: int = 0
    damage: list[str] = field(default_factory=list)


def recover_segment(
    path: Path,
    on_sealing: Callable[[Sealed, Recovered], object] = lambda *_: None,
    *,
    recording: Mapping[str, object] | None = None,
) -> Recovered:
    """Cut, complete and seal one open segment, `.mcap.open`, that has no writer.

    `on_sealing` is called when the segment is complete and on the disk, before it gets its final
    name. If it fails, the file stays, and this can be called again. `recording` is the catalog
    entry, for a segment whose own is damaged. A `StoreError` leaves the file unchanged, a
    `DiskFullError` all whole records.
    """
    number = int(path.name.removesuffix(OPEN_SUFFIX))
    final = path.with_name(sealed_name(number))
    with files.explained(path, "recovering"):
        with suppress(FileNotFoundError):
            files.status(final)
            raise StoreError(
                f"{final} is sealed, and {path} lies beside it. Move one of them out of the store."
            )
        with SegmentReader(path, number) as reader:
            walk = Walk(reader, reads=True)
            walk.go_on()
            damage = [f"byte {one.offset}: {one.reason}" for one in walk.damaged]
            if not (walk.recording or walk.table.chunks or walk.attachments or damage):
                files.unlink(path)
                files.sync_folder(path.parent)
                return Recovered(None)
            found = Recovered(final, sum(walk.table.build().counts().values()), damage)
            group = number
            if walk.recording is not None:
                check_format(walk.recording, path)
                group = group_of(walk.recording, number)
            file = AppendFile.reopen(path)
            segment = SegmentFile(path, number, file, group=group, content=walk)
            try:
                _mend(segment, walk, recording)
                on_sealing(segment.prepare(sync=True), found)
                segment.publish()
            finally:
                segment.abandon()
    return found


def _damage(walk: Walk) -> dict[int, str]:
    """Reasons of damage by the byte where it starts, without what a recovery has mended."""
    return {one.offset: one.reason for one in walk.damaged if one.reason != MENDED}


def _mend(segment: SegmentFile, walk: Walk, recording: Mapping[str, object] | None) -> None:
    """Cut what is not whole, and let readers skip what is damaged."""
    if walk.recording is None and recording is None:
        raise SegmentError(
            f"{segment.path} was left open, and what it says of its recording is damaged. "
            "Move it out of the store, and see what is left with `mcap recover`."
        )
    segment.cut(walk.end)
    if walk.recording is None:
        segment.add_recording(recording or {})
    # Only now: what is damaged looks well behind this.
    if bytes(walk.reader.read(0, len(START))) != START:
        segment.rewrite(0, START)
    for one in walk.damaged:
        if one.offset < walk.end:
            segment.rewrite(one.offset, RECORD_HEAD.pack(DAMAGED_OPCODE, one.length - HEAD))


def rebuild_summary(path: Path) -> bool:
    """Seal a segment again of which the summary alone is damaged; False if more is."""
    number = int(path.name.partition(".")[0])
    with SegmentReader(path, number) as reader:
        walk = Walk(reader, reads=True)
        walk.go_on()
    if _damage(walk) or walk.recording is None or not walk.is_complete:
        return False
    opened = path.with_name(f"{number:06d}{OPEN_SUFFIX}")
    with files.explained(path, "rebuilding"):
        files.rename(path, opened)
        files.sync_folder(path.parent)  # or a power cut leaves it cut, and sealed by its name
    recover_segment(opened)
    return True


def damage_of(
    path: Path, digest: str = "", progress: Callable[[int], None] | None = None
) -> tuple[list[tuple[int, str]], bool]:
    """All damage in a sealed segment; its records are read only if the digest differs.

    It is byte and problem of each place, in file order, but for a damaged summary, which comes
    first; with it comes whether the summary is whole. `digest` is that of the manifest; empty if
    it lists none. `progress` is called with the number of bytes read so far.
    """
    with SegmentReader(path, 0) as reader:
        if reader.digest(progress) == digest:
            return [], True
        walk = Walk(reader, reads=True)
        try:
            summary = reader.summary()
        except SegmentError as error:
            walk.go_on()
            return [(max(reader.size - 1, 0), str(error)), *_damage(walk).items()], False
        walk.channels |= summary.channels
        walk.go_on()
    found, whole = _damage(walk), {*walk.table.build().chunks["offset"].tolist()}
    for place in summary.chunks:
        if place.offset not in whole:
            parts = summary.table.chunk_parts(place.number)[["channel", "messages"]].tolist()
            lost = ", ".join(f"{summary.channels[c].topic} {count}" for c, count in parts[:5])
            lost += ", ..." if parts[5:] else ""
            reason = found.get(place.offset, "it cannot be read")
            problem = f"chunk {place.number} is lost (messages: {lost}): {reason}"
            found[place.offset] = problem
    if digest and not found:
        found[0] = "it is not the file that the manifest lists: their digests differ"
    return sorted(found.items()), True
