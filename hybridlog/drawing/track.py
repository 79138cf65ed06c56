"""The track of a satellite receiver, or of poses, in metres and of bounded length."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
from msgspec import Struct

from hybridlog.drawing.series import ShownRows, Wanted, log_times, over_time
from hybridlog.query.query import field_types, tables_of
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    import pyarrow as pa
    from numpy.typing import NDArray

    from hybridlog.drawing.series import Numbers
    from hybridlog.message import Message
    from hybridlog.query.query import Query
    from hybridlog.query.question import Span

_RADIUS = 6_378_137.0  # m, semi-major axis of WGS 84
_ECCENTRICITY = 6.694379990141317e-3  # squared
_CHI = 5.991464547107979  # square of the radius that holds 95 % of a normal distribution in 2-D
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


class Position(Struct, frozen=True):
    """Place of the position in the messages of a topic.

    Attributes:
        prefix: Path in front of both values: `""`, `pose.pose.position.`.
        is_geographic: True for `latitude` and `longitude`, False for `x` and `y`.
    """

    prefix: str
    is_geographic: bool

    @property
    def paths(self) -> tuple[str, str]:
        """Paths of both values."""
        names = ("latitude", "longitude") if self.is_geographic else ("x", "y")
        return f"{self.prefix}{names[0]}", f"{self.prefix}{names[1]}"


def position_of(known: Mapping[str, str] | None) -> Position | None:
    """The place of the position in messages with these types of fields; None if they have none."""
    if known is None:
        return Position("", is_geographic=True)
    for end, is_geographic in (("latitude", True), ("position.x", False)):
        for path in known:
            if path != end and not path.endswith(f".{end}"):
                continue
            found = Position(path[: len(path) - (8 if is_geographic else 1)], is_geographic)
            if "[]" not in path and found.paths[1] in known:
                return found
    return None


def track(query: Query, *, pixels: int, span: Span | None = None) -> Track:
    """The positions of a topic of one recording, such as NavSatFix or Odometry, over log time.

    A message has a fix if its position is one and its `status.status`, if there is one, is not
    negative. `pixels` are steps of time: up to six times as many messages are returned exactly. The
    span is log time `[begin, end)`, ns; None for that of the messages. The counters of the query
    are set to the cost.
    """
    if pixels < 1:
        raise UsageError("A track has at least one pixel.")
    known = field_types(query)
    position = position_of(known)
    if position is None:
        raise UsageError("These messages have no latitude and longitude, and no pose.")
    paths = list(position.paths)
    if position.is_geographic and (known is None or _STATUS in known):
        paths.append(_STATUS)
    narrowed, (begin, end) = over_time(query, paths, span)
    rows = ShownRows((begin, end), pixels, most=_POSITIONS_PER_PIXEL * pixels)
    rows.add(np.empty(0, np.int64), {"x": np.empty(0), "y": np.empty(0)})
    grid, messages, fixes = None, 0, 0
    with query.counters.timed():
        for table in tables_of(narrowed) if begin < end else ():
            first, second, *status = (_numbers(table, path) for path in paths)
            if position.is_geographic:
                has_fix = _is_position(first, second)
            else:
                has_fix = np.isfinite(first) & np.isfinite(second)
            if status:
                has_fix &= ~(status[0] < 0)
            messages += len(has_fix)
            fixes += int(np.count_nonzero(has_fix))
            xy = np.where(has_fix, (first, second), np.nan)
            if position.is_geographic and fixes:
                at = int(np.argmax(has_fix))
                grid = grid or Grid.at(float(first[at]), float(second[at]))
                xy = grid.metres(*xy).T
            rows.add(log_times(table), {"x": xy[0], "y": xy[1]})
        query.counters.add(narrowed.counters)
    if not rows.exact:
        rows.thin()
    gaps, middles = rows.gaps()
    places = np.stack([rows.columns[name] for name in "xy"], axis=1)
    return {
        "times": np.insert(rows.times, gaps, middles),
        "xy": np.insert(places, gaps, np.nan, axis=0),
        "grid": grid,
        "is_geographic": position.is_geographic,
        "messages": messages,
        "fixes": fixes,
        "exact": rows.exact,
    }


def _is_position(latitude: Numbers, longitude: Numbers) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = (np.abs(latitude) <= 90) & (np.abs(longitude) <= 360)
    return found


def _numbers(table: pa.Table, path: str) -> Numbers:
    """A column, NaN for null, and for a column that is not there."""
    values = Wanted.of(path).columns(table).get(path, np.full(table.num_rows, np.nan))
    if values is None:
        raise UsageError(f"{path} is no number: only numbers can be drawn.")
    return values


def fix_of(message: Message, prefix: str = "") -> dict[str, Any]:
    """The position of a message: `time`, log time in ns, and more by name.

    * `latitude`, `longitude`: degrees; None for what is no number. `altitude`: m, None if unknown.
    * `has_fix`: False if the receiver says that it has none, or the position is none.
    * `status`: number that the receiver gives; None if the message has none.
    * `ellipse`: half axes of the ellipse that holds the position with 95 %, m, and the angle of the
      first one, rad from east to north; None if it is unknown.

    The prefix is from `position_of`.
    """
    fields: Any = message.fields
    inner = _inner(fields, prefix)
    if not {"latitude", "longitude"} <= inner.keys():
        raise UsageError(f"This message of {message.topic} has no latitude and longitude.")
    latitude, longitude, altitude = (
        _number(inner.get(name)) for name in ("latitude", "longitude", "altitude")
    )
    given = fields.get("status")
    number = given.get("status") if isinstance(given, Mapping) else None
    status = number if isinstance(number, int) and not isinstance(number, bool) else None
    is_there = bool(_is_position(np.array(latitude), np.array(longitude)))
    return {
        "time": message.log_time_ns,
        "has_fix": is_there and (status is None or status >= 0),
        "latitude": _finite(latitude),
        "longitude": _finite(longitude),
        "altitude": _finite(altitude),
        "status": status,
        "ellipse": _ellipse(fields),
    }


def pose_of(message: Message, prefix: str) -> dict[str, Any]:
    """The pose of a message: `time`, log time in ns; `x`, `y`, m; `heading`, rad from x to y.

    What is no number or not there is None. The prefix is from `position_of`.
    """
    inner = _inner(message.fields, prefix)
    if not {"x", "y"} <= inner.keys():
        raise UsageError(f"This message of {message.topic} has no position.")
    around = _inner(message.fields, prefix.removesuffix("position."))
    x, y, z, w = (_number(_inner(around, "orientation.").get(name)) for name in "xyzw")
    length = x * x + y * y + z * z + w * w
    heading = math.atan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return {
        "time": message.log_time_ns,
        "x": _finite(_number(inner["x"])),
        "y": _finite(_number(inner["y"])),
        "heading": heading if math.isfinite(length) and length > 0 else None,
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None


def _inner(fields: Any, prefix: str) -> Mapping[str, Any]:
    """The fields below a path that ends with a dot; none if there is no such path."""
    for name in prefix.split(".")[:-1]:
        fields = fields.get(name) if isinstance(fields, Mapping) else None
    return fields if isinstance(fields, Mapping) else {}


def _number(value: Any) -> float:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number else math.nan


def _ellipse(fields: Mapping[str, Any]) -> tuple[float, float, float] | None:
    """Half axes and angle of the ellipse of 95 % from the covariance, if it is known."""
    given = fields.get("position_covariance")
    if not isinstance(given, list) or len(given) != 9:
        return None
    if fields.get("position_covariance_type") == 0:  # unknown
        return None
    matrix = np.array([_number(given[at]) for at in (0, 1, 3, 4)]).reshape(2, 2)
    if not np.isfinite(matrix).all():
        return None
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    if values[0] < 0 or values[1] <= 0:
        return None
    small, large = np.sqrt(values * _CHI).tolist()
    return large, small, math.atan2(vectors[1, 1], vectors[0, 1])
