"""Episodes of a training set: frames at regular times, with the values that were current.

The map from topics and fields to features of a training set.

A map is YAML:

    robot_type: turtlebot
    features:
      observation.state:
        - joint_states: position
        - odom: twist.twist.linear.x
      action:
        - cmd_vel: [linear.x, angular.z]
    images:
      front: /front/image_raw
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Meta, Struct, ValidationError, convert

from hybridlog.across.match import match
from hybridlog.arrays.message_arrays import IMAGES, plain_type
from hybridlog.drawing.images import shown_pixels
from hybridlog.formats.yaml_values import YamlError, parse_yaml, read_yaml
from hybridlog.query.intervals import GAP_PERIODS, usual_period
from hybridlog.query.planner import log_spans, log_times
from hybridlog.query.query import Query
from hybridlog.query.question import Question
from hybridlog.query.times import format_time
from hybridlog.schema.arrow_types import is_list, is_numeric
from hybridlog.wording import listed
from hybridlog_storage.errors import DefinitionError, PayloadError, TopicError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.message import Message
    from hybridlog.query.pieces import Piece
    from hybridlog.session import Session

OnGap = Literal["refuse", "drop", "hold"]
"""An episode with a gap in a topic is refused, is cut there, or keeps the last value."""
MIN_FRAMES: Final = 2
"""Fewer frames are no episode."""


class Values(NamedTuple):
    """Numbers of a topic, [n, width], at log times, int64[n], ns, ascending."""

    times: NDArray[np.int64]
    numbers: NDArray[Any]
    names: tuple[str, ...]


class Episode(Struct, frozen=True):
    """Frames at regular times, int64[n], ns, in a recording, whose id is `recording`.

    Their `vectors` are numbers[n, width] by name of the feature, as the names of columns are.
    `held` counts frames whose value is older than usual, by topic.
    """

    name: str
    recording: str
    times: NDArray[np.int64]
    vectors: dict[str, NDArray[Any]]
    names: dict[str, tuple[str, ...]]
    held: dict[str, int]


def episodes(
    piece: Piece,
    features: FeatureMap,
    fps: int,
    on_gap: OnGap,
    dropped: Counter[str] | None = None,
) -> Iterator[Episode]:
    """The episodes of a part of a question: one for each recording and range in it.

    An episode begins when all topics have a value. A frame has the last value of each topic that is
    not later than it. `dropped` collects the number of frames that are in no episode because of
    gaps, by part.
    """
    name, query = piece
    for summary, (begin, end) in log_spans(query.source.now(), query.question):
        times, read = {}, {}
        for topic in features.images.values():
            times[topic] = _times(_query(query.source.now(), summary.id, topic, begin, end))
        for source in (part for parts in features.vectors.values() for part in parts):
            own = _query(query.source.now(), summary.id, source.topic, begin, end)
            read[source] = _values(own, source)
            found_at = read[source].times
            times[source.topic] = np.intersect1d(times.get(source.topic, found_at), found_at)
        first = max([begin, *(int(own[0]) for own in times.values())])
        count = max(end - first, 0) * fps // 10**9 + 1
        grid = first + np.arange(count, dtype=np.int64) * 10**9 // fps
        grid = grid[grid < end]
        is_old = {topic: _is_old(grid, own, fps) for topic, own in times.items()}
        late = np.any([*is_old.values()], axis=0)
        if late.any() and on_gap == "refuse":
            begins = {one: int(np.argmax(old)) for one, old in is_old.items() if old.any()}
            topic = min(begins, key=begins.__getitem__)
            raise UsageError(
                f"{name}: {topic} has a gap at {format_time(int(grid[begins[topic]]))}. --on-gap "
                "drop cuts the episode there, --on-gap hold keeps the last value."
            )
        runs = [(0, len(grid))] if on_gap == "hold" else _runs(~late)
        long_runs = [(low, high) for low, high in runs if high - low >= MIN_FRAMES]
        if dropped is not None and late.any():
            dropped[name] += len(grid) - sum(high - low for low, high in long_runs)
        for number, (low, high) in enumerate(long_runs):
            own_grid = grid[low:high]
            found = {
                feature: [_at(own_grid, read[part]) for part in parts]
                for feature, parts in features.vectors.items()
            }
            yield Episode(
                name if len(runs) == 1 else f"{name}-{number + 1:03d}",
                summary.id,
                own_grid,
                {feature: np.concatenate(parts, axis=1) for feature, parts in found.items()},
                {
                    feature: tuple(name for part in parts for name in read[part].names)
                    for feature, parts in features.vectors.items()
                },
                {
                    topic: int(old[low:high].sum())
                    for topic, old in is_old.items()
                    if old[low:high].any()
                },
            )


def pictures(
    session: Session, episode: Episode, topic: str, depth_scale: tuple[float, float] | None = None
) -> Iterator[tuple[NDArray[np.uint8] | None, int]]:
    """The picture of each frame of an episode, and how many frames in turn show it.

    None stands for a picture that cannot be shown, or has no payload. Those of depth have one
    scale: metres at 0 and at 255; what has no depth is 0.
    """
    current: Message | None = None
    place, frames = 0, episode.times.tolist()
    for message in _query(session, episode.recording, topic, frames[0], frames[-1] + 1):
        shown = place
        while place < len(frames) and frames[place] < message.log_time_ns:
            place += 1
        if place > shown:
            yield _picture_or_none(current, depth_scale), place - shown
        current = message
    if place < len(frames):
        yield _picture_or_none(current, depth_scale), len(frames) - place


def is_depth(pixels: NDArray[Any]) -> bool:
    """True for one value a pixel that is no brightness: mm in 16 bits, or metres."""
    return pixels.ndim == 2 and pixels.dtype != np.uint8


def _picture_or_none(
    message: Message | None, depth_scale: tuple[float, float] | None
) -> NDArray[np.uint8] | None:
    """The picture of a message in colours; None if it cannot be shown, or has no payload."""
    if message is None:
        return None
    try:
        raw = None if depth_scale is None else message.to_numpy()
        if depth_scale is None or raw is None or not is_depth(raw):
            pixels = shown_pixels(message)
        else:
            near, far = depth_scale
            metres = raw * (1.0 if raw.dtype.kind == "f" else 0.001)
            share = (metres - near) / (far - near) * np.where(raw != 0, 255, np.nan)
            pixels = np.clip(np.nan_to_num(share, posinf=255), 0, 255).astype(np.uint8)
    except (PayloadError, DefinitionError):
        return None
    if pixels.ndim == 2:
        pixels = np.repeat(pixels[:, :, None], 3, axis=2)
    return np.ascontiguousarray(pixels[:, :, :3])


def _query(session: Session, recording: str, topic: str, begin: int, end: int) -> Query:
    """The messages of a topic in a range, and the one before that is current at its begin."""
    whole = Query(session, Question((topic,), (recording,)))
    with suppress(TopicError):
        begin = whole.at(begin).log_time_ns
    return whole.between(begin, end)


def _times(query: Query) -> NDArray[np.int64]:
    """Log times of the messages, ns; at least one."""
    times = log_times(query.source.now(), query.question)
    _check(query, times)
    return times


def _values(query: Query, source: Source) -> Values:
    """Numbers of a topic; messages without them, or with NaN, are left out: a gap."""
    table = query.fields(*source.paths).to_arrow()
    present = [column for column in table.column_names if column in source.paths]
    if missing := set(source.paths).difference(present):
        raise UsageError(f"{source.topic} has no field {min(missing)}.")
    table = table.filter(reduce(pc.and_, (pc.is_valid(table[name]) for name in present)))
    columns, names = [], []
    for path in source.paths:
        numbers = _numbers(table[path], source.topic, path)
        short = f"{source.topic.strip('/')}.{path}"
        is_array = table[path].type.num_fields > 0
        names += [f"{short}[{n}]" for n in range(numbers.shape[1])] if is_array else [short]
        columns.append(numbers)
    found = np.concatenate(columns, axis=1)
    is_number = np.isfinite(found).all(axis=1)
    times = table["log_time"].cast(pa.int64()).to_numpy()[is_number]
    _check(query, times)
    return Values(times, found[is_number], tuple(names))


def _check(query: Query, times: NDArray[np.int64]) -> None:
    if not len(times):
        (recording,), (topic,) = query.source.now().summaries_of(query.question), query.topics
        _, end = query.question.bounds or (0, 0)
        raise TopicError(
            f"Recording {recording.name} has no message of {topic} before "
            f"{format_time(end)}: leave the recording out, or map another topic."  # type: ignore[arg-type]
        )


def _numbers(column: pa.ChunkedArray, topic: str, path: str) -> NDArray[Any]:
    """The numbers of a column, of its type: [n, width]."""
    kind = column.type
    width = 1
    if is_list(kind):
        lengths = pc.unique(pc.list_value_length(column)).to_pylist()
        if len(lengths) > 1:
            raise UsageError(
                f"{topic}: {path} has {min(lengths)} to {max(lengths)} elements; a feature has "
                f"always as many: name elements, such as {path}[0]."
            )
        width = int(lengths[0]) if lengths else 0
        column, kind = pc.list_flatten(column), kind.value_type
    if not is_numeric(kind):
        raise UsageError(f"{topic}: {path} is {kind}, no number.")
    flat: NDArray[Any] = column.to_numpy()
    return flat.reshape(-1, width)


def _at(times: NDArray[np.int64], values: Values) -> NDArray[Any]:
    return values.numbers[match(times, values.times, "asof", None).before]


def _is_old(times: NDArray[np.int64], messages: NDArray[np.int64], fps: int) -> NDArray[np.bool_]:
    """True for times whose current message of a topic is older than its usual gaps."""
    period = usual_period(np.diff(messages))
    if not period:
        return np.zeros(len(times), np.bool_)  # a topic that says something once
    ages = times - messages[match(times, messages, "asof", None).before]
    old: NDArray[np.bool_] = ages > max(GAP_PERIODS * period, 10**9 / fps)
    return old


def _runs(is_good: NDArray[np.bool_]) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], is_good.astype(np.int8), [0]])))
    return [(int(low), int(high)) for low, high in edges.reshape(-1, 2)]


IMAGE_PREFIX: Final = "observation.images."
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.\-]{0,63}")
_OWN = frozenset({"timestamp", "frame_index", "episode_index", "index", "task_index", "task"})
_STATES: Final = {
    "sensor_msgs/JointState": ("position",),
    "nav_msgs/Odometry": ("twist.twist.linear.x", "twist.twist.angular.z"),
}
_ACTIONS: Final = {
    "geometry_msgs/Twist": ("linear.x", "angular.z"),
    "geometry_msgs/TwistStamped": ("twist.linear.x", "twist.angular.z"),
    "sensor_msgs/Joy": ("axes",),
    "std_msgs/Float64MultiArray": ("data",),
}


_Parts: TypeAlias = dict[str, str | Annotated[list[str], Meta(min_length=1)]]


class _Given(Struct, forbid_unknown_fields=True):
    """A map as it is written."""

    features: dict[str, list[_Parts] | _Parts] = {}
    images: dict[str, Annotated[str, Meta(min_length=1)]] = {}
    robot_type: str = ""


@dataclass(frozen=True, slots=True)
class Source:
    """Fields of a topic, numbers or arrays of numbers, that are a part of a feature."""

    topic: str
    paths: tuple[str, ...]


class FeatureMap(Struct, frozen=True):
    """Features of a training set.

    Attributes:
        vectors: Parts by name of the feature, such as `action`.
        images: Topics by name of the camera.
        robot_type: Name of the robot; empty if unknown.
    """

    vectors: Mapping[str, tuple[Source, ...]]
    images: Mapping[str, str]
    robot_type: str = ""

    @property
    def topics(self) -> tuple[str, ...]:
        """All topics, each once."""
        parts = (part.topic for parts in self.vectors.values() for part in parts)
        return tuple(dict.fromkeys([*parts, *self.images.values()]))

    def resolved(self, session: Session) -> FeatureMap:
        """The map with full names of topics."""
        full = {name: session.resolve_in([name], None) for name in self.topics}
        if several := [name for name, found in full.items() if len(found) > 1]:
            raise TopicError(f"{several[0]} means several topics: {listed(full[several[0]])}.")
        return FeatureMap(
            {
                name: tuple(Source(full[one.topic][0], one.paths) for one in parts)
                for name, parts in self.vectors.items()
            },
            {name: full[topic][0] for name, topic in self.images.items()},
            self.robot_type,
        )

    @classmethod
    def given(cls, features: str | Path | Mapping[str, Any]) -> FeatureMap:
        """A map of plain values, or from a file."""
        return cls.read(features) if isinstance(features, str | Path) else cls.of(features)

    @classmethod
    def read(cls, path: str | Path) -> FeatureMap:
        """Read a map from a file; a `UsageError` says where it is wrong and what to write."""
        text = read_yaml(path, "map of features")
        try:
            return cls.of(parse_yaml(text), str(path))
        except YamlError as error:
            raise UsageError(f"{path} is no YAML: {error}.") from error

    @classmethod
    def of(cls, values: object, name: str = "the map") -> FeatureMap:
        """A map of plain values; a `UsageError` says where they are wrong."""
        try:
            given = convert(values, _Given)
        except ValidationError as error:
            raise UsageError(f"{name}: {error}; --propose-map shows how it is written.") from error
        for key in (*given.features, *given.images):
            if not _NAME.fullmatch(key) or key in _OWN or key.startswith(IMAGE_PREFIX):
                raise UsageError(
                    f"{name}: {key!r} is no name for a feature; name it like observation.state."
                )
        if not given.features and not given.images:
            raise UsageError(f"{name}: it has no features; --propose-map writes a map.")
        vectors = {
            key: tuple(
                Source(topic, (paths,) if isinstance(paths, str) else tuple(paths))
                for row in (parts if isinstance(parts, list) else [parts])
                for topic, paths in row.items()
            )
            for key, parts in given.features.items()
        }
        return cls(vectors, given.images, given.robot_type)

    def to_yaml(self) -> str:
        """The map as YAML."""
        import yaml

        vectors = {
            name: [{part.topic: [*part.paths]} for part in parts]
            for name, parts in self.vectors.items()
        }
        parts = {"robot_type": self.robot_type, "features": vectors, "images": {**self.images}}
        return "".join(
            yaml.dump(
                {key: value},
                Dumper=yaml.CSafeDumper,
                default_flow_style=None if key == "features" else False,
                sort_keys=False,
                allow_unicode=True,
                width=1 << 20,
            )
            for key, value in parts.items()
            if value
        )


def proposed(query: Query) -> FeatureMap:
    """A map for the topics of a question, by their types.

    Joint states and odometry become states, commands become actions, images of all encodings and
    videos become images. Without such topics there is a `UsageError`.
    """
    states: list[Source] = []
    actions: list[Source] = []
    images: dict[str, str] = {}
    entries = map(query.source.now().entry_of, query.source.now().summaries_of(query.question))
    types = {one.topic: plain_type(one.type) for entry in entries for one in entry.channels}
    for topic in query.topics:
        kind = types.get(topic, "")
        if kind in _STATES:
            states.append(Source(topic, _STATES[kind]))
        elif kind in _ACTIONS:
            actions.append(Source(topic, _ACTIONS[kind]))
        elif kind in IMAGES:
            words = [word for word in re.split(r"[^A-Za-z0-9]+", topic) if word]
            plain = [word for word in words if word not in {"image", "raw", "color", "compressed"}]
            name = "_".join(plain or words)
            images[name if name not in images else f"{name}_{len(images)}"] = topic
    named = {"observation.state": tuple(states), "action": tuple(actions)}
    found = FeatureMap({name: parts for name, parts in named.items() if parts}, images)
    if not found.topics:
        raise UsageError(
            "There are no joint states, odometry, commands or images: write the map by hand."
        )
    return found
