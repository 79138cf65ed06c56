"""The files of fields of a recording: their names, and what is left of expired chunks."""

from __future__ import annotations

import re
import threading
from collections import defaultdict
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Final

from hybridlog.columns.layout import PAYLOAD_PARTS
from hybridlog_storage import journal
from hybridlog_storage.cache import Cache
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import PAYLOADS, payload_names
from hybridlog_storage.errors import SegmentError, StoreError
from hybridlog_storage.lazy import lazy
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.segments.segment_reader import SegmentReader

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from hybridlog.columns.column_file import OpenFiles
    from hybridlog.columns.field_files import FieldFile
    from hybridlog.columns.topic_table import TopicTable
    from hybridlog_storage.journal import Journal, JournalState, PayloadFile
    from hybridlog_storage.segments.chunk import ExpiredMessages, StoredChunk
    from hybridlog_storage.segments.segment_reader import ChunkPlace, SegmentSummary

REPLACEMENT: Final = re.compile(r"(?P<number>\d{6,9})\.mcap\.thinned")
"""Name of a segment that is about to replace the whole one."""


def next_number(state: JournalState) -> int:
    """The least number that no file of fields of a recording has had."""
    names = (name.rpartition("-")[2] for name in state.payloads.keys() | state.deleted)
    return 1 + max((int(name.partition(".")[0]) for name in names), default=-1)


def announce(
    recording: Path, made: Sequence[PayloadFile], log: Journal, deleted: Sequence[str] = ()
) -> None:
    """List new files, still among unfinished ones, and files that go, in the journal.

    Raises:
        HybridlogError: The journal cannot be written.
        OSError: The names of the files cannot be forced to the disk.
    """
    parts = recording / PAYLOAD_PARTS
    for folder in {(parts / file.file).parent for file in made}:
        files.sync_folder(folder)
    files.sync_folder(parts)
    files.sync_folder(recording)
    gone = {"deleted": deleted} if deleted else {}
    log.append(journal.event(journal.EXPIRED, files=[asdict(file) for file in made], **gone))


def take_back(recording: Path, before: JournalState) -> None:
    """Remove unfinished files, unless the journal lists them: then the next opening goes on."""
    with suppress(StoreError, OSError):
        state = journal.read(recording)
        if state is not None and state.payloads.keys() == before.payloads.keys():
            files.remove_tree(recording / PAYLOAD_PARTS)


def publish(recording: Path, state: JournalState | None) -> None:
    """Give finished files their names, remove the folder of unfinished files, and deleted ones.

    Args:
        recording: The recording's directory, locked by this process.
        state: Its journal, which says what is finished and deleted; None without one.

    Raises:
        HybridlogError: A file cannot be renamed or removed.
    """
    parts, final = recording / PAYLOAD_PARTS, recording / PAYLOADS
    try:
        names = sorted(payload_names(recording, PAYLOAD_PARTS))
        moved = [name for name in names if state is not None and name in state.payloads]
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
        deleted = set() if state is None else state.deleted & payload_names(recording).keys()
        for name in sorted(deleted):
            files.unlink(final / name)
    except OSError as error:
        raise durability.explain(error, final, "moving fields to") from error


def replace_segments(
    recording: Path, names: Iterable[str], thinned: Mapping[int, Sequence[tuple[str, int]]]
) -> list[str]:
    """Put finished segments with expired chunks in the place of the whole ones.

    Those that the journal does not list are removed.

    Args:
        recording: The recording's directory, locked by this process.
        names: Names of files in it.
        thinned: Digest and size of such segments as the journal lists them, by number.

    Returns:
        Names of the segments that were replaced.

    Raises:
        HybridlogError: A file cannot be renamed or removed.
    """
    done = []
    try:
        for name in names:
            found = REPLACEMENT.fullmatch(name)
            if found is None:
                continue
            number = int(found["number"])
            if _is_listed(recording / name, number, thinned.get(number, ())):
                final = sealed_name(number)
                files.rename(recording / name, recording / final)
                done.append(final)
            else:
                files.unlink(recording / name)
        if done:
            files.sync_folder(recording)
    except OSError as error:
        raise durability.explain(error, recording, "replacing segments of") from error
    return done


def _is_listed(path: Path, number: int, listed: Sequence[tuple[str, int]]) -> bool:
    if not listed:
        return False
    try:
        with SegmentReader(path, number) as reader:
            summary = reader.summary()
    except SegmentError:
        return False
    return (summary.digest, summary.size) == listed[-1]


class RecordingPayloads:
    """The files of fields of one recording. Thread safe.

    Nothing is read before it is needed.

    Args:
        recording: The recording's directory.
        listed: The files; None for those that its journal lists.
        folder: Name of the folder that holds them.
        cache: Keeps rows that were read.
    """

    def __init__(
        self,
        recording: Path,
        listed: Sequence[PayloadFile] | None = None,
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
    def listed(self) -> Sequence[PayloadFile]:
        """The files.

        Raises:
            StoreError: The journal cannot be read.
        """
        if self._given is not None:
            return self._given
        state = journal.read(self._recording)
        return [] if state is None else list(state.payloads.values())

    def reader(self, listed: PayloadFile) -> FieldFile:
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
    numbers: Iterable[int],
    contents: RecordingPayloads | None = None,
    report: Callable[[int], None] = lambda _: None,
    *,
    known: Mapping[int, SegmentSummary] | None = None,
) -> Iterator[WalkedSegment]:
    """Open sealed segments of a recording, one after the other.

    Args:
        recording: The recording's directory.
        numbers: Numbers of the segments.
        contents: As for `open_segment`.
        report: As for `WalkedSegment`; told at the end of each segment, too.
        known: Footers that were read before.

    Raises:
        SegmentError: One cannot be opened.
    """
    contents = contents or RecordingPayloads(recording)
    begin = 0
    for number in numbers:
        with open_segment(recording / sealed_name(number), number, contents) as reader:
            summary = (known or {}).get(number) or reader.summary()
            yield WalkedSegment(number, reader, summary, begin, report)
            begin += reader.size
            report(begin)
