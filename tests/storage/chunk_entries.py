"""What a catalog tells of each chunk, as entries."""

from __future__ import annotations

from hybridlog_storage.catalog import Catalog, ChunkEntry, RecordingEntry


def chunk_entries(catalog: Catalog, entry: RecordingEntry) -> list[ChunkEntry]:
    """All chunks of a recording."""
    return [
        ChunkEntry(segment, number, catalog.chunk_stats(entry, segment, number))
        for segment, _, _ in entry.spans
        for number in range(len(catalog.table(entry, segment).chunks))
    ]
