"""The files of fields of a recording: their names, and what is left of expired chunks."""

from __future__ import annotations

import threading
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hybridlog.columns.layout import PAYLOAD_PARTS
from hybridlog_storage.cache import Cache
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import PAYLOADS, payload_names
from hybridlog_storage.errors import HybridlogError, SegmentError, StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.manifest import replace
from hybridlog_storage.manifests import manifests_at
from hybridlog_storage.segments.segment_file import number_of
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from hybridlog.columns.column_file import OpenFiles
    from hybridlog.columns.field_files import FieldFile
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog_storage.manifest import Fields, Manifest
    from hybridlog_storage.segments.chunk import ExpiredMessages, StoredChunk
    from hybridlog_storage.segments.segment_reader import ChunkPlace, SegmentSummary


def next_number(manifest: Manifest) -> int:
    """The least number that no file of fields of a recording has had."""
    files = (*(file.file for file in manifest.fields), *manifest.deleted)
    names = (name.rpartition("-")[2] for name in files)
    return 1 + max((int(name.partition(".")[0]) for name in names), default=-1)


def announce(
    recording: Path,
    made: Sequence[Fields],
    deleted: Collection[str] = (),
    check: Callable[[Manifest], object] = lambda _: None,
) -> Manifest:
    """List new files, which are complete, in the manifest, and give them their names.

    Args:
        recording: The recording's directory, locked by this process.
        made: The files, among unfinished ones.
        deleted: Files that they replace; they are removed.
        check: Raises if the manifest must not be changed so any more.

    Returns:
        The manifest with them.

    Raises:
        HybridlogError: The manifest cannot be changed, or a file not renamed or removed.
        OSError: The names of the files cannot be forced to the disk.
    """
    parts = recording / PAYLOAD_PARTS
    for folder in {(parts / file.file).parent for file in made}:
        files.sync_folder(folder)
    files.sync_folder(parts)
    files.sync_folder(recording)

    def how(now: Manifest) -> Manifest:
        check(now)
        fields = {file.file: file for file in (*now.fields, *made) if file.file not in deleted}
        gone = dict.fromkeys((*now.deleted, *deleted))
        return replace(now, fields=tuple(fields.values()), deleted=tuple(gone))

    manifest = manifests_at(recording).change(recording.name, how)
    publish(recording, manifest)
    return manifest


def take_back(recording: Path) -> None:
    """Remove unfinished files, unless the manifest lists them; the next opening does the rest."""
    with suppress(HybridlogError, OSError):
        publish(recording, manifests_at(recording).find(recording.name))


def publish(recording: Path, manifest: Manifest | None) -> None:
    """Give finished files their names, remove the folder of unfinished files, and deleted ones.

    Args:
        recording: The recording's directory, locked by this process.
        manifest: Says what is finished and deleted; None if it is lost.

    Raises:
        HybridlogError: A file cannot be renamed or removed.
    """
    parts, final = recording / PAYLOAD_PARTS, recording / PAYLOADS
    try:
        listed = set() if manifest is None else {file.file for file in manifest.fields}
        moved = sorted(payload_names(recording, PAYLOAD_PARTS).keys() & listed)
        folders = {(final / name).parent for name in moved}
        for folder in folders:
            files.make_folders(folder)
        if moved:  # folders are on the disk before anything moves into them
            files.sync_folder(recording)
            files.sync_folder(final)
        for name in moved:
            files.rename(parts / name, final / name)
        for folder in folders:
            files.sync_folder(folder)
        files.remove_tree(parts)
        deleted = () if manifest is None else manifest.deleted
        for name in sorted(payload_names(recording).keys() & {*deleted}):
            files.unlink(final / name)
    except OSError as error:
        raise durability.explain(error, final, "moving fields to") from error


def remove_replaced(recording: Path, names: Iterable[str], manifest: Manifest | None) -> None:
    """Remove segments in whose place the manifest lists another file of their number.

    Args:
        recording: The recording's directory, locked by this process.
        names: Names of files in it.
        manifest: Its manifest; None if it is lost.

    Raises:
        HybridlogError: A file cannot be removed.
    """
    there, logs = {*names}, {} if manifest is None else manifest.logs
    gone = [
        name
        for name in sorted(there)
        if (found := number_of(name)) is not None
        and (log := logs.get(found[0])) is not None
        and log.name in there - {name}
    ]
    try:
        for name in gone:
            with suppress(FileNotFoundError):
                files.unlink(recording / name)
        if gone:
            files.sync_folder(recording)
    except OSError as error:
        raise durability.explain(error, recording, "removing replaced segments of") from error


class RecordingPayloads:
    """The files of fields of one recording. Thread safe.

    Nothing is read before it is needed.

    Args:
        recording: The recording's directory.
        listed: The files; None for those that its manifest lists.
        folder: Name of the folder that holds them.
        cache: Keeps rows that were read.
    """

    def __init__(
        self,
        recording: Path,
        listed: Sequence[Fields] | None = None,
        folder: str = PAYLOADS,
        cache: Cache | None = None,
    ) -> None:
        self._recording = recording
        self._given = listed
        self._folder = recording / folder
        self._cache = cache or Cache()
        self._readers: dict[str, FieldFile] = {}
        self._places: dict[tuple[int, int], list[FieldFile]] | None = None
        self._problem = ""  # of a file that cannot be read
        self._lock = threading.RLock()

    @lazy
    def listed(self) -> Sequence[Fields]:
        """The files.

        Raises:
            StoreError: The manifest cannot be read.
        """
        if self._given is not None:
            return self._given
        manifest = manifests_at(self._recording).find(self._recording.name)
        return () if manifest is None else manifest.fields

    def reader(self, listed: Fields) -> FieldFile:
        """The reader of a file.

        Raises:
            StoreError: The file is missing or damaged.
        """
        from hybridlog.columns.field_files import FieldFile

        with self._lock:
            found = self._readers.get(listed.file)
            if found is None:
                found = FieldFile(self._folder, listed, self._cache)
                self._readers[listed.file] = found
            return found

    def expired(self, segment: int, chunk: int) -> ExpiredMessages:
        """The remains of an expired chunk.

        Raises:
            SegmentError: It is missing or damaged.
        """
        from hybridlog.columns.field_files import expired_messages, newest

        try:
            found = self._having(segment, chunk)
            if not found:
                raise SegmentError(self._problem or "its fields are in no file")
            files = newest(found, (segment, chunk))
            return expired_messages([file.rows(segment, chunk) for file in files])
        except SegmentError:
            raise
        except StoreError as error:
            raise SegmentError(str(error)) from error

    def expired_fields(
        self, topic: str, chunks: Collection[tuple[int, int]], opened: OpenFiles
    ) -> TopicTable:
        """The fields of a topic in expired chunks as a table, in no order."""
        from hybridlog.columns.column_file import FIRST, LAST, TablePart
        from hybridlog.columns.field_files import newest
        from hybridlog.columns.layout import TopicCounts
        from hybridlog.columns.topic_table import TopicTable

        parts = []
        for key in chunks:
            own = [file for file in self._having(*key) if file.listed.topic == topic]
            parts += [TablePart(file, *file.places[key], FIRST, LAST) for file in newest(own, key)]
        return TopicTable(topic, parts, TopicCounts(sum(part.rows for part in parts)), opened)

    def _having(self, segment: int, chunk: int) -> list[FieldFile]:
        """The files with messages of a chunk, but for damaged or missing ones."""
        with self._lock:
            if self._places is None:
                places: defaultdict[tuple[int, int], list[FieldFile]] = defaultdict(list)
                for listed in self.listed:
                    try:
                        reader = self.reader(listed)
                    except StoreError as error:
                        self._problem = str(error)
                        continue
                    for key in reader.places:
                        places[key].append(reader)
                self._places = dict(places)
            return self._places.get((segment, chunk), [])


def open_segment(
    path: Path, number: int, contents: RecordingPayloads | None = None
) -> SegmentReader:
    """Open a sealed segment whose chunks may have expired.

    Args:
        path: The file, in its recording's directory.
        number: Its number.
        contents: Shared by the segments of a recording.

    Raises:
        SegmentError: It cannot be opened.
    """
    return SegmentReader(path, number, contents=contents or RecordingPayloads(path.parent))


@dataclass(frozen=True, slots=True)
class WalkedSegment:
    """A segment in a walk over a recording.

    Attributes:
        number: Its number.
        reader: Reads it.
        summary: Its footer.
        begin: Bytes of the segments before it.
        report: Told the bytes of the walk behind each chunk that was read.
    """

    number: int
    reader: SegmentReader
    summary: SegmentSummary
    begin: int
    report: Callable[[int], None]

    def chunks(
        self, is_wanted: Callable[[ChunkPlace], bool] = lambda _: True
    ) -> Iterator[tuple[ChunkPlace, StoredChunk | SegmentError]]:
        """The wanted chunks in order; what is wrong with those that cannot be read."""
        for place in self.summary.chunks:
            if not is_wanted(place):
                continue
            found: StoredChunk | SegmentError
            try:
                found = self.reader.read_chunk(place)
            except SegmentError as error:
                found = error
            yield place, found
            self.report(self.begin + place.offset + place.length)


def walk(
    recording: Path,
    names: Mapping[int, str],
    contents: RecordingPayloads | None = None,
    report: Callable[[int], None] = lambda _: None,
    *,
    known: Mapping[int, SegmentSummary] | None = None,
) -> Iterator[WalkedSegment]:
    """Open sealed segments of a recording, one after the other.

    Args:
        recording: The recording's directory.
        names: Names of the segments, by number.
        contents: As for `open_segment`.
        report: As for `WalkedSegment`; told at the end of each segment, too.
        known: Footers that were read before.

    Raises:
        SegmentError: One cannot be opened.
    """
    contents = contents or RecordingPayloads(recording)
    begin = 0
    for number, name in names.items():
        with open_segment(recording / name, number, contents) as reader:
            summary = (known or {}).get(number) or reader.summary()
            yield WalkedSegment(number, reader, summary, begin, report)
            begin += reader.size
            report(begin)
