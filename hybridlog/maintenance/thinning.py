"""Takes chunks whose messages are in columns out of the segments of a recording.

A chunk is taken out only if its whole content, rebuilt from the columns that the journal
lists, equals the content in the segment. The segment is then written again without it, next
to the old one, and every chunk of the new one is read and compared with the old one. Only
then the journal announces the new segment, and it takes the place of the old one. A crash
before that line leaves a file that the next opening removes; after it, the next opening
renames it. Until then both segments are right.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from hybridlog.columns import payload_files
from hybridlog.columns.layout import replacement_name
from hybridlog.columns.payload_files import RecordingPayloads, open_segment, walk
from hybridlog.entries import take_inventory
from hybridlog.maintenance.report import CompactedTopic, reporter
from hybridlog_storage import journal
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.journal import Journal
from hybridlog_storage.messages import EXPIRED_IDS
from hybridlog_storage.segments.segment_check import SegmentCheck
from hybridlog_storage.segments.segment_file import sealed_name
from hybridlog_storage.segments.segment_format import MOVED_SIZE, moved_record
from hybridlog_storage.segments.segment_thinning import thin

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
    from pathlib import Path

    from hybridlog.columns.payload_files import WalkedSegment
    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.disk.directory import StoreDirectory
    from hybridlog_storage.journal import JournalState, PayloadFile
    from hybridlog_storage.messages import Buffer
    from hybridlog_storage.segments.chunk import StoredChunk
    from hybridlog_storage.segments.segment_reader import (
        ChunkPlace,
        SegmentReader,
        SegmentSummary,
    )


def drop(
    directory: StoreDirectory,
    label: str,
    topics: Collection[str] | None,
    reports: Sequence[CompactedTopic],
    progress: Progress | None,
) -> list[CompactedTopic]:
    """Take chunks out of the segments of a recording that this process has locked.

    Args:
        directory: The store.
        label: The recording.
        topics: Only chunks of these topics; None for all that have columns.
        reports: What was done before; `dropped` is filled in.
        progress: Called after each chunk.

    Returns:
        The reports, with those of topics that had columns before.

    Raises:
        SegmentError: A new segment is not what it should be.
        DiskFullError: There is no room; the recording is right.
    """
    path = directory.recording(label)
    inventory = take_inventory(directory, label)
    dropped: Counter[str] = Counter()
    contents = RecordingPayloads(path)
    sizes = [summary.size for summary in inventory.summaries.values()]
    done = reporter(progress, label, sum(sizes))
    footers = inventory.summaries
    for segment in walk(path, footers, contents, done, known=footers):
        summary = segment.summary
        movable = _movable(inventory, segment, contents, topics)
        if movable:
            assert inventory.state is not None  # it has the columns
            replace_chunks(
                path,
                inventory.state,
                segment.reader,
                summary,
                dict.fromkeys(movable, moved_record),
                files=inventory.payloads.values(),
                event=journal.COMPACTED,
                log=Journal(path),
                contents=contents,
            )
            dropped.update(_messages(summary, movable))
    found = {report.topic: report for report in reports}
    for topic, count in dropped.items():
        report = found.setdefault(topic, CompactedTopic(label, topic))
        report.dropped += count
    for topic, count in _left(take_inventory(directory, label)).items():
        if topic in found or topics is None or topic in topics:
            found.setdefault(topic, CompactedTopic(label, topic)).both = count
    known = {report.topic for report in reports}
    return [*reports, *(report for topic, report in found.items() if topic not in known)]


def _left(inventory: Inventory) -> Counter[str]:
    """Messages in segments of topics that have columns."""
    in_columns = _topics(inventory)
    found: Counter[str] = Counter()
    for summary in inventory.summaries.values():
        there = {chunk.number for chunk in summary.chunks} - _without_content(summary)
        counts = _messages(summary, there)
        found.update({topic: n for topic, n in counts.items() if topic in in_columns})
    return found


def _topics(inventory: Inventory) -> set[str]:
    """Topics that have columns of payloads."""
    return {file.topic for file in inventory.payloads.values() if not file.has_fields}


def _messages(summary: SegmentSummary, chunks: Collection[int]) -> Counter[str]:
    """Messages of each topic in some chunks."""
    number = np.repeat(np.arange(len(summary.table.chunks)), summary.table.chunks["parts"])
    parts = summary.table.parts[np.isin(number, list(chunks))]
    found: Counter[str] = Counter()
    for channel, count in zip(parts["channel"].tolist(), parts["messages"].tolist(), strict=True):
        found[summary.channels[channel].topic] += count
    return found


def _movable(
    inventory: Inventory,
    segment: WalkedSegment,
    contents: RecordingPayloads,
    topics: Collection[str] | None,
) -> set[int]:
    """Numbers of the chunks whose content comes back from columns, byte for byte."""
    in_columns = _topics(inventory)
    if topics is not None:
        in_columns &= set(topics)
    channels, gone = segment.summary.channels, _without_content(segment.summary)

    def is_wanted(place: ChunkPlace) -> bool:
        names = {channels[number].topic for number in place.channels if number in channels}
        return place.number not in gone and names <= in_columns

    found: set[int] = set()
    for place, chunk in segment.chunks(is_wanted):
        if isinstance(chunk, SegmentError):
            continue
        content = memoryview(chunk.batch.buffer).cast("B")
        try:
            rebuilt = contents(segment.number, place.number, len(content))
        except SegmentError:
            continue  # not all of its messages are in columns
        if memoryview(rebuilt).cast("B") == content:
            found.add(place.number)
    return found


def replace_chunks(
    path: Path,
    state: JournalState,
    reader: SegmentReader,
    summary: SegmentSummary,
    records: Mapping[int, Callable[[Buffer], bytes]],
    *,
    files: Iterable[PayloadFile],
    event: str,
    log: Journal,
    contents: RecordingPayloads,
) -> int:
    """Write a segment without the content of some chunks, prove it, and put it in place.

    Args:
        path: The recording's directory, locked by this process.
        state: Its journal.
        reader: The segment.
        summary: Its footer.
        records: As for `thin`.
        files: The files that the content or what is left of it lies in.
        event: Name of the event that announces the new segment.
        log: The journal.
        contents: Has the content of the chunks, or what is left of it.

    Returns:
        Bytes that became free.

    Raises:
        SegmentError: The new segment is not what it should be.
        DiskFullError: There is no room.
    """
    name = sealed_name(reader.number)
    target = path / replacement_name(name)
    sealed = state.sealed.get(reader.number)
    about = {
        "digest": summary.whole_digest,
        "bytes": sealed.bytes if sealed is not None else summary.size,
        "files": [asdict(file) for file in files],
    }
    listed = False
    try:
        written = thin(reader, target, records, about)
        _prove(target, reader, summary, records, contents)
        line = {"segment": reader.number, "bytes": written.bytes, "digest": written.digest}
        if event == journal.EXPIRED:
            line["topics"] = sorted(_messages(summary, records))
        log.append(journal.event(event, segments=[line]))
        listed = True
        thinned = {reader.number: [(written.digest, written.bytes)]}
        if payload_files.replace_segments(path, [target.name], thinned) != [name]:
            raise SegmentError(f"{target} changed while it was to replace {name}")
    except BaseException:
        if not listed:
            now = journal.read(path)
            payload_files.replace_segments(path, [target.name], now.thinned if now else {})
        raise
    return reader.size - written.bytes


def _prove(
    target: Path,
    reader: SegmentReader,
    summary: SegmentSummary,
    changed: Collection[int],
    contents: RecordingPayloads,
) -> None:
    """Compare a new segment with the old one: every byte, every message.

    Raises:
        SegmentError: It differs.
    """
    with SegmentCheck(target) as check:
        problems = [problem for _, problem in check.problems()]
    with open_segment(target, reader.number, contents) as new:
        found = new.summary()
        is_same = (
            not problems
            and (found.recording, found.end, found.losses)
            == (summary.recording, summary.end, summary.losses)
            and _channels(found) == _channels(summary)
            and np.array_equal(found.table.as_stored().parts, summary.table.as_stored().parts)
            and len(found.chunks) == len(summary.chunks)
            and _without_content(found) == {*changed} | _without_content(summary)
            and _stretches(found)[: len(summary.table.others) - 1] == _stretches(summary)[:-1]
            and [len(part) for part in new.indexes()[1:]]
            == [len(part) for part in reader.indexes()[1:]]
            and all(
                there.crc == here.crc
                if here.is_expired
                else _is_same(new.read_chunk(there), reader.read_chunk(here))
                for there, here in zip(found.chunks, summary.chunks, strict=True)
            )
        )
    if not is_same:
        raise SegmentError(f"{target} is not what it should be: {problems or 'a chunk differs'}")


def _without_content(summary: SegmentSummary) -> set[int]:
    """Numbers of moved and expired chunks."""
    return {
        chunk.number for chunk in summary.chunks if chunk.is_expired or chunk.length == MOVED_SIZE
    }


def _channels(summary: SegmentSummary) -> dict[int, dict[str, Any]]:
    return {number: asdict(summary.channels[number]) for number in summary.schema_ids}


def _stretches(summary: SegmentSummary) -> list[tuple[int, int]]:
    """Length and checksum of all bytes between chunks."""
    return [(length, crc) for _, length, crc in summary.table.others.tolist()]


def _is_same(one: StoredChunk, other: StoredChunk) -> bool:
    """True if a chunk has the same messages; of expired ones the payloads are not there."""
    a, b = one.batch, other.batch
    columns = ("log_time", "publish_time", "sequence")
    is_there = one.fields is None
    return (
        not (is_there and memoryview(a.buffer).cast("B") != memoryview(b.buffer).cast("B"))
        and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in columns)
        and np.array_equal(a.channel % EXPIRED_IDS, b.channel % EXPIRED_IDS)
        and all(map(np.array_equal, a.places, b.places))
        and np.array_equal(one.seq, other.seq)
    )
