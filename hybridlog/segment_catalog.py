"""The catalog as the segments tell it, for when MongoDB is away.

It knows what a segment's own summary knows: enough to fetch by topic and time.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from hybridlog.entries import (
    StoredSummaries,
    build_entry,
    channels_of,
    entry_of,
    read_summaries,
)
from hybridlog.indexing import ChunkIndexer
from hybridlog_storage.catalog import ChannelStats, ChannelTotals, ChunkEntry, RecordingEntry

if TYPE_CHECKING:
    from hybridlog_storage.directory import StoreDirectory
    from hybridlog_storage.messages import Channel


class SegmentCatalog:
    """Reads summaries of sealed segments, each recording's once."""

    def __init__(self, directory: StoreDirectory) -> None:
        self._directory = directory
        self._chunks: dict[str, list[ChunkEntry]] = {}

    def recordings(self) -> list[RecordingEntry]:
        """All recordings with a sealed segment, oldest log time first."""
        found = []
        for recording_id in self._directory.recording_ids():
            summaries = read_summaries(self._directory, recording_id)
            if not summaries:
                continue
            base = entry_of(summaries[min(summaries)].recording)
            indexer = ChunkIndexer(recording_id, base.key)
            totals = ChannelTotals()  # what only the index knows
            found.append(
                build_entry(self._directory, indexer, recording_id, totals, summaries.values())
            )
            self._chunks[recording_id] = [
                ChunkEntry(
                    recording_id,
                    number,
                    place.offset,
                    place.length,
                    place.trailer,
                    place.first,
                    place.last,
                    {c: ChannelStats(first=place.first, last=place.last) for c in place.channels},
                )
                for number, summary in summaries.items()
                for place in summary.chunks
            ]
        return sorted(found, key=lambda r: (r.span is None, r.span or (0, 0), r.id))

    def chunks(
        self,
        recording: str,
        channels: Sequence[int] | None = None,
        bounds: tuple[int, int] | None = None,
        clock: str = "log",
        longest: int | None = None,
        *,
        brief: bool = False,
    ) -> list[ChunkEntry]:
        """Chunks that may hold messages of some channels in a time range.

        Segments know log times only: with another clock every chunk may.
        """
        found = self._chunks.get(recording, [])
        if channels is not None:
            wanted = set(channels)
            found = [c for c in found if not wanted.isdisjoint(c.stats)]
        if bounds is not None and clock == "log":
            found = [c for c in found if c.first < bounds[1] and c.last >= bounds[0]]
        return found


def channels_of_recording(directory: StoreDirectory, recording_id: str) -> dict[int, Channel]:
    """The channels of a recording, from its segments."""
    return channels_of(StoredSummaries(directory, recording_id))
