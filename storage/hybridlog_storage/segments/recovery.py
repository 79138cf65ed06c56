"""Finds what is damaged in segments; recovers and seals those that a crash left open, in place.

The file is cut behind its last whole record. What is damaged before becomes a record that readers
skip. Then the summary is written, as the recorder would have done.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from msgspec import Struct, field

from hybridlog_storage.disk import files
from hybridlog_storage.disk.append_file import BLOCK, AppendFile
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.manifest import hasher
from hybridlog_storage.mcap.mcap_content import Damage
from hybridlog_storage.messages import Schema
from hybridlog_storage.segments.segment_file import (
    OPEN_SUFFIX,
    Sealed,
    SegmentFile,
    sealed_name,
)
from hybridlog_storage.segments.segment_format import (
    START,
    damaged_head,
    group_of,
)
from hybridlog_storage.segments.segment_reader import SegmentReader, check_format
from hybridlog_storage.segments.walk import Walk

if TYPE_CHECKING:
    from hybridlog_storage.segments.segment_reader import SegmentSummary

_PIECE = 4 << 20  # bytes read at once for a digest


class Recovered(Struct):
    """The result of recovering an open segment; `path` is None for an empty one, which is removed.

    `cut_bytes` are of records at the end, without an incomplete summary.
    """

    path: Path | None
    messages: int = 0
    cut_bytes: int = 0
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
    try:
        with suppress(FileNotFoundError):
            files.status(final)
            raise StoreError(
                f"{final} is sealed, and {path} lies beside it. Move one of them out of the store."
            )
        with _Rest.of(path, number) as rest:
            if rest.is_empty:
                files.unlink(path)
                files.sync_folder(path.parent)
                return Recovered(None, cut_bytes=rest.cut_bytes, damage=rest.told)
            found = Recovered(final, rest.messages, rest.cut_bytes, rest.told)
            rest.seal(recording, lambda sealed: on_sealing(sealed, found))
            return found
    except OSError as error:
        raise files.explain(error, path, "recovering") from error


def rebuild_summary(path: Path, digest: str) -> bool:
    """Write the damaged summary of a sealed segment again, if the file then has its digest.

    The summary is a function of the data before it. False if the segment was not repaired: it is
    unchanged. After an error it can be repaired again.
    """
    try:
        with _Rest.of(path, int(path.name.partition(".")[0])) as rest:
            return rest.seal_again(digest)
    except OSError as error:
        raise files.explain(error, path, "rebuilding") from error


class _Rest:
    """The whole part of a segment, and the writer that goes on behind it.

    `messages` are in whole chunks; `cut_bytes` are behind the last whole record, and of no summary.
    """

    def __init__(self, segment: SegmentFile, reader: SegmentReader) -> None:
        self._segment = segment
        self._reader = reader
        self._walk = walk = Walk(reader, reads=True)
        walk.go_on()
        if walk.recording is not None:
            check_format(walk.recording, segment.path)
            segment.group = group_of(walk.recording, segment.number)
        self._damage = walk.damaged
        for number, one in walk.schemas.items():
            segment.schemas[number] = Schema(one.name, one.encoding, bytes(one.data))
        segment.channels |= {n: (walk.schema_ids[n], one) for n, one in walk.channels.items()}
        segment.note_extras(walk.metadata, walk.attachments)
        segment.losses += walk.losses
        segment.table = walk.table
        for chunk in walk.chunks:
            segment.note_index(chunk.offset, chunk.head, chunk.indexes)
        self.messages = sum(walk.table.build().counts().values())
        self.cut_bytes = self._torn()

    @classmethod
    @contextmanager
    def of(cls, path: Path, number: int) -> Iterator[_Rest]:
        """Open a file; it is closed at the end."""
        with SegmentReader(path, number) as reader:
            segment = SegmentFile(path, number, AppendFile.reopen(path))
            try:
                yield cls(segment, reader)
            finally:
                segment.abandon()

    @property
    def told(self) -> list[str]:
        """Descriptions of the damage, in the order of the file."""
        found = sorted(self._damage, key=lambda one: one.offset)
        return [f"byte {one.offset}: {one.reason}" for one in found]

    @property
    def is_empty(self) -> bool:
        """True if there is nothing but the beginning of a segment."""
        walk = self._walk
        return not (walk.recording or walk.chunks or walk.attachments or self._damage)

    def _torn(self) -> int:
        """Bytes behind the last whole record, but for the zeros that fill the last block."""
        end = 0 if self.is_empty else self._walk.end
        rest = self._reader.size - end
        is_room = 0 <= rest < BLOCK and not any(self._reader.read(end, rest))
        return 0 if is_room or self._walk.is_complete else rest

    def seal(
        self, recording: Mapping[str, object] | None, on_sealing: Callable[[Sealed], object]
    ) -> None:
        """Write what is missing, and give the file its name."""
        walk, segment = self._walk, self._segment
        if walk.recording is None and recording is None:
            raise SegmentError(
                f"{segment.path} was left open, and what it says of its recording is damaged. "
                "Move it out of the store, and see what is left with `mcap recover`."
            )
        start = bytes(self._reader.read(0, len(START)))
        if start != START:
            self._damage.append(Damage(0, len(START), "the beginning of the file was damaged"))
        if walk.recording is None:
            segment.cut(walk.end)
            segment.add_recording(recording or {})
        # Only now: what is damaged looks well behind this.
        for one in self._damage:
            if one.offset == 0:
                segment.rewrite(0, START)
            elif one.offset < walk.end:
                segment.rewrite(one.offset, damaged_head(one.length))
        if walk.recording is not None:
            self._put_summary(segment.tail(walk.end))
        on_sealing(segment.prepare(sync=True))
        segment.publish()

    def seal_again(self, digest: str) -> bool:
        """Write the summary of a sealed file, if the file then has its digest."""
        walk, segment, end = self._walk, self._segment, self._walk.end
        if not walk.is_complete or walk.recording is None:
            return False  # more is missing than the summary
        found = hasher()
        for at in range(0, end, _PIECE):
            found.update(self._reader.read(at, min(_PIECE, end - at)))
        tail = segment.tail(end)
        found.update(tail)
        if found.hexdigest() != digest:
            return False
        self._put_summary(tail)
        segment.prepare(sync=True)
        return True

    def _put_summary(self, tail: bytes) -> None:
        """Write the summary in place, if the file is long enough; else it is appended later."""
        segment, end = self._segment, self._walk.end
        if self._reader.size < end + len(tail):
            segment.cut(end)
            return
        if bytes(self._reader.read(end, len(tail))) != tail:
            segment.rewrite(end, tail)
        segment.cut(end + len(tail))
        segment.note_complete()


class SegmentDamage(NamedTuple):
    """A damaged place of a segment; `offset` is the byte where it starts.

    `chunk` is the number of a chunk that cannot be read; None for something else.
    """

    offset: int
    problem: str
    chunk: int | None = None


def damage_of(
    path: Path, digest: str = "", progress: Callable[[int], None] | None = None
) -> tuple[list[SegmentDamage], bool]:
    """All damage in a sealed segment. Its chunks are read only if the digest differs.

    It is in file order, but for a damaged summary, which comes first; with it comes whether the
    summary is whole. `digest` is that of the manifest; empty if it lists none. `progress` is called
    with the number of bytes read so far.
    """
    with SegmentReader(path, 0) as reader:
        try:
            summary = reader.summary()
        except SegmentError as error:
            walk = Walk(reader)
            walk.go_on()
            damaged = [SegmentDamage(one.offset, one.reason) for one in walk.damaged]
            return [SegmentDamage(max(reader.size - 1, 0), str(error)), *damaged], False
        if reader.digest(progress) == digest:
            return [], True
        found = sorted(_unreadable(reader, summary))
    if digest and not found:
        problem = "it is not the file that the manifest lists: their digests differ"
        found = [SegmentDamage(0, problem)]
    return found, True


def _unreadable(reader: SegmentReader, summary: SegmentSummary) -> Iterator[SegmentDamage]:
    """Chunks, attachments and metadata records that are lost."""
    for place in summary.chunks:
        try:
            reader.read_chunk(place)
        except SegmentError as error:
            parts = summary.table.chunk_parts(place.number)[["channel", "messages"]].tolist()
            lost = [f"{summary.channels[channel].topic} {count}" for channel, count in parts]
            topics = ", ".join(lost[:5]) + (f" and {len(lost) - 5} more" if lost[5:] else "")
            problem = f"chunk {place.number} is lost (messages: {topics}): {error}"
            yield SegmentDamage(place.offset, problem, place.number)
    reads: list[tuple[Callable[[Any], object], list[Any]]] = [
        (reader.attachment, summary.attachments),
        (reader.metadata, summary.metadata),
    ]
    for read, record in ((read, record) for read, records in reads for record in records):
        try:
            read(record)
        except SegmentError as error:
            yield SegmentDamage(record.offset, str(error))
