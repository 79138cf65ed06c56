"""Catalog entries of recordings, made from segments and chunk entries alone.

`record` and `reindex` both end here, which is why their entries are equal.
"""

from __future__ import annotations

import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, cast

from hybridlog.losses import joined
from hybridlog_storage.catalog import (
    ChannelEntry,
    ChannelStats,
    ChannelTotals,
    RecordingEntry,
    channel_entry,
)
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segment_reader import SegmentReader, SegmentSummary

if TYPE_CHECKING:
    from pathlib import Path

    from hybridlog.indexing import ChunkIndexer
    from hybridlog_storage.directory import StoreDirectory


def new_key(taken: Iterable[int]) -> int:
    """A random 32-bit number that no other recording of the store has."""
    used = set(taken)
    while True:
        key = secrets.randbits(32)
        if key not in used:
            return key


def recording_metadata(entry: RecordingEntry) -> dict[str, object]:
    """What each segment keeps of its recording."""
    return {
        "id": entry.id,
        "key": entry.key,
        "name": entry.name,
        "tags": entry.tags,
        "source": entry.source,
        "created": entry.created,
    }


def entry_of(recording: Mapping[str, object]) -> RecordingEntry:
    """The entry of a recording as its segments describe it, without statistics.

    Raises:
        SegmentError: the description is damaged.
    """
    try:
        return RecordingEntry(
            id=str(recording["id"]),
            key=int(cast(int, recording["key"])),
            name=str(recording["name"]),
            tags=dict(cast("Mapping[str, str]", recording["tags"])),
            source=dict(cast("Mapping[str, Any]", recording["source"])),
            created=int(cast(int, recording["created"])),
            status="open",
        )
    except (KeyError, TypeError, ValueError) as error:
        raise SegmentError(f"the description of a recording is damaged: {error!r}") from error


def channels_of(summaries: Iterable[SegmentSummary]) -> dict[int, Channel]:
    """All channels of a recording, by id."""
    channels: dict[int, Channel] = {}
    for summary in summaries:
        channels.update(summary.channels)
    return channels


class StoredSummaries:
    """Summaries of a recording's sealed segments, in order; of a long one too many to hold."""

    def __init__(self, directory: StoreDirectory, recording_id: str) -> None:
        self._segments = directory.segments(recording_id)

    def __iter__(self) -> Iterator[SegmentSummary]:
        """Read one after the other."""
        for number, path in self._segments:
            yield _summary(number, path)


def read_summaries(directory: StoreDirectory, recording_id: str) -> dict[int, SegmentSummary]:
    """The summaries of a recording's sealed segments, by segment number."""
    return {number: _summary(number, path) for number, path in directory.segments(recording_id)}


def _summary(number: int, path: Path) -> SegmentSummary:
    with SegmentReader(path, number) as reader:
        return reader.summary()


def build_entry(
    directory: StoreDirectory,
    indexer: ChunkIndexer,
    recording_id: str,
    totals: ChannelTotals,
    summaries: Iterable[SegmentSummary] | None = None,
) -> RecordingEntry:
    """The whole entry of a sealed recording.

    Args:
        directory: The store.
        indexer: Knows which channels are indexed.
        recording_id: The recording.
        totals: Statistics of its channels, as far as its chunks are indexed.
        summaries: Summaries of its segments, in order, if they are at hand; may be gone
            through twice.

    Raises:
        SegmentError: a segment cannot be read, or there is none.
    """
    if summaries is None:
        summaries = StoredSummaries(directory, recording_id)
    entry: RecordingEntry | None = None
    channels: dict[int, Channel] = {}
    counts: Counter[int] = Counter()
    end: Mapping[str, Any] | None = None
    lost: list[dict[str, Any]] = []
    segments = chunks = 0
    for summary in summaries:
        entry = entry or entry_of(summary.recording)
        channels.update(summary.channels)
        counts.update(summary.counts)
        end = summary.end if summary.end is not None else end
        lost += summary.losses
        segments += 1
        chunks += len(summary.chunks)
    if entry is None:
        raise SegmentError(f"Recording {recording_id!r} has no sealed segment.")
    entry.id = recording_id
    entry.status = str(end.get("status", "complete")) if end is not None else "recovered"
    entry.end = dict(end) if end is not None else {}
    if lost:
        entry.end["losses"] = joined([*entry.end.get("losses", ()), *lost])
    for channel_id, channel in sorted(channels.items()):
        reason = indexer.reason(channel_id, channel)
        entry.channels.append(channel_entry(channel_id, channel, reason))
        entry.channels[-1].stats = totals.stats(channel_id)
    _fill_unindexed(entry.channels, counts, summaries)
    entry.segments, entry.chunks = segments, chunks
    entry.stored_bytes = sum(p.stat().st_size for _, p in directory.segments(recording_id))
    return entry


def _fill_unindexed(
    channels: Iterable[ChannelEntry],
    counts: Mapping[int, int],
    summaries: Iterable[SegmentSummary],
) -> None:
    """Where chunks have no entries (yet), say at least what the segments' summaries say."""
    short = {c.id: c.stats for c in channels if counts.get(c.id, 0) > c.stats.messages}
    if not short:
        return
    for summary in summaries:
        for chunk in summary.chunks:
            for channel_id in short.keys() & chunk.channels:
                short[channel_id].add(ChannelStats(first=chunk.first, last=chunk.last))
    for channel_id, stats in short.items():
        stats.messages = counts[channel_id]
