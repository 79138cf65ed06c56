"""Content of a store for SQL at one moment: recordings, views, and tables about the store."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa

from hybridlog.columns.recordings_file import RECORDINGS, TAGS, TIME, recordings_table, times
from hybridlog.query.answers.marks import marks_in
from hybridlog.query.counters import Counters
from hybridlog.query.ranges import RangeResolver
from hybridlog.snapshot import UNFINISHED
from hybridlog.sql.columns import merged
from hybridlog.sql.names import ViewNames
from hybridlog.sql.pieces import TopicOfRecording
from hybridlog.sql.topic_view import TopicView
from hybridlog_storage.catalog import ChannelStats

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


_TOPICS: Final = pa.schema(
    [
        ("topic", pa.string()),
        ("view", pa.string()),
        ("short", pa.string()),
        ("recording", pa.string()),
        ("type", pa.string()),
        ("encoding", pa.string()),
        ("messages", pa.int64()),
        ("bytes", pa.int64()),
        ("first_time", TIME),
        ("last_time", TIME),
        ("first_t", pa.int64()),
        ("last_t", pa.int64()),
        ("mean_skew", pa.float64()),
        ("unset_stamps", pa.int64()),
        ("problem", pa.string()),
    ]
)
_LOSSES: Final = pa.schema(
    [
        ("recording", pa.string()),
        ("topic", pa.string()),
        ("cause", pa.string()),
        ("messages", pa.int64()),
        ("first_time", TIME),
        ("last_time", TIME),
        ("first_t", pa.int64()),
        ("last_t", pa.int64()),
        ("file", pa.string()),
        ("reason", pa.string()),
    ]
)
_MARKS: Final = pa.schema(
    [
        ("log_time", TIME),
        ("t", pa.int64()),
        ("end_time", TIME),
        ("end_t", pa.int64()),
        ("recording", pa.string()),
        ("text", pa.string()),
        ("tags", TAGS),
    ]
)


def store_table(name: str, content: StoreContent) -> pa.Table:
    """One of the tables about a store.

    Args:
        name: `recordings`, `topics`, `losses` or `marks`.
        content: The store.
    """
    if name == "recordings":
        return recordings_table(content.summaries)
    rows, schema = _TABLES[name]
    return pa.Table.from_pylist(list(rows(content)), schema=schema)


def store_schema(name: str) -> pa.Schema:
    """The columns of such a table."""
    return RECORDINGS if name == "recordings" else _TABLES[name][1]


def _topics(content: StoreContent) -> Iterator[Mapping[str, Any]]:
    for topic, view in content.names.views.items():
        for summary in content.summaries_of(topic):
            found = content.topic_of(summary, topic)
            channels = list(found.channels.values())
            total = ChannelStats()
            for channel in channels:
                total.add(channel.stats)
            types = dict.fromkeys(c.channel.schema.name for c in channels if c.channel.schema)
            encodings = dict.fromkeys(c.encoding for c in channels)
            problems = dict.fromkeys(c.codec.reason for c in channels if c.codec.reason)
            yield {
                "topic": topic,
                "view": view,
                "short": content.names.short(topic),
                "recording": summary.name,
                "type": ", ".join(types) or None,
                "encoding": ", ".join(encodings) or None,
                "messages": total.messages,
                "bytes": total.payload_bytes,
                **times(total.first, total.last),
                "mean_skew": total.mean_skew,
                "unset_stamps": total.unset if found.entry.is_decoded else None,
                "problem": "; ".join(problems) or None,
            }


def _losses(content: StoreContent) -> Iterator[Mapping[str, Any]]:
    for summary in content.summaries:
        entry = content.session.entry_of(summary)
        for loss in entry.end.get("losses", ()):
            yield {
                "recording": entry.name,
                "topic": loss.get("topic"),
                "cause": str(loss["cause"]),
                "messages": loss["count"],
                **times(loss.get("from"), loss.get("to")),
                "file": loss.get("file") or None,
                "reason": loss.get("reason") or None,
            }


def _marks(content: StoreContent) -> Iterator[Mapping[str, Any]]:
    names = {one.id: one.name for one in content.summaries}
    for mark in marks_in(content.session, [*names], Counters()):
        window = content.window(mark.recording)
        if window is not None and not window[0] <= mark.begin < window[1]:
            continue
        yield {
            "log_time": mark.begin // 1000,
            "t": mark.begin,
            "end_time": None if mark.end is None else mark.end // 1000,
            "end_t": mark.end,
            "recording": names[mark.recording],
            "text": mark.text,
            "tags": list(mark.tags.items()),
        }


_Rows = Callable[["StoreContent"], Iterator[Mapping[str, Any]]]
_TABLES: Final[Mapping[str, tuple[_Rows, Any]]] = {
    "topics": (_topics, _TOPICS),
    "losses": (_losses, _LOSSES),
    "marks": (_marks, _MARKS),
}
