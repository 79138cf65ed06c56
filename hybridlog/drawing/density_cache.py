"""Densities of recordings that are drawn again and again, at any zoom.

Time is cut into bins of a power of two of nanoseconds, counted from the epoch, so that bins
stay the same when a picture moves. Neighbouring bins form blocks. A block is counted once, in
finer bins than the picture needs, so that the next steps of zooming in read nothing. Chunks
that a running recording adds are counted into the blocks that they touch.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, defaultdict
from collections.abc import Sequence
from itertools import groupby, product
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from hybridlog.drawing.chunk_parts import RecordedChunks
from hybridlog.drawing.density import MOST_WORK, Density, count, reading_work
from hybridlog.drawing.silence import sampled_period
from hybridlog_storage.errors import TopicError
from hybridlog_storage.stopping import held

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry

_RECORDINGS: Final = 4
_MOST_BYTES: Final = 24 << 20  # of the blocks of one recording
_BLOCK: Final = 10  # a block has 2^10 bins
_STEPS: Final = 4  # of zooming in that are drawn from the same bins
_MOST_BINS: Final = 1 << 21  # that are counted for one picture
_LIGHT: Final = 1 << 20  # messages that are read for finer bins in any case
_DEARER: Final = 4  # times more messages that finer bins may cost
_LATEST: Final = np.iinfo(np.int64).max


class _Block(NamedTuple):
    """Counts of one topic in some neighbouring bins.

    Attributes:
        counts: Unsigned integers, 2^`_BLOCK` of them.
        exact: False if they are estimates.
        parts: Number of the recording's parts that are counted.
    """

    counts: NDArray[np.unsignedinteger[Any]]
    exact: bool
    parts: int


class DensityCache:
    """Counts messages by pixel for many clients. Thread safe.

    Args:
        session: The open store.
    """

    def __init__(self, session: Session) -> None:
        self._session = session
        self._recordings: OrderedDict[str, _Recorded] = OrderedDict()
        self._lock = threading.Lock()

    def density(
        self,
        recording: RecordingEntry,
        span: tuple[int, int],
        pixels: int,
        topics: Sequence[str],
    ) -> Density:
        """Counts of messages by bin.

        Args:
            recording: The recording.
            span: Log time `[begin, end)`, ns.
            pixels: Most bins that fit into the span.
            topics: Full names.

        Returns:
            Bins of equal length that cover the span: more than half as many as pixels, unless
            a bin is one nanosecond, and one more than pixels at most.

        Raises:
            TopicError: The recording has no such topic.
        """
        recorded = self._of(recording)
        with held(recorded.lock):
            return recorded.density(recording, span, pixels, topics)

    def periods(
        self, recording: RecordingEntry, span: tuple[int, int], topics: Sequence[str]
    ) -> list[float]:
        """Usual time from one message of each topic to the next, ns; 0 where it is unknown.

        Args:
            recording: The recording.
            span: Log time of messages that tell it, if it is not known yet.
            topics: Full names.
        """
        recorded = self._of(recording)
        with held(recorded.lock):
            return [recorded.period(recording, span, topic) for topic in topics]

    def _of(self, recording: RecordingEntry) -> _Recorded:
        with self._lock:
            found = self._recordings.pop(recording.id, None) or _Recorded(self._session)
            self._recordings[recording.id] = found
            while len(self._recordings) > _RECORDINGS:
                self._recordings.popitem(last=False)
            return found


class _Recorded:
    """The chunks and blocks of one recording."""

    def __init__(self, session: Session) -> None:
        self.lock = threading.Lock()
        self._session = session
        self._chunks: RecordedChunks | None = None
        self._blocks: OrderedDict[tuple[int, int, str], _Block] = OrderedDict()
        self._bytes = 0
        self._periods: dict[str, tuple[float, int]] = {}  # and the messages that told it

    def follow(self, recording: RecordingEntry) -> RecordedChunks:
        """The chunks as they are now."""
        if self._chunks is None or not self._chunks.follow(recording):
            self._blocks.clear()
            self._bytes = 0
            self._chunks = RecordedChunks(self._session, recording)
        return self._chunks

    def period(self, recording: RecordingEntry, span: tuple[int, int], topic: str) -> float:
        chunks = self.follow(recording)
        known, told = self._periods.get(topic, (0.0, 0))
        if known and recording.status != "open":
            return known
        parts = chunks.parts(span, [topic])
        messages = int(parts.messages.sum())
        if not known or messages > 2 * told:
            known = sampled_period(chunks, parts) or known
            self._periods[topic] = known, messages
        return known

    def density(
        self,
        recording: RecordingEntry,
        span: tuple[int, int],
        pixels: int,
        topics: Sequence[str],
    ) -> Density:
        chunks = self.follow(recording)
        unknown = set(topics).difference(chunks.topics())
        if unknown:
            raise TopicError(f"{recording.label} has no topic {min(unknown)!r}.")
        level = max(-(-(span[1] - span[0]) // pixels) - 1, 0).bit_length()
        begin, end = span[0] >> level, -(-span[1] >> level)
        fine = self._fine_level(chunks, topics, level, begin, end)
        steps = level - fine
        numbers = range(begin << steps >> _BLOCK, ((end << steps) - 1 >> _BLOCK) + 1)
        self._count(chunks, topics, fine, numbers)
        low = (begin << steps) - (numbers.start << _BLOCK)
        high = low + ((end - begin) << steps)
        counts = np.empty((len(topics), end - begin), np.int64)
        exact = np.ones(len(topics), np.bool_)
        for row, topic in enumerate(topics):
            blocks = [self._blocks[fine, number, topic] for number in numbers]
            bins = np.concatenate([block.counts for block in blocks])[low:high]
            counts[row] = bins.reshape(-1, 1 << steps).sum(axis=1, dtype=np.int64)
            exact[row] = all(block.exact for block in blocks)
        self._make_room()
        return Density(tuple(topics), _edges(level, begin, end), counts, exact)

    def _fine_level(
        self, chunks: RecordedChunks, topics: Sequence[str], level: int, begin: int, end: int
    ) -> int:
        """The level of the bins that are counted: finer ones unless that costs much more."""
        plain = None
        for most in (level - _STEPS + 1, level):
            fine = max(most - most % _STEPS, 0)
            steps = level - fine
            if steps == 0 or (end - begin << steps) * len(topics) > _MOST_BINS:
                continue
            if plain is None:
                plain = reading_work(chunks, topics, _edges(level, begin, end))
            work = reading_work(chunks, topics, _edges(fine, begin << steps, end << steps))
            if work <= min(max(_DEARER * plain, _LIGHT), MOST_WORK):
                return fine
        return level

    def _count(
        self, chunks: RecordedChunks, topics: Sequence[str], level: int, numbers: range
    ) -> None:
        """Count what is missing in some blocks."""
        chunks.load((numbers.start << level + _BLOCK, numbers.stop << level + _BLOCK))
        now = chunks.size
        missing: dict[tuple[int, int], list[str]] = defaultdict(list)
        for number, topic in product(numbers, topics):
            block = self._blocks.get((level, number, topic))
            if block is None or block.parts < now:
                missing[number, 0 if block is None else block.parts].append(topic)
            else:
                self._blocks.move_to_end((level, number, topic))
        # Neighbouring blocks that lack the same are counted together.
        ordered = sorted(missing.items(), key=lambda item: (item[0][1], item[1], item[0][0]))
        alike = groupby(
            enumerate(ordered), lambda item: (item[1][0][1], item[1][1], item[1][0][0] - item[0])
        )
        for (since, lacking, _), group in alike:
            own = [number for _, ((number, _), _) in group]
            edges = _edges(level, own[0] << _BLOCK, own[-1] + 1 << _BLOCK)
            counts, exact = count(chunks, lacking, edges, since=since)
            for row, topic in enumerate(lacking):
                for number, part in zip(own, np.split(counts[row], len(own)), strict=True):
                    self._add((level, number, topic), part, is_exact=bool(exact[row]), parts=now)

    def _add(
        self, key: tuple[int, int, str], counts: NDArray[np.int64], *, is_exact: bool, parts: int
    ) -> None:
        before = self._blocks.pop(key, None)
        if before is not None:
            counts = counts + before.counts
            is_exact = is_exact and before.exact
            self._bytes -= before.counts.nbytes
        small = counts.astype(np.min_scalar_type(int(counts.max())))
        self._blocks[key] = _Block(small, is_exact, parts)
        self._bytes += small.nbytes

    def _make_room(self) -> None:
        while self._bytes > _MOST_BYTES:
            _, block = self._blocks.popitem(last=False)
            self._bytes -= block.counts.nbytes


def _edges(level: int, begin: int, end: int) -> NDArray[np.int64]:
    """Edges of bins by their numbers, ns; those after all times are the latest time."""
    first = begin << level
    rest = _LATEST - first
    numbers = np.arange(end - begin + 1)
    return first + np.where(numbers > rest >> level, rest, numbers << level)
