"""The recordings of the store, and one of them in detail."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

from msgspec import Meta

from hybridlog.query.answers.interval_queries import marks_in
from hybridlog.query.choice import Choice
from hybridlog.record.losses import losses_of
from hybridlog.schema.states import encoding_of, shown_channels
from hybridlog.view.context import Context, Text, extent, route, start_of
from hybridlog_storage.catalog import ChannelStats
from hybridlog_storage.manifest import MAX_MARKS

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry, RecordingSummary
    from hybridlog_storage.manifest import Manifest

_MAX_ROWS: Final = 200

_KEYS: Final[Mapping[str, Callable[[RecordingSummary], Any]]] = {
    "start": start_of,
    "name": lambda one: one.name,
    "duration": lambda one: one.extent[1] - one.extent[0],
    "topics": lambda one: one.topic_count,
    "messages": lambda one: one.messages,
    "size": lambda one: one.stored_bytes,
}
"""Keys to order recordings by."""


_Some: TypeAlias = Annotated[list[Text], Meta(max_length=16)]


@route("/recordings")
def recordings(
    context: Context,
    *,
    first: Annotated[int, Meta(ge=0, le=1 << 31)] = 0,
    count: Annotated[int, Meta(ge=1, le=_MAX_ROWS)] = _MAX_ROWS,
    order: Literal["start", "name", "duration", "topics", "messages", "size"] = "start",
    direction: Literal["up", "down"] = "down",
    name: Text = "",
    tag: _Some = [],  # noqa: B006 - defaults of a structure, which copies them
    topic: _Some = [],  # noqa: B006
    type: _Some = [],  # noqa: A002, B006 - its name in addresses
    where: _Some = [],  # noqa: B006
    begin: Text = "",
    end: Text = "",
) -> dict[str, Any]:
    """A part of the recordings that satisfy some conditions, in some order."""
    during = (begin or None, end or None) if begin or end else None
    # Globs for names that contain any of the words.
    names = [
        word if {*word} & {*"*?"} else f"*{word.replace('[', '[[]')}*" for word in name.split()
    ]
    choice = Choice.of(names, tag=tag, has=topic, type=type, during=during, where=where)
    store = context.store
    summaries = store.choose(choice).summaries
    ordered = sorted(summaries, key=_KEYS[order], reverse=direction == "down")
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


@route("/recording")
def recording_of(context: Context, *, recording: Text) -> dict[str, Any]:
    """One recording: its topics, marks, losses, what has expired, and times."""
    entry = context.store.entry(recording)
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
        "gone": _gone(entry.manifest, start),
        "topics": _topics(entry, start),
    }


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


def _gone(manifest: Manifest, start: int) -> list[dict[str, Any]]:
    """The stretches of topics of which only fields are left, and whether the rest has expired."""
    found: list[dict[str, Any]] = []
    last: dict[str, dict[str, Any]] = {}  # the stretch that goes on, by topic
    for file in sorted(manifest.logs.values(), key=lambda one: one.number):
        for number, part in file.parts.items():
            topic = manifest.channels[number].topic
            if file.is_here or part.first is None or part.last is None:
                last.pop(topic, None)
                continue
            stretch = {"topic": topic, "begin": part.first - start, "cause": file.gone}
            if topic not in last or last[topic]["cause"] != file.gone:
                found.append(stretch)
                last[topic] = stretch
            last[topic]["end"] = part.last - start
    return found


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


routes = [recordings, recording_of]
