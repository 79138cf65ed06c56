"""Fields over time, and tracks in metres, with no more points than a picture has pixels."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec import Struct

from hybridlog.frames.names import FIELD, is_summary
from hybridlog.query.answers.statistics import infer_fields
from hybridlog.query.intervals import GAP_PERIODS, Intervals, Steps
from hybridlog.query.query import Query, field_types, spans_of, tables_of
from hybridlog.query.times import TIME_LIMIT
from hybridlog.schema.arrow_types import is_list, is_number, is_time, lengths_of
from hybridlog.schema.definition_text import NUMERIC, element_of, width_of
from hybridlog_storage.errors import SegmentError, TopicError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.question import Span


Numbers: TypeAlias = "NDArray[np.floating[Any]]"
_Part: TypeAlias = "tuple[NDArray[np.int64], Mapping[str, Numbers]]"
_ACCESS = re.compile(r"\[(\d{1,9})\]|\.([^.\[\]]+)")
_NO_NUMBER = "{} is no number: only numbers can be drawn, of an array `x[0]` or `x.min`."
_EXTREMES = (np.fmin, np.fmax)


class Series(Struct, frozen=True):
    """One field over time. Entries are in order of time; NaN means no line there.

    A time without messages longer than `GAP_PERIODS` usual periods has one entry of NaN in its
    middle. All series of one call have the same times.

    Attributes:
        field: Path of the field.
        times: int64[n], log time, ns since the epoch: of a message, or of the first one in a
            pixel.
        least: float64[n], least value; NaN where a field is missing or NaN. Of integers of 64
            bits, longdouble[n], which holds them all.
        greatest: The same of the greatest value.
        exact: True if there is an entry for each message, and `least` equals `greatest`. Else
            there is one for each pixel with messages, and values that are infinite or NaN are
            left out if a pixel has others.
    """

    field: str
    times: NDArray[np.int64]
    least: Numbers
    greatest: Numbers
    exact: bool

    def alone(self) -> NDArray[np.bool_]:
        """bool[n], True for entries between two gaps: no line goes through them."""
        is_known = np.isfinite(self.least) & np.isfinite(self.greatest)
        edged = np.concatenate([[False], is_known, [False]])
        found: NDArray[np.bool_] = is_known & ~edged[:-2] & ~edged[2:]
        return found

    def polyline(self) -> tuple[NDArray[np.int64], Numbers]:
        """Corners of the line: times, ns, and values. A pixel has its least and its greatest."""
        if self.exact:
            return self.times, self.least
        return np.repeat(self.times, 2), np.stack([self.least, self.greatest], axis=1).ravel()


def series(
    query: Query, fields: Sequence[str], *, pixels: int, span: Span | None = None
) -> list[Series]:
    """Fields of the messages of a query, of one topic of one recording, over log time.

    Numbers become floating, true and false 1 and 0, times and durations nanoseconds. Fields are
    paths of numbers (`ranges.min`, `position[2]`), or of messages with numbers (`twist.linear`),
    which give a series for each. `pixels` is the width of the picture: up to twice as many messages
    are returned exactly. Its span is log time `[begin, end)`, ns; None for that of the messages.
    The counters of the query are set to the cost.
    """
    if pixels < 1:
        raise UsageError(f"A picture is at least one pixel wide, not {pixels}.")
    wanted = [Wanted.of(text) for text in fields]
    if not wanted:
        raise UsageError("Name a field: `hybridlog info -t TOPIC` lists them.")
    narrowed, (begin, end) = over_time(query, [one.path for one in wanted], span)
    if begin >= end:
        none = np.empty(0)
        return [Series(one.text, none.astype(np.int64), none, none, True) for one in wanted]
    with query.counters.timed():
        rows = ShownRows(span or (begin, end), pixels, most=2 * pixels)
        found = _read(tables_of(narrowed), wanted, rows)
        query.counters.add(narrowed.counters)
    return found


def over_time(query: Query, fields: Sequence[str], span: Span | None) -> tuple[Query, Span]:
    """The query for some fields of one topic in one recording, and its part of a span.

    That is log time `[begin, end)`, ns; None for that of the messages.
    """
    if query.question.reverse:
        raise UsageError("Time runs from left to right here: leave out reverse.")
    narrowed = query.fields(*dict.fromkeys(fields))
    spans = spans_of(query)
    if len(query.topics) != 1 or len(spans) > 1:
        raise UsageError(
            f"A picture of fields is of one topic in one recording; these are {len(query.topics)} "
            f"topics in {len(spans)} recordings."
        )
    recording, (begin, end) = next(iter(spans.items()), ("", (0, 0)))
    if span is not None:
        begin, end = max(begin, span[0]), min(end, span[1])
        window = np.array([[begin, max(begin, end), 0]], np.int64)
        narrowed = narrowed.during(Intervals([(recording, window)])) if recording else narrowed
    return narrowed, (begin, end)


class Wanted(Struct, frozen=True):
    """A field as it was asked for.

    Attributes:
        text: As it was written.
        path: Path of a column.
        access: Elements by number and fields by name, which lead from there to the number.
    """

    text: str
    path: str
    access: tuple[int | str, ...]

    @classmethod
    def of(cls, text: str) -> Wanted:
        """The field of a path."""
        path, bracket, rest = text.partition("[")
        rest = bracket + rest
        found = list(_ACCESS.finditer(rest))
        if "".join(match[0] for match in found) != rest or not path:
            raise UsageError(f"{text!r} names no single number: write position[0] for an element.")
        return cls(text, path, tuple(int(m[1]) if m[1] else m[2] for m in found))

    def columns(self, table: pa.Table) -> dict[str, Numbers | None]:
        """Its columns in a table, by path; None for what is no number."""
        found: dict[str, Numbers | None] = {}
        for field, column in zip(table.schema, table.columns, strict=True):
            path = (field.metadata or {}).get(FIELD, field.name.encode()).decode()
            if path != self.path and (self.access or not path.startswith(f"{self.path}.")):
                continue
            array = column.combine_chunks()
            for step in self.access:
                array = _stepped(array, step)
            name = self.text if path == self.path else path
            found[name] = None if array is None else _numbers(array)
        return found


def _stepped(array: Any, step: int | str) -> Any:
    """An element of each list, or a field of each message; None if the type has none."""
    if array is None:
        return None
    if isinstance(step, str):
        if not pa.types.is_struct(array.type):
            return None
        names = [field.name for field in array.type]
        return array.flatten()[names.index(step)] if step in names else None
    if not is_list(array.type):
        return None
    counts = lengths_of(array)
    begins = np.cumsum(counts) - counts
    return array.flatten().take(pa.array(begins + step, mask=counts <= step))


def _numbers(array: Any) -> Numbers | None:
    """Values as in a `Series`, NaN for null; None if they are no numbers."""
    types, kind = pa.types, array.type
    if is_time(kind):
        array = array.cast(pa.int64())
    elif types.is_boolean(kind):
        array = array.cast(pa.uint8())
    elif not (is_number(kind) or types.is_null(kind)):
        return None
    values: Numbers
    if types.is_int64(array.type) or types.is_uint64(array.type):
        values = array.fill_null(0).to_numpy(zero_copy_only=False).astype(np.longdouble)
        values[array.is_null().to_numpy(zero_copy_only=False)] = np.nan
    else:
        values = array.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False)
    return values


def _read(tables: Iterable[pa.Table], wanted: Sequence[Wanted], rows: ShownRows) -> list[Series]:
    """The series from tables of messages, which are in order."""
    names: list[dict[str, bool]] = [{} for _ in wanted]  # of columns, True for numbers
    for table in tables:
        columns: dict[str, Numbers] = {}
        for one, known in zip(wanted, names, strict=True):
            for path, values in one.columns(table).items():
                known[path] = known.get(path, False) or values is not None
                if values is not None:
                    columns[path] = values
        rows.add(log_times(table), columns)
    count = len(rows.joined()[0])
    for one, known in zip(wanted, names, strict=True):
        if not known and count:
            raise TopicError(f"No message here has a field {one.text!r}.")
        if not any(known.values()) and count:
            raise UsageError(_NO_NUMBER.format(one.text))
    paths = dict.fromkeys(p for known in names for p, is_number in known.items() if is_number)
    return rows.series(paths)


def log_times(table: pa.Table) -> NDArray[np.int64]:
    """The log times of a table of messages, ns."""
    times: NDArray[np.int64] = table["log_time"].combine_chunks().cast("int64").to_numpy()
    return times


class ShownRows:
    """Messages in order of time; of very many, more than `most`, those that a picture shows.

    Then a pixel has its first and its last message, those with the least and the greatest finite
    value of each column, and one without, if it has any. The span of the picture is log time
    `[begin, end)`, ns.

    Attributes:
        exact: True if they are all messages.
    """

    def __init__(self, span: Span, pixels: int, most: int) -> None:
        begin, end = max(span[0], 0), min(span[1], TIME_LIMIT)
        width = max(1, -(-(end - begin) // pixels))
        inner = min(pixels - 1, (TIME_LIMIT - 1 - begin) // width)
        self._edges = begin + width * np.arange(1, inner + 1, dtype=np.int64)
        self._most = self._room = most
        self._steps = Steps()
        self._parts: list[_Part] = []
        self._size = 0
        self.exact = True

    def add(self, times: NDArray[np.int64], columns: Mapping[str, Numbers]) -> None:
        """Add messages, which are not before earlier ones."""
        self._steps.add(times)
        self._parts.append((times, columns))
        self._size += len(times)
        if self._size > self._room:
            self._parts = [self._thinned(*part) for part in self._parts]
            self.thin()
            self._room = max(self._most, 4 * self._size)

    def thin(self) -> None:
        """Leave out what a picture does not show."""
        self._parts = [self._thinned(*self.joined())]
        self._size, self.exact = len(self._parts[0][0]), False

    def joined(self) -> _Part:
        """int64[n], log times, ns; and values by name, n each, NaN where a message has none."""
        if len(self._parts) != 1:
            times = np.concatenate([np.empty(0, np.int64), *(times for times, _ in self._parts)])
            columns = {
                name: np.concatenate(
                    [c[name] if name in c else np.full(len(t), np.nan) for t, c in self._parts]
                )
                for name in dict.fromkeys(name for _, columns in self._parts for name in columns)
            }
            self._parts = [(times, columns)]
        return self._parts[0]

    def _begins(self, times: NDArray[np.int64]) -> NDArray[np.intp]:
        """The place of the first message of each pixel that has any."""
        found = np.searchsorted(times, self._edges)
        found = np.append(0, found[np.diff(found, prepend=0) > 0])
        return found[found < len(times)]

    def _thinned(self, times: NDArray[np.int64], columns: Mapping[str, Numbers]) -> _Part:
        if not len(times):
            return times, columns
        begins = self._begins(times)
        ends = np.append(begins[1:], len(times))
        keep = np.zeros(len(times), np.bool_)
        keep[begins] = keep[ends - 1] = True
        for values in columns.values():
            finite, is_finite = values, np.isfinite(values)
            places = []
            if not is_finite.all():
                finite, places = np.where(is_finite, values, np.nan), [np.flatnonzero(~is_finite)]
            for choose in _EXTREMES:
                found = choose.reduceat(finite, begins).repeat(ends - begins)
                places.append(np.flatnonzero(finite == found))
            for some in places:
                first = np.append(some, len(times))[np.searchsorted(some, begins)]
                keep[first[first < ends]] = True
        return times[keep], {name: values[keep] for name, values in columns.items()}

    def gaps(self) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Places in front of which times without messages end, and the middles of these, ns."""
        times, _ = self.joined()
        steps = np.diff(times)
        is_gap = steps > GAP_PERIODS * self._steps.usual_period()
        if not self.exact:  # one that has a pixel of its own
            is_gap &= np.diff(np.searchsorted(self._edges, times, "right")) > 1
        places = np.flatnonzero(is_gap)
        return places + 1, times[places] + steps[places] // 2

    def series(self, paths: Iterable[str]) -> list[Series]:
        """Columns; with an entry for each pixel if there are very many messages."""
        (times, columns), (gaps, middles) = self.joined(), self.gaps()
        begins = np.arange(len(times)) if self.exact else self._begins(times)
        places = np.searchsorted(begins, gaps)
        shown = np.insert(times[begins], places, middles)
        found = []
        for path in paths:
            ends = [columns[path]] * 2
            if not self.exact:
                finite = np.where(np.isfinite(ends[0]), ends[0], np.nan)
                ends = [choose.reduceat(finite, begins) for choose in _EXTREMES]
            least, greatest = (np.insert(end, places, np.nan) for end in ends)
            found.append(Series(path, shown, least, greatest, self.exact))
        return found


MAX_ELEMENTS: Final = 36
"""Most elements of an array that are listed one by one: those of a covariance."""

_SUMMARIES: Final = ("min", "max", "mean", "n")
_IN_JSON: Final = {"bool", "integer", "number"}


Field: TypeAlias = tuple[str, str]
"""A field, as `series` takes it, and its type."""


def known_fields(query: Query) -> Mapping[str, str]:
    """Types of fields, by path; of the first messages where no definition fixes them."""
    known = field_types(query)
    if known is not None:
        return known
    return {one.path: one.type for one in infer_fields(query)}


def fields_of(known: Mapping[str, str], messages: Iterator[Message]) -> Iterator[Field]:
    """Numbers, elements of short arrays and summaries of arrays, in the order of the definition.

    `known` are the types of the fields, by path; the first of the messages tells how long arrays
    are.
    """
    first = None
    with suppress(SegmentError):  # damage hides how long arrays are, and no field
        first = next(messages, None)
    values = {} if first is None else first.fields
    for path, kind in known.items():
        if "[" in path or "`" in path:
            continue  # within the elements of an array, or a name with dots, which no path has
        if kind in NUMERIC or kind in _IN_JSON:
            yield path, kind
            continue
        summaries = (f"{path}.{name}" for name in _SUMMARIES)
        yield from ((name, "summary") for name in summaries if is_summary(name, known))
        element = element_of(kind)
        if element in NUMERIC:
            width = _width(kind, path, values)
            yield from ((f"{path}[{n}]", element) for n in range(width))


def _width(kind: str, path: str, values: Mapping[str, Any]) -> int:
    """Number of elements that are listed: of a fixed array, or of the first message."""
    width = width_of(kind)
    if width is None:
        value: Any = values
        for name in path.split("."):
            value = value.get(name) if isinstance(value, Mapping) else None
        width = len(value) if isinstance(value, list) else 0
    return width if width <= MAX_ELEMENTS else 0


# Tracks of satellite receivers, or of poses.

_RADIUS = 6_378_137.0  # m, semi-major axis of WGS 84
_ECCENTRICITY = 6.694379990141317e-3  # squared
_STATUS: Final = "status.status"
_POSITIONS_PER_PIXEL = 6  # positions of a pixel at most


class Grid(Struct, frozen=True):
    """A local metric grid: east and north of an origin (degrees), on the ellipsoid of WGS 84.

    Lengths are right near the origin; 100 km away from it, they are wrong by a few percent.

    Attributes:
        east: Metres of a degree of longitude at the origin.
        north: Metres of a degree of latitude at the origin.
    """

    latitude: float
    longitude: float
    east: float
    north: float

    @classmethod
    def at(cls, latitude: float, longitude: float) -> Grid:
        """The grid with its origin at a position in degrees."""
        angle = math.radians(latitude)
        part = 1 - _ECCENTRICITY * math.sin(angle) ** 2
        east = _RADIUS / math.sqrt(part) * math.cos(angle)
        north = _RADIUS * (1 - _ECCENTRICITY) / part**1.5
        return cls(latitude, longitude, math.radians(max(east, 0.0)), math.radians(north))

    def metres(self, latitude: Numbers, longitude: Numbers) -> NDArray[np.float64]:
        """Positions in degrees as float64[n, 2], metres east and north of the origin."""
        turn = (longitude - self.longitude + 180) % 360 - 180  # the short way round
        return np.stack([turn * self.east, (latitude - self.latitude) * self.north], axis=1)


Track: TypeAlias = "dict[str, Any]"
"""Positions in order of time.

* `times`: int64[n], log time, ns since the epoch.
* `xy`: float64[n, 2], metres: east and north of the origin of the grid, or x and y of poses in
  their frame. NaN where no line goes: for messages without a fix, and in the middle of times
  without messages that are longer than usual, as in a `Series`.
* `grid`: the `Grid`, with its origin at the first fix; None without any, and for poses.
* `is_geographic`: False for poses.
* `messages`: number of messages; `fixes`: of those that have a fix.
* `exact`: True if each message is here. Else each pixel of time has its first and its last one, the
  fixes farthest east, north, west and south, and one without a fix if it has any.
"""


def position_of(known: Mapping[str, str] | None) -> tuple[tuple[str, str], bool] | None:
    """Paths of both values, and whether they are latitude and longitude; None without any.

    The types of the fields are known, or no definition fixes them.
    """
    if known is None:
        return ("latitude", "longitude"), True
    for first, second in (("latitude", "longitude"), ("position.x", "position.y")):
        for path in known:
            other = path.removesuffix(first) + second
            is_it = path == first or path.endswith(f".{first}")
            if is_it and "[]" not in path and other in known:
                return (path, other), first == "latitude"
    return None


def track(query: Query, *, pixels: int) -> Track:
    """The positions of a topic of one recording, such as NavSatFix or Odometry, over log time.

    A message has a fix if its position is one and its `status.status`, if there is one, is not
    negative. `pixels` are steps of time: up to six times as many messages are returned exactly. The
    counters of the query are set to the cost.
    """
    if pixels < 1:
        raise UsageError("A track has at least one pixel.")
    known = field_types(query)
    found = position_of(known)
    if found is None:
        raise UsageError("These messages have no latitude and longitude, and no pose.")
    paths, is_geographic = [*found[0]], found[1]
    if is_geographic and (known is None or _STATUS in known):
        paths.append(_STATUS)
    narrowed, (begin, end) = over_time(query, paths, None)
    rows = ShownRows((begin, end), pixels, most=_POSITIONS_PER_PIXEL * pixels)
    rows.add(np.empty(0, np.int64), {"x": np.empty(0), "y": np.empty(0)})
    grid, messages, fixes = None, 0, 0
    with query.counters.timed():
        for table in tables_of(narrowed) if begin < end else ():
            first, second, *status = (_column(table, path) for path in paths)
            if is_geographic:
                has_fix = (np.abs(first) <= 90) & (np.abs(second) <= 360)
            else:
                has_fix = np.isfinite(first) & np.isfinite(second)
            if status:
                has_fix &= ~(status[0] < 0)
            messages += len(has_fix)
            fixes += int(np.count_nonzero(has_fix))
            xy = np.where(has_fix, (first, second), np.nan)
            if is_geographic and fixes:
                at = int(np.argmax(has_fix))
                grid = grid or Grid.at(float(first[at]), float(second[at]))
                xy = grid.metres(*xy).T
            rows.add(log_times(table), {"x": xy[0], "y": xy[1]})
        query.counters.add(narrowed.counters)
    if not rows.exact:
        rows.thin()
    (times, columns), (gaps, middles) = rows.joined(), rows.gaps()
    places = np.stack([columns[name] for name in "xy"], axis=1)
    return {
        "times": np.insert(times, gaps, middles),
        "xy": np.insert(places, gaps, np.nan, axis=0),
        "grid": grid,
        "is_geographic": is_geographic,
        "messages": messages,
        "fixes": fixes,
        "exact": rows.exact,
    }


def _column(table: pa.Table, path: str) -> Numbers:
    """A column, NaN for null, and for a column that is not there."""
    values = Wanted.of(path).columns(table).get(path, np.full(table.num_rows, np.nan))
    if values is None:
        raise UsageError(_NO_NUMBER.format(path))
    return values
