"""Copies payloads of ended recordings into columns, and proves that they come back.

The steps are: write the files in a folder of their own; force them to the disk; rebuild
every message from them and compare it with its segment; list them in the journal; give them
their names. A crash before the journal's line leaves a folder that the next opening
removes; after it, the next opening finishes.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass, field
from functools import partial
from itertools import count, pairwise
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.columns import payload_files
from hybridlog.columns.layout import PAYLOAD_PARTS, table_schema_of, topic_folder
from hybridlog.columns.payload_files import RecordingPayloads, walk
from hybridlog.entries import put_entry, take_inventory
from hybridlog.maintenance import thinning
from hybridlog.maintenance.report import CompactedTopic, reporter
from hybridlog_storage import journal
from hybridlog_storage.disk import durability, files
from hybridlog_storage.disk.directory import LOCK_WAIT_S
from hybridlog_storage.errors import DefinitionError, SegmentError, StoreError
from hybridlog_storage.journal import Journal
from hybridlog_storage.mcap.mcap_content import MESSAGE_HEAD

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from hybridlog.columns.payload_rows import TopicColumns
    from hybridlog.columns.payload_writer import TopicWriter
    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import Catalog, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.journal import PayloadFile
    from hybridlog_storage.messages import Channel
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.chunk_table import ChunkTable
    from hybridlog_storage.segments.segment_reader import ChunkPlace, SegmentSummary

_MIN_SHARE = 0.5  # of the sequences in the bytes of a topic's messages
_MIN_BYTES = 128 << 10  # of a topic's messages: the footer of a file takes some kilobytes


@dataclass(slots=True)
class _Topic:
    """A topic of one type that is being compacted."""

    name: str
    channels: dict[int, Channel]
    columns: TopicColumns
    report: CompactedTopic
    writer: TopicWriter | None = None
    files: list[PayloadFile] = field(default_factory=list)

    def rows_of(self, chunk: StoredChunk) -> NDArray[np.intp]:
        return np.flatnonzero(np.isin(chunk.batch.channel, list(self.channels)))

    def exclude(self, messages: int, reason: str) -> None:
        self.report.kept += messages
        self.report.reason = reason


def compact(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    *,
    topics: Collection[str] | None = None,
    drop_mcap: bool = False,
    dry_run: bool = False,
    progress: Progress | None = None,
) -> list[CompactedTopic]:
    """Write columns of payloads of a recording that has ended.

    Args:
        directory: The store.
        catalog: Its catalog.
        entry: The recording.
        topics: Full names of the topics; None for those that consist of arrays mostly.
        drop_mcap: True to take chunks that are in columns out of the segments.
        dry_run: True to write nothing.
        progress: Called after each chunk.

    Returns:
        The topics; those that have columns already are left out, unless their chunks are taken
        out of the segments.

    Raises:
        StoreError: The recording is being written, or files cannot be read or written.
        TopicError: It is gone.
        DiskFullError: There is no room; the recording is as it was.
    """
    with directory.writing(entry.label, entry.id, wait_s=LOCK_WAIT_S) as label:
        work = _Compaction(directory, label, progress)
        chosen = work.choose(topics)
        reports = [*work.refused, *(topic.report for topic in chosen)]
        if dry_run or not (chosen or drop_mcap):
            return reports
        try:
            if chosen:
                work.write(chosen)
                work.prove(chosen)
                if made := [file for topic in chosen for file in topic.files]:
                    log = Journal(work.path)
                    payload_files.announce(work.path, made, journal.COMPACTED, log, ())
                payload_files.publish(work.path, journal.read(work.path))
        except BaseException as error:
            payload_files.take_back(work.path, work.state)
            if isinstance(error, OSError):
                raise durability.explain(error, work.path, "writing columns of") from error
            raise
        try:
            if drop_mcap:
                reports = thinning.drop(directory, label, topics, reports, progress)
        except OSError as error:
            raise durability.explain(error, work.path, "replacing segments of") from error
        finally:
            put_entry(directory, catalog, label)
        return reports


class _Compaction:
    """The steps for one recording, which this process has locked."""

    def __init__(self, directory: StoreDirectory, label: str, progress: Progress | None) -> None:
        self.path: Path = directory.recording(label)
        self.refused: list[CompactedTopic] = []
        self._label = label
        self._inventory: Inventory = take_inventory(directory, label)
        state = self._inventory.state
        if state is None or state.end is None:
            raise StoreError(
                f"The journal of recording {label!r} has no end: run `hybridlog verify --repair` "
                "first."
            )
        self.state = state
        self._size = sum(summary.size for summary in self._inventory.summaries.values())
        self._report = reporter(progress, label, 2 * self._size)  # what is written is proved

    def choose(self, topics: Collection[str] | None) -> list[_Topic]:
        """The topics whose payloads can be moved.

        Args:
            topics: Full names of the wanted ones; those that cannot are `refused` by name.
        """
        from hybridlog.columns.payload_rows import TopicColumns

        have = {f.topic for f in self.state.payloads.values() if not f.has_fields}
        found: dict[tuple[str, str], _Topic] = {}
        refused: dict[str, CompactedTopic] = {}
        for number, channel, messages in self._channels():
            name = channel.topic
            if name in have or (topics is not None and name not in topics):
                continue
            key = name, table_schema_of(channel)
            try:
                topic = found.get(key) or _Topic(
                    name, {}, TopicColumns(channel), CompactedTopic(self._label, name)
                )
            except DefinitionError as error:
                report = refused.setdefault(name, CompactedTopic(self._label, name))
                report.kept, report.reason = report.kept + messages, str(error)
                continue
            found[key] = topic
            topic.channels[number] = channel
            topic.report.messages += messages
        if topics is not None:
            self.refused = list(refused.values())
        chosen = [t for t in found.values() if topics is not None or self._is_worth(t)]
        return sorted(chosen, key=lambda topic: topic.name)

    def _channels(self) -> Iterator[tuple[int, Channel, int]]:
        """Id, channel and number of messages of each channel in each segment."""
        for summary in self._inventory.summaries.values():
            for number, channel in summary.channels.items():
                if messages := summary.counts.get(number, 0):
                    yield number, channel, messages

    def _is_worth(self, topic: _Topic) -> bool:
        """True if a topic is large, and the sequences of its first messages are most of it."""
        totals = [
            row
            for summary in self._inventory.summaries.values()
            for row in summary.table.by_channel()
        ]
        size = sum(int(r["payload_bytes"]) for r in totals if int(r["channel"]) in topic.channels)
        if size < _MIN_BYTES:
            return False
        for _, _, chunk in self._chunks([topic]):
            if not isinstance(chunk, SegmentError):
                batch = chunk.batch.take(topic.rows_of(chunk))
                return topic.columns.share_of_sequences(batch) >= _MIN_SHARE
        return False

    def write(self, chosen: Sequence[_Topic]) -> None:
        """Write the files; what does not fit its definition stays where it is."""
        from hybridlog.columns.payload_writer import TopicWriter

        files.remove_tree(self.path / PAYLOAD_PARTS)
        numbers: defaultdict[str, count[int]] = defaultdict(count)
        for topic in chosen:
            topic.report.messages = 0
            topic.writer = TopicWriter(
                self.path / PAYLOAD_PARTS,
                self._inventory.id,
                next(iter(topic.channels.values())),
                topic.columns,
                partial(next, numbers[topic_folder(topic.name)]),
            )
        for summary, place, chunk in self._chunks(chosen, self._report):
            if isinstance(chunk, SegmentError):
                _exclude_damaged(chosen, summary.table, place.number)
                continue
            for topic in chosen:
                rows = topic.rows_of(chunk)
                if len(rows):
                    self._add(topic, chunk, rows, summary.digest)
        for topic in chosen:
            assert topic.writer is not None
            topic.writer.close()
            topic.files = topic.writer.written
            topic.report.column_bytes = sum(file.bytes for file in topic.files)

    def _add(self, topic: _Topic, chunk: StoredChunk, rows: NDArray[np.intp], digest: str) -> None:
        has_publish_time = {n: channel.has_publish_time for n, channel in topic.channels.items()}
        piece = topic.columns.piece(chunk, rows, has_publish_time)
        if piece is None:
            topic.exclude(len(rows), "a message of the chunk does not fit its definition")
            return
        assert topic.writer is not None
        topic.writer.add(piece, chunk.segment, chunk.number, digest)
        topic.report.messages += len(rows)
        topic.report.payload_bytes += int(chunk.batch.length[rows].sum())

    def prove(self, chosen: Sequence[_Topic]) -> None:
        """Rebuild every message from the files and compare it with its segment.

        The files of a topic that differs are removed.
        """
        left = {
            number: (
                topic,
                RecordingPayloads(self.path, topic.files, PAYLOAD_PARTS),
                Counter[str](),
            )
            for number, topic in enumerate(chosen)
            if topic.files
        }
        read = [topic for topic, _, _ in left.values()]
        for _, _, chunk in self._chunks(read, lambda done: self._report(self._size + done)):
            if isinstance(chunk, SegmentError):
                continue
            for number, (topic, payloads, seen) in list(left.items()):
                problem = _difference(payloads, chunk, topic.rows_of(chunk), seen)
                if problem:
                    del left[number]
                    self._refuse(topic, problem)
        for topic, _, seen in left.values():
            if seen != {file.file: file.messages for file in topic.files}:
                self._refuse(topic, "its columns hold messages that no segment has")

    def _refuse(self, topic: _Topic, problem: str) -> None:
        """Remove the files of a topic that did not come back exactly."""
        report = topic.report
        topic.exclude(report.messages, problem)
        report.messages = report.payload_bytes = report.column_bytes = 0
        for file in topic.files:
            files.unlink(self.path / PAYLOAD_PARTS / file.file)
        topic.files = []

    def _chunks(
        self, topics: Sequence[_Topic], report: Callable[[int], None] = lambda _: None
    ) -> Iterator[tuple[SegmentSummary, ChunkPlace, StoredChunk | SegmentError]]:
        """Chunks with messages of some topics in order, with the footer of their segment."""
        wanted = {number for topic in topics for number in topic.channels}
        known = self._inventory.summaries
        for segment in walk(self.path, known, report=report, known=known):
            for place, chunk in segment.chunks(lambda p: not wanted.isdisjoint(p.channels)):
                yield segment.summary, place, chunk


def _exclude_damaged(topics: Sequence[_Topic], table: ChunkTable, number: int) -> None:
    """Count the messages of a chunk that cannot be read."""
    bounds = table.part_bounds()
    for part in table.parts[bounds[number] : bounds[number + 1]]:
        for topic in topics:
            if int(part["channel"]) in topic.channels:
                topic.exclude(int(part["messages"]), "a chunk is damaged; run `hybridlog verify`")


def _difference(
    payloads: RecordingPayloads, chunk: StoredChunk, rows: NDArray[np.intp], seen: Counter[str]
) -> str:
    """Compare messages of a chunk with those in columns, byte for byte.

    Returns:
        The difference; empty if there is none, or if the chunk is not in the columns.
    """
    try:
        readers = payloads.having(chunk.segment, chunk.number)
        if not readers or not len(rows):
            return ""
        (reader,) = readers
        place = reader.places[chunk.segment, chunk.number]
        rebuilt = reader.rebuilt(place.group)
    except StoreError as error:
        return str(error)
    inside = slice(place.begin, place.begin + place.rows)
    begin = chunk.batch.offset[rows] - MESSAGE_HEAD.itemsize
    end = chunk.batch.offset[rows] + chunk.batch.length[rows]
    is_same = place.rows == len(rows) and bool(
        (rebuilt.seq[inside] == chunk.seq[rows]).all()
        and (rebuilt.place[inside] == begin).all()
        and (np.diff(rebuilt.offset)[inside] == end - begin).all()
    )
    if not is_same:
        return "its columns hold other messages"
    content = memoryview(chunk.batch.buffer)
    start = rebuilt.offset[place.begin : place.begin + place.rows + 1].tolist()
    data = rebuilt.data.data
    pieces = zip(begin.tolist(), end.tolist(), pairwise(start), strict=True)
    if any(content[a:b] != data[c:d] for a, b, (c, d) in pieces):
        return "a message does not come back from its columns byte for byte"
    seen[reader.listed.file] += len(rows)
    return ""
