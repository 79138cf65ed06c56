"""Reads the transforms of a recording: messages of tf, tf2 and Foxglove."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hybridlog.frames.answer import stream, to_arrow
from hybridlog.frames.columns import flat
from hybridlog.query.answers.lost import completeness_of
from hybridlog.query.answers.match_times import match_times
from hybridlog.query.counters import Counters
from hybridlog.query.planner import Planner
from hybridlog.query.question import Question
from hybridlog.tf import is_of_transforms
from hybridlog.tf.transform import Transform
from hybridlog.tf.tree import Frame, FrameTree
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_STATIC: Final = "tf_static"
_MAX_NORM_ERROR: Final = 1e-2
"""How far the norm of a quaternion may be from 1; that of tf2."""


def frame_tree(session: Session, recording: RecordingSummary, topics: Sequence[str]) -> FrameTree:
    """The frames of one recording.

    Args:
        session: The open store.
        recording: The recording.
        topics: Full names of topics that may have transforms. Those whose names end in
            `tf_static` hold at all times.

    Raises:
        TopicError: No topic has transforms.
    """
    question = Question(tuple(topics), (recording.id,))
    types = {
        one.channel.topic: one.channel.schema.name
        for one in Planner(session, question, Counters()).channels()
        if one.channel.schema
    }
    names = [topic for topic, name in types.items() if is_of_transforms(name)]
    if not names:
        raise TopicError(
            "No topic has transforms: they are messages of tf2_msgs/TFMessage or "
            "foxglove.FrameTransform."
        )
    builder = _Builder()
    for topic in names:
        for table in stream(Planner(session, replace(question, topics=(topic,)), Counters())):
            builder.add(table, is_static=topic.endswith(_STATIC))
    lacks = completeness_of(session, replace(question, topics=tuple(names))).sentences
    return FrameTree(builder.frames(), recording.extent, dict(builder.invalid), [*lacks])


def frames_and_stamps(
    session: Session, question: Question, counters: Counters
) -> tuple[list[str], NDArray[np.int64]]:
    """The frames that the headers of a topic name, and its times.

    Returns:
        Names of frames, and int64[n]: header stamps, or log times without headers; ns.
    """
    known = session.field_types(question.topics, question.recordings) or {}
    wanted = [name for name in ("header.stamp", "header.frame_id") if name in known]
    if "header.stamp" not in wanted:  # no message has to be read
        times = match_times(session, question, counters)
        return [], np.concatenate([np.empty(0, np.int64), *(one.log_time for one in times)])
    table = to_arrow(Planner(session, replace(question, fields=tuple(wanted)), counters))
    frames = table["header.frame_id"].unique().to_pylist() if len(wanted) == 2 else []
    return frames, table["header.stamp"].cast(pa.int64()).to_numpy()


class _Builder:
    """Collects transforms by their child frame."""

    def __init__(self) -> None:
        self.invalid: Counter[str] = Counter()
        self._parts: list[tuple[pa.Table, bool]] = []

    def add(self, table: pa.Table, *, is_static: bool) -> None:
        """Add the messages of a table."""
        rows = _transforms_of(table)
        if rows.num_rows:
            self._parts.append((rows, is_static))

    def frames(self) -> dict[str, Frame]:
        """All frames with a parent."""
        if not self._parts:
            return {}
        rows = pa.concat_tables([rows for rows, _ in self._parts])
        static = np.repeat(
            [is_static for _, is_static in self._parts],
            [part.num_rows for part, _ in self._parts],
        )
        order = np.argsort(rows["log_time"].to_numpy(), kind="stable")
        rows, static = rows.take(pa.array(order)), static[order]
        pose = Transform(
            np.stack([rows[name].to_numpy() for name in ("tx", "ty", "tz")], axis=1),
            np.stack([rows[name].to_numpy() for name in ("rx", "ry", "rz", "rw")], axis=1),
        )
        names = pc.utf8_ltrim(rows["child"], "/").combine_chunks().dictionary_encode()
        parents = pc.utf8_ltrim(rows["parent"], "/").combine_chunks().dictionary_encode()
        child, parent = names.indices.to_numpy(), parents.indices.to_numpy()
        known, above = names.dictionary.to_pylist(), parents.dictionary.to_pylist()
        good = self._valid(
            np.asarray(known, object)[child], np.asarray(above, object)[parent], pose
        )
        stamps = rows["stamp"].to_numpy()
        made: dict[str, Frame] = {}
        by_child = np.argsort(child, kind="stable")
        starts = np.searchsorted(child[by_child], np.arange(len(known) + 1))
        for place, name in enumerate(known):
            own = by_child[starts[place] : starts[place + 1]]
            own = own[good[own]]
            if len(own):
                made[name] = self._frame(
                    name,
                    own,
                    stamps=stamps,
                    parent=parent,
                    above=above,
                    pose=pose,
                    static=static,
                )
        return made

    def _valid(
        self, child: NDArray[np.object_], parent: NDArray[np.object_], pose: Transform
    ) -> NDArray[np.bool_]:
        """Mask of the valid transforms; each of the others is counted by its first reason."""
        with np.errstate(all="ignore"):
            norm = np.linalg.norm(pose.rotation, axis=1)
            finite = np.isfinite(pose.translation).all(axis=1) & np.isfinite(norm)
            reasons = {
                "a frame without a name": (child == "") | (parent == ""),
                "a frame that is its own parent": child == parent,
                "numbers that are not finite": ~finite,
                "a rotation that is no unit quaternion": np.abs(norm - 1) > _MAX_NORM_ERROR,
            }
        good = np.ones(len(child), np.bool_)
        for why, bad in reasons.items():
            if number := int((good & bad).sum()):
                self.invalid[why] += number
            good &= ~bad
        with np.errstate(all="ignore"):
            pose.rotation[:] /= norm[:, None]
        return good

    def _frame(
        self,
        name: str,
        own: NDArray[np.intp],
        *,
        stamps: NDArray[np.int64],
        parent: NDArray[np.int32],
        above: list[str],
        pose: Transform,
        static: NDArray[np.bool_],
    ) -> Frame:
        # As in tf2, the first transform decides whether a frame is static.
        is_static = bool(static[own[0]])
        if other := int((static[own] != is_static).sum()):
            here, there = ("static", "moving") if is_static else ("moving", "static")
            self.invalid[f"{there}, while {name} is {here}"] += other
            own = own[static[own] == is_static]
        repeated = 0
        if is_static:
            own = own[-1:]
        else:
            own = own[np.argsort(stamps[own], kind="stable")]
            is_first = np.concatenate(([True], np.diff(stamps[own]) != 0))
            repeated = int((~is_first).sum())
            own = own[is_first]
        codes = list(dict.fromkeys(parent[own][::-1].tolist()))[::-1]
        place_of = {code: place for place, code in enumerate(codes)}
        return Frame(
            name,
            tuple(above[code] for code in codes),
            is_static,
            stamps[own],
            np.array([place_of[code] for code in parent[own].tolist()], np.intp),
            Transform(pose.translation[own], pose.rotation[own]),
            repeated,
        )


def _transforms_of(table: pa.Table) -> pa.Table:
    """The transforms of messages as rows: log_time, stamp, parent, child and seven numbers."""
    times = table["log_time"].combine_chunks().cast(pa.int64())
    columns = {name: table[name].combine_chunks() for name in table.column_names}
    if "transforms" in columns:
        times = times.take(pc.list_parent_indices(columns["transforms"]))
        columns = flat(columns["transforms"].flatten())
    is_foxglove = "parent_frame_id" in columns
    stamp, parent, pose = (
        ("timestamp", "parent_frame_id", "")
        if is_foxglove
        else ("header.stamp", "header.frame_id", "transform.")
    )
    names = {
        "parent": parent,
        "child": "child_frame_id",
        **{f"t{axis}": f"{pose}translation.{axis}" for axis in "xyz"},
        **{f"r{axis}": f"{pose}rotation.{axis}" for axis in "xyzw"},
    }
    if missing := [name for name in names.values() if name not in columns]:
        raise TopicError(f"Messages of transforms lack {listed(missing)}.")
    found = {"log_time": times, "stamp": _nanoseconds(columns, stamp)}
    for own, name in names.items():
        kind = pa.string() if own in {"parent", "child"} else pa.float64()
        found[own] = columns[name].cast(kind)
    return pa.table(found).drop_null()


def _nanoseconds(columns: Mapping[str, pa.Array], name: str) -> pa.Array:
    """Times in ns, from Arrow's own or from seconds and nanoseconds."""
    if name in columns:
        return columns[name].cast(pa.timestamp("ns", "UTC")).cast(pa.int64())
    parts = [
        next((f"{name}.{one}" for one in names if f"{name}.{one}" in columns), None)
        for names in (("sec", "seconds"), ("nsec", "nanos", "nanosec"))
    ]
    if None in parts:
        raise TopicError(f"Messages of transforms lack {name}.")
    seconds, rest = (columns[str(part)].cast(pa.int64()) for part in parts)
    return pc.add(pc.multiply(seconds, 10**9), rest)
