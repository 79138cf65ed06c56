"""Content of a store for SQL at one moment: names of views, recordings, flushed chunks."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from hybridlog.query.ranges import RangeResolver
from hybridlog.snapshot import UNFINISHED
from hybridlog.sql.columns import merged
from hybridlog.sql.names import ViewNames
from hybridlog.sql.pieces import TopicOfRecording
from hybridlog.sql.topic_view import TopicView

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary


_SAMPLED: Final = 20  # recordings that tell how many messages a topic has


class StoreContent:
    """Recordings and views of a store at one moment. Thread safe.

    Args:
        session: The open store.
        scope: The recordings and times of this question alone, whatever its topics.

    Attributes:
        session: The open store.
        scope: The recordings and times.
        snapshot: All recordings of the store.
        summaries: Those of the scope, oldest first.
        names: Names of the views.

    Raises:
        TopicError: A recording does not exist any more.
        TimeError: The range of time is empty, or outside all recordings.
        ChangedError: A ring has just let files go.
    """

    def __init__(self, session: Session, scope: Question) -> None:
        self.session = session
        self.scope = scope
        self.snapshot = session.look()
        self._places = np.arange(len(self.snapshot))
        if scope.recordings is not None:
            self._places = session.chosen(scope)
        self.summaries = [self.snapshot.summaries[place] for place in self._places.tolist()]
        topics = self.snapshot.topics_at(self._places)
        self._windows: dict[str, Span] | None = None
        if scope.bounds is not None:
            found = RangeResolver(session, replace(scope, topics=tuple(topics))).resolve()
            self._windows = {one.summary.id: one.bounds for one in found if one.bounds}
        self._views: dict[str, TopicView] = {}
        self._lock = threading.RLock()
        # DuckDB asks on threads of its own, which see a later moment.
        unfinished = (one for one in self.summaries if one.status in UNFINISHED)
        self._running = {one.id: session.entry_of(one) for one in unfinished}
        for entry in self._running.values():
            session.hold(entry, map(int, entry.digests))
        self.names = ViewNames(topics)

    def summaries_of(self, topic: str) -> list[RecordingSummary]:
        """Recordings that have a topic, oldest first."""
        return [self.snapshot.summaries[place] for place in self._having(topic).tolist()]

    def _having(self, topic: str) -> NDArray[np.intp]:
        return np.intersect1d(self.snapshot.having([topic]), self._places)

    def having(self, topics: Iterable[str]) -> list[str]:
        """Ids of the recordings that may have rows of some topics."""
        found = {one.id for topic in topics for one in self.summaries_of(topic)}
        return [one for one in found if self._windows is None or one in self._windows]

    def window(self, recording: str) -> Span | None:
        """The log time `[begin, end)` of a recording in the scope, ns; None for all times."""
        return None if self._windows is None else self._windows.get(recording, (0, 0))

    def topic_of(self, summary: RecordingSummary, topic: str) -> TopicOfRecording:
        """A topic in a recording."""
        entry = self._running.get(summary.id) or self.session.entry_of(summary)
        return TopicOfRecording(self.session, entry, topic)

    def view(self, topic: str) -> TopicView:
        """The view of a topic."""
        with self._lock:
            if topic not in self._views:
                self._views[topic] = self._view(topic)
            return self._views[topic]

    def _view(self, topic: str) -> TopicView:
        found = self.summaries_of(topic)
        kinds = self._kinds(topic, found)
        found = [one for one in found if self._windows is None or one.id in self._windows]
        return TopicView(
            topic,
            recordings=[partial(self.topic_of, summary, topic) for summary in found],
            names=[summary.name for summary in found],
            spans=[self._span(summary) for summary in found],
            windows=[self.window(summary.id) for summary in found],
            kinds=kinds,
            points=self._points(topic, found),
            size=self._size(topic, found),
        )

    def _size(self, topic: str, found: Sequence[RecordingSummary]) -> int:
        """Number of messages, estimated from some recordings."""
        some = found[:_SAMPLED]
        messages = [
            sum(c.stats.messages for c in self.topic_of(one, topic).channels.values())
            for one in some
        ]
        return sum(messages) * len(found) // max(len(some), 1)

    def _kinds(self, topic: str, found: Sequence[RecordingSummary]) -> list[Any]:
        """Types of the messages; recordings with equal definitions have equal ones."""
        differing = self.snapshot.differing(self._having(topic))
        some = [self.topic_of(one, topic) for one in differing]
        if not all(one.is_fixed for one in some):
            some = [self.topic_of(one, topic) for one in found]
        return [kind for one in some for kind in one.kinds]

    def _points(self, topic: str, found: Sequence[RecordingSummary]) -> Any:
        """Type of the points of clouds of a topic whose tables have them; None without."""
        if topic not in self.session.directory.settings.arrays:
            return None
        clouds = [self.topic_of(one, topic) for one in found]
        tables = (one.table for one in clouds)
        kinds = [table.points for table in tables if table is not None]
        kinds = [kind for kind in kinds if kind is not None]
        if not kinds:  # no table is there yet, or payloads have expired
            first = (one.first_points() for one in clouds[:_SAMPLED])
            kinds = [kind for kind in first if kind is not None]
        return merged(kinds) if kinds else None

    def _span(self, summary: RecordingSummary) -> tuple[int, int] | None:
        first, end = summary.extent
        if first >= end:
            return None
        return first, end  # one more, for messages at the end of time
