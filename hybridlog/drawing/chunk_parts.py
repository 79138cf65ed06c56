"""Counts and times of the messages in each chunk, from chunk tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from hybridlog.query.chunk_counts import Parts, part_rows
from hybridlog_storage.messages import MARKS_CHANNEL

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segments.chunk_table import ChunkTable

_CHANNELS = MARKS_CHANNEL + 1  # ids of channels


class RecordedChunks:
    """The chunks of a recording, read segment by segment when a span needs them.

    Not thread safe.
    """

    def __init__(self, session: Session, recording: RecordingEntry) -> None:
        self.session = session
        self._recording = recording
        self._known: dict[int, int] = {}  # chunks of each segment whose parts are known
        self._sealed: set[int] = set()  # segments with no other chunks
        self._rows: list[NDArray[np.int64]] = []
        self._size = 0

    @property
    def size(self) -> int:
        """Number of parts that are known; parts are only added."""
        return self._size

    @property
    def nbytes(self) -> int:
        """Memory of the parts that are known."""
        return sum(rows.nbytes for rows in self._rows)

    def topics(self) -> list[str]:
        """Names of all topics, sorted."""
        return sorted({channel.topic for channel in self._recording.channels})

    def follow(self, recording: RecordingEntry) -> bool:
        """See what was flushed since; False if what was read before does not hold any more."""
        before, self._recording = self._recording, recording
        return (
            recording.status == before.status
            and recording.files == before.files
            and all(
                before.digests.get(number) in {None, recording.digests.get(number)}
                for number in map(str, self._known)
            )
            and all(
                self._has_grown(number, flushed.table)
                for number, flushed in before.flushed.items()
                if number in self._known
            )
        )

    def _has_grown(self, number: int, before: ChunkTable) -> bool:
        """True if a segment has its chunks of before, and maybe more; it may be sealed now."""
        recording = self._recording
        if number not in recording.flushed and str(number) not in recording.digests:
            return False
        count = len(before.chunks)
        now = self.session.chunk_table(recording, number).chunks[:count]
        return len(now) == count and all(
            np.array_equal(now[name][-1:], before.chunks[name][-1:])
            for name in ("offset", "length", "trailer_crc")
        )

    def load(self, span: tuple[int, int]) -> None:
        """Read the chunk tables of segments that may have messages in a span.

        Args:
            span: Log time `[begin, end)`, ns.
        """
        for number, first, last in self._recording.spans:
            if number in self._sealed or first >= span[1] or last < span[0]:
                continue
            table = self.session.chunk_table(self._recording, number)
            new = part_rows(number, table, self._known.get(number, 0))
            if len(new):
                self._rows.append(new)
                self._size += len(new)
            self._known[number] = len(table.chunks)
            if not table.is_flushed:
                self._sealed.add(number)

    def parts(self, span: tuple[int, int], topics: Sequence[str], since: int = 0) -> Parts:
        """The parts of some topics that may have messages in a span.

        Args:
            span: Log time `[begin, end)`, ns.
            topics: Full names.
            since: Leave out as many of the parts known first; see `size`.
        """
        self.load(span)
        if len(self._rows) > 1:
            self._rows = [np.concatenate(self._rows)]
        rows = self._rows[0][since:] if self._rows else np.empty((0, 6), np.int64)
        places = {topic: place for place, topic in enumerate(topics)}
        topic_of = np.full(_CHANNELS, -1, np.intp)
        for channel in self._recording.channels:
            topic_of[channel.id] = places.get(channel.topic, -1)
        wanted = (rows[:, 4] < span[1]) & (rows[:, 5] >= span[0]) & (topic_of[rows[:, 2]] >= 0)
        return Parts.of(rows[wanted], topic_of[rows[wanted, 2]])

    def times(self, segment: int, chunk: int) -> dict[int, NDArray[np.int64]]:
        """Log times of a chunk's messages by channel, ascending; reads no payload.

        Raises:
            SegmentError: They are missing or damaged.
        """
        return self.session.times(self._recording, segment, chunk)
