"""Deletes payloads of a recording to make room; fields, counts and times stay.

First the rows of what goes are written to files of their own: the fields as in tables, the
index documents, times, sizes and hashes (`columns/field_files.py`). They are forced to the
disk, and read and compared; then the manifest lists them. From then on they are the truth.
Then each segment is written again with short records in place of the chunks that go, as
another file, which the manifest lists in the place of the old one (`thinning.py`). A segment
that loses all of its payloads keeps its definitions, times, arrival numbers, metadata and
attachments in a small file.

A crash before the first change leaves files that the next opening removes. After it, fields of
chunks that are still there do no harm: readers use them for expired chunks alone, and the
next expiry writes them anew.

Each expiry writes files of fields; where a topic has many, they are joined (`columns/joining.py`).
"""

from __future__ import annotations

import secrets
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from types import MappingProxyType
from typing import TYPE_CHECKING, Final

import numpy as np

from hybridlog.columns import payload_files
from hybridlog.columns.layout import PAYLOAD_PARTS, table_schema_of
from hybridlog.columns.payload_files import RecordingPayloads, next_number, walk
from hybridlog.maintenance.report import reporter
from hybridlog.maintenance.thinning import replace_chunks, write_thinned
from hybridlog_storage.checksum import crc32
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import PAYLOADS
from hybridlog_storage.errors import HybridlogError, SegmentError, StoreError
from hybridlog_storage.manifest import replace
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.segments.segment_format import expired_record, not_copied_record

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.payload_files import WalkedSegment
    from hybridlog.columns.payload_writer import TopicWriter
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.manifest import Fields, Manifest
    from hybridlog_storage.messages import Batch, Channel
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import ChunkPlace, SegmentSummary

MIN_BYTES: Final = 256
"""Stored bytes a message below which payloads stay: what is left would take as much room."""
MAX_FILES: Final = 16
"""Small files of fields of a topic; where there are more, they are joined."""
_Key = tuple[str, str, bool]
"""A topic, a hash of its definition, and whether its messages are reduced."""


@dataclass(slots=True)
class Expired:
    """The result of an expiry.

    Attributes:
        segments: Numbers of the segments that lost payloads.
        messages: Number of messages whose payloads went, by topic.
        freed: Bytes of the disk that became free, what was written subtracted.
        field_bytes: Bytes of the files of fields that were written.
    """

    segments: list[int] = field(default_factory=list)
    messages: dict[str, int] = field(default_factory=dict)
    freed: int = 0
    field_bytes: int = 0


def expire(
    directory: StoreDirectory,
    recording: str,
    segments: Collection[int],
    topics: Collection[str] | None = None,
    *,
    digests: Mapping[int, str] = MappingProxyType({}),
    check: Callable[[Manifest], object] = lambda _: None,
    progress: Progress | None = None,
    min_bytes: int = MIN_BYTES,
    max_files: int = MAX_FILES,
) -> Expired:
    """Delete payloads in sealed segments of a recording that this process has locked.

    Expired payloads do not expire again: what is gone already is left out.

    Args:
        directory: The store.
        recording: Its id; it may be running, then it is the caller who records it.
        segments: Numbers of sealed segments.
        topics: Full names of the topics whose payloads go; None for all. Messages of other
            topics in the same chunk keep theirs, and so the chunk stays.
        digests: Digests that files of these segments must have, by number.
        check: Part of each change of the manifest; raises if these payloads must stay by now.
        progress: Called after each chunk.
        min_bytes: Chunks with fewer stored bytes a message stay.
        max_files: Small files of fields that a topic may have.

    Raises:
        StoreError: Files cannot be read or written; what is not listed is as before.
        DiskFullError: There is no room for the fields; nothing is deleted.
    """
    path = directory.recording(recording)
    manifest = directory.manifests.read(recording)
    work = _Expiry(path, manifest, path, topics, check=check, min_bytes=min_bytes)
    work.choose(sorted(segments), digests)
    done = work.run(directory, progress)
    # Files that cannot be joined stay as they are, and the next expiry tries again.
    with suppress(HybridlogError, OSError):
        done.freed += work.join(max_files)
    return done


def without_payloads(
    path: Path, manifest: Manifest, segments: Collection[int], into: Path
) -> Manifest:
    """Write segments of a recording without payloads, which are to be copied later.

    Args:
        path: The recording's directory; it stays as it is.
        manifest: Its manifest.
        segments: Numbers of the segments; those that would save nothing stay as they are.
        into: A folder for the new files, those of fields included. Their names are drawn, so that
            no other file of the recording gets them.

    Returns:
        The manifest with the new files in the place of others.

    Raises:
        StoreError: Files cannot be read or written.
        DiskFullError: There is no room.
    """
    work = _Expiry(path, manifest, into, None, check=lambda _: None, min_bytes=MIN_BYTES)
    work.choose(sorted(segments), {})
    return work.write_apart()


class _Expiry:
    """The steps for one recording."""

    def __init__(
        self,
        path: Path,
        manifest: Manifest,
        into: Path,
        topics: Collection[str] | None,
        *,
        check: Callable[[Manifest], object],
        min_bytes: int,
    ) -> None:
        self._path = path
        self._into = into
        self._min_bytes = min_bytes
        self._topics = topics
        self._check = check
        self._manifest = manifest
        self._chosen: dict[int, set[int]] = {}  # numbers of chunks by segment
        self._summaries: dict[int, SegmentSummary] = {}
        self._writers: dict[_Key, TopicWriter] = {}
        self._written: dict[tuple[int, int], list[int]] = {}  # checksums by segment and chunk
        self._made: list[Fields] = []
        self._numbers = count(next_number(manifest))

    def choose(self, segments: Iterable[int], digests: Mapping[int, str]) -> None:
        """Note the chunks of segments that go.

        Raises:
            StoreError: A segment is not as it is listed, or has another digest.
        """
        logs = self._manifest.logs
        if any(n not in logs or digests.get(n, logs[n].digest) != logs[n].digest for n in segments):
            raise StoreError(f"{self._manifest.name}: a segment was replaced meanwhile.")
        for segment in walk(self._path, self._names(segments)):
            number, summary = segment.number, segment.summary
            if summary.size != logs[number].bytes:
                raise StoreError(
                    f"{segment.reader.path} is not the segment that the manifest lists; nothing "
                    "was deleted. Run `hybridlog verify --repair` first."
                )
            chosen = {place.number for place in summary.chunks if self._goes(place, summary)}
            if chosen:
                self._chosen[number], self._summaries[number] = chosen, summary

    def _names(self, segments: Iterable[int]) -> dict[int, str]:
        return {number: self._manifest.logs[number].name for number in segments}

    def _goes(self, place: ChunkPlace, summary: SegmentSummary) -> bool:
        if place.is_expired:
            return False
        parts = _parts_of(summary, place)
        if place.length < self._min_bytes * int(parts["messages"].sum()):
            return False
        names = {summary.channels[number].topic for number in place.channels}
        return self._topics is None or names <= {*self._topics}

    def run(self, directory: StoreDirectory, progress: Progress | None) -> Expired:
        done = Expired()
        sizes = sum(summary.size for summary in self._summaries.values())
        report = reporter(progress, self._manifest.name, sizes)
        try:
            made = self._write(report)
            if not self._chosen:
                return done
            self._manifest = payload_files.announce(self._path, made, check=self._check)
        except BaseException as error:
            payload_files.take_back(self._path)
            if isinstance(error, OSError):
                raise durability.explain(error, self._path, "writing fields of") from error
            raise
        if self._manifest.is_ended:
            self._remove_arrays(directory)
        done.field_bytes = sum(file.bytes for file in made)
        done.freed = -done.field_bytes
        for segment in walk(self._path, self._names(self._chosen), known=self._summaries):
            done.freed += self._replace(segment)
            done.segments.append(segment.number)
            for place in self._places(segment.number):
                self._count(place, segment.summary, done)
        return done

    def _remove_arrays(self, directory: StoreDirectory) -> None:
        """Remove tables with arrays that expire; they are made again without these."""
        from hybridlog.columns.folders import TableFolders
        from hybridlog.columns.layout import type_prefix

        gone = {
            channel.topic: "" if channel.schema is None else channel.schema.name
            for channel in (writer.channel for writer in self._writers.values())
            if channel.topic in directory.settings.arrays
        }
        if gone:
            logs = self._manifest.logs
            folders = TableFolders(
                directory.path,
                self._manifest.id,
                {
                    str(one.number): one.summary.content(logs[one.number].digest)
                    for one in walk(self._path, self._names(logs))
                },
            )
            with suppress(OSError):
                folders.add({}, {*gone}, {type_prefix(kind) for kind in gone.values()})

    def _places(self, number: int) -> Iterator[ChunkPlace]:
        chosen = self._chosen[number]
        return (one for one in self._summaries[number].chunks if one.number in chosen)

    def _count(self, place: ChunkPlace, summary: SegmentSummary, done: Expired) -> None:
        for part in _parts_of(summary, place):
            topic = summary.channels[int(part["channel"])].topic
            done.messages[topic] = done.messages.get(topic, 0) + int(part["messages"])

    def _write(self, report: Callable[[int], None]) -> list[Fields]:
        """Write what is left of the chosen messages, and compare it with them."""
        files.remove_tree(self._into / PAYLOAD_PARTS)
        for segment, chunk in self._chunks(report):
            self._add(chunk, segment.summary)
        self._chosen = {number: chosen for number, chosen in self._chosen.items() if chosen}
        for writer in self._writers.values():
            writer.close()
        made = [file for writer in self._writers.values() for file in writer.written]
        left = RecordingPayloads(self._into, made, PAYLOAD_PARTS)
        self._made = made
        for (segment_number, number), known in self._written.items():
            if _checksums(left.expired(segment_number, number).batch) != known:
                raise StoreError(f"What was written of {self._path} does not come back.")
        return made

    def _chunks(self, report: Callable[[int], None]) -> Iterator[tuple[WalkedSegment, StoredChunk]]:
        known = self._summaries
        for segment in walk(self._path, self._names(known), report=report, known=known):
            chosen = self._chosen[segment.number]
            wanted = {*chosen}

            def is_wanted(place: ChunkPlace, wanted: set[int] = wanted) -> bool:
                return place.number in wanted

            for place, chunk in segment.chunks(is_wanted):
                if isinstance(chunk, SegmentError):
                    # What cannot be read stays: its loss is known, and a copy may mend it.
                    chosen.discard(place.number)
                else:
                    yield segment, chunk

    def _add(self, chunk: StoredChunk, summary: SegmentSummary) -> None:
        """Write what is left of the messages of a chunk, and note what is to come back."""
        by_topic: dict[_Key, list[int]] = {}
        for number in np.unique(chunk.batch.channel).tolist():
            channel = summary.channels[number]
            by_topic.setdefault(_key_of(channel), []).append(number)
        for key, numbers in by_topic.items():
            channel = summary.channels[numbers[0]]
            has_publish_time = {n: summary.channels[n].has_publish_time for n in numbers}
            rows = np.flatnonzero(np.isin(chunk.batch.channel, numbers))
            writer = self._writer(key, channel)
            table = writer.columns.table(chunk, rows, has_publish_time)
            digest = summary.content(self._manifest.logs[chunk.segment].digest)
            writer.add(table, chunk.segment, chunk.number, digest)
        self._written[chunk.segment, chunk.number] = _checksums(chunk.batch)

    def _writer(self, key: _Key, channel: Channel) -> TopicWriter:
        found = self._writers.get(key)
        if found is None:
            from hybridlog.columns.field_files import FieldColumns
            from hybridlog.columns.payload_writer import TopicWriter

            columns, number = FieldColumns(channel), partial(next, self._numbers)
            folder = self._into / PAYLOAD_PARTS
            found = TopicWriter(folder, self._manifest.id, channel, columns, number)
            self._writers[key] = found
        return found

    def join(self, max_files: int) -> int:
        """Join the files of fields of topics that have many; returns the bytes that became free."""
        if not self._writers:
            return 0
        from hybridlog.columns.joining import join

        channels = {(topic, schema): w.channel for (topic, schema, _), w in self._writers.items()}
        return join(self._path, channels.values(), max_files)

    def _replace(self, segment: WalkedSegment) -> int:
        chosen = self._chosen[segment.number]
        return replace_chunks(
            self._path,
            self._manifest,
            segment.reader,
            segment.summary,
            dict.fromkeys(chosen, expired_record),
            contents=RecordingPayloads(self._path, self._made),
            check=self._check,
        )

    def write_apart(self) -> Manifest:
        """As of `without_payloads`."""
        drawn = secrets.randbelow(8 * 10**8) + 10**8
        self._numbers = count(drawn)
        made = self._write(lambda _: None)
        if not self._chosen:
            return self._manifest
        files.rename(self._into / PAYLOAD_PARTS, self._into / PAYLOADS)
        now = replace(self._manifest, fields=(*self._manifest.fields, *made), lacks_payloads=True)
        contents = RecordingPayloads(self._into, made)
        for segment in walk(self._path, self._names(self._chosen), known=self._summaries):
            number, records = (
                segment.number,
                dict.fromkeys(self._chosen[segment.number], not_copied_record),
            )
            target = self._into / sealed_name(number, drawn)
            log = write_thinned(
                target, now, segment.reader, segment.summary, records, contents=contents
            )
            now = replace(
                now, files=tuple(log if one.number == number else one for one in now.files)
            )
        return now


def _parts_of(summary: SegmentSummary, place: ChunkPlace) -> NDArray[np.void]:
    bounds = summary.table.part_bounds()
    return summary.table.parts[bounds[place.number] : bounds[place.number + 1]]


def _key_of(channel: Channel) -> _Key:
    from hybridlog.schema.states import State, state_of

    is_reduced = state_of(channel.message_encoding) is State.REDUCED
    return channel.topic, table_schema_of(channel), is_reduced


def _checksums(batch: Batch) -> list[int]:
    """Checksums of what an expiry keeps of messages besides their fields."""
    columns = (batch.log_time, batch.publish_time, batch.sequence, *batch.places)
    return [crc32(np.ascontiguousarray(column).tobytes()) for column in columns]
