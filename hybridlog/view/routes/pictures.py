"""What panels show: messages by pixel, fields over time, images, points, tracks, messages, rows."""

from __future__ import annotations

from contextlib import suppress
from itertools import islice
from math import isfinite
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeAlias

import numpy as np
from msgspec import Meta
from msgspec.structs import asdict
from starlette.responses import Response

from hybridlog.drawing.images import picture
from hybridlog.drawing.points import MAX_POINTS, bounds, points
from hybridlog.drawing.series import fields_of, known_fields, track
from hybridlog.drawing.series import series as read_series
from hybridlog.drawing.times import aligned, lane_of
from hybridlog.drawing.tree import MAX_SHOWN, tree
from hybridlog.query.times import format_time
from hybridlog.schema.states import CAUSES
from hybridlog.view.context import (
    Context,
    Offset,
    Pixels,
    Question,
    Seq,
    Text,
    current,
    extent,
    json_response,
    moment_of,
    packed_response,
    part_of,
    route,
    start_of,
)
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    MissingDependencyError,
    PayloadError,
    TimeError,
    UsageError,
)
from hybridlog_storage.times import END

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.query import Query

MAX_LANES: Final = 64
"""Topics of one picture."""
MAX_BINS: Final = 1 << 17
"""Topics times pixels of one picture."""
MAX_LISTED: Final = 5000
"""Most fields of a topic that are listed."""
MAX_FIELDS: Final = 16
"""Most fields of one plot."""
_GREATEST_EXACT: Final = 1 << 53
Lanes: TypeAlias = Annotated[list[Text], Meta(max_length=MAX_LANES)]
Fields: TypeAlias = Annotated[list[Text], Meta(max_length=MAX_FIELDS)]


@route("/timeline")
def timeline(
    context: Context, *, recording: Text, topic: Lanes, begin: Offset, end: Offset, pixels: Pixels
) -> Response:
    """Messages of some topics by bin, as bytes; `pixels` is the most bins that fit in the range.

    The header has `start` (ns since 1970, as text), `begin` of the first bin, `width` of a bin,
    and `lanes`: `exact` (false for estimates) and `period`, the usual time from one message to
    the next, 0 if unknown. Times are ns. The arrays of lane n are `counts n`, an integer a bin, and
    `gaps n`, pairs: first bin, and the one behind the last.
    """
    entry = context.store.entry(recording)
    if len(topic) * pixels > MAX_BINS:
        raise UsageError(f"At most {MAX_BINS // max(len(topic), 1)} pixels for as many topics.")
    start = start_of(entry)
    edges, lanes = aligned(part_of(start, begin, end), pixels), []
    arrays: dict[str, NDArray[Any]] = {}
    for number, name in enumerate(topic):
        lane = lane_of(context.store.session, entry, name)
        period = lane.period()
        lanes.append({"exact": lane.exact, "period": period})
        silent = lane.gaps(edges, extent(entry), period).astype(np.uint32)
        arrays |= {f"counts {number}": _small(lane.counts(edges)), f"gaps {number}": silent}
    head = {
        "start": str(start),
        "begin": int(edges[0]) - start,
        "width": int(edges[1] - edges[0]),
        "lanes": lanes,
    }
    return packed_response(head, arrays)


def _small(counts: NDArray[np.int64]) -> NDArray[Any]:
    """The counts in as few bytes as possible: 1, 2 or 4; none of them is greater."""
    most = int(counts.max(initial=0))
    return np.minimum(counts, (1 << 32) - 1).astype(np.min_scalar_type(min(most, (1 << 32) - 1)))


@route("/fields")
def fields(context: Context, *, recording: Text, topic: Text) -> dict[str, Any]:
    """The fields of a topic that can be drawn, and their types."""
    _, query = context.topic(recording, topic)
    found = islice(fields_of(known_fields(query), iter(query.limit(1))), MAX_LISTED)
    return {"fields": [{"path": path, "type": kind} for path, kind in found]}


@route("/series")
def series(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    begin: Offset,
    end: Offset,
    pixels: Pixels,
    field: Fields,
) -> dict[str, Any]:
    """Least and greatest values by pixel, or each value if there are few."""
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    found = read_series(query, field, pixels=pixels, span=part_of(start, begin, end))
    if len(found) > MAX_FIELDS:
        raise UsageError(f"These are {len(found)} fields, at most {MAX_FIELDS} fit in a plot.")
    return {
        "exact": all(one.exact for one in found),
        "times": [str(time - start) for time in found[0].times.tolist()] if found else [],
        "fields": [
            {"field": one.field, "least": _values(one.least)}
            | ({} if one.exact else {"greatest": _values(one.greatest)})
            for one in found
        ],
    }


def _values(numbers: NDArray[np.floating[Any]]) -> list[float | str | None]:
    """Null for NaN and infinities, which JSON lacks, and texts for integers that pages round."""
    return [_value(value) if isfinite(value) else None for value in numbers.tolist()]


def _value(number: float) -> float | str:
    is_float = isinstance(number, float) or abs(number) <= _GREATEST_EXACT
    return float(number) if is_float else str(int(number))


@route("/image")
def image(
    context: Context, *, recording: Text, topic: Text, at: Offset, seq: Seq = END
) -> Response:
    """The picture as a file; as JSON, why there is none. Headers say when it is current."""
    found = current(context, recording, topic, at, seq)
    answer: Response = json_response({})
    if found.message is not None:
        try:
            made = picture(found.message, raw=False)
            answer = Response(made.data, media_type=made.media_type)
        except (DefinitionError, MissingDependencyError, PayloadError) as error:
            answer = json_response({"problem": str(error)})
    times = {"Hybridlog-Time": found.time, "Hybridlog-Until": found.until}
    answer.headers.update({name: time for name, time in times.items() if time is not None})
    return answer


@route("/points")
def points_at(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    seq: Seq = END,
    value: Text = "",
    limit: Annotated[int, Meta(ge=1, le=MAX_POINTS)] = MAX_POINTS,
) -> Response:
    """The points of the message that is current at a time, at most so many.

    They have the values of that name, to colour by.
    """
    shown = current(context, recording, topic, at, seq)
    header: dict[str, Any] = {"time": shown.time, "until": shown.until}
    if shown.message is None:
        return packed_response(header, {})
    try:
        found = points(shown.message, values=[value], limit=limit)
    except (DefinitionError, PayloadError) as error:
        return packed_response({**header, "problem": str(error)}, {})
    xyz, offered = found.pop("xyz"), found.pop("values")
    values = {"value": offered[value]} if value in offered else {}
    columns = dict(zip("xyz", xyz.T, strict=True)) | values
    header |= {
        **found,
        "shown": len(xyz),
        "bounds": {name: bounds(array) for name, array in columns.items()},
    }
    return packed_response(header, {"xyz": xyz, **values})


@route("/track")
def track_of(context: Context, *, recording: Text, topic: Text, pixels: Pixels) -> Response:
    """The track of a topic in metres, of a receiver from its first fix, and the times.

    A time is the sum of `times` and `rests`: a float64 is too coarse far from the start.
    """
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    found = track(query, pixels=pixels)
    offsets, xy = found.pop("times") - start, found.pop("xy")
    header = {**found, "grid": None if found["grid"] is None else asdict(found["grid"])}
    times = offsets.astype(np.float64)
    arrays: dict[str, NDArray[np.floating[Any]]] = {
        "times": times,
        "rests": np.array([n - int(float(n)) for n in offsets.tolist()], np.float32),
        "xy": xy.astype(np.float32),
    }
    return packed_response(header, arrays)


# The message at the cursor, and rows of the log.

Place: TypeAlias = Annotated[str, Meta(pattern=r"\A(\d{1,9}(\.\d{1,9}){0,99})?\Z")]


@route("/message")
def message(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    seq: Seq = END,
    path: Place = "",
    begin: Annotated[int, Meta(ge=0, le=1 << 40)] = 0,
    count: Annotated[int, Meta(ge=1, le=MAX_SHOWN)] | None = None,
) -> dict[str, Any]:
    """The message, or the part of it at a path (numbers), from an element or character on."""
    found = current(context, recording, topic, at, seq)
    shown = found.message
    answer: dict[str, Any] = {"time": found.time, "until": found.until}
    if shown is None:
        return answer
    answer |= {
        "type": shown.type,
        "log_time": format_time(shown.log_time_ns),
        "publish_time": _time(shown.publish_time_ns),
        "seq": shown.seq,
        "sequence": shown.sequence,
        "reduced": CAUSES.get(shown.state),
    }
    try:
        if not shown.is_reduced:
            answer["bytes"] = len(shown.payload)
        place = [int(number) for number in path.split(".")] if path else []
        answer["tree"] = tree(shown, place, begin=begin, count=count)
    except (DefinitionError, PayloadError) as error:
        answer["problem"] = str(error)
    return answer


def _time(ns: int | None) -> str | None:
    return None if ns is None or not 0 <= ns < 1 << 63 else format_time(ns)


MAX_CHARACTERS: Final = 4000
"""Characters of a field of a row; one more says that there are others."""
_Rows: TypeAlias = Annotated[int, Meta(ge=0, le=500)]


@route("/rows")
def rows(
    context: Context,
    *,
    recording: Text,
    topic: Text,
    at: Offset,
    field: Annotated[list[Text], Meta(min_length=1, max_length=8)],
    seq: Seq = END,
    where: Question = "",
    before: _Rows = 0,
    after: _Rows = 0,
) -> dict[str, Any]:
    """Messages before and after a time; with `seq`, before and after the one of that number.

    `time` since the start of the recording, ns, `seq`, and `values` of the fields: numbers, or
    texts; or the `problem` why it cannot be read.
    """
    entry, query = context.topic(recording, topic)
    start = start_of(entry)
    time = moment_of(start, at)
    if where:
        query = query.where(where)
    # A message at the time itself is before the cursor, as it is current there.
    earlier = beside(query, time, seq, before, before=True)
    later = beside(query, time, seq, after)
    return {
        "rows": [_row(one, start, field) for one in (*earlier, *later)],
        "first": len(earlier) < before,
        "last": len(later) < after,
    }


def beside(query: Query, time: int, seq: int, count: int, *, before: bool = False) -> list[Message]:
    """The next messages behind one, or the last ones in front of it, in order.

    The query is of one topic of one recording; that message is named by its log time, ns, and its
    arrival number; -1 stands in front of all messages of that time.
    """
    same = query.between(time, time + 1).where(f"_meta.seq {'<' if before else '>'} {seq}")
    rest = query.between(None, time) if before else query.between(time + 1)
    found: list[Message] = []
    for part in (same, rest):
        with suppress(TimeError):  # a range before or behind the recording has none
            ordered = part.reverse() if before else part
            found += ordered.limit(count - len(found))
    return found[::-1] if before else found


def _row(message: Message, start: int, names: Sequence[str]) -> dict[str, Any]:
    found: dict[str, Any] = {"time": str(message.log_time_ns - start), "seq": message.seq}
    try:
        fields = message.fields
        if not fields:
            message.content()
    except HybridlogError as error:
        return {**found, "problem": str(error)}
    values = [fields.get(name, "") for name in names]
    return {
        **found,
        "values": [
            value if type(value) is int else str(value)[: MAX_CHARACTERS + 1] for value in values
        ],
    }


routes = [timeline, fields, series, image, points_at, track_of, message, rows]
