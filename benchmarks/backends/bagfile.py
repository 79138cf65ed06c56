"""ROS bag files, written and read by rosbags: ROS 1 bags, and ROS 2 bags for CDR."""

from __future__ import annotations

import hashlib
import sqlite3
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.backends.base import BackendMissingError
from benchmarks.backends.recording_files import FileBackend, Recorder
from benchmarks.backends.requirements import need

if TYPE_CHECKING:
    from rosbags.interfaces import Connection

    from hybridlog_storage.messages import Channel

_ANY_MD5 = "*"


class BagFile(FileBackend):
    """An uncompressed bag, as `rosbag record` writes it: the paper's flat file.

    A load of ROS 1 messages makes a ROS 1 bag; a load of ROS 2 messages makes a ROS 2 bag
    with SQLite storage, which is a directory.
    """

    name = "bagfile"
    about = "a ROS bag, written by rosbags: ROS 1 format, or ROS 2 with SQLite storage for CDR"
    suffix = ".bag"

    @classmethod
    def check(cls) -> None:
        need("rosbags", "rosbags")

    def _check_channels(self, channels: Sequence[Channel]) -> None:
        encodings = {channel.message_encoding for channel in channels}
        if len(encodings) > 1 or not encodings <= {"ros1", "cdr"}:
            raise BackendMissingError(
                f"A bag holds messages of ROS 1 or of ROS 2, not {', '.join(sorted(encodings))}: "
                "leave the backend bagfile out for this load."
            )

    def _record(self, path: Path) -> Recorder:
        if self._channels[0].message_encoding == "ros1":
            return _Ros1Recorder(path, self._channels)
        return _Ros2Recorder(path, self._channels)

    def _count(self, path: Path) -> Mapping[str, int]:
        from rosbags.rosbag1 import Reader as Ros1Reader
        from rosbags.rosbag2 import Reader as Ros2Reader

        reader: Any = Ros2Reader(path) if path.is_dir() else Ros1Reader(path)
        with reader:
            found = Counter((c.id, c.topic) for c, _, _ in reader.messages())
        topics: Counter[str] = Counter()
        for (number, topic), count in found.items():
            topics[topic if path.is_dir() else self._as_given(number, topic)] += count
        return topics

    def _as_given(self, number: int, topic: str) -> str:
        """A topic as its channel spells it: rosbags leaves out slashes that say nothing."""
        if number < len(self._channels):
            given = self._channels[number].topic
            if [part for part in given.split("/") if part] == topic.strip("/").split("/"):
                return given
        return topic


class _Ros1Recorder:
    def __init__(self, path: Path, channels: Sequence[Channel]) -> None:
        from rosbags.rosbag1 import Writer

        self._writer = Writer(path)
        self._writer.open()
        self._connections = [self._add(number, c) for number, c in enumerate(channels)]

    def _add(self, number: int, channel: Channel) -> Connection:
        from rosbags.typesys.msg import normalize_msgtype

        schema = channel.schema
        latching = channel.metadata.get("latching", "")
        return self._writer.add_connection(
            channel.topic,
            normalize_msgtype(schema.name if schema is not None else "unknown/Unknown"),
            msgdef=schema.data.decode("utf-8", "replace") if schema is not None else "",
            md5sum=channel.metadata.get("md5sum") or _ANY_MD5,
            # Two connections of a topic differ in who sent, or rosbags refuses the second.
            callerid=channel.metadata.get("callerid") or f"/publisher_{number}",
            latching=int(latching) if latching in {"0", "1"} else None,
        )

    def write(self, channel: int, log_time: int, payload: bytes) -> None:
        self._writer.write(self._connections[channel], log_time, payload)

    def close(self) -> None:
        self._writer.close()


class _Ros2Recorder:
    def __init__(self, path: Path, channels: Sequence[Channel]) -> None:
        from rosbags.rosbag2 import StoragePlugin, Writer
        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

        class Storage(Sqlite3Writer):
            """Written by several threads, one at a time."""

            def __init__(self, path: Path, compression: Any) -> None:
                super().__init__(path, compression)
                self.conn.close()
                self.conn = sqlite3.connect(self.path, check_same_thread=False)
                self.cursor = self.conn.cursor()

        class BagWriter(Writer):
            STORAGE_PLUGINS = {StoragePlugin.SQLITE3: Storage}  # noqa: RUF012 - as in the base

        self._writer = BagWriter(
            path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.SQLITE3
        )
        self._writer.open()
        self._known: dict[tuple[str, str], Connection] = {}
        self._connections = [self._add(channel) for channel in channels]

    def _add(self, channel: Channel) -> Connection:
        from rosbags.typesys.msg import normalize_msgtype

        schema = channel.schema
        kind = normalize_msgtype(schema.name) if schema is not None else "unknown/msg/Unknown"
        key = (channel.topic, kind)
        if key not in self._known:
            definition = schema.data if schema is not None else b""
            self._known[key] = self._writer.add_connection(
                channel.topic,
                kind,
                msgdef=definition.decode("utf-8", "replace"),
                # Stands where the type's hash of its source is not known.
                rihs01="RIHS01_" + hashlib.sha256(definition).hexdigest(),
            )
        return self._known[key]

    def write(self, channel: int, log_time: int, payload: bytes) -> None:
        self._writer.write(self._connections[channel], log_time, payload)

    def close(self) -> None:
        self._writer.close()
