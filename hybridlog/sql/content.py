"""Content of a store for SQL at one moment: recordings, views, and tables about the store."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.columns.layout import POINTS
from hybridlog.columns.recordings_file import (
    TAGS,
    TIME,
    TIMES,
    recordings_table,
    times,
)
from hybridlog.query.answers.marks import marks_in
from hybridlog.query.ranges import RangeResolver
from hybridlog.snapshot import UNFINISHED
from hybridlog.sql.columns import OWN, merged, points_column, view_columns
from hybridlog.sql.names import ViewNames
from hybridlog.sql.rows import Plan, TopicOfRecording
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Question, Span
    from hybridlog.session import Session
    from hybridlog.sql.rows import Bounds, Filter, Reading
    from hybridlog_storage.summary import RecordingSummary


_SAMPLED: Final = 20  # recordings that tell how many messages a topic has


class StoreContent:
    """Recordings and views of a store at one moment. Thread safe.

    Attributes:
        scope: The recordings and times of this question alone, whatever its topics.
        snapshot: All recordings of the store.
        summaries: Those of the scope, oldest first.
        names: Names of the views.
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
        for summary in self.summaries:
            if summary.status in UNFINISHED:
                entry = session.entry_of(summary)
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
        return TopicOfRecording(self.session, self.session.entry_of(summary), topic)

    def view(self, topic: str) -> TopicView:
        """The view of a topic."""
        with self._lock:
            if topic not in self._views:
                self._views[topic] = TopicView(self, topic)
            return self._views[topic]

    def differing(self, topic: str) -> list[RecordingSummary]:
        """One of the recordings that have a topic, for each set of topics and types."""
        return self.snapshot.differing(self._having(topic))


class TopicView:
    """The view of a topic: its columns, and rows for a query; `size` is nearly their number."""

    def __init__(self, content: StoreContent, topic: str) -> None:
        self.topic = topic
        self._content = content
        self._known: dict[str, TopicOfRecording] = {}
        having = {*content.having([topic])}
        known = content.summaries_of(topic)
        self._summaries = [one for one in known if one.id in having]
        kinds = self._kinds(known)
        columns = view_columns(merged(kinds) if kinds else pa.struct([]))
        self._columns = {column.name: column for column in columns}
        points = self._points()
        if points is not None and POINTS not in self._columns:
            self._columns[POINTS] = points_column(points)
        fields = [pa.field(column.name, column.type) for column in self._columns.values()]
        self.schema = pa.schema([*OWN, *fields])
        some = [self._of(one) for one in self._summaries[:_SAMPLED]]
        self.size = sum(one.messages for one in some) * len(self._summaries) // max(len(some), 1)

    def _of(self, summary: RecordingSummary) -> TopicOfRecording:
        if summary.id not in self._known:
            self._known[summary.id] = self._content.topic_of(summary, self.topic)
        return self._known[summary.id]

    def _kinds(self, known: Sequence[RecordingSummary]) -> list[Any]:
        """Types of the messages; recordings with equal definitions have equal ones."""
        some = [self._of(one) for one in self._content.differing(self.topic)]
        if not all(one.is_fixed for one in some):
            some = [self._of(one) for one in known]
        return [kind for one in some for kind in one.kinds]

    def _points(self) -> Any:
        """Type of the points of clouds of a topic whose tables have them; None without."""
        if self.topic not in self._content.session.directory.settings.arrays:
            return None
        clouds = (self._of(one).points() for one in self._summaries)
        kinds = [kind for kind in clouds if kind is not None]
        return merged(kinds) if kinds else None

    def rows(
        self, columns: Sequence[str], where: Filter, reading: Reading
    ) -> Iterator[pa.RecordBatch]:
        """Rows for a query: those columns, where a filter holds."""
        plan = Plan(self.schema, self._columns, columns, where, reading)
        # The end of a recording is one more than its last time: for messages at the end of time.
        spans = ((one.name, one.extent) for one in self._summaries)
        bounds = _bounds((name, span if span[0] < span[1] else None) for name, span in spans)
        for number in np.flatnonzero(where.may_hold(bounds)).tolist():
            summary = self._summaries[number]
            recording, window = self._of(summary), self._content.window(summary.id)
            reading.add(recording)
            bounds = _bounds((summary.name, source.span) for source in recording.sources)
            chosen, (first, last) = where.may_hold(bounds), bounds["t"]
            if window is not None:
                chosen &= (first < window[1]) & (last >= window[0])
            for place in np.flatnonzero(chosen).tolist():
                yield from plan.read(recording, recording.sources[place], window)


def _bounds(parts: Iterable[tuple[str, Span | None]]) -> Bounds:
    """The bounds of parts, by their recordings and log times, ns, None where these are unknown."""
    names, spans = [], []
    for name, span in parts:
        names.append(name)
        spans.append(span or (BEGIN, END))
    recording = np.array(names, object)
    first, last = np.array(spans, np.int64).reshape(-1, 2).T
    micros = first // 1000, last // 1000
    return {"t": (first, last), "log_time": micros, "recording": (recording, recording)}


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
        *TIMES,
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
        *TIMES,
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
    """One of the tables about a store: `recordings`, `topics`, `losses` or `marks`."""
    if name == "recordings":
        return recordings_table(content.summaries)
    rows, schema = _TABLES[name]
    return pa.Table.from_pylist(list(rows(content)), schema=schema)


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
        for loss in entry.losses:
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
    for mark in marks_in(content.session, [*names]):
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
