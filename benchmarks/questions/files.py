"""Questions to files of recordings: the one-off script that people write today.

Each question is a loop over the messages of the topics that it needs, decoded one by one
by rosbags; bags are read by rosbags' readers, MCAP files by that of the mcap package.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from itertools import islice
from operator import attrgetter
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.backends.conversion import typestore_of
from benchmarks.questions.base import ARM, GRIPPER, VIEWPOINT, Asker, Reading, sums

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd
    from numpy.typing import NDArray

    from benchmarks.backends.base import Backend

Told = tuple[str, int, Any]
"""Topic, log time in ns, message as rosbags decodes it."""


class _File(ABC):
    """A file, and ways through it."""

    path: Path
    kept: ExitStack | None = None
    """What `close` closes, when the file is kept open."""

    def start(self, backend: Backend) -> None:
        from benchmarks.backends.recording_files import FileBackend

        assert isinstance(backend, FileBackend)
        self.path = backend.path

    @abstractmethod
    def opened(self) -> AbstractContextManager[Any]:
        """A reader: a new one for a script that is run once, or the one that is kept."""

    def keep(self) -> None:
        """Open the file once for all that follows."""
        stack = ExitStack()
        reader = stack.enter_context(self.opened())
        self.kept = stack
        self.opened = lambda: nullcontext(reader)  # type: ignore[method-assign]

    def close(self) -> None:
        if self.kept is not None:
            self.kept.close()

    @abstractmethod
    def messages(
        self, topics: Sequence[str], begin: int | None = None, end: int | None = None
    ) -> Iterator[Told]:
        """Messages of topics with a log time in `[begin, end)`, in order."""

    @abstractmethod
    def last_before(self, topic: str, time: int) -> Any:
        """The last message of a topic with a log time up to `time`."""


class _FileReading(_File, Reading):
    """The same for messages themselves; the file stays open."""

    def start(self, backend: Backend) -> None:
        super().start(backend)
        self.keep()

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        rows = [message.ranges for _, _, message in self.messages([topic], begin, end)]
        return np.array(rows, np.float32)

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self.last_before(topic, time).ranges
        return found

    def table(self, topic: str) -> pd.DataFrame:
        import pandas as pd

        values = [attrgetter(name) for name in self.columns]
        rows = [
            (time, *(value(message) for value in values))
            for _, time, message in self.messages([topic])
        ]
        return pd.DataFrame(rows, columns=["log_time", *self.columns])


class _Bag(_File):
    """A bag."""

    def opened(self) -> AbstractContextManager[Any]:
        from rosbags.highlevel import AnyReader

        return AnyReader([self.path])

    def messages(
        self, topics: Sequence[str], begin: int | None = None, end: int | None = None
    ) -> Iterator[Told]:
        with self.opened() as reader:
            chosen = [c for c in reader.connections if c.topic in topics]
            for connection, time, raw in reader.messages(chosen, start=begin, stop=end):
                yield connection.topic, time, reader.deserialize(raw, connection.msgtype)

    def last_before(self, topic: str, time: int) -> Any:
        with self.opened() as reader:
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


class _Mcap(_File):
    """An MCAP file."""

    @contextmanager
    def opened(self) -> Iterator[Any]:
        from mcap.reader import make_reader

        with self.path.open("rb") as stream:
            yield make_reader(stream)

    def messages(
        self, topics: Sequence[str], begin: int | None = None, end: int | None = None
    ) -> Iterator[Told]:
        decode = _Decoder()
        with self.opened() as reader:
            for schema, channel, message in reader.iter_messages(
                topics, start_time=begin, end_time=end
            ):
                yield channel.topic, message.log_time, decode(schema, message.data)

    def last_before(self, topic: str, time: int) -> Any:
        decode = _Decoder()
        with self.opened() as reader:
            found = reader.iter_messages([topic], end_time=time + 1, reverse=True)
            for schema, _, message in islice(found, 1):
                return decode(schema, message.data)
        raise LookupError(f"no message of {topic} is at or before {time}")


class _Decoder:
    """Decodes messages by the definitions in the file."""

    def __init__(self) -> None:
        self._types: dict[int, tuple[Any, str]] = {}

    def __call__(self, schema: Any, data: bytes) -> Any:
        if schema.id not in self._types:
            from hybridlog_storage.messages import Schema

            self._types[schema.id] = typestore_of(
                Schema(name=schema.name, encoding=schema.encoding, data=schema.data)
            )
        types, name = self._types[schema.id]
        return types.deserialize_ros1(data, name)


class BagAsker(_Bag, Asker):
    """A loop over a bag."""

    def closings(self) -> int:
        return sum(message.position == 0.0 for _, _, message in self.messages([GRIPPER]))

    def behind(self) -> int:
        return sum(message.position.x <= 0 for _, _, message in self.messages([VIEWPOINT]))

    def positions(self) -> list[float]:
        found = [
            (message.position.x, message.position.y, message.position.z)
            for _, _, message in self.messages([VIEWPOINT])
            if message.position.x <= 0
        ]
        return sums(found)

    def in_region(self) -> int:
        found = 0
        for _, _, message in self.messages([ARM]):
            place = message.pose.position
            found += place.z > 1 and -0.5 < place.y < 0.5 and 0.5 < place.x < 1
        return found

    def grasps(self, half_ns: int) -> int:
        closings, in_front = [], []
        for topic, time, message in self.messages([GRIPPER, VIEWPOINT]):
            if topic == GRIPPER:
                if message.position == 0.0:
                    closings.append(time)
            elif message.position.x >= 0:
                in_front.append(time)
        in_front.sort()
        return sum(
            bisect_right(in_front, time - half_ns) < bisect_left(in_front, time + half_ns)
            for time in closings
        )


class BagReading(_Bag, _FileReading):
    """From a bag, by its index."""


class McapReading(_Mcap, _FileReading):
    """From an MCAP file, by its index."""
