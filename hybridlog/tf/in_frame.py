"""Answers in another frame: points and poses of messages, at the times of their headers.

The rules are those of tf2. Positions are of 64 bits. A message without a transform at its time
keeps its row: its points and poses are NaN or null, and `Counters.no_transform` says why.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeAlias

import numpy as np
import pyarrow as pa
from msgspec.structs import replace

from hybridlog.arrays.message_arrays import (
    POINT_MAKERS,
    attributes,
    plain_type,
    point_columns,
    positions,
)
from hybridlog.formats.places import POSITIONS, poses_among
from hybridlog.frames import answer
from hybridlog.message import Message, messages_in
from hybridlog.query.planner import Planner
from hybridlog.query.times import decoded_time
from hybridlog.tf.reader import Trees
from hybridlog.tf.tree import Transform, placed, unknown
from hybridlog_storage.errors import DefinitionError, PayloadError, TopicError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.query.question import Counters, Question
    from hybridlog.session import Session

_STAMPS: Final = ("header.stamp", "timestamp")
_FRAMES: Final = ("header.frame_id", "frame_id", "parent_frame_id")
_XYZ: Final = ("x", "y", "z")
_TIME: Final = pa.timestamp("ns", "UTC")

Known: TypeAlias = "dict[str, Trees | TopicError]"
"""The trees of recordings, or why the frame that is asked for is not there."""


class Points(NamedTuple):
    """The points of a message.

    Attributes:
        stamp: Its header stamp, or its log time without one, ns.
        points: Records with the fields of its points; any shape. In a frame that was asked for,
            `x`, `y` and `z` (float64) come first.
    """

    message: Message
    stamp: int
    points: NDArray[Any]


class _Pose(NamedTuple):
    """Paths above x, y, z (and w) of a pose, and of its covariance; empty for what is not there.

    A vector is only turned.
    """

    position: str
    rotation: str = ""
    covariance: str = ""
    is_vector: bool = False

    def numbers(self) -> list[str]:
        """The paths of its numbers."""
        paths = [f"{self.position}.{axis}" for axis in "xyz"]
        return paths + [f"{self.rotation}.{axis}" for axis in "xyzw" * bool(self.rotation)]


def stream_in_frame(planner: Planner, known: Known | None = None) -> Iterator[pa.Table]:
    """The tables of an answer in the frame of its question, see `frames.answer.stream`.

    Scans and clouds are lists then, one for each field of their points. Pieces of an answer have
    one `known`, so that transforms are read once.
    """
    looked = _Looked(planner.session, planner.question, planner.counters, known)
    return (_tables_of_points if has_points(planner) else _tables_of_poses)(planner, looked)


def has_points(planner: Planner) -> bool:
    """True if the messages are scans or clouds."""
    if len(planner.question.topics) != 1:
        raise UsageError("An answer in a frame is of one topic; `align` takes several.")
    types = {one.channel.schema.name for one in planner.examples if one.channel.schema}
    return bool(types) and all(plain_type(name) in POINT_MAKERS for name in types)


def has_places(planner: Planner) -> bool:
    """True if messages of a topic have points or poses, with a frame and a time of their own."""
    return has_points(planner) or _places_in(planner) is not None


class _Looked:
    """Looks up transforms to the frame of a question, and counts what is missing."""

    def __init__(
        self,
        session: Session,
        question: Question,
        counters: Counters,
        known: Known | None = None,
    ) -> None:
        self.session = session
        self.question = question
        self.counters = counters
        self._trees: Known = {} if known is None else known

    def _of(self, recording: str) -> Trees | TopicError:
        """The trees of a recording, or why the frame asked for is not there."""
        if recording not in self._trees:
            topic = self.question.topics[0]
            trees = Trees(self.session, self.session.some([recording]), self.question.tf_topics)
            try:
                trees.check(topic, str(self.question.frame))
                self._trees[recording] = trees
                self.counters.of_frames += tuple(trees.tree(topic).remarks)
            except TopicError as error:
                self._trees[recording] = error
        return self._trees[recording]

    def transforms(
        self,
        recordings: Sequence[str],
        frames: Sequence[str],
        times: NDArray[np.int64],
        log_time: NDArray[np.int64],
    ) -> Transform:
        """The transforms from some frames at some times; NaN where there are none.

        A frame that no recording has is refused.
        """
        made, missing = unknown(len(times)), Counter[str]()
        target, topic = str(self.question.frame), self.question.topics[0]
        pairs = [*zip(recordings, frames, strict=True)]
        for pair in dict.fromkeys(pairs):
            trees = self._of(pair[0])
            rows = np.flatnonzero([one == pair for one in pairs])
            if isinstance(trees, TopicError):
                chosen = self.session.summaries_of(self.question)
                if all(isinstance(self._of(one.id), TopicError) for one in chosen):
                    raise trees
                missing["no such frame in the recording"] += len(rows)
                continue
            try:
                found = trees.lookup(topic, target, pair[1], times[rows], log_time[rows])
            except TopicError:
                missing[f"no frame {pair[1]!r} among the transforms"] += len(rows)
                continue
            made.translation[rows], made.rotation[rows] = found.translation, found.rotation
            missing.update(found.missing)
        self.counters.no_transform += tuple(
            (f"to {target}: {why}", count) for why, count in missing.items()
        )
        return made


def points_of(session: Session, question: Question, counters: Counters) -> Iterator[Points]:
    """The points of messages in order, in the frame of the question, if any.

    Messages that cannot be arrays are left out; `counters.unreadable` counts them. Messages of
    other types are refused.
    """
    return _points_of(_Looked(session, question, counters))


def _points_of(looked: _Looked) -> Iterator[Points]:
    counters = looked.counters
    for run in Planner(looked.session, replace(looked.question, frame=None), counters).runs():
        found: list[tuple[Points, dict[str, object]]] = []
        for message in messages_in(run):
            if plain_type(message.type) not in POINT_MAKERS:
                raise UsageError(f"{message.topic} has no clouds or scans: {message.type}.")
            if message.is_reduced:
                counters.leave_out(1, message.state)
                continue
            try:
                array, fields = message.to_numpy(), message.fields
            except (PayloadError, DefinitionError):
                counters.unreadable += 1
                continue
            stamp = decoded_time(_first_of(fields, _STAMPS))
            stamp = message.log_time_ns if stamp is None else stamp
            found.append((Points(message, stamp, array), fields))
        if looked.question.frame is None:
            yield from (one for one, _ in found)
            continue
        messages = [one.message for one, _ in found]
        poses = looked.transforms(
            [one.recording for one in messages],
            [str(_first_of(fields, _FRAMES) or "") for _, fields in found],
            np.array([one.stamp for one, _ in found], np.int64),
            np.array([one.log_time_ns for one in messages], np.int64),
        )
        for row, (one, fields) in enumerate(found):
            pose = Transform(poses.translation[row], poses.rotation[row])
            own = fields.get("pose")  # of the points, in Foxglove's messages
            if isinstance(own, dict):
                pose = pose @ placed(attributes(own))
            yield one._replace(points=_moved(one.points, pose))


def _moved(array: NDArray[Any], pose: Transform) -> NDArray[Any]:
    """The points of an array, moved; other fields stay."""
    others = [name for name in array.dtype.names or () if name not in _XYZ]
    fields: list[Any] = [(axis, np.float64) for axis in _XYZ]
    made = np.empty(array.shape, fields + [(name, array.dtype[name]) for name in others])
    with np.errstate(invalid="ignore"):  # ranges without an echo are infinite
        there = pose.apply(positions(array))
    for place, axis in enumerate(_XYZ):
        made[axis] = there[..., place]
    for name in others:
        made[name] = array[name]
    return made


def _first_of(fields: Mapping[str, Any], paths: Sequence[str]) -> Any:
    """The value of the first of some paths that the fields of a message have."""
    for path in paths:
        value: Any = fields
        for name in path.split("."):
            value = value.get(name) if isinstance(value, dict) else None
        if value is not None:
            return value
    return None


def _tables_of_points(planner: Planner, looked: _Looked) -> Iterator[pa.Table]:
    question = planner.question
    if question.fields is not None:
        raise UsageError("Points in a frame have the fields of their points: leave out fields.")
    several = question.names_recording or len(planner.session.summaries_of(question)) > 1
    names = {one.id: one.name for one in planner.session.snapshot().summaries}
    table = None
    for message, time, points in _points_of(looked):
        own = {
            "log_time": pa.array([message.log_time_ns], _TIME),
            **({"recording": pa.array([names[message.recording]])} if several else {}),
            "header.stamp": pa.array([time], _TIME),
            "header.frame_id": pa.array([question.frame]),
        }
        own |= {
            name: pa.ListArray.from_arrays(np.array([0, len(values)], np.int32), values)
            for name, values in point_columns(points).items()
            if name not in own
        }
        yield (table := pa.table(own))
    if table is None:
        yield pa.table({"log_time": pa.array([], _TIME)})


def _places_in(planner: Planner) -> tuple[Sequence[_Pose], str, str] | None:
    """The poses of a topic, and the paths of their time and frame; None if one is missing."""
    question = planner.question
    known = planner.session.field_types(question.topics, question.recordings) or {}
    poses = [*_poses_among(known)]
    stamp = next((name for name in _STAMPS if name in known), None)
    frame = next((name for name in _FRAMES if name in known), None)
    return None if not poses or stamp is None or frame is None else (poses, stamp, frame)


def _poses_among(paths: Mapping[str, str]) -> Iterator[_Pose]:
    """The poses, points and vectors of a message that are in the frame of its header."""
    for position, rotation in poses_among(paths):
        above, _, word = position.rpartition(".")
        if word in POSITIONS and "[" not in position:
            beside = f"{above.rpartition('.')[0]}.covariance".lstrip(".")
            known = above.endswith("pose") and paths.get(beside, "").endswith("[36]")
            yield _Pose(position, rotation, beside if known else "")
    for word in ("point", "vector"):
        if all(f"{word}.{axis}" in paths for axis in _XYZ):
            yield _Pose(word, is_vector=word == "vector")


def _tables_of_poses(planner: Planner, looked: _Looked) -> Iterator[pa.Table]:
    session, question, places = planner.session, planner.question, _places_in(planner)
    if places is None:
        raise UsageError(
            f"{question.topics[0]} has no points or poses with a frame and a time of their own, "
            "so it cannot be in another frame."
        )
    poses, stamp, frame = places
    several = question.names_recording or len(session.summaries_of(question)) > 1
    hidden = set() if several else {"recording"}
    plain = replace(question, frame=None, names_recording=True)
    if (asked := question.fields) is not None:
        used = [stamp, frame, *(path for one in poses for path in one.numbers())]
        added = [path for path in used if not any(f"{path}.".startswith(f"{o}.") for o in asked)]
        hidden |= {*added}
        plain = replace(plain, fields=(*asked, *added))
    known = session.summaries_of(question)
    ids = {one.name: one.id for one in known}
    if len(ids) < len(known):
        raise TopicError("Two of these recordings have one name: ask about one by its id.")
    for table in answer.stream(Planner(session, plain, planner.counters)):
        moved = looked.transforms(
            [ids[name] for name in table["recording"].to_pylist()],
            [str(name or "") for name in table[frame].to_pylist()],
            table[stamp].cast(pa.int64()).fill_null(0).to_numpy(),
            table["log_time"].cast(pa.int64()).to_numpy(),
        )
        columns = {name: table[name].combine_chunks() for name in table.column_names}
        for pose in poses:
            columns |= _pose_in_frame(columns, pose, moved)
        columns[frame] = pa.array([question.frame] * table.num_rows, pa.string())
        yield pa.table({name: column for name, column in columns.items() if name not in hidden})


def _pose_in_frame(
    columns: Mapping[str, Any], pose: _Pose, moved: Transform
) -> dict[str, pa.Array[Any]]:
    """New columns of a pose; null where there is no transform."""
    lost = ~moved.is_known
    given = np.stack([_doubles(columns[path]) for path in pose.numbers()], axis=1)
    zero = Transform(np.zeros_like(moved.translation), moved.rotation)
    found = (zero if pose.is_vector else moved).apply(given[:, :3])
    if pose.rotation:
        turned = (moved @ Transform(given[:, :3], given[:, 3:])).rotation
        found = np.concatenate([found, turned], axis=1)
    made: dict[str, pa.Array[Any]] = {
        path: pa.array(values, mask=lost)
        for path, values in zip(pose.numbers(), found.T, strict=True)
    }
    if pose.covariance in columns:
        covariance = columns[pose.covariance]
        turn = np.zeros((len(lost), 6, 6))
        turn[:, :3, :3] = turn[:, 3:, 3:] = moved.matrix()[:, :3, :3]
        own = np.full_like(turn, np.nan)
        there = covariance.is_valid().to_numpy(zero_copy_only=False)
        own[there] = covariance.flatten().to_numpy().reshape(-1, 6, 6)
        own = turn @ own @ turn.transpose(0, 2, 1)
        made[pose.covariance] = pa.FixedSizeListArray.from_arrays(
            own.reshape(-1), 36, mask=pa.array(lost)
        )
    return made


def _doubles(column: pa.Array[Any]) -> NDArray[np.float64]:
    found: NDArray[np.float64] = column.cast(pa.float64()).to_numpy(zero_copy_only=False)
    return found
