"""The last message at or before a time, out of as few chunks as may hold it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hybridlog_storage.catalog import ChunkEntry
    from hybridlog_storage.chunk import StoredChunk
    from hybridlog_storage.messages import Batch


@dataclass(frozen=True, slots=True)
class Found:
    """A message in a chunk.

    Attributes:
        log_time: ns.
        seq: Arrival number in its recording.
        batch: The messages of its chunk; `channel` holds channel ids.
        row: Which of them it is.
    """

    log_time: int
    seq: int
    batch: Batch
    row: int


def last_message(
    chunks: Iterable[tuple[ChunkEntry, int]],
    channels: Collection[int],
    latest: int,
    read: Callable[[ChunkEntry], StoredChunk],
) -> Found | None:
    """The message with the greatest log time, of several the one that arrived last.

    Args:
        chunks: Those of one recording that may hold it, see `ChunkLists.before`.
        channels: Ids of the channels that are asked about.
        latest: The time, ns.
        read: Gives the content of a chunk.

    Raises:
        SegmentError: a chunk is not there, or damaged.
    """
    best: Found | None = None
    for entry, last in chunks:
        if best is not None and last < best.log_time:
            break
        chunk = read(entry)
        others = not all(channel in channels for channel in entry.stats)
        row = _last_row(chunk.batch, channels if others else None, latest)
        if row is not None:
            place = int(chunk.batch.log_time[row]), int(chunk.seq[row])
            if best is None or place > (best.log_time, best.seq):
                best = Found(*place, chunk.batch, row)
    return best


def _last_row(batch: Batch, channels: Collection[int] | None, latest: int) -> int | None:
    """The row of the last message; `channels` is None when the batch has no others."""
    fits = batch.log_time <= latest
    if channels is not None:
        is_wanted = np.zeros(max(channels) + 2, np.bool_)  # the last one stands for all others
        is_wanted[list(channels)] = True
        fits &= is_wanted.take(batch.channel, mode="clip")
    (rows,) = fits.nonzero()
    if not len(rows):
        return None
    # Rows are in the order of arrival: of equal times the last one counts.
    return int(rows[-1 - batch.log_time[rows][::-1].argmax()])
