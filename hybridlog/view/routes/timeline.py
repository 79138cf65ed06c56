"""The timeline: messages by pixel, gaps and marks; and how far a running recording is."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from starlette.responses import Response

from hybridlog.drawing.silence import gaps
from hybridlog.losses import extent_of
from hybridlog.marks import MARKS
from hybridlog.view.context import Context, route, start_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.view.asked import Asked
    from hybridlog_storage.catalog import RecordingEntry

MAX_LANES: Final = 64
"""Topics of one picture."""
MAX_BINS: Final = 1 << 17
"""Topics times pixels of one picture."""
MAX_MARKS: Final = 500
"""Marks of one answer."""

_ALIGNED: Final = 8  # bytes


def timeline(context: Context, asked: Asked) -> Response:
    """Messages of some topics by bin, as bytes.

    Parameters are `recording`, `begin` and `end` (ns since its start), `pixels` (most bins that
    fit between them), and `topic`, repeated. The answer is

    | bytes | |
    |---|---|
    | 4 | length of the head, little endian |
    | head | JSON in UTF-8, with spaces behind it up to a multiple of 8 bytes |
    | counts | of each lane, `bins` integers of `size` bytes, and zeros up to a multiple of 8 |
    | gaps | of the lane, pairs of uint32: first bin, and the one behind the last; and zeros |

    The head has `start` (ns since 1970, as text), `begin` of the first bin, `width` of a bin
    and their number `bins`, and `lanes`: `size`, `gaps`, `exact` (false for estimates) and
    `period`, the usual time from one message to the next, 0 if unknown. Times are ns.
    """
    recording = context.recording(asked)
    topics = asked.texts("topic", most=MAX_LANES)
    pixels = asked.pixels()
    if len(topics) * pixels > MAX_BINS:
        raise UsageError(f"At most {MAX_BINS // max(len(topics), 1)} pixels for as many topics.")
    start = start_of(recording)
    span = asked.span(start)
    found = context.densities.density(recording, span, pixels, topics)
    extent = _extent(context, recording)
    periods = context.densities.periods(recording, span, topics)
    lanes, body = [], []
    for counts, exact, period in zip(found.counts, found.exact.tolist(), periods, strict=True):
        silent = gaps(*_within(counts, found.edges, extent), period)
        small = _small(counts)
        lanes.append(
            {"size": small.itemsize, "gaps": len(silent), "exact": exact, "period": period}
        )
        body += [_filled(small.tobytes()), _filled(silent.astype("<u4").tobytes())]
    head = {
        "start": str(start),
        "begin": int(found.edges[0]) - start,
        "width": int(found.edges[1] - found.edges[0]),
        "bins": found.counts.shape[1],
        "lanes": lanes,
    }
    text = json.dumps(head, separators=(",", ":")).encode()
    text += b" " * (-(len(text) + 4) % _ALIGNED)
    content = b"".join([len(text).to_bytes(4, "little"), text, *body])
    return Response(content, media_type="application/octet-stream")


def live(context: Context, asked: Asked) -> dict[str, Any]:
    """Status, span and counts of a running recording, with what it has flushed."""
    recording = context.recording(asked)
    if recording.status == "open":
        listing = context.store.directory.listing(recording.label)
        if not listing.open or recording.digests.keys() != {str(n) for n in listing.sealed}:
            context.refresh()
            recording = context.recording(asked)
    start = start_of(recording)
    begin, end = _extent(context, recording)
    topics: dict[str, dict[str, Any]] = {}
    for channel in recording.channels:
        row = topics.setdefault(channel.topic, _row(channel.topic, channel.type))
        row["messages"] += channel.stats.messages
    for topic, running in context.densities.running(recording).items():
        row = topics.setdefault(topic, _row(topic, running.type))
        row["messages"] += running.messages
    return {
        "status": recording.status,
        "start": str(start),
        "begin": str(begin - start),
        "end": str(end - start),
        "messages": sum(row["messages"] for row in topics.values()),
        "topics": [topics[topic] for topic in sorted(topics)],
    }


def marks(context: Context, asked: Asked) -> dict[str, Any]:
    """The first marks in a range, and how many more there are."""
    recording = context.recording(asked)
    start = start_of(recording)
    if MARKS not in {channel.topic for channel in recording.channels}:
        return {"marks": [], "more": 0}
    begin, end = asked.span(start)
    first, last = recording.span or (start, start)
    if begin > last or end <= first:
        return {"marks": [], "more": 0}  # a query refuses such a range
    query = context.query(recording, MARKS).between(begin, end)
    found = [
        {"at": message.log_time_ns - start, "text": str(message.fields.get("text", ""))}
        for message in query.limit(MAX_MARKS)
    ]
    return {"marks": found, "more": query.count() - len(found)}


def _extent(context: Context, recording: RecordingEntry) -> tuple[int, int]:
    """Log time `[begin, end)` of a recording, ns, with what is flushed."""
    begin, end = extent_of(recording)
    if recording.status == "open":
        running = context.densities.running(recording).values()
        spans = [(topic.first, topic.last + 1) for topic in running if topic.messages]
        spans += [(begin, end)] if begin < end else []
        if spans:
            return min(a for a, _ in spans), max(b for _, b in spans)
    return (begin, end) if begin < end else (recording.created, recording.created)


def _within(
    counts: NDArray[np.int64], edges: NDArray[np.int64], extent: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Bins cut to the time of a recording; those outside are not empty."""
    is_outside = (edges[1:] <= extent[0]) | (edges[:-1] >= extent[1])
    return np.where(is_outside, 1, counts), np.clip(edges, *extent)


def _small(counts: NDArray[np.int64]) -> NDArray[Any]:
    """The counts in as few bytes as possible: 1, 2 or 4; none of them is greater."""
    most = int(counts.max(initial=0))
    size = "<u1" if most < 1 << 8 else "<u2" if most < 1 << 16 else "<u4"
    return np.minimum(counts, (1 << 32) - 1).astype(size)


def _filled(content: bytes) -> bytes:
    return content + bytes(-len(content) % _ALIGNED)


def _row(topic: str, kind: str) -> dict[str, Any]:
    return {"topic": topic, "type": kind, "messages": 0}


routes = [route("/timeline", timeline), route("/live", live), route("/marks", marks)]
