"""Counts and times of the messages in each chunk, from chunk tables; also of running recordings."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from hybridlog_storage.errors import SegmentError
from hybridlog_storage.open_segment import OpenSegment, open_segment
from hybridlog_storage.segment_reader import places_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.segment_reader import ChunkPlace

_CHANNELS = 1 << 16  # ids of channels


class Parts(NamedTuple):
    """The messages of one channel in one chunk, a row each.

    Attributes:
        segment: int64[n], number of the segment.
        chunk: int64[n], number of the chunk in it.
        channel: int64[n], id.
        topic: intp[n], place of its topic among those asked for.
        messages: int64[n].
        first: int64[n], least log time, ns.
        last: int64[n], greatest log time, ns.
    """

    segment: NDArray[np.int64]
    chunk: NDArray[np.int64]
    channel: NDArray[np.int64]
    topic: NDArray[np.intp]
    messages: NDArray[np.int64]
    first: NDArray[np.int64]
    last: NDArray[np.int64]

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> Parts:
        """Some rows."""
        return Parts(*(column[rows] for column in self))


class RunningTopic(NamedTuple):
    """Messages of a topic that are flushed and not in a sealed segment yet.

    Attributes:
        type: Name of their type; empty if unknown.
        messages: Number of them.
        first: Least log time, ns.
        last: Greatest log time, ns.
    """

    type: str
    messages: int
    first: int
    last: int


class RecordedChunks:
    """The chunks of a recording, read segment by segment when a span needs them.

    Not thread safe.

    Args:
        session: The open store.
        recording: The recording.
    """

    def __init__(self, session: Session, recording: RecordingEntry) -> None:
        self._session = session
        self._recording = recording
        self._topics = {channel.id: channel.topic for channel in recording.channels}
        self._sealed: dict[int, list[ChunkPlace] | None] = {}
        self._open: dict[int, OpenSegment] = {}
        self._rows: list[NDArray[np.int64]] = []
        self._size = 0
        self.follow(recording)

    @property
    def size(self) -> int:
        """Number of parts that are known; parts are only added."""
        return self._size

    def topics(self) -> list[str]:
        """Names of all topics, sorted."""
        return sorted(set(self._topics.values()))

    def follow(self, recording: RecordingEntry) -> bool:
        """See what was flushed since.

        Args:
            recording: Its entry as it is now.

        Returns:
            False if what was read before does not hold any more.
        """
        before, self._recording = self._recording, recording
        is_same = recording.status == before.status and all(
            before.digests.get(number) in {None, recording.digests.get(number)}
            for number in map(str, self._sealed)
        )
        if is_same and recording.status == "open":
            self._topics |= {channel.id: channel.topic for channel in recording.channels}
            self._follow_open()
        return is_same

    def _follow_open(self) -> None:
        folder = self._session.directory.recording(self._recording.label)
        listing = self._session.directory.listing(self._recording.label)
        # A segment that was sealed since the entry was made is read like an open one.
        for number, name in sorted({**listing.open, **listing.sealed}.items()):
            if number in self._open or str(number) in self._recording.digests:
                continue
            found = open_segment(folder / name, number)
            if found is not None and number not in self._sealed:
                self._open[number] = found
                self._add_flushed(found, 0)
        for segment in self._open.values():
            known = len(segment.chunks)
            with suppress(SegmentError):
                segment.advance()
            self._add_flushed(segment, known)

    def _add_flushed(self, segment: OpenSegment, known: int) -> None:
        self._topics |= {number: channel.topic for number, channel in segment.channels.items()}
        rows = []
        for place in segment.chunks[known:]:
            with suppress(SegmentError):  # it is in the ledger when its segment is sealed
                for channel, times in sorted(segment.read_times(place).items()):
                    span = int(times[0]), int(times[-1])
                    rows.append((segment.number, place.number, channel, len(times), *span))
        self._add(np.array(rows, np.int64).reshape(-1, 6))

    def _add(self, rows: NDArray[np.int64]) -> None:
        if len(rows):
            self._rows.append(rows)
            self._size += len(rows)

    def load(self, span: tuple[int, int]) -> None:
        """Read the chunk tables of sealed segments that may have messages in a span.

        Args:
            span: Log time `[begin, end)`, ns.
        """
        for number, first, last in self._recording.spans:
            known = number in self._sealed or number in self._open
            if known or first >= span[1] or last < span[0]:
                continue
            table = self._session.chunk_table(self._recording, number)
            chunk = np.repeat(np.arange(len(table.chunks)), table.chunks["parts"])
            names = ("channel", "messages", "first", "last")
            columns = [table.parts[name].astype(np.int64) for name in names]
            self._add(np.stack([np.full_like(chunk, number), chunk, *columns], axis=1))
            self._sealed[number] = None

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
        for channel, topic in self._topics.items():
            topic_of[channel] = places.get(topic, -1)
        wanted = (rows[:, 4] < span[1]) & (rows[:, 5] >= span[0]) & (topic_of[rows[:, 2]] >= 0)
        segment, chunk, channel, messages, first, last = np.ascontiguousarray(rows[wanted].T)
        return Parts(segment, chunk, channel, topic_of[channel], messages, first, last)

    def times(self, segment: int, chunk: int) -> dict[int, NDArray[np.int64]]:
        """Log times of a chunk's messages by channel, ascending; reads no payload.

        Raises:
            SegmentError: They are missing or damaged.
        """
        running = self._open.get(segment)
        if running is not None:
            return running.read_times(running.chunks[chunk])
        places = self._sealed[segment]
        if places is None:
            table = self._session.chunk_table(self._recording, segment)
            places = self._sealed[segment] = places_of(table)
        return self._session.segment(self._recording.id, segment).read_times(places[chunk])

    def running(self) -> dict[str, RunningTopic]:
        """Flushed messages that the recording's entry does not count yet, by topic."""
        found: dict[str, RunningTopic] = {}
        numbers = [n for n in self._open if str(n) not in self._recording.digests]
        for number in numbers:
            for channel in self._open[number].channels.values():
                kind = channel.schema.name if channel.schema is not None else ""
                found.setdefault(channel.topic, RunningTopic(kind, 0, 0, 0))
        rows = np.concatenate([np.empty((0, 6), np.int64), *self._rows])
        rows = rows[np.isin(rows[:, 0], np.array(numbers, np.int64))]
        for channel_id in np.unique(rows[:, 2]).tolist():
            own = rows[rows[:, 2] == channel_id]
            topic = self._topics[channel_id]
            kind, messages, first, last = found[topic]
            least, greatest = int(own[:, 4].min()), int(own[:, 5].max())
            if messages:
                least, greatest = min(first, least), max(last, greatest)
            found[topic] = RunningTopic(kind, messages + int(own[:, 3].sum()), least, greatest)
        return found
