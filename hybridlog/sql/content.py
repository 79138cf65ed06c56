"""Content of a store for SQL at one moment: names of views, recordings, flushed chunks."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from hybridlog.snapshot import UNFINISHED
from hybridlog.sql.names import ViewNames
from hybridlog.sql.pieces import TopicOfRecording
from hybridlog.sql.topic_view import TopicView

if TYPE_CHECKING:
    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary


_SAMPLED: Final = 20  # recordings that tell how many messages a topic has


def current_content(session: Session, known: StoreContent | None) -> StoreContent:
    """The content of a store as it is now.

    Args:
        session: The open store.
        known: The content before; it is returned if nothing has changed.
    """
    if known is not None and known.snapshot is session.look():
        return known
    return StoreContent(session)


class StoreContent:
    """Recordings and views of a store at one moment. Thread safe.

    Args:
        session: The open store.

    Attributes:
        session: The open store.
        snapshot: Its recordings.
        names: Names of the views.
    """

    def __init__(self, session: Session) -> None:
        self.session = session
        self.snapshot = session.look()
        self._views: dict[str, TopicView] = {}
        self._lock = threading.RLock()
        # DuckDB asks on threads of its own, which see a later moment.
        unfinished = (one for one in self.snapshot.summaries if one.status in UNFINISHED)
        self._running = {one.id: session.entry_of(one) for one in unfinished}
        self.names = ViewNames(self.snapshot.topics)

    def summaries_of(self, topic: str) -> list[RecordingSummary]:
        """Recordings that have a topic, oldest first."""
        places = self.snapshot.having([topic]).tolist()
        return [self.snapshot.summaries[place] for place in places]

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
        return TopicView(
            topic,
            recordings=[partial(self.topic_of, summary, topic) for summary in found],
            labels=[summary.label for summary in found],
            spans=[self._span(summary) for summary in found],
            kinds=self._kinds(topic, found),
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
        places = self.snapshot.having([topic])
        some = [self.topic_of(one, topic) for one in self.snapshot.differing(places)]
        if not all(one.is_fixed for one in some):
            some = [self.topic_of(one, topic) for one in found]
        return [kind for one in some for kind in one.kinds]

    def _span(self, summary: RecordingSummary) -> tuple[int, int] | None:
        first, end = summary.extent
        if first >= end:
            return None
        return first, end  # one more, for messages at the end of time
