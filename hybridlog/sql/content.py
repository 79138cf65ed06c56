"""Content of a store for SQL at one moment: names, views of topics, and tables about the store.

DuckDB asks for whole columns, also where a query names one field of a struct: its syntax tree
tells the paths that are named.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa
from msgspec.structs import replace

from hybridlog.columns.layout import column_names
from hybridlog.query.answers.interval_queries import marks_in
from hybridlog.query.planner import resolved
from hybridlog.query.question import Question, windows_in
from hybridlog.sql.views import Names, TopicView
from hybridlog_storage.catalog import ChannelStats, RecordingSummary
from hybridlog_storage.mongo.index_documents import collection_of
from hybridlog_storage.times import BEGIN, END, touches

if TYPE_CHECKING:
    from hybridlog.session import Session

TABLES: Final = ("recordings", "topics", "losses", "marks")
"""Tables about the store itself; their names are reserved."""
TREE: Final = (
    "select json_serialize_sql(?::varchar, skip_null := true, skip_empty := true, "
    "skip_default := true)"
)
_WORD: Final = re.compile(r'"((?:[^"]|"")*)"|([^\W\d][\w$]*)')
_PLAIN: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_LISTING: Final = frozenset({
    "database", "duckdb_columns", "duckdb_tables", "duckdb_views", "information_schema",
    "pg_catalog", "pragma_show", "pragma_table_info", "show",
})  # fmt: skip
"""Words of statements that list views."""
_OPEN: Final = frozenset(
    {"STAR", "POSITIONAL_REFERENCE", "NATURAL", "PIVOT", "SHOW_REF", "TABLE_FUNCTION"}
)
"""Parts of a query that may use columns which it does not name."""


class StoreContent:
    """Recordings and views of a store at one moment. Thread safe.

    The recordings and times of the question `scope` alone, whatever its topics, are in
    `summaries`; those that may have rows are `resolved`, by id; both oldest first. `views` are
    their names by topic. DuckDB ignores case, so do names.
    """

    def __init__(self, session: Session, scope: Question) -> None:
        self.session = session
        self.scope = scope
        self.snapshot = session.look()
        self.summaries = session.some(scope.recordings)
        topics = self.snapshot.topics_of(self.summaries)
        found = resolved(session, replace(scope, topics=tuple(topics)))
        self.resolved = {one.summary.id: one for one in found}
        # Of names that differ in case, the one in lower case stays as it is.
        known = sorted(topics, key=lambda topic: (topic.casefold(), topic.swapcase()))
        collections = dict(zip(map(collection_of, known), known, strict=True))
        named = column_names(collections, TABLES)
        self.views = {collections[collection]: view for collection, view in named}
        taken = {view.casefold() for view in (*self.views.values(), *TABLES)}
        short = [(topic, name) for topic in known for name in _short_names(topic)]
        owners = Counter(name.casefold() for _, name in short)
        self._short = [
            (topic, name)
            for topic, name in short
            if owners[name.casefold()] == 1 and name.casefold() not in taken
        ]
        self._topics = {name.casefold(): topic for topic, name in self._short}
        self._topics |= {view.casefold(): topic for topic, view in self.views.items()}
        self._made: dict[str, TopicView] = {}

    @property
    def names(self) -> list[str]:
        """All names: tables, views, short names."""
        return [*TABLES, *self.views.values(), *(name for _, name in self._short)]

    def short(self, topic: str) -> str | None:
        """The shortest name of a topic's view; None if only the long one is unambiguous."""
        return min((name for one, name in self._short if one == topic), key=len, default=None)

    def named(self, query: str) -> list[str]:
        """Names in the text of a query, in any role; all for statements that list views."""
        found: list[tuple[str, str]] = _WORD.findall(query)
        words = {(quoted.replace('""', '"') or plain).casefold() for quoted, plain in found}
        is_listing = not words.isdisjoint(_LISTING)
        return [name for name in self.names if is_listing or name.casefold() in words]

    def summaries_of(self, topic: str) -> list[RecordingSummary]:
        """Recordings that have a topic, oldest first."""
        return self.snapshot.having([topic], self.scope.recordings)

    def view(self, name: str) -> TopicView | None:
        """The view of a name; None if there is none."""
        topic = self._topics.get(name.casefold())
        if topic is not None and topic not in self._made:
            ids = [one.id for one in self.summaries_of(topic)]
            self._made[topic] = TopicView(self.session, topic, ids, self.resolved)
        return None if topic is None else self._made[topic]

    def table(self, name: str) -> pa.Table:
        """One of the tables about the store."""
        rows, schema = _TABLES[name]
        return pa.Table.from_pylist(list(rows(self)), schema=schema)


def _short_names(topic: str) -> Iterator[str]:
    """Whole parts at the end of a name: `scan` and `base__scan` of `/robot/base/scan`."""
    parts = topic.strip("/").split("/")
    for start in range(1, len(parts)):
        name = "__".join(parts[start:])
        if _PLAIN.fullmatch(name):
            yield name


def paths_named(tree: str) -> Names:
    """The paths that a query names, by its tree as of `TREE`; None where it may use any.

    It may if a struct or a row can be used as a whole: `*`, a row as a value, a query in a text.
    """
    nodes: list[dict[str, Any]] = []
    json.loads(tree, object_hook=nodes.append)
    chains = {tuple(map(str.casefold, one.get("column_names", ()))) for one in nodes} - {()}
    chains |= {(name.casefold(),) for one in nodes for name in one.get("using_columns", ())}
    # A row as a value: `select s from scan s`.
    sources = [one for one in nodes if "class" not in one]
    rows = {one.get(key, "").casefold() for one in sources for key in ("alias", "table_name")}
    is_open = any(
        one.get("error")
        or one.get("column_name_alias")
        or not _OPEN.isdisjoint((one.get("class"), one.get("type"), one.get("ref_type")))
        for one in nodes
    )
    return None if is_open or any(one[-1] in rows for one in chains) else frozenset(chains)


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
    for topic, view in content.views.items():
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
                "short": content.short(topic),
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
        windows = windows_in(None if one is None else one.windows, (BEGIN, END) if one else (0, 0))
        if content.scope.bounds is not None and not touches(windows, mark.begin, mark.begin):
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
