"""Recording files, and the one-off script that people write today to ask one.

Each question is a loop over the messages of the topics that it needs, decoded one by one
by rosbags; bags are read by rosbags' readers, MCAP files by that of the mcap package.
"""

from __future__ import annotations

import json
import os
import threading
from abc import abstractmethod
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from benchmarks.backends.base import (
    ARM,
    GRIPPER,
    HALF_NS,
    IMU_COLUMNS,
    VIEWPOINT,
    Backend,
    BackendFailedError,
    sums,
)
from benchmarks.backends.conversion import schema_of, typestore_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog_storage.messages import Channel


Told = tuple[str, int, Any]
"""Topic, log time in ns, message as rosbags decodes it."""
Write = Callable[[int, int, bytes], None]
"""Appends a message: its channel, its log time, its payload."""


class FileBackend(Backend):
    """One file, written under a lock by one thread at a time."""

    suffix: ClassVar[str]
    """Of the file's name."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self.path = directory / f"recording{self.suffix}"
        self._channels: Sequence[Channel] = ()
        self._write: Write | None = None
        self._ending = ExitStack()
        self._lock = threading.Lock()
        self._reading = ExitStack()
        self._kept: Any = None

    def open(self, channels: Sequence[Channel]) -> None:
        self._channels = channels
        if not self.path.exists():
            with self._failures():
                self._write = self._begin(self._ending)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        with self._lock, self._failures():
            assert self._write is not None
            self._write(channel, log_time, payload)

    def finish(self) -> None:
        with self._lock, self._failures():
            self._ending.close()
            for place in (self.path, self.directory):
                descriptor = os.open(place, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)

    def counts(self) -> Mapping[str, int]:
        found = dict.fromkeys((channel.topic for channel in self._channels), 0)
        with self._failures():
            return found | self._count()

    def close(self) -> None:
        self._reading.close()
        with self._lock, suppress(Exception):  # on a full disk there is no good end
            self._ending.close()

    @abstractmethod
    def _begin(self, ending: ExitStack) -> Write:
        """Begin the file; `ending` gets what belongs at its end."""

    @abstractmethod
    def _count(self) -> Mapping[str, int]:
        """Read all messages and count them by topic."""

    @abstractmethod
    @contextmanager
    def _reader(self) -> Iterator[Any]:
        """A new reader."""

    @abstractmethod
    def _messages(
        self, reader: Any, topics: Sequence[str], begin: int | None = None, end: int | None = None
    ) -> Iterator[Told]:
        """Messages of topics with a log time in `[begin, end)`, in order."""

    @abstractmethod
    def _last(self, reader: Any, topic: str, time: int) -> Any:
        """The last message of a topic with a log time up to `time`."""

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Whatever a package raises is a failure of the backend."""
        try:
            yield
        except Exception as error:
            of_system = isinstance(error, OSError) and error.strerror
            reason = of_system or str(error)
            raise BackendFailedError(f"{self.name}: {type(error).__name__}: {reason}") from error

    # A script that is run once opens the file; one that reads again and again keeps it open.

    def _said(self, *topics: str) -> Iterator[Told]:
        with self._reader() as reader:
            yield from self._messages(reader, topics)

    def _open_reader(self) -> Any:
        if self._kept is None:
            self._kept = self._reading.enter_context(self._reader())
        return self._kept

    def closings(self) -> int:
        return sum(message.position == 0.0 for _, _, message in self._said(GRIPPER))

    def behind(self) -> int:
        return sum(message.position.x <= 0 for _, _, message in self._said(VIEWPOINT))

    def positions(self) -> list[float]:
        points = [message.position for _, _, message in self._said(VIEWPOINT)]
        return sums([(point.x, point.y, point.z) for point in points if point.x <= 0])

    def in_region(self) -> int:
        found = 0
        for _, _, message in self._said(ARM):
            place = message.pose.position
            found += place.z > 1 and -0.5 < place.y < 0.5 and 0.5 < place.x < 1
        return found

    def grasps(self) -> int:
        closings, in_front = [], []
        for topic, time, message in self._said(GRIPPER, VIEWPOINT):
            if topic == GRIPPER and message.position == 0.0:
                closings.append(time)
            elif topic == VIEWPOINT and message.position.x >= 0:
                in_front.append(time)
        in_front.sort()
        return sum(
            bisect_right(in_front, time - HALF_NS) < bisect_left(in_front, time + HALF_NS)
            for time in closings
        )

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        said = self._messages(self._open_reader(), [topic], begin, end)
        return np.array([message.ranges for _, _, message in said], np.float32)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self._last(self._open_reader(), topic, time).ranges
        return found

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        values = [attrgetter(name) for name in IMU_COLUMNS]
        said = self._messages(self._open_reader(), [topic])
        rows = [(time, *(value(message) for value in values)) for _, time, message in said]
        return pd.DataFrame(rows, columns=["log_time", *IMU_COLUMNS])


class BagFile(FileBackend):
    """An uncompressed ROS 1 bag, as `rosbag record` writes it: the paper's flat file."""

    name, title, suffix = "bagfile", "ROS bag", ".bag"
    answers = reads = True

    def _begin(self, ending: ExitStack) -> Write:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys.msg import normalize_msgtype

        writer = ending.enter_context(Writer(self.path))
        connections = []
        for number, channel in enumerate(self._channels):
            schema, about = schema_of(channel), channel.metadata
            latching = about.get("latching", "")
            made = writer.add_connection(
                channel.topic,
                normalize_msgtype(schema.name),
                msgdef=schema.data.decode(),
                md5sum=about.get("md5sum") or "*",
                # Two connections of a topic differ in who sent, or rosbags refuses the second.
                callerid=about.get("callerid") or f"/publisher_{number}",
                latching=int(latching) if latching in {"0", "1"} else None,
            )
            connections.append(made)
        return lambda channel, time, payload: writer.write(connections[channel], time, payload)

    def _count(self) -> Mapping[str, int]:
        from rosbags.rosbag1 import Reader

        with Reader(self.path) as reader:
            return Counter(c.topic for c, _, _ in reader.messages())

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        from rosbags.highlevel import AnyReader

        with AnyReader([self.path]) as reader:
            yield reader

    def _messages(
        self, reader: Any, topics: Sequence[str], begin: int | None = None, end: int | None = None
    ) -> Iterator[Told]:
        chosen = [c for c in reader.connections if c.topic in topics]
        for connection, time, raw in reader.messages(chosen, start=begin, stop=end):
            yield connection.topic, time, reader.deserialize(raw, connection.msgtype)

    def _last(self, reader: Any, topic: str, time: int) -> Any:
        chosen = [c for c in reader.connections if c.topic == topic]
        # A bag is read forwards: the steps back grow until there is a message.
        back = 10**8
        while True:
            last = None
            for last in reader.messages(chosen, start=time - back, stop=time + 1):  # noqa: B007
                pass
            if last is not None:
                return reader.deserialize(last[2], last[0].msgtype)
            if time - back < reader.start_time:
                raise LookupError(f"no message of {topic} is at or before {time}")
            back *= 10


class McapFile(FileBackend):
    """The `mcap` package's writer with its default settings: chunks of 1 MiB, zstd."""

    name, title, suffix = "mcap", "plain MCAP", ".mcap"
    reads = True

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._types: dict[int, tuple[Any, str]] = {}

    def _begin(self, ending: ExitStack) -> Write:
        from mcap.writer import Writer

        writer = Writer(ending.enter_context(self.path.open("xb")))
        writer.start(profile="ros1", library="")
        ids = []
        for channel in self._channels:
            kind = schema_of(channel)
            schema = writer.register_schema(kind.name, kind.encoding, kind.data)
            about = channel.topic, channel.message_encoding, schema
            ids.append(writer.register_channel(*about, dict(channel.metadata)))
        ending.callback(writer.finish)
        return lambda channel, time, payload: writer.add_message(ids[channel], time, payload, time)

    def _count(self) -> Mapping[str, int]:
        from mcap.records import Channel, Message
        from mcap.stream_reader import StreamReader

        topics: dict[int, str] = {}
        found: Counter[str] = Counter()
        with self.path.open("rb") as stream:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                elif isinstance(record, Message):
                    found[topics[record.channel_id]] += 1
        return found

    @contextmanager
    def _reader(self) -> Iterator[Any]:
        from mcap.reader import make_reader

        with self.path.open("rb") as stream:
            yield make_reader(stream)

    def _messages(
        self, reader: Any, topics: Sequence[str], begin: int | None = None, end: int | None = None
    ) -> Iterator[Told]:
        found = reader.iter_messages(topics, start_time=begin, end_time=end)
        for schema, channel, message in found:
            yield channel.topic, message.log_time, self._decoded(schema, message.data)

    def _last(self, reader: Any, topic: str, time: int) -> Any:
        for schema, _, message in reader.iter_messages([topic], end_time=time + 1, reverse=True):
            return self._decoded(schema, message.data)
        raise LookupError(f"no message of {topic} is at or before {time}")

    def _decoded(self, schema: Any, data: bytes) -> Any:
        if schema.id not in self._types:
            self._types[schema.id] = typestore_of(schema)
        types, name = self._types[schema.id]
        return types.deserialize_ros1(data, name)


_COUNTS = "counts.json"


class Nothing(Backend):
    """Counts messages and lets them go."""

    name, title = "nothing", "harness alone"

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._topics: list[str] = []
        self._counts: list[int] = []

    def open(self, channels: Sequence[Channel]) -> None:
        """Note the topics."""
        self._topics = [channel.topic for channel in channels]
        self._counts = [0] * len(channels)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        """Count a message. A channel has one thread, so its number has one writer."""
        self._counts[channel] += 1

    def finish(self) -> None:
        """Write the counts."""
        totals: Counter[str] = Counter()
        for topic, count in zip(self._topics, self._counts, strict=True):
            totals[topic] += count
        (self.directory / _COUNTS).write_text(json.dumps(totals), encoding="utf-8")

    def counts(self) -> Mapping[str, int]:
        """The counts that were written."""
        try:
            text = (self.directory / _COUNTS).read_text(encoding="utf-8")
        except FileNotFoundError:
            raise BackendFailedError("nothing was counted: the run did not finish") from None
        counts: dict[str, int] = json.loads(text)
        return counts

    def close(self) -> None:
        """Nothing to stop."""
