"""ROS 1 bag files, written and read by rosbags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.backends.database import schema_of
from benchmarks.backends.recording_files import FileBackend, Recorder

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

    from hybridlog_storage.messages import Channel

_ANY_MD5 = "*"


class BagFile(FileBackend):
    """An uncompressed ROS 1 bag, as `rosbag record` writes it: the paper's flat file."""

    name, title = "bagfile", "ROS bag"
    asker = "benchmarks.questions.files:BagAsker"
    reader = "benchmarks.questions.files:BagReading"
    suffix = ".bag"

    def _record(self, path: Path) -> Recorder:
        return _Ros1Recorder(path, self._channels)

    def _count(self, path: Path) -> Mapping[str, int]:
        from rosbags.rosbag1 import Reader

        with Reader(path) as reader:
            return Counter(c.topic for c, _, _ in reader.messages())


class _Ros1Recorder:
    def __init__(self, path: Path, channels: Sequence[Channel]) -> None:
        from rosbags.rosbag1 import Writer

        self._writer = Writer(path)
        self._writer.open()
        self._connections = [self._add(number, c) for number, c in enumerate(channels)]

    def _add(self, number: int, channel: Channel) -> Connection:
        from rosbags.typesys.msg import normalize_msgtype

        schema = schema_of(channel)
        latching = channel.metadata.get("latching", "")
        return self._writer.add_connection(
            channel.topic,
            normalize_msgtype(schema.name),
            msgdef=schema.data.decode(),
            md5sum=channel.metadata.get("md5sum") or _ANY_MD5,
            # Two connections of a topic differ in who sent, or rosbags refuses the second.
            callerid=channel.metadata.get("callerid") or f"/publisher_{number}",
            latching=int(latching) if latching in {"0", "1"} else None,
        )

    def write(self, channel: int, log_time: int, payload: bytes) -> None:
        self._writer.write(self._connections[channel], log_time, payload)

    def close(self) -> None:
        self._writer.close()
