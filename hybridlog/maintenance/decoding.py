"""Decodes messages again to restore header stamps and decoding failures in the catalog."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING

from hybridlog.columns.payload_files import open_segment
from hybridlog.entries import take_inventory
from hybridlog.index.indexing import ChunkIndexer
from hybridlog.maintenance.opening import put_entry
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
    total = sum(summary.size for summary in inventory.summaries.values())
    before = 0
    for number, summary in inventory.summaries.items():
        if catalog.stamps(entry, number, summary.table) is None:
            stats: dict[int, Mapping[int, ChannelStats]] = {}
            path = directory.recording(entry.label) / inventory.listing.sealed[number]
            with open_segment(path, number) as reader:
                for place in summary.chunks:
                    # An unreadable chunk has no results; reading it raises an error.
                    with suppress(SegmentError):
                        chunk = reader.read_chunk(place)
                        _, (of_chunk,) = indexer.documents_of([chunk], summary.channels)
                        stats[place.number] = of_chunk.stats
                    if progress is not None:
                        progress(entry.label, before + place.offset + place.length, total)
            yield number, summary.digest, stamps_of(summary.table, stats)
        before += summary.size
