"""What a catalog tells of each chunk, as entries."""

from __future__ import annotations

from hybridlog_storage.catalog import Catalog, ChannelStats, ChunkEntry, RecordingEntry


def chunk_entries(catalog: Catalog, entry: RecordingEntry) -> list[ChunkEntry]:
    """All chunks of a recording, with the numbers of messages in them."""
    return [
        ChunkEntry(
            segment,
            number,
            {
                int(part["channel"]): ChannelStats(messages=int(part["messages"]))
                for part in table.chunk_parts(number)
            },
        )
        for segment, _, _ in entry.spans
        for table in [catalog.table(entry, segment)]
        for number in range(len(table.chunks))
    ]
