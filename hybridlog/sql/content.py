"""Content of a store for SQL at one moment: recordings, views, and tables about the store."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.columns.fields import records_of
from hybridlog.columns.layout import POINTS
from hybridlog.columns.rows import is_cloud
from hybridlog.frames.answer import FIXED
from hybridlog.index.indexing import rows_by_channel
from hybridlog.query.answers.marks import marks_in
from hybridlog.query.chunk_scan import ChunkScan
from hybridlog.query.planner import Planner
from hybridlog.query.question import Question
from hybridlog.query.ranges import RangeResolver
from hybridlog.schema.arrow_types import has_empty
from hybridlog.sql.columns import OWN, merged, points_column, view_columns
from hybridlog.sql.names import ViewNames
from hybridlog.sql.rows import Limits, ViewRows, columns_in
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from hybridlog.query.question import Part, RecordedChannel
    from hybridlog.query.ranges import Resolved
    from hybridlog.session import Session
    from hybridlog.sql.rows import Reading
    from hybridlog_storage.summary import RecordingSummary


_SAMPLED: Final = 20  # recordings that tell how many messages a topic has


class StoreContent:
    """Recordings and views of a store at one moment. Thread safe.

    The recordings and times of the question `scope` alone, whatever its topics, are in
    `summaries`; those that may have rows are `resolved`, by id; both oldest first.
    """

    def __init__(self, session: Session, scope: Question) -> None:
        self.session = session
        self.scope = scope
        self.snapshot = session.look()
        places = np.arange(len(self.snapshot))
        if scope.recordings is not None:
            places = session.chosen(scope)
        self.summaries = [self.snapshot.summaries[place] for place in places.tolist()]
        topics = self.snapshot.topics_at(places)
        found = RangeResolver(session, replace(scope, topics=tuple(topics))).resolve()
        self.resolved = {one.summary.id: one for one in found}
        self.names = ViewNames(topics)
        self._views: dict[str, TopicView] = {}
        self._lock = threading.RLock()

    def summaries_of(self, topic: str) -> list[RecordingSummary]:
        """Recordings that have a topic, oldest first."""
        places = self.snapshot.having([topic], self.scope.recordings)
        return [self.snapshot.summaries[place] for place in places.tolist()]

    def view(self, topic: str) -> TopicView:
        """The view of a topic."""
        with self._lock:
            if topic not in self._views:
                self._views[topic] = TopicView(self, topic)
            return self._views[topic]


class TopicView:
    """The view of a topic: its columns, and rows for a query; `size` is nearly their number."""

    def __init__(self, content: StoreContent, topic: str) -> None:
        self.topic = topic
        self._session = content.session
        summaries = content.summaries_of(topic)
        ids = tuple(one.id for one in summaries)
        self._planner = Planner(self._session, Question((topic,), ids))
        self._reason = next(filter(None, (c.codec.reason for c in self._planner.examples)), None)
        kinds = self._kinds()
        columns = view_columns(merged(kinds) if kinds else pa.struct([]))
        self._columns = {column.name: column for column in columns}
        if POINTS not in self._columns and (points := self._points()):
            self._columns[POINTS] = points_column(merged(points))
        fields = [pa.field(column.name, column.type) for column in self._columns.values()]
        self.schema = pa.schema([*OWN, *fields])
        self._parts: dict[str, Part | None] = {}
        self._chosen = [content.resolved[one] for one in ids if one in content.resolved]
        some = self._chosen[:_SAMPLED]
        messages = sum(part.messages for part in map(self._part, some) if part is not None)
        self.size = messages * len(self._chosen) // max(len(some), 1)

    def _part(self, one: Resolved) -> Part | None:
        """The topic in a recording, as asked; None without messages."""
        if one.summary.id not in self._parts:
            self._parts[one.summary.id] = next(self._planner.parts_in(*one), None)
        return self._parts[one.summary.id]

    def _kinds(self) -> list[Any]:
        """Types of the messages; recordings with equal definitions have equal ones."""
        channels = self._planner.examples
        if all(map(_is_fixed, channels)):
            return [channel.arrow_type() for channel in channels if channel.codec.indexed]
        found = []
        for part in self._planner.split():
            table = self._planner.tabled(part)
            if table is not None:
                found += table.table.whole_types()
            else:
                found += (records_of(one).type for one in self._read(part))
        return found

    def _points(self) -> list[Any]:
        """Types of the points of clouds, of a topic whose tables have them."""
        if self.topic not in self._session.directory.settings.arrays:
            return []
        found = []
        for part in self._planner.split():
            table = self._planner.tabled(part)
            if table is not None and table.table.points is not None:
                found.append(table.table.points)
            elif any(is_cloud(channel.channel) for channel in part.channels):
                clouds = (one.type for one in self._read(part, has_points=True))
                found += islice(
                    (one.field(POINTS).type for one in clouds if POINTS in one.names), 1
                )
        return found

    def _read(self, part: Part, *, has_points: bool = False) -> Iterator[Any]:
        """The fields of messages in chunks, as `columns_in` has them."""
        for run in ChunkScan(self._planner.chunk_plan([part]), self._session).runs():
            for number, rows in rows_by_channel(run.batch.channel):
                codec = run.channels[number].codec
                if codec.indexed:
                    decoded = codec.columns_of(run.batch.take(rows), None)
                    yield columns_in(decoded, has_points=has_points)

    def rows(self, schema: pa.Schema, limits: Limits, reading: Reading) -> Iterator[pa.RecordBatch]:
        """Rows for a query, with those columns."""
        if self._reason is not None:
            reading.undefined[self.topic] = self._reason
        read = ViewRows(self._session, schema, self._columns, reading)
        low, high = limits.span
        for one in self._chosen:
            summary, (begin, end) = one.summary, one.summary.extent
            is_beside = begin < end and (begin >= high or end <= low)
            names = limits.recordings
            if is_beside or (names is not None and summary.name not in names):
                continue
            reading.recordings[summary.id] = self._session.entry_of(summary)
            reading.topics.add(self.topic)
            part = self._part(one)
            if part is not None:
                span = Limits(part.bounds or (BEGIN, END)).common(limits).span
                bounds = None if span == (BEGIN, END) else span
                yield from read.read(replace(part, bounds=bounds))


def _is_fixed(channel: RecordedChannel) -> bool:
    """True if a definition fixes the fields of all messages."""
    return (
        channel.codec.reason is not None
        or channel.encoding in FIXED
        # The keys of a map of protobuf are fields, which no definition knows.
        or (channel.encoding == "protobuf" and not has_empty(channel.arrow_type()))
    )


_TIME: Final = pa.timestamp("us", "UTC")
_TIMES: Final = [
    *[(name, _TIME) for name in ("first_time", "last_time")],
    *[(name, pa.int64()) for name in ("first_t", "last_t")],
]
"""Columns of a first and a last log time."""
_TAGS: Final = pa.map_(pa.string(), pa.string())
_RECORDINGS: Final = pa.schema(
    [
        ("recording", pa.string()),
        ("id", pa.string()),
        ("tags", _TAGS),
        ("status", pa.string()),
        ("created", _TIME),
        *_TIMES,
        ("messages", pa.int64()),
        ("topics", pa.int64()),
        ("segments", pa.int64()),
        ("bytes", pa.int64()),
        ("has_losses", pa.bool_()),
    ]
)
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
        *_TIMES,
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
        *_TIMES,
        ("file", pa.string()),
        ("reason", pa.string()),
    ]
)
_MARKS: Final = pa.schema(
    [
        ("log_time", _TIME),
        ("t", pa.int64()),
        ("end_time", _TIME),
        ("end_t", pa.int64()),
        ("recording", pa.string()),
        ("text", pa.string()),
        ("tags", _TAGS),
    ]
)


def store_table(name: str, content: StoreContent) -> pa.Table:
    """One of the tables about a store: `recordings`, `topics`, `losses` or `marks`."""
    rows, schema = _TABLES[name]
    return pa.Table.from_pylist(list(rows(content)), schema=schema)


def _times(first: int | None, last: int | None) -> dict[str, Any]:
    """Cells of `_TIMES` for a first and a last log time, ns."""
    return {
        "first_time": None if first is None else first // 1000,
        "last_time": None if last is None else last // 1000,
        "first_t": first,
        "last_t": last,
    }


def _recordings(content: StoreContent) -> Iterator[Mapping[str, Any]]:
    for one in content.summaries:
        yield {
            "recording": one.name,
            "id": one.id,
            "tags": list(one.tags.items()),
            "status": one.status,
            "created": one.created // 1000,
            **_times(*(one.span or (None, None))),
            "messages": one.messages,
            "topics": one.topic_count,
            "segments": one.segments,
            "bytes": one.stored_bytes,
            "has_losses": one.has_losses,
        }


def _topics(content: StoreContent) -> Iterator[Mapping[str, Any]]:
    for topic, view in content.names.views.items():
        for summary in content.summaries_of(topic):
            entry = content.session.entry_of(summary)
            channels = content.session.channels_of(entry, [topic])
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
                **_times(total.first, total.last),
                "mean_skew": total.mean_skew,
                "unset_stamps": total.unset if entry.is_decoded else None,
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
                **_times(loss.get("from"), loss.get("to")),
                "file": loss.get("file") or None,
                "reason": loss.get("reason") or None,
            }


def _marks(content: StoreContent) -> Iterator[Mapping[str, Any]]:
    names = {one.id: one.name for one in content.summaries}
    for mark in marks_in(content.session, [*names]):
        one = content.resolved.get(mark.recording)
        begin, end = (0, 0) if one is None else one.bounds or (BEGIN, END)
        if content.scope.bounds is not None and not begin <= mark.begin < end:
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
    "recordings": (_recordings, _RECORDINGS),
    "topics": (_topics, _TOPICS),
    "losses": (_losses, _LOSSES),
    "marks": (_marks, _MARKS),
}
