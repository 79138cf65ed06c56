"""Densities of recordings that are drawn again and again, at any zoom.

Time is cut into bins of a power of two of nanoseconds, counted from the epoch, so that bins
stay the same when a picture moves. Neighbouring bins form blocks. A block is counted once, in
finer bins than the picture needs, so that the next steps of zooming in read nothing. Chunks
that a running recording adds are counted into the blocks that they touch.
"""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Sequence
from itertools import groupby, product
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from hybridlog.drawing.chunk_parts import RecordedChunks
from hybridlog.drawing.density import MAX_WORK, Density, count, reading_work, sampled_period
from hybridlog_storage.errors import TopicError
from hybridlog_storage.stopping import held

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Asked, Session
    from hybridlog_storage.catalog import RecordingEntry

_BLOCK: Final = 10  # a block has 2^10 bins
_STEPS: Final = 4  # of zooming in that are drawn from the same bins
_MAX_BINS: Final = 1 << 21  # that are counted for one picture
_CHEAP_MESSAGES: Final = 1 << 20  # messages that are read for finer bins in any case
_MAX_COST_RATIO: Final = 4  # times more messages that finer bins may cost
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

    @classmethod
    def of(cls, counts: NDArray[np.int64], *, is_exact: bool, parts: int) -> _Block:
        """A block with numbers that are as small as possible."""
        return cls(counts.astype(np.min_scalar_type(int(counts.max()))), is_exact, parts)

    def with_more(self, more: _Block) -> _Block:
        """The block with the counts of parts that came later."""
        counts = self.counts.astype(np.int64) + more.counts
        return _Block.of(counts, is_exact=self.exact and more.exact, parts=more.parts)


class DensityCache:
    """Counts messages by pixel for many clients. Thread safe.

    Args:
        source: The open store, or one moment of it.
    """

    def __init__(self, source: Asked) -> None:
        self._source = source

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
        session = self._source.now()
        recorded = _recorded(session, recording)
        with held(recorded.lock):
            recorded.session = session
            found = recorded.density(recording, span, pixels, topics)
        _keep(session, recording, recorded)
        return found

    def periods(
        self, recording: RecordingEntry, span: tuple[int, int], topics: Sequence[str]
    ) -> list[float]:
        """Usual time from one message of each topic to the next, ns; 0 where it is unknown.

        Args:
            recording: The recording.
            span: Log time of messages that tell it, if it is not known yet.
            topics: Full names.
        """
        session = self._source.now()
        recorded = _recorded(session, recording)
        with held(recorded.lock):
            recorded.session = session
            found = [recorded.period(recording, span, topic) for topic in topics]
        _keep(session, recording, recorded)
        return found


def _recorded(session: Session, recording: RecordingEntry) -> _Recorded:
    found: _Recorded | None = session.cache.get("recording", recording.id)
    return found or _Recorded(session)


def _keep(session: Session, recording: RecordingEntry, recorded: _Recorded) -> None:
    session.cache.put("recording", recording.id, value=recorded, size=recorded.size)


class _Recorded:
    """The chunks and blocks of one recording.

    Attributes:
        session: The store at the moment that is drawn.
    """

    def __init__(self, session: Session) -> None:
        self.lock = threading.Lock()
        self.session = session
        self._chunks: RecordedChunks | None = None
        self._periods: dict[str, tuple[float, int]] = {}  # and the messages that told it

    def follow(self, recording: RecordingEntry) -> RecordedChunks:
        """The chunks as they are now."""
        if self._chunks is not None:
            self._chunks.session = self.session
        if self._chunks is None or not self._chunks.follow(recording):
            self._chunks = RecordedChunks(self.session, recording)
        return self._chunks

    @property
    def size(self) -> int:
        """Its memory without blocks, bytes."""
        return 0 if self._chunks is None else self._chunks.nbytes

    def period(self, recording: RecordingEntry, span: tuple[int, int], topic: str) -> float:
        chunks = self.follow(recording)
        known, counted = self._periods.get(topic, (0.0, 0))
        if known and recording.status != "open":
            return known
        parts = chunks.parts(span, [topic])
        messages = int(parts.messages.sum())
        if not known or messages > 2 * counted:
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
            raise TopicError(f"{recording.name} has no topic {min(unknown)!r}.")
        level = max(-(-(span[1] - span[0]) // pixels) - 1, 0).bit_length()
        begin, end = span[0] >> level, -(-span[1] >> level)
        fine = self._fine_level(chunks, topics, level, begin, end)
        steps = level - fine
        numbers = range(begin << steps >> _BLOCK, ((end << steps) - 1 >> _BLOCK) + 1)
        blocks = self._count(chunks, topics, fine, numbers)
        low = (begin << steps) - (numbers.start << _BLOCK)
        high = low + ((end - begin) << steps)
        counts = np.empty((len(topics), end - begin), np.int64)
        exact = np.ones(len(topics), np.bool_)
        for row, topic in enumerate(topics):
            own = [blocks[number, topic] for number in numbers]
            bins = np.concatenate([block.counts for block in own])[low:high]
            counts[row] = bins.reshape(-1, 1 << steps).sum(axis=1, dtype=np.int64)
            exact[row] = all(block.exact for block in own)
        return Density(tuple(topics), _edges(level, begin, end), counts, exact)

    def _fine_level(
        self, chunks: RecordedChunks, topics: Sequence[str], level: int, begin: int, end: int
    ) -> int:
        """The level of the bins that are counted: finer ones unless that costs much more."""
        plain = None
        for most in (level - _STEPS + 1, level):
            fine = max(most - most % _STEPS, 0)
            steps = level - fine
            if steps == 0 or (end - begin << steps) * len(topics) > _MAX_BINS:
                continue
            if plain is None:
                plain = reading_work(chunks, topics, _edges(level, begin, end))
            work = reading_work(chunks, topics, _edges(fine, begin << steps, end << steps))
            if work <= min(max(_MAX_COST_RATIO * plain, _CHEAP_MESSAGES), MAX_WORK):
                return fine
        return level

    def _count(
        self, chunks: RecordedChunks, topics: Sequence[str], level: int, numbers: range
    ) -> dict[tuple[int, str], _Block]:
        """Blocks by number and topic; what is missing is counted."""
        chunks.load((numbers.start << level + _BLOCK, numbers.stop << level + _BLOCK))
        now = chunks.size
        blocks: dict[tuple[int, str], _Block] = {}
        missing: dict[tuple[int, int], list[str]] = defaultdict(list)
        for number, topic in product(numbers, topics):
            block = self.session.cache.get("density", chunks, level, number, topic)
            if block is not None:
                blocks[number, topic] = block
            if block is None or block.parts < now:
                missing[number, 0 if block is None else block.parts].append(topic)
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
                    block = _Block.of(part, is_exact=bool(exact[row]), parts=now)
                    if (number, topic) in blocks:
                        block = blocks[number, topic].with_more(block)
                    blocks[number, topic] = block
                    self.session.cache.put(
                        "density",
                        *(chunks, level, number, topic),
                        value=block,
                        size=block.counts.nbytes,
                    )
        return blocks


def _edges(level: int, begin: int, end: int) -> NDArray[np.int64]:
    """Edges of bins by their numbers, ns; those after all times are the latest time."""
    first = begin << level
    rest = _LATEST - first
    numbers = np.arange(end - begin + 1)
    return first + np.where(numbers > rest >> level, rest, numbers << level)
