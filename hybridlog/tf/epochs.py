"""Epochs of a recording: where its header stamps start again, as after a reset of a simulation.

And the transforms of its messages as rows of a table.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from msgspec import Struct

from hybridlog.arrays.message_arrays import plain_type
from hybridlog.frames.answer import flat, stream
from hybridlog.query.planner import Planner
from hybridlog.query.question import Question
from hybridlog.query.times import format_time
from hybridlog.schema.column import STAMP
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError
from hybridlog_storage.times import BEGIN, END

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from hybridlog.session import Session

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
    snapshot = session.look([recording])
    summary = snapshot.summaries[snapshot.by_id[recording]]
    entry = session.entry_of(summary)
    known = session.shared.epochs.get(recording)
    if known is not None and known[0] is entry:
        found: Epochs = known[1]
        return found
    kinds = {channel.topic: plain_type(channel.type) for channel in entry.channels}
    skews: dict[str, list[int]] = defaultdict(list)
    for channel in entry.channels:
        ends = (channel.stats.skew_min, channel.stats.skew_max)
        if entry.is_decoded and channel.stats.stamped:
            skews[channel.topic] += [skew for skew in ends if skew is not None]
    if not entry.is_decoded:
        channels = session.channels_of(entry, {*kinds})
        has = [c for c in channels if any(path.path == STAMP for path in c.codec.paths())]
        skews |= {one.channel.topic: [] for one in has}
    may_fall = not (entry.is_decoded and skews) or any(
        max(skew, default=0) - min(skew, default=0) > _FALL_NS for skew in skews.values()
    )
    begins = np.empty(0, np.int64)
    if may_fall and kinds.get("/clock") == "rosgraph_msgs/Clock":
        log_time, clock = _stamps(session, recording, "/clock", "clock")
        begins = log_time[1:][np.diff(clock) < 0]
    elif may_fall:
        moving = [t for t, kind in kinds.items() if kind in TYPES and not t.endswith("tf_static")]
        topics = [*((topic, "stamp") for topic in skews), *((topic, "") for topic in moving)]
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
    return log_time, stamp


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
