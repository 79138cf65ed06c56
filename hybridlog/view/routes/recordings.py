"""The recordings of the store, and one of them in detail."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

from hybridlog.query.answers.marks import marks_in
from hybridlog.query.choice import Choice
from hybridlog.record.losses import losses_of
from hybridlog.schema.states import encoding_of, shown_channels
from hybridlog.view.context import Context, extent, route, start_of
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.manifest import MAX_MARKS

if TYPE_CHECKING:
    from hybridlog.view.context import RequestParams
    from hybridlog_storage.catalog import RecordingEntry
    from hybridlog_storage.summary import RecordingSummary

_MAX_ROWS: Final = 200
_MAX_CONDITIONS: Final = 16


_KEYS: Final[Mapping[str, Callable[[RecordingSummary], Any]]] = {
    "start": start_of,
    "name": lambda one: one.name,
    "duration": lambda one: one.extent[1] - one.extent[0],
    "topics": lambda one: one.topic_count,
    "messages": lambda one: one.messages,
    "size": lambda one: one.stored_bytes,
}
"""Keys to order recordings by."""


def recordings(context: Context, params: RequestParams) -> dict[str, Any]:
    """A part of the recordings that satisfy some conditions, in some order."""
    first = params.integer("first", 0, 1 << 31, 0)
    count = params.integer("count", 1, _MAX_ROWS, _MAX_ROWS)
    key = _KEYS[params.word("order", _KEYS, "start")]
    is_ascending = params.word("direction", ("up", "down"), "down") == "up"
    store = context.store
    summaries = store.choose(_choice(params)).summaries
    ordered = sorted(summaries, key=key, reverse=not is_ascending)
    shown = ordered[first : first + count]
    return {
        "store": store.directory.place,
        "all": len(store.session.snapshot().summaries),
        "found": len(ordered),
        "messages": sum(one.messages for one in ordered),
        "bytes": sum(one.stored_bytes for one in ordered),
        "first": first,
        "rows": [*map(_row, shown)],
    }


def recording(context: Context, params: RequestParams) -> dict[str, Any]:
    """One recording: its topics, marks, losses and times."""
    entry = context.recording(params)
    start = start_of(entry)
    begin, end = extent(entry)
    return {
        "id": entry.id,
        "store": context.store.directory.place,
        "name": entry.name,
        "status": entry.status,
        "start": str(start),
        "begin": str(begin - start),
        "end": str(end - start),
        "messages": entry.messages,
        "bytes": entry.stored_bytes,
        "tags": entry.tags,
        "notes": [note.text for note in entry.manifest.notes],
        "marks": [
            {"at": one.begin - start, "end": (one.end or one.begin) - start, "text": one.text}
            for one in islice(marks_in(context.store.session, [entry.id]), MAX_MARKS)
        ],
        "losses": [_loss(loss, start) for loss in losses_of(entry)],
        "topics": _topics(entry, start),
    }


def _choice(params: RequestParams) -> Choice:
    begin, end = params.text("begin", ""), params.text("end", "")
    return Choice.of(
        _globs(params.text("name", "")),
        tag=params.texts("tag", most=_MAX_CONDITIONS),
        has=params.texts("topic", most=_MAX_CONDITIONS),
        type=params.texts("type", most=_MAX_CONDITIONS),
        during=(begin or None, end or None) if begin or end else None,
        where=params.texts("where", most=_MAX_CONDITIONS),
    )


def _globs(text: str) -> Sequence[str]:
    """Globs for names that contain any of the words."""
    words = text.split()
    return [word if set(word) & set("*?") else f"*{word.replace('[', '[[]')}*" for word in words]


def _row(summary: RecordingSummary) -> dict[str, Any]:
    begin, end = summary.extent
    return {
        "id": summary.id,
        "name": summary.name,
        "tags": summary.tags,
        "status": summary.status,
        "start": str(start_of(summary)),
        "duration": end - begin,
        "topics": summary.topic_count,
        "messages": summary.messages,
        "bytes": summary.stored_bytes,
        "incomplete": summary.has_losses or summary.has_lost_segments,
    }


def _loss(loss: Mapping[str, Any], start: int) -> dict[str, Any]:
    begin, end = loss.get("from"), loss.get("to")
    return {
        "topic": loss["topic"],
        "count": loss["count"],
        "cause": str(loss["cause"]),
        "reason": loss.get("reason", ""),
        "begin": None if begin is None else begin - start,
        "end": None if end is None else end - start,
    }


def _topics(entry: RecordingEntry, start: int) -> list[dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    totals: dict[str, ChannelStats] = defaultdict(ChannelStats)
    for channel in shown_channels(entry.channels):
        total = totals[channel.topic]
        total.add(channel.stats)
        row = {
            "topic": channel.topic,
            "type": channel.type,
            "encoding": encoding_of(channel.message_encoding, channel.metadata),
        }
        found.setdefault(channel.topic, row).update(
            messages=total.messages,
            bytes=total.payload_bytes,
            first=None if total.first is None else str(total.first - start),
            last=None if total.last is None else str(total.last - start),
        )
    return [found[topic] for topic in sorted(found)]


routes = [route("/recordings", recordings), route("/recording", recording)]
