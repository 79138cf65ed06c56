"""Catalog entries of recordings, made from segments and chunk entries alone.

`record` and `reindex` both end here, which is why their entries are equal.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, cast

from hybridlog.losses import joined
from hybridlog_storage.catalog import (
    ChannelEntry,
    ChannelStats,
    ChunkEntry,
    RecordingEntry,
    channel_entry,
)
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segment_reader import SegmentReader, SegmentSummary

if TYPE_CHECKING:
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


def read_summaries(directory: StoreDirectory, recording_id: str) -> dict[int, SegmentSummary]:
    """The summaries of a recording's sealed segments, by segment number."""
    summaries = {}
    for number, path in directory.segments(recording_id):
        with SegmentReader(path, number) as reader:
            summaries[number] = reader.summary()
    return summaries


def build_entry(
    directory: StoreDirectory,
    indexer: ChunkIndexer,
    recording_id: str,
    chunks: Iterable[ChunkEntry],
    summaries: Mapping[int, SegmentSummary] | None = None,
) -> RecordingEntry:
    """The whole entry of a sealed recording.

    Args:
        directory: The store.
        indexer: Knows which channels are indexed.
        recording_id: The recording.
        chunks: Entries of all its chunks, in any order.
        summaries: Summaries of its segments, if they are at hand.
    """
    if summaries is None:
        summaries = read_summaries(directory, recording_id)
    if not summaries:
        raise SegmentError(f"Recording {recording_id!r} has no sealed segment.")
    entry = entry_of(summaries[min(summaries)].recording)
    entry.id = recording_id
    ends = [s.end for _, s in sorted(summaries.items()) if s.end is not None]
    entry.status = str(ends[-1].get("status", "complete")) if ends else "recovered"
    entry.end = dict(ends[-1]) if ends else {}
    lost = [row for _, summary in sorted(summaries.items()) for row in summary.losses]
    if lost:
        entry.end["losses"] = joined([*entry.end.get("losses", ()), *lost])
    entries: dict[int, ChannelEntry] = {
        channel_id: channel_entry(channel_id, channel, indexer.reason(channel_id, channel))
        for channel_id, channel in sorted(channels_of(summaries.values()).items())
    }
    # Sums of floats depend on their order, so it is fixed.
    for chunk in sorted(chunks, key=lambda c: (c.segment, c.offset)):
        for channel_id, stats in chunk.stats.items():
            entries[channel_id].stats.add(stats)
    _fill_unindexed(entries, summaries)
    entry.channels = list(entries.values())
    entry.segments = len(summaries)
    entry.chunks = sum(len(s.chunks) for s in summaries.values())
    entry.stored_bytes = sum(p.stat().st_size for _, p in directory.segments(recording_id))
    return entry


def _fill_unindexed(
    entries: Mapping[int, ChannelEntry], summaries: Mapping[int, SegmentSummary]
) -> None:
    """Where chunks have no entries (yet), say at least what the segments' summaries say."""
    for channel_id, entry in entries.items():
        counted = sum(s.counts.get(channel_id, 0) for s in summaries.values())
        if counted > entry.stats.messages:
            places = [c for s in summaries.values() for c in s.chunks if channel_id in c.channels]
            entry.stats.add(
                ChannelStats(
                    messages=counted - entry.stats.messages,
                    first=min(c.first for c in places),
                    last=max(c.last for c in places),
                )
            )
