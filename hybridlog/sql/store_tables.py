"""Tables about the store itself: recordings, topics, losses, marks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, Final

import pyarrow as pa

from hybridlog.columns.recordings_file import RECORDINGS, TAGS, TIME, recordings_table, times
from hybridlog.query.answers.marks import marks_in
from hybridlog.query.counters import Counters
from hybridlog_storage.catalog import ChannelStats

if TYPE_CHECKING:
    from hybridlog.sql.content import StoreContent

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
