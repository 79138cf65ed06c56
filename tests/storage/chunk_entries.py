"""What a catalog tells of each chunk."""

from __future__ import annotations

from typing import NamedTuple

from hybridlog_storage.catalog import Catalog, RecordingEntry


class ChunkEntry(NamedTuple):
    """A chunk, and the number of messages of each channel in it."""

    segment: int
    number: int
    messages: dict[int, int]


def chunk_entries(catalog: Catalog, entry: RecordingEntry) -> list[ChunkEntry]:
    """All chunks of a recording."""
    return [
        ChunkEntry(
            segment,
            number,
            {int(p["channel"]): int(p["messages"]) for p in table.chunk_parts(number)},
        )
        for segment, _, _ in entry.spans
        for table in [catalog.table(entry, segment)]
        for number in range(len(table.chunks))
    ]
