"""The recordings, and questions about one: counts, command lines, programs, matches, SQL."""

from __future__ import annotations

import re
import shlex
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, TypeAlias

from msgspec import Meta

from hybridlog.drawing.times import Match, Matches, aligned
from hybridlog.query.answers.interval_queries import marks_in
from hybridlog.query.choice import Choice
from hybridlog.query.times import format_time
from hybridlog.record.losses import losses_of
from hybridlog.schema.states import encoding_of, shown_channels
from hybridlog.view.commands import run
from hybridlog.view.context import (
    Context,
    Offset,
    Pixels,
    Question,
    Seq,
    Text,
    extent,
    moment_of,
    part_of,
    route,
    start_of,
)
from hybridlog_storage.catalog import ChannelStats, RecordingEntry, RecordingSummary
from hybridlog_storage.manifest import MAX_MARKS, Manifest
from hybridlog_storage.stopping import held

if TYPE_CHECKING:
    from hybridlog.query.query import Query
    from hybridlog.query.question import Span
    from hybridlog.store import Store

# Recordings.

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


# Questions.

MAX_TOPICS: Final = 200
"""Greatest number of topics that are named; without any, all are meant."""
Topics: TypeAlias = Annotated[list[Text], Meta(max_length=MAX_TOPICS)]
Within: TypeAlias = Annotated[str, Meta(max_length=64)]


class PageQuestion:
    """A question about one recording.

    Args:
        recording: Its id or name.
        topic: Full names of topics; none for all.
        where: Predicate, empty for every message.
        within: Greatest distance in time of messages of other topics, empty without any.
        begin: Beginning of its part of the recording, ns since its start; None for all of it.
        end: End of that, not included.

    Attributes:
        recording: The recording.
        span: Log time `[begin, end)`, ns; None for all of it.
    """

    def __init__(
        self,
        context: Context,
        recording: str,
        topic: list[str],
        *,
        where: str,
        within: str,
        begin: int | None = None,
        end: int | None = None,
    ) -> None:
        self.store, self.recording = context.store, context.store.entry(recording)
        self.topics = tuple(dict.fromkeys(topic))
        self.where, self.within = where.strip(), within
        self.span: Span | None = None
        if begin is not None or end is not None:
            self.span = part_of(start_of(self.recording), begin or 0, end or 0)
        known = {channel.topic for channel in self.recording.channels}
        self._query = context.query(self.recording, *(self.topics or sorted(known)))

    def query(self) -> Query:
        """Its messages."""
        query = self._query
        if self.span is not None:
            # First, so that conditions on other topics are asked in this range only.
            query = query.between(*self.span)
        return query.where(self.where, self.within or None) if self.where else query

    def command(self) -> str:
        """The command line that writes it to a file named by recording and range."""
        begin, end = self.span or self.recording.extent
        times = "_".join(format_time(time).replace(":", "") for time in (begin, end))
        name = re.sub(r"[^\w.+-]+", "_", self.recording.name)
        words = ["hybridlog", "fetch", "--store", self.store.directory.place]
        words += ["-r", self.recording.name]
        for topic in self.topics or ["**"]:
            words += ["-t", topic]
        if self.span is not None:
            words += ["--between", *map(format_time, self.span)]
        if self.where:
            words += ["--where", self.where]
        if self.within:
            words += ["--within", self.within]
        return shlex.join([*words, "-o", f"{name}_{times}.mcap"])

    def python(self) -> str:
        """A program that asks the same."""
        recordings = f"store.recordings({self.recording.name!r})"
        topics = ", ".join(map(repr, self.topics))
        steps = [f"{recordings}.topic({topics})" if topics else f"{recordings}.all_topics()"]
        if self.span is not None:
            steps.append(f".between({self.span[0]}, {self.span[1]})")
        if self.where:
            within = f", within={self.within!r}" if self.within else ""
            steps.append(f".where({self.where!r}{within})")
        lines = "".join(f"\n        {step}" for step in steps)
        body = (
            f"    messages = ({lines}\n    )\n"
            "    print(messages.count())\n"
            "    for message in messages.limit(10):\n"
            "        print(message.log_time_ns, message.topic)\n"
        )
        return _program(self.store, body)


def _program(store: Store, body: str) -> str:
    """A program that opens a store; `body` is indented."""
    path = store.directory.place
    return f"import hybridlog as hl\n\nwith hl.open({path!r}) as store:\n{body}"


@route("/ask")
def ask(
    context: Context,
    *,
    recording: Text,
    topic: Topics = [],  # noqa: B006 - a default of the structure, which copies it
    where: Question = "",
    within: Within = "",
    begin: Offset | None = None,
    end: Offset | None = None,
) -> dict[str, Any]:
    """The number of messages, with losses and remarks; the command line and Python for them."""
    asked = PageQuestion(
        context, recording, topic, where=where, within=within, begin=begin, end=end
    )
    query = asked.query()
    count = query.count()
    found = query.completeness()
    return {
        "count": count,
        "lost": found.describe(count) if found.has_losses else None,
        "remarks": found.sentences,
        "python": asked.python(),
        "command": asked.command(),
    }


# Matches and SQL.

MAX_LISTED: Final = 200
"""Greatest number of episodes that are listed at once."""
_matching = threading.Lock()  # held while matches are looked for


@route("/matches")
def matches(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    begin: Offset,
    end: Offset,
    pixels: Pixels,
    where: Question = "",
    within: Within = "",
) -> dict[str, Any]:
    """The matches in a range by pixel, and the bands in which the predicate holds."""
    found, start = _matches(context, recording, topic, where, within)
    span = part_of(start, begin, end)
    edges = aligned(span, pixels)
    first, counts = found.ticks(edges)
    bands = found.bands(span, int(edges[1] - edges[0]))
    return {
        "first": (first - start).tolist(),
        "counts": counts.tolist(),
        "bands": (bands - start).tolist(),
    }


@route("/episodes")
def episodes(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    seq: Seq = -1,
    count: Annotated[int, Meta(ge=1, le=MAX_LISTED)] = MAX_LISTED,
    direction: Literal["later", "earlier"] = "later",
    where: Question = "",
    within: Within = "",
) -> dict[str, Any]:
    """Some episodes behind or in front of a place, how many are in front of them, and in all.

    An episode is a row of matches: times of its first match and of its end, arrival number of that
    match, number of matches.
    """
    found, start = _matches(context, recording, topic, where, within)
    place = Match(moment_of(start, at), seq)
    rows = found.beside(place, count, earlier=direction == "earlier")
    return {
        "rows": [[str(e.first.time - start), str(e.end - start), e.first.seq, e.n] for e in rows],
        "before": found.count_before(rows[0].first) if rows else None,
        "all": found.episodes,
    }


def _matches(
    context: Context, name: str, topic: str, where: str, within: str
) -> tuple[Matches, int]:
    """The matches of a question about one topic, and the start of its recording."""
    asked = PageQuestion(context, name, [topic], where=where, within=within)
    recording = asked.recording
    state = recording.status, recording.messages, frozenset(recording.digests.items())
    key = recording.id, state, (topic, asked.where, within)
    with held(_matching):  # a second client that asks the same waits
        made = context.store.shared.cache.made
        found = made(
            "matches", *key, make=lambda: Matches(asked.query()), size_of=lambda one: one.size
        )
    return found, start_of(recording)


SQL_SECONDS: Final = 60
"""Seconds that a query in SQL may take."""
SQL_MEMORY: Final = 512 << 20
"""Bytes that DuckDB may use."""
SQL_ROWS: Final = 1000
SQL_COLUMNS: Final = 200
_MICROSECOND: Final = 1000  # ns


@route("/sql", threading.BoundedSemaphore(1))
def sql(context: Context, *, recording: Text, text: Question) -> dict[str, Any]:
    """The first rows of a query in SQL about a recording; with times, their moments in it."""
    from hybridlog.frames.lines import shown

    store, entry = context.store, context.store.entry(recording)
    options = [f"--recording={entry.id}", "--format=arrow", f"--limit={SQL_ROWS + 1}"]
    bounds = [f"--memory={SQL_MEMORY}", f"--timeout={SQL_SECONDS}s"]
    place = store.directory.address
    printed, remarks = run(place, "sql", [*options, *bounds], text, seconds=SQL_SECONDS + 5)
    found = shown(printed, SQL_ROWS, SQL_COLUMNS)
    first, last = entry.span or (0, -1)
    body = f"    print(store.sql({text!r}, recordings={entry.name!r}).to_pandas())\n"
    return found | {
        "at": [
            None
            if time is None or not first <= time < last + _MICROSECOND
            else str(min(time, last) - first)
            for time in found.pop("times")
        ],
        "remarks": remarks,
        "python": _program(store, body),
    }


routes = [recordings, recording_of, ask, matches, episodes, sql]
