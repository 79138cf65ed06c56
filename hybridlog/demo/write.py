"""Writes what the simulated robot says as an ordinary ROS bag.

A span of about a second is made, put in the order of log times and written, before
the next one is begun: memory does not grow with the duration. The same arguments
give the same bytes.
"""

from __future__ import annotations

import errno
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, Self

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from hybridlog.demo.config import DEFAULT_DURATION_S, DEFAULT_SEED, RobotConfig
from hybridlog.demo.robot import Robot
from hybridlog.demo.streams import Speech
from hybridlog.demo.wire import Types
from hybridlog_storage.errors import DiskFullError, HybridlogError, TopicError, UsageError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from types import TracebackType

    from numpy.typing import NDArray
    from rosbags.interfaces import Connection

    from hybridlog.demo.streams import Stream

Progress = Callable[[float, float], None]
"""Called with the simulated seconds written and the seconds to write."""

_SPAN_S = 1.0
_SPAN_BYTES = 16 << 20


@dataclass(frozen=True, slots=True)
class BagSummary:
    """What was written.

    Attributes:
        path: The bag: a file, or the directory of a ROS 2 bag.
        size: Bytes on disk.
        messages: Number of messages by topic.
        start_ns: Log time at which the recording starts, nanoseconds since the epoch.
        truth: What questions to the bag must answer: `gripper_closings` (commands with
            position 0), `near_scans` (scans with a range below 0.5 m), `errors`
            (diagnostics with an error in them).
        elapsed_s: Seconds it took.
    """

    path: Path
    size: int
    messages: Mapping[str, int]
    start_ns: int
    truth: Mapping[str, int]
    elapsed_s: float


def write_bag(
    path: Path | str,
    *,
    duration_s: float = DEFAULT_DURATION_S,
    seed: int = DEFAULT_SEED,
    ros: Literal[1, 2] = 1,
    storage: Literal["mcap", "sqlite3"] = "mcap",
    compression: Literal["none", "lz4", "bz2"] = "none",
    topics: Iterable[str] | None = None,
    config: RobotConfig | None = None,
    progress: Progress | None = None,
) -> BagSummary:
    """Simulate a robot and write its log.

    Args:
        path: Must not exist: a `.bag` file for ROS 1, a directory for ROS 2.
        duration_s: Seconds of log time; the bag spans `[0, duration_s)`.
        seed: Gives the furniture, the noise and the day.
        ros: Version of the messages and the bag.
        storage: File format within a ROS 2 bag.
        compression: Of the chunks of a ROS 1 bag.
        topics: Exact names; all when None.
        config: Sensors and rates.
        progress: Called after each span.

    Raises:
        UsageError: An argument is out of range, or `path` exists or cannot be written.
        TopicError: A name in `topics` is none of the robot's.
        DiskFullError: No space left. Whatever fails, no half bag is left behind.
    """
    began = time.monotonic()
    path = Path(path)
    robot = Robot(duration_s, seed)
    types = Types(ros)
    streams = _chosen(Speech(robot, config or RobotConfig(), types).streams(), topics)
    if path.exists() or path.is_symlink():
        raise UsageError(f"{path} exists already; remove it or choose another name")
    counts: Counter[str] = Counter({stream.topic: 0 for stream in streams})
    truth: Counter[str] = Counter({"gripper_closings": 0, "near_scans": 0, "errors": 0})
    try:
        with _open(path, ros, storage, compression) as writer:
            writer.connect(streams, types)
            for done, messages in _spans(robot, streams, truth):
                for _, stream, log_time, payload in messages:
                    writer.write(stream, log_time, payload)
                counts.update(streams[stream].topic for _, stream, _, _ in messages)
                writer.forget()
                if progress is not None:
                    progress(done, robot.duration_s)
    except BaseException as error:
        # Also when interrupted: a bag without its index would only be found later.
        _remove(path)
        if isinstance(error, OSError):
            raise _mapped(error, path) from error
        raise
    files = [path] if path.is_file() else sorted(path.iterdir())
    return BagSummary(
        path=path,
        size=sum(file.stat().st_size for file in files),
        messages=dict(counts),
        start_ns=robot.start_ns,
        truth=dict(truth),
        elapsed_s=time.monotonic() - began,
    )


def _mapped(error: OSError, path: Path) -> HybridlogError:
    if error.errno in {errno.ENOSPC, errno.EDQUOT}:
        return DiskFullError(f"no space left for {path}; free some or write elsewhere")
    return UsageError(f"cannot write {path}: {error.strerror or error}; choose another place")


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _chosen(streams: list[Stream], topics: Iterable[str] | None) -> list[Stream]:
    if topics is None:
        return streams
    wanted = set(topics)
    known = [stream.topic for stream in streams]
    for name in sorted(wanted.difference(known)):
        raise TopicError(f"the robot has no topic {name}; it has {', '.join(known)}")
    return [stream for stream in streams if stream.topic in wanted]


Message = tuple[int, int, int, memoryview | bytes]
"""Order of arrival, index of the stream, log time in nanoseconds, payload."""


def _spans(
    robot: Robot, streams: Sequence[Stream], truth: Counter[str]
) -> Iterator[tuple[float, list[Message]]]:
    """Messages in the order of their log times, a span at a time, and the seconds done."""
    rate = sum(stream.hz * stream.size for stream in streams)
    length = min(_SPAN_S, max(0.05, _SPAN_BYTES / max(rate, 1.0)))
    end_ns = robot.start_ns + round(robot.duration_s * 1e9)
    # The last log time of each stream: jitter must not swap two of its messages.
    last = np.full(len(streams), robot.start_ns, np.int64)
    waiting: list[Message] = []
    arrival = 0
    for block in range(int(np.ceil(robot.duration_s / length))):
        start, end = block * length, min((block + 1) * length, robot.duration_s)
        for index, stream in enumerate(streams):
            ticks = stream.ticks(start, end, block, robot)
            if not len(ticks):
                continue
            spoken = stream.speak(ticks)
            log_time = ticks.stamp + stream.transport(ticks, robot.seed)
            log_time = np.maximum.accumulate(np.maximum(log_time, last[index]))
            last[index] = log_time[-1]
            # What arrives after the recording has stopped is not in it.
            kept = log_time < end_ns
            for name, flags in spoken.flags.items():
                truth[name] += int(np.count_nonzero(flags & kept))
            payloads = _payloads(spoken.payloads)
            for row in np.flatnonzero(kept).tolist():
                waiting.append((arrival, index, int(log_time[row]), payloads[row]))
                arrival += 1
        waiting.sort(key=lambda message: (message[2], message[0]))
        # A message of the next span can be stamped, and logged, from `end` on.
        border = robot.start_ns + round(end * 1e9)
        ready = next((i for i, m in enumerate(waiting) if m[2] >= border), len(waiting))
        yield end, waiting[:ready]
        del waiting[:ready]


def _payloads(payloads: NDArray[np.uint8] | Sequence[bytes]) -> Sequence[memoryview | bytes]:
    if not isinstance(payloads, np.ndarray):
        return payloads
    flat, size = payloads.reshape(-1).data, payloads.shape[1]
    return [flat[i * size : (i + 1) * size] for i in range(len(payloads))]


class _Writer(Protocol):
    """What the two kinds of bag have in common."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> object: ...
    def connect(self, streams: Sequence[Stream], types: Types) -> None: ...
    def write(self, stream: int, log_time: int, payload: memoryview | bytes) -> None: ...
    def forget(self) -> None: ...


def _open(path: Path, ros: int, storage: str, compression: str) -> _Writer:
    if ros == 1:
        return _Bag1(path, compression)
    if compression != "none":
        raise UsageError("compression applies to ROS 1 bags only; leave it out with ros=2")
    return _Bag2(path, storage)


class _Bag1:
    """A ROS 1 bag."""

    def __init__(self, path: Path, compression: str) -> None:
        self._writer = Writer1(path)
        if compression != "none":
            self._writer.set_compression(Writer1.CompressionFormat[compression.upper()])
        self._connections: list[Connection] = []
        self._forgotten = 0

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> object:
        return self._writer.__exit__(kind, error, trace)

    def connect(self, streams: Sequence[Stream], types: Types) -> None:
        for stream in streams:
            self._connections.append(
                self._writer.add_connection(
                    stream.topic,
                    stream.msgtype,
                    typestore=types.store,
                    callerid=stream.node,
                    latching=1 if stream.latched else None,
                )
            )

    def write(self, stream: int, log_time: int, payload: memoryview | bytes) -> None:
        self._writer.write(self._connections[stream], log_time, payload)

    def forget(self) -> None:
        # The writer keeps time and offset of every message to the end, where only
        # their number counts. Chunks that are on disk need no more than that.
        chunks = self._writer.chunks
        for chunk in chunks[self._forgotten : -1]:
            for entries in chunk.connections.values():
                entries[:] = [(0, 0)] * len(entries)
        self._forgotten = len(chunks) - 1


class _Bag2:
    """A ROS 2 bag."""

    def __init__(self, path: Path, storage: str) -> None:
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        self._writer = Writer2(path, version=9, storage_plugin=plugin)
        self._connections: list[Connection] = []

    def __enter__(self) -> Self:
        self._writer.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> object:
        return self._writer.__exit__(kind, error, trace)

    def connect(self, streams: Sequence[Stream], types: Types) -> None:
        forever = QosTime(2147483647, 4294967295)
        for stream in streams:
            durability = QosDurability.TRANSIENT_LOCAL if stream.latched else QosDurability.VOLATILE
            qos = Qos(
                QosHistory.KEEP_LAST,
                1 if stream.latched else 10,
                QosReliability.RELIABLE,
                durability,
                forever,
                forever,
                QosLiveliness.AUTOMATIC,
                forever,
                False,
            )
            self._connections.append(
                self._writer.add_connection(
                    stream.topic,
                    stream.msgtype,
                    typestore=types.store,
                    offered_qos_profiles=[qos],
                )
            )

    def write(self, stream: int, log_time: int, payload: memoryview | bytes) -> None:
        self._writer.write(self._connections[stream], log_time, payload)

    def forget(self) -> None:
        """Nothing to do: chunks and rows are gone once written."""
