"""Content of a playback: messages from any time on, those that are current, and its clock."""

from __future__ import annotations

import math
import time
from collections.abc import Collection, Generator, Iterator, Sequence
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.query.intervals import Intervals
from hybridlog.query.latching import depth_of, is_video
from hybridlog.query.query import Query, at_time, channels_of, narrowed, spans_of
from hybridlog_storage.errors import TimeError, TopicError

if TYPE_CHECKING:
    from hybridlog.query.question import RecordedChannel
    from hybridlog_storage.messages import Batch, Channel


class PlayedChannel(Struct, frozen=True):
    """A channel for viewers: those of all recordings with the same topic, encoding and type.

    Attributes:
        id: Its number, from 1 on.
        channel: The first of them.
    """

    id: int
    channel: Channel


Blocks: TypeAlias = "Generator[Batch, None, None]"
"""Messages in order of log time; `channel` is the number of the played channel, 0 for none."""


class PlayedLog:
    """The messages of a query, as a log that is played.

    Args:
        query: Topics, recordings, range of log time and predicate.

    Attributes:
        channels: What viewers can subscribe to. Messages whose payload was dropped under
            pressure are not among them.
        begin: First log time, ns.
        end: Last log time, ns.

    Raises:
        TimeError: The range is outside of all recordings, or these have no messages.
    """

    def __init__(self, query: Query) -> None:
        spans = spans_of(query)
        if not spans:
            raise TimeError("There are no messages to play.")
        times = np.array([(begin, end, 0) for begin, end in spans.values()], np.int64)
        self.begin = int(times[:, 0].min())
        self.end = int(times[:, 1].max()) - 1
        whole = replace(query.question, bounds=None, during=None, clock="log")
        self._whole = Query(query.source.now(), whole, conditions=query.conditions)
        params = Intervals((id_, times[row : row + 1]) for row, id_ in enumerate(spans))
        during = query.question.during
        self._during = params if during is None else during.common(params)
        self._begin, self._end = times[:, 0], times[:, 1]
        self._ids: dict[tuple[str, int], int] = {}
        self._latching: set[str] = set()
        self.channels = self._merge(channels_of(query))

    def _merge(self, recorded: Sequence[RecordedChannel]) -> list[PlayedChannel]:
        """The channels as viewers see them."""
        alike: dict[object, list[RecordedChannel]] = {}
        for each in recorded:
            if not each.is_reduced:
                own = each.channel
                alike.setdefault((own.topic, own.message_encoding, own.schema), []).append(each)
                if depth_of(own) or is_video(own):
                    self._latching.add(own.topic)
        merged = []
        for number, group in enumerate(alike.values(), 1):
            self._ids.update({(one.recording.id, one.channel_id): number for one in group})
            merged.append(PlayedChannel(number, group[0].channel))
        return merged

    def next_covered(self, position: int) -> int:
        """The next log time that a recording covers, ns; the same one if it is, or no more is."""
        is_covered = (self._begin <= position) & (position < self._end)
        later = self._begin[self._begin > position]
        return position if is_covered.any() or not len(later) else int(later.min())

    def after(self, topics: Collection[str], position: int) -> Blocks:
        """All messages of some topics behind a log time, ns, in order."""
        if not topics or position >= self.end:
            return
        query = narrowed(self._whole, *topics).during(self._during).between(position + 1, None)
        for batch, channels in query.batches():
            yield self._numbered(batch, channels)

    def current(self, topics: Collection[str], position: int) -> Blocks:
        """The messages of some topics that are current at a log time, ns.

        They are the latched ones that a subscriber receives which joins then, the frames of
        video from the last key frame on, and the last message of every other topic. Messages
        from before the played range are not current, unless they are of the former two.
        """
        if not topics:
            return
        if found := self._latching.intersection(topics):
            latched = narrowed(self._whole, *found).between(min(position + 1, self.end), None)
            for batch, channels in latched.latched(original_times=True):
                yield self._numbered(batch, channels)
            if position >= self.end:
                yield from self.after(found, self.end - 1)
        if position >= self.begin:
            for topic in topics:
                if topic not in self._latching:
                    yield from self._last(topic, position)

    def _last(self, topic: str, position: int) -> Iterator[Batch]:
        """The last message of a topic until a log time, ns, if the range has one."""
        try:
            query = at_time(narrowed(self._whole, topic), position)
        except TopicError:
            return  # the topic has none yet
        for batch, channels in query.during(self._during).batches():
            yield self._numbered(batch, channels)

    def _numbered(self, batch: Batch, channels: Sequence[RecordedChannel]) -> Batch:
        ids = [self._ids.get((c.recording.id, c.channel_id), 0) for c in channels]
        return replace(batch, channel=np.array(ids, np.int32)[batch.channel])


SLOWEST: Final = 0.01
FASTEST: Final = 100.0
"""Limits of the speed, in seconds of log time a second."""


class PlaybackClock:
    """Log time, ns, during a playback; it stands still until it runs.

    Attributes:
        speed: Seconds of log time a second.
        is_running: The time runs.
    """

    def __init__(self, position: int, speed: float) -> None:
        self.speed, self.is_running = 1.0, False
        self._position = self._since = 0
        self.set(position, speed=speed)

    @property
    def position(self) -> int:
        """Log time now, ns."""
        passed = time.monotonic_ns() - self._since if self.is_running else 0
        return self._position + int(passed * self.speed)

    def set(
        self, position: int | None = None, *, runs: bool | None = None, speed: float = math.nan
    ) -> None:
        """Go to a log time, ns, run or stand still, and change the speed, within its limits.

        What is not given stays; so does the speed if it is NaN.
        """
        self._position = self.position if position is None else position
        self._since = time.monotonic_ns()
        if runs is not None:
            self.is_running = runs
        if not math.isnan(speed):
            self.speed = min(max(speed, SLOWEST), FASTEST)
