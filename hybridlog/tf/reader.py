"""Transforms of a recording: messages of tf, tf2 and Foxglove, by epochs.

An epoch begins where header stamps start again, as after a reset of a simulation.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct
from msgspec.structs import replace

from hybridlog.arrays.message_arrays import plain_type
from hybridlog.frames.answer import flat, stream, to_arrow
from hybridlog.query.answers.completeness import completeness_of
from hybridlog.query.planner import Planner, log_times
from hybridlog.query.question import Counters, Question
from hybridlog.query.times import format_time
from hybridlog.schema.column import STAMP
from hybridlog.tf.tree import Frame, FrameTree, Lookup, Transform, unknown
from hybridlog.wording import counted, listed
from hybridlog_storage.errors import TopicError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session
    from hybridlog_storage.catalog import RecordingSummary

    Times = NDArray[np.int64]
    Stamps = tuple[Times, Times]  # log times of a topic's messages, ascending, and their stamps

TYPES: Final = frozenset({
    "tf2_msgs/TFMessage", "tf/tfMessage", "geometry_msgs/TransformStamped",
    "foxglove.FrameTransform", "foxglove.FrameTransforms",
})  # fmt: skip
"""Message types with transforms, as `plain_type` names them."""
_SECOND: Final = 10**9
_FALL_NS: Final = _SECOND
_TOGETHER_NS: Final = 2 * _SECOND
_RETURN_NS: Final = 10 * _SECOND
_LEAST_STAMPS: Final = 100  # of a topic that alone has stamps
_ROOM: Final = 49 * 10**17  # ns beyond all stamps, those of 2106 too; for all epochs together
_NAMES: Final = {"tf", "tf_static"}
_LATE_NS: Final = 100_000_000
_MAX_NORM_ERROR: Final = 1e-2
"""Greatest distance of a quaternion's norm from 1; that of tf2."""


class Epochs(Struct, frozen=True):
    """The epochs of a recording.

    Attributes:
        name: That of the recording.
        begins: int64[n], log times at which all but the first begin, ns, ascending.
    """

    name: str
    begins: Times

    @property
    def apart(self) -> int | None:
        """Times that are farther apart are of two epochs, ns, if `offsets` were added."""
        return _ROOM // len(self.begins) // 2 if len(self.begins) else None

    def number(self, log_time: Times) -> NDArray[np.intp]:
        """The epoch of messages, from 0 on."""
        return self.begins.searchsorted(log_time, "right")

    def offsets(self, log_time: Times) -> Times:
        """Offsets, ns, that set the stamps of each epoch apart from those of all others."""
        return self.number(log_time) * (_ROOM // max(len(self.begins), 1))

    def sentence(self) -> str:
        """A sentence about a recording with several."""
        first, more = format_time(int(self.begins[0])), len(self.begins) - 1
        often = f", and {more} more times" if more > 1 else ", and once more" if more else ""
        return (
            f"Header stamps of {self.name} start again at {first}{often} (log time): messages "
            "from before and after are not matched."
        )


def epochs_of(session: Session, recording: str) -> Epochs:
    """The epochs of the recording with an id.

    They begin where `/clock` goes back; without it, where most topics fall behind their greatest
    stamp together. No message is read if no topic's stamps fall behind log time.
    """
    (summary,) = session.some([recording])
    entry = session.entry_of(summary)
    known = session.shared.epochs.get(recording)
    if known is not None and known[0] is entry:
        found: Epochs = known[1]
        return found
    kinds = {channel.topic: plain_type(channel.type) for channel in entry.channels}
    stats = [channel.stats for channel in entry.channels if channel.stats.stamped]
    spreads = [(one.skew_max or 0) - (one.skew_min or 0) for one in stats]
    may_fall = not (entry.is_decoded and spreads) or max(spreads) > _FALL_NS
    begins = np.empty(0, np.int64)
    if may_fall and kinds.get("/clock") == "rosgraph_msgs/Clock":
        log_time, clock = _stamps(session, recording, "/clock", "clock")
        begins = log_time[1:][np.diff(clock) < 0]
    elif may_fall:
        channels = session.channels_of(entry, {*kinds})
        has = (c for c in channels if any(path.path == STAMP for path in c.codec.paths()))
        topics = dict.fromkeys((one.channel.topic, "stamp") for one in has)
        moving = (t for t, kind in kinds.items() if kind in TYPES and not t.endswith("tf_static"))
        topics |= dict.fromkeys((topic, "") for topic in moving)
        begins = found_in([_stamps(session, recording, *one) for one in topics])
    found = Epochs(summary.name, begins)
    session.shared.epochs[recording] = entry, found
    return found


def _stamps(session: Session, recording: str, topic: str, field: str) -> Stamps:
    """Log times of a topic, and its stamps; without a field those of transforms."""
    question = Question((topic,), (recording,), fields=(field,) if field else None)
    found = [(np.empty(0, np.int64),) * 2]
    for table in stream(Planner(session, question)):
        rows = table if field else transforms_of(table, 0, is_static=False)
        if (field or "stamp") in rows.column_names:
            rows = rows.select(["log_time", field or "stamp"]).drop_null()
            log_time, stamp = (column.cast(pa.int64()).to_numpy() for column in rows.columns)
            found.append((log_time, stamp))
    log_time, stamp = (np.concatenate(parts) for parts in zip(*found, strict=True))
    is_set = (stamp != 0) | (field == "clock")
    return log_time[is_set], stamp[is_set]


def found_in(topics: Sequence[Stamps]) -> Times:
    """Log times at which epochs begin, by the stamps of all topics that have some.

    At least half of the topics with stamps before and behind fall more than a second below their
    greatest stamp within two seconds, and none returns within ten to its old distance of log time
    and stamp. A topic that alone has stamps counts from a hundred on; one that had the new
    distance before has stamps of several clocks, and does not count as fallen.
    """
    begins: list[int] = []
    start = BEGIN
    while True:
        falls = [_falls(log_time, stamp, start) for log_time, stamp in topics]
        candidates = np.unique(np.concatenate([*falls, np.empty(0, np.int64)])).tolist()
        begin = next((at for at in candidates if _is_epoch(topics, falls, start, at)), None)
        if begin is None:
            return np.array(begins, np.int64)
        begins.append(begin)
        start = begin


def _falls(log_time: Times, stamp: Times, start: int) -> Times:
    """Log times from a start on at which the stamps of a topic fall."""
    first = int(log_time.searchsorted(start))
    log_time, stamp = log_time[first:], stamp[first:]
    is_low = np.maximum.accumulate(stamp) - stamp > _FALL_NS
    return log_time[is_low & ~np.concatenate(([False], is_low[:-1]))[: len(is_low)]]


def _is_epoch(topics: Sequence[Stamps], falls: Sequence[Times], start: int, begin: int) -> bool:
    """True if an epoch begins at a log time."""
    lasting, fallen = [], 0
    for (log_time, stamp), fall in zip(topics, falls, strict=True):
        first, at = (int(log_time.searchsorted(time)) for time in (start, begin))
        if first == at or at == len(log_time):
            continue
        lasting.append(len(log_time))
        place = int(fall.searchsorted(begin))
        if place == len(fall) or int(fall[place]) > begin + _TOGETHER_NS:
            continue
        at = int(log_time.searchsorted(fall[place]))
        end = int(log_time.searchsorted(min(int(fall[place]) + _RETURN_NS, END), "right"))
        distance = log_time[first:end].astype(np.float64) - stamp[first:end]
        before, behind = distance[: at - first], distance[at - first :]
        if behind[0] <= before.max():
            continue  # stamps of several clocks
        if bool((behind < (before[-1] + behind[0]) / 2).any()):
            return False
        fallen += 1
    is_sole = len(lasting) == 1 and lasting[0] < _LEAST_STAMPS
    return bool(lasting) and not is_sole and 2 * fallen >= len(lasting)


def transforms_of(table: pa.Table, topic: int, *, is_static: bool) -> pa.Table:
    """The transforms of messages as rows: times, frames, seven numbers, topic, `is_static`."""
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
    found["topic"] = pa.repeat(pa.scalar(topic), len(times))
    found["is_static"] = pa.repeat(pa.scalar(is_static), len(times))
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
        trees = [self.tree(topic, epoch) for epoch in range(len(self.epochs.begins) + 1)]
        if not any(frame.removeprefix("/") in tree.names for tree in trees):
            trees[0].check(frame)

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
