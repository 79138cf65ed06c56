"""Decodes messages again to restore header stamps and decoding failures in the catalog."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from hybridlog.columns.payload_files import walk
from hybridlog.entries import take_inventory
from hybridlog.index.indexing import ChunkIndexer
from hybridlog.maintenance.opening import put_entry
from hybridlog.maintenance.report import reporter
from hybridlog_storage.catalog import stamps_of
from hybridlog_storage.errors import SegmentError

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from hybridlog.entries import Inventory
    from hybridlog.maintenance.report import Progress
    from hybridlog_storage.catalog import Catalog, ChannelStats, RecordingEntry
    from hybridlog_storage.disk.directory import StoreDirectory


def decode_again(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    progress: Progress | None = None,
) -> RecordingEntry:
    """Decode all segments without decoding results in the catalog.

    Args:
        directory: The store.
        catalog: Its catalog.
        entry: The recording, locked by this process for writing.
        progress: Called after each chunk.

    Returns:
        The recording's complete entry.

    Raises:
        SegmentError: A segment cannot be opened.
    """
    inventory = take_inventory(directory, entry.label)
    found = _decoded(directory, catalog, entry, inventory, progress)
    catalog.put_stamps(entry.id, found)
    return put_entry(directory, catalog, entry.label)


def _decoded(
    directory: StoreDirectory,
    catalog: Catalog,
    entry: RecordingEntry,
    inventory: Inventory,
    progress: Progress | None,
) -> Iterator[tuple[int, str, NDArray[Any]]]:
    indexer = ChunkIndexer(entry.id)
    missing = {
        number: summary
        for number, summary in inventory.summaries.items()
        if catalog.stamps(entry, number, summary.table) is None
    }
    report = reporter(progress, entry.label, sum(summary.size for summary in missing.values()))
    for segment in walk(directory.recording(entry.label), missing, report=report, known=missing):
        summary = segment.summary
        stats: dict[int, Mapping[int, ChannelStats]] = {}
        for place, chunk in segment.chunks():
            if not isinstance(chunk, SegmentError):  # an unreadable chunk has no results
                _, (of_chunk,) = indexer.documents_of([chunk], summary.channels)
                stats[place.number] = of_chunk.stats
        yield segment.number, summary.digest, stamps_of(summary.table, stats)
