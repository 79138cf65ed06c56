"""Reads the transforms of a recording: messages of tf, tf2 and Foxglove."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec.structs import replace

from hybridlog.arrays.message_arrays import plain_type
from hybridlog.frames.answer import stream, to_arrow
from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.planner import Planner, log_times
from hybridlog.query.question import Counters, Question
from hybridlog.tf.epochs import TYPES, epochs_of, transforms_of
from hybridlog.tf.transform import Transform, unknown
from hybridlog.tf.tree import Frame, FrameTree, Lookup
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import TopicError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.summary import RecordingSummary

_NAMES: Final = {"tf", "tf_static"}
_LATE_NS: Final = 100_000_000
_MAX_NORM_ERROR: Final = 1e-2
"""Greatest distance of a quaternion's norm from 1; that of tf2."""


class Trees:
    """The trees of frames of a recording, each read once it is asked for.

    A tree is of the topics `tf` and `tf_static` of a namespace, by which `topics` has them; empty
    is the root's. What it lacks comes from the root's, to which Foxglove's messages belong,
    whatever their topic. Each epoch of the recording has transforms of its own. The tree of `only`
    some topics takes the place of all others. Several recordings are a TopicError.
    """

    def __init__(
        self, session: Session, summaries: Sequence[RecordingSummary], only: Sequence[str] = ()
    ) -> None:
        if len(summaries) > 1:
            names = listed([one.name for one in summaries])
            raise TopicError(f"Frames belong to one recording: name one of {names}.")
        self._session, self._recording = session, summaries[0]
        entry = session.entry_of(self._recording)
        self.epochs = epochs_of(session, entry.id)
        found: dict[str, list[str]] = {}
        types = {one.topic: plain_type(one.type) for one in entry.channels}
        for topic, kind in sorted(types.items()):
            above, _, last = topic.lstrip("/").rpartition("/")
            if kind not in TYPES or (only and topic not in only):
                continue
            if only or kind.startswith("foxglove."):
                found.setdefault("", []).append(topic)
            elif last in _NAMES:
                found.setdefault(above, []).append(topic)
        self.topics: Mapping[str, Sequence[str]] = dict(sorted(found.items()))
        self._trees: dict[tuple[str, int], FrameTree] = {}

    def tree(self, topic: str | None = None, epoch: int = -1) -> FrameTree:
        """The tree of a topic: that of its innermost namespace with one, or the only one.

        Without a topic, it is the root's, or the only one. Its transforms are of one epoch.

        Raises:
            TopicError: No topic has transforms, or only those of other namespaces.
        """
        above = (topic or "").lstrip("/")
        while above and above not in self.topics:
            above = above.rpartition("/")[0]
        if above not in self.topics and len(self.topics) == 1:
            (above,) = self.topics
        if self.topics and above not in self.topics:
            what = "No tree of frames is the root's" if topic is None else f"{topic} has no tree"
            names = listed([topics[0] for topics in self.topics.values()])
            raise TopicError(f"{what}; choose one of these by its topic (--tf-topic): {names}.")
        number = range(len(self.epochs.begins) + 1)[epoch]
        if (above, number) not in self._trees:
            own = self._read(self.topics.get(above, ()), number)
            if above and "" in self.topics:
                root = self.tree(epoch=number)
                frames, lacks = {**root.frames, **own.frames}, [*own.remarks, *root.remarks]
                own = replace(own, frames=frames, remarks=[*dict.fromkeys(lacks)])
            self._trees[above, number] = own
        return self._trees[above, number]

    def lookup(
        self,
        topic: str | None,
        target: str,
        source: str,
        times: NDArray[np.int64],
        log_time: NDArray[np.int64],
    ) -> Lookup:
        """Transforms between frames of a topic's tree, as of `FrameTree.lookup`.

        They are those of the epochs of the log times.
        """
        number = self.epochs.number(log_time)
        epochs = np.unique(number).tolist() or [-1]
        if len(epochs) == 1:
            return self.tree(topic, *epochs).lookup(target, source, times)
        made = unknown(len(times))
        missing = Counter[str]()
        for epoch in epochs:
            own, tree = np.flatnonzero(number == epoch), self.tree(topic, epoch)
            try:
                found = tree.lookup(target, source, times[own])
            except TopicError:
                missing["no such frame before its stamps start again, or after"] += len(own)
                continue
            made.translation[own], made.rotation[own] = found.translation, found.rotation
            missing.update(found.missing)
        return Lookup(made.translation, made.rotation, times, dict(missing))

    def check(self, topic: str | None, frame: str) -> None:
        """Refuse a frame that a topic's tree has in no epoch."""
        for epoch in reversed(range(len(self.epochs.begins) + 1)):
            try:
                self.tree(topic, epoch).check(frame)
            except TopicError:
                if not epoch:
                    raise
            else:
                return

    def _read(self, topics: Sequence[str], epoch: int) -> FrameTree:
        if not topics:
            raise TopicError(
                "No topic has transforms: they are messages of tf2_msgs/TFMessage on topics "
                "called tf or tf_static, or of foxglove.FrameTransform."
            )
        session, question = self._session, Question(tuple(topics), (self._recording.id,))
        found = [
            transforms_of(table, place, is_static=topic.endswith("tf_static"))
            for place, topic in enumerate(topics)
            for table in stream(Planner(session, replace(question, topics=(topic,))))
        ]
        lacks = [*completeness_of(session, question).sentences]
        invalid = Counter[str]()
        if not found:
            return FrameTree({}, self._recording.extent, {}, lacks)
        rows = pa.concat_tables(found)
        if len(self.epochs.begins):
            numbers = self.epochs.number(rows["log_time"].to_numpy())
            is_static = rows["is_static"].to_numpy()
            rows = rows.filter(pa.array((numbers == epoch) | (is_static & (numbers < epoch))))
            lacks.append(self.epochs.sentence())
        frames = _frames(rows, topics, invalid)
        lacks += [
            f"{counted(one.late, 'transform')} of {name} came behind newer ones: sorted in."
            for name, one in frames.items()
            if one.late
        ]
        return FrameTree(frames, self._recording.extent, dict(invalid), lacks)


def frames_and_stamps(
    session: Session, question: Question, counters: Counters
) -> tuple[list[str], NDArray[np.int64], NDArray[np.int64]]:
    """The frames that the headers of a topic name, and header stamps and log times, ns.

    The stamps of a topic without headers are its log times.
    """
    known = session.field_types(question.topics, question.recordings) or {}
    wanted = [name for name in ("header.stamp", "header.frame_id") if name in known]
    if "header.stamp" not in wanted:  # no message has to be read
        log_time = log_times(session, question, counters)
        return [], log_time, log_time
    table = to_arrow(Planner(session, replace(question, fields=tuple(wanted)), counters))
    frames = table["header.frame_id"].unique().to_pylist() if len(wanted) == 2 else []
    stamps, log_time = (table[n].cast(pa.int64()).to_numpy() for n in ("header.stamp", "log_time"))
    return frames, stamps, log_time


def _frames(rows: pa.Table, topics: Sequence[str], invalid: Counter[str]) -> dict[str, Frame]:
    """The frames with a parent, by name; counts transforms that are left out, by reason."""
    rows = rows.take(pa.array(np.argsort(rows["log_time"].to_numpy(), kind="stable")))
    pose = Transform(
        np.stack([rows[name].to_numpy() for name in ("tx", "ty", "tz")], axis=1),
        np.stack([rows[name].to_numpy() for name in ("rx", "ry", "rz", "rw")], axis=1),
    )
    columns = (pc.utf8_ltrim(rows[name], "/").combine_chunks() for name in ("child", "parent"))
    (child, known), (parent, above) = (
        (one.indices.to_numpy(), one.dictionary.to_pylist())
        for one in (column.dictionary_encode() for column in columns)
    )
    stamps, static, log_time = (
        rows[name].to_numpy() for name in ("stamp", "is_static", "log_time")
    )
    good = _valid(
        np.asarray(known, object)[child],
        np.asarray(above, object)[parent],
        pose,
        (stamps == 0) & ~static,
        invalid,
    )
    made: dict[str, Frame] = {}
    by_child = np.argsort(child, kind="stable")
    starts = np.searchsorted(child[by_child], np.arange(len(known) + 1))
    for place, name in enumerate(known):
        own = by_child[starts[place] : starts[place + 1]]
        own = own[good[own]]
        if not len(own):
            continue
        conflict = _conflict(name, topics, rows.take(pa.array(own)))
        # As in tf2, the first transform decides whether a frame is static.
        is_static, late = bool(static[own[0]]), 0
        if other := int((static[own] != is_static).sum()):
            here, there = ("static", "moving") if is_static else ("moving", "static")
            invalid[f"{there}, while {name} is {here}"] += other
            own = own[static[own] == is_static]
        times = log_time if is_static else stamps
        if is_static:
            values = np.column_stack([pose.translation, pose.rotation, parent])[own]
            own = own[np.concatenate(([True], (np.diff(values, axis=0) != 0).any(axis=1)))]
        else:
            before = np.maximum.accumulate(stamps[own])
            late = int((before - stamps[own] > _LATE_NS).sum())
            own = own[np.argsort(stamps[own], kind="stable")]
            own = own[np.concatenate(([True], np.diff(stamps[own]) != 0))]
        codes = list(dict.fromkeys(parent[own][::-1].tolist()))[::-1]
        place_of = {code: place for place, code in enumerate(codes)}
        made[name] = Frame(
            name,
            tuple(above[code] for code in codes),
            is_static,
            times[own],
            np.array([place_of[code] for code in parent[own].tolist()], np.intp),
            Transform(pose.translation[own] + (np.nan if conflict else 0), pose.rotation[own]),
            late,
            conflict,
        )
    return made


def _conflict(name: str, topics: Sequence[str], rows: pa.Table) -> str:
    """The parents that two topics give a frame at overlapping times, as words; empty for none."""
    seen: list[tuple[set[str], str, int, int]] = []
    for place, topic in enumerate(topics):
        own = rows.filter(pc.equal(rows["topic"], place))
        if own.num_rows:
            parents = set(pc.utf8_ltrim(own["parent"], "/").unique().to_pylist())
            ends = pc.min_max(own["stamp"]).as_py()
            span = (BEGIN, END) if own["is_static"][0].as_py() else (ends["min"], ends["max"])
            seen.append((parents, topic, *span))
    for (one, here, begin, end), (other, there, first, last) in combinations(seen, 2):
        if one != other and begin <= last and first <= end:
            return (
                f"{name} is below {listed(sorted(one))} by {here}, and at the same time below "
                f"{listed(sorted(other))} by {there}"
            )
    return ""


def _valid(
    child: NDArray[np.object_],
    parent: NDArray[np.object_],
    pose: Transform,
    unset: NDArray[np.bool_],
    invalid: Counter[str],
) -> NDArray[np.bool_]:
    """Mask of the valid transforms; each of the others is counted by its first reason."""
    with np.errstate(all="ignore"):
        norm = np.linalg.norm(pose.rotation, axis=1)
        finite = np.isfinite(pose.translation).all(axis=1) & np.isfinite(norm)
        reasons = {
            "a frame without a name": (child == "") | (parent == ""),
            "a frame that is its own parent": child == parent,
            "a stamp of zero, which is not set": unset,
            "numbers that are not finite": ~finite,
            "a rotation that is no unit quaternion": np.abs(norm - 1) > _MAX_NORM_ERROR,
        }
        pose.rotation[:] /= norm[:, None]
    good = np.ones(len(child), np.bool_)
    for why, bad in reasons.items():
        if number := int((good & bad).sum()):
            invalid[why] += number
        good &= ~bad
    return good
