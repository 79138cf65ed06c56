"""Counts messages without reading them: from statistics, or chunk tables (`chunk_counts`)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.chunk_counts import Placed
from hybridlog.query.engines import Counting, MatchColumns, Need
from hybridlog_storage.times import inside

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.chunk_counts import Parts
    from hybridlog.query.counters import Counters
    from hybridlog.query.question import Part, Span
    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry


_ENTRY_S = 2e-5  # seconds to fetch the entry of a chunk
_READ_S = 1e-4  # seconds to read the message indexes of a chunk
_TIME_S = 2e-7  # seconds to sort the log time of a message
_MAX_CACHED_TIMES = 4_000_000  # of chunks with several channels, until the question is answered


class ChunkIndex(Counting):
    """Answers questions about log time alone, without a predicate.

    Args:
        session: The open store.
        counters: Count the bytes that are read.
    """

    def __init__(self, session: Session, counters: Counters) -> None:
        super().__init__(session, counters)
        self._cached_times: dict[tuple[str, int, int], dict[int, NDArray[np.int64]]] = {}
        self._room = _MAX_CACHED_TIMES

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """For counts and times by log time; it grows with the number of chunks in the range."""
        if part.predicate is not None or not part.is_by_log_time:
            return None
        if need not in {Need.COUNT, Need.OUTCOMES}:
            return None
        if need is Need.OUTCOMES:
            return _READ_S * part.chunks + _TIME_S * part.messages * part.share
        return _ENTRY_S * part.chunks

    def count(self, parts: Sequence[Part]) -> int:
        """Number of messages in the windows of the parts.

        Raises:
            SegmentError: a segment cannot be read, or is damaged in a part that is needed.
        """
        alike: dict[tuple[str, Span | None, int], list[Part]] = defaultdict(list)
        for part in parts:
            alike[part.recording.id, part.bounds, id(part.windows)].append(part)
        return sum(map(self._count, alike.values()))

    def outcomes(self, part: Part) -> Iterator[MatchColumns]:
        """All log times in the windows, sorted; arrival numbers are unknown and 0.

        Raises:
            SegmentError: a segment cannot be read, or is damaged in a part that is needed.
        """
        windows = part.log_windows
        found = [np.empty(0, np.int64)]
        parts = self._parts([part])
        rows = parts.chunk_starts
        for segment, chunk in zip(*(c[rows].tolist() for c in parts[:2]), strict=True):
            times = self._times(part.recording, segment, chunk)
            found += [times[c.channel_id] for c in part.channels if c.channel_id in times]
        time = np.sort(np.concatenate(found))
        time = time[inside(time, windows)]
        yield MatchColumns(time, np.zeros(len(time), np.int64), np.ones(len(time), np.bool_))

    def _count(self, parts: Sequence[Part]) -> int:
        """Number of messages of some topics of one recording in the same windows."""
        edges = parts[0].log_windows.ravel()
        counts = np.zeros((1, max(len(edges) - 1, 0)), np.int64)
        cut = Placed.of(self._parts(parts), edges).add_known(counts)
        cut.add_read(edges, counts, partial(self._times, parts[0].recording))
        return int(counts[0, ::2].sum())

    def _parts(self, parts: Sequence[Part]) -> Parts:
        windows = parts[0].log_windows
        span = (int(windows[0, 0]), int(windows[-1, 1])) if len(windows) else (0, 0)
        channels = [channel.channel_id for part in parts for channel in part.channels]
        return self._session.parts(parts[0].recording, channels, span)

    def _times(
        self, recording: RecordingEntry, segment: int, chunk: int
    ) -> dict[int, NDArray[np.int64]]:
        key = recording.id, segment, chunk
        if key in self._cached_times:
            return self._cached_times[key]
        reader = self._session.segment(recording.id, segment)
        read_before = reader.bytes_read
        times = self._session.times(recording, segment, chunk)
        self._counters.bytes_read += reader.bytes_read - read_before
        size = sum(map(len, times.values()))
        if len(times) > 1 and size <= self._room:  # another topic may be asked about next
            self._cached_times[key] = times
            self._room -= size
        return times


class Statistics(Counting):
    """Uses the number of messages of each channel; reads nothing."""

    def cost(self, part: Part, need: Need, fields: Collection[str] | None = ()) -> float | None:
        """Zero for a count without predicate and time range."""
        is_plain = part.predicate is None and part.is_unbounded
        return 0.0 if need is Need.COUNT and is_plain else None

    def count(self, parts: Sequence[Part]) -> int:
        """Sum of the statistics."""
        return sum(part.messages for part in parts)
