"""Content of a store for SQL at one moment: names of views, recordings, flushed chunks."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from hybridlog.snapshot import UNFINISHED
from hybridlog.sql.names import ViewNames
from hybridlog.sql.pieces import TopicOfRecording
from hybridlog.sql.topic_view import TopicView
from hybridlog_storage.open_segment import OpenSegment, open_segment

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
    if known is not None and known.snapshot is session.snapshot() and not known.is_live:
        return known
    live = [one for one in session.snapshot().summaries if one.status in UNFINISHED]
    flushed = {one.id: list(_open_segments(session, one)) for one in live}
    if live:
        session.invalidate()  # segments may have been sealed since
    return StoreContent(session, flushed)


def _open_segments(session: Session, summary: RecordingSummary) -> Iterator[OpenSegment]:
    """Segments of a recording that are not sealed."""
    folder = session.directory.recording(summary.label)
    for number, name in session.directory.listing(summary.label).open.items():
        found = open_segment(folder / name, number)
        if found is not None:
            yield found


class StoreContent:
    """Recordings and views of a store at one moment. Thread safe.

    Args:
        session: The open store.
        flushed: Segments that are not sealed, of each running recording, by id.

    Attributes:
        session: The open store.
        snapshot: Its recordings.
        names: Names of the views.
        is_live: True if a recording goes on.
    """

    def __init__(self, session: Session, flushed: Mapping[str, Sequence[OpenSegment]]) -> None:
        self.session = session
        self.snapshot = session.snapshot()
        self._views: dict[str, TopicView] = {}
        self._lock = threading.RLock()
        self._flushed: dict[str, list[OpenSegment]] = {}
        self.is_live = bool(flushed)
        for summary in self.snapshot.summaries:
            if flushed.get(summary.id):
                sealed = self.session.entry_of(summary).digests
                self._flushed[summary.id] = [
                    segment for segment in flushed[summary.id] if str(segment.number) not in sealed
                ]
        topics = {
            channel.topic
            for segments in self._flushed.values()
            for segment in segments
            for channel in segment.channels.values()
        }
        self.names = ViewNames({*self.snapshot.topics, *topics})

    def summaries_of(self, topic: str) -> list[RecordingSummary]:
        """Recordings that have a topic, oldest first."""
        places = set(self.snapshot.having([topic]).tolist())
        for recording, segments in self._flushed.items():
            channels = [c for segment in segments for c in segment.channels.values()]
            if any(channel.topic == topic for channel in channels):
                places.add(self.snapshot.by_id[recording])
        return [self.snapshot.summaries[place] for place in sorted(places)]

    def topic_of(self, summary: RecordingSummary, topic: str) -> TopicOfRecording:
        """A topic in a recording."""
        entry = self.session.entry_of(summary)
        return TopicOfRecording(self.session, entry, topic, self._flushed.get(summary.id, ()))

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
        some += [self.topic_of(one, topic) for one in found if one.id in self._flushed]
        if not all(one.is_fixed for one in some):
            some = [self.topic_of(one, topic) for one in found]
        return [kind for one in some for kind in one.kinds]

    def _span(self, summary: RecordingSummary) -> tuple[int, int] | None:
        first, end = summary.extent
        if summary.status in UNFINISHED or first >= end:
            return None
        return first, end  # one more, for messages at the end of time
