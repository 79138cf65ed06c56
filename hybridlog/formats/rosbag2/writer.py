"""Writes bags of ROS 2, as Jazzy writes them: a directory with files and `metadata.yaml`."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import yaml
from msgspec import Struct, field
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

from hybridlog.formats.log_set import NAME
from hybridlog.formats.mcap.writer import McapWriter
from hybridlog.formats.writing import Answer, LogWriter, Target, failures, new_directory, path_of
from hybridlog.formats.yaml_values import YamlError, parse_yaml
from hybridlog_storage.errors import DiskFullError, HybridlogError, UsageError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Batch, Channel
    from hybridlog_storage.segments.segment_format import Attachment

STORAGES: Final = {"mcap": ".mcap", "sqlite3": ".db3"}
"""Suffixes of files by the storage of a bag."""
_VERSION: Final = 9
_TABLES: Final = f"{Sqlite3Writer.SQLITE_SCHEMA} UPDATE schema SET ros_distro = 'hybridlog';"  # noqa: S608


class _Topic(Struct):
    """A topic of one type."""

    number: int
    channel: Channel
    type_hash: str
    messages: int = 0
    offered: dict[str, None] = field(default_factory=dict)

    def profiles(self) -> list[Any]:
        """The QoS profiles that were offered, without those that cannot be read."""
        found: list[Any] = []
        for text in self.offered:
            with suppress(YamlError, KeyError, TypeError, ValueError, AttributeError):
                listed: Any = parse_yaml(text) or []
                found += [one for one in dump_qos_v9(parse_qos(listed)) if one not in found]
        return found


def write_rosbag2(answer: Answer, target: Target, **settings: Any) -> None:
    """Write a bag of ROS 2, with the settings of a `Rosbag2Writer`."""
    with Rosbag2Writer(target, **settings) as bag:
        bag.write_answer(answer)


class Rosbag2Writer(LogWriter):
    """Writes a bag."""

    def __init__(self, target: Target, *, storage: str = "mcap") -> None:
        self._storage = storage
        path = path_of(target, "rosbag2", "a directory")
        self._name = os.fspath(path)
        with failures(self._name):
            self._final, self._unfinished = new_directory(path, "a bag of ROS 2 is a directory")
        self.topics: dict[tuple[str, str], _Topic] = {}
        self._messages, self._first, self._last = 0, 2**63 - 1, 0
        self._file = f"{self._final.name}_0{STORAGES[storage]}"
        place = self._unfinished.path / self._file
        is_mcap = storage == "mcap"
        self._log = McapWriter(place, profile="ros2") if is_mcap else _SqliteFile(place, self)

    def write(self, batch: Batch, channels: Sequence[Channel]) -> None:
        """Append messages in the order of the rows."""
        if not len(batch):
            return
        topics = {number: self.topic(channels[number]) for number in set(batch.channel.tolist())}
        for number in batch.channel.tolist():
            topics[number].messages += 1
        self._log.write(batch, channels)
        self._messages += len(batch)
        self._first = min(self._first, int(batch.log_time.min()))
        self._last = max(self._last, int(batch.log_time.max()))

    def declare(self, channels: Sequence[Channel]) -> None:
        """Add channels, which need have no messages; those that fit into no bag are left out."""
        for channel in channels:
            if channel.message_encoding == "cdr" and channel.schema is not None:
                self.topic(channel)
                self._log.declare([channel])

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record, in MCAP."""
        self._log.add_metadata(name, values)

    def add_attachment(self, attachment: Attachment) -> None:
        """Add an attachment, piece by piece, in MCAP."""
        self._log.add_attachment(attachment)

    def topic(self, channel: Channel) -> _Topic:
        """The topic of a channel."""
        if channel.message_encoding != "cdr" or channel.schema is None:
            cure = "write --format mcap"
            if channel.message_encoding == "ros1":
                cure = "write --format bag, and convert that with rosbags-convert"
            raise UsageError(
                f"{channel.topic} has {channel.message_encoding or 'unknown'} messages"
                f"{'' if channel.schema else ' without a definition'}, and a ROS 2 bag holds "
                "ROS 2 messages only; nothing is converted, so that every byte stays as it "
                f"came: {cure}, or leave the topic out with -t"
            )
        type_hash = channel.metadata.get("topic_type_hash", "").strip()
        own = _Topic(len(self.topics) + 1, channel, type_hash)
        found = self.topics.setdefault((channel.topic, channel.schema.name), own)
        found.offered[channel.metadata.get("offered_qos_profiles", "")] = None
        return found

    def commit(self) -> None:
        """Complete the bag."""
        self._log.commit()
        described = {"rosbag2_bagfile_information": self.described()}
        with failures(self._name):
            with (self._unfinished.path / NAME).open("x", encoding="utf-8") as file:
                file.write(_yaml(described))
                file.flush()
                os.fsync(file.fileno())
            self._unfinished.publish(self._final)

    def described(self) -> dict[str, Any]:
        """The metadata of the bag so far."""
        first = self._first if self._messages else 0
        span = {
            "duration": {"nanoseconds": self._last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self._messages,
        }
        return {
            "version": _VERSION,
            "storage_identifier": self._storage,
            **span,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": name,
                        "type": kind,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": topic.profiles(),
                        "type_description_hash": topic.type_hash,
                    },
                    "message_count": topic.messages,
                }
                for (name, kind), topic in self.topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self._file],
            "files": [{"path": self._file, **span}],
            "custom_data": None,
            "ros_distro": "hybridlog",
        }

    def abort(self) -> None:
        """Remove the bag."""
        self._log.abort()
        self._unfinished.remove()


class _SqliteFile(LogWriter):
    """A file of a bag in SQLite; times of publication and attachments have no place in it."""

    def __init__(self, path: Path, bag: Rosbag2Writer) -> None:
        self._path = path
        self._bag = bag
        with self._failures():
            self._db = sqlite3.connect(path)
            # The file is complete, or it is removed.
            self._db.executescript(f"PRAGMA journal_mode=OFF; PRAGMA synchronous=OFF; {_TABLES}")

    def write(self, batch: Batch, channels: Sequence[Channel]) -> None:
        """Append messages in the order of the rows."""
        numbers = {n: self._bag.topic(channels[n]).number for n in set(batch.channel.tolist())}
        rows = (
            (numbers[channel], time, batch.payload(row))
            for row, (channel, time) in enumerate(
                zip(batch.channel.tolist(), batch.log_time.tolist(), strict=True)
            )
        )
        with self._failures():
            self._db.executemany(
                "INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", rows
            )

    def commit(self) -> None:
        """Complete the file."""
        types: dict[str, tuple[str, str, str, str]] = {}
        with self._failures():
            for (name, kind), topic in self._bag.topics.items():
                row = (topic.number, name, kind, "cdr", _yaml(topic.profiles()), topic.type_hash)
                self._db.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)", row)
                schema = topic.channel.schema
                assert schema is not None
                text = schema.data.decode(errors="replace")
                if text:  # readers refuse a definition that is empty
                    types.setdefault(kind, (kind, schema.encoding, text, topic.type_hash))
            self._db.executemany(
                "INSERT INTO message_definitions(topic_type, encoding, "
                "encoded_message_definition, type_description_hash) VALUES (?, ?, ?, ?)",
                types.values(),
            )
            self._db.execute(
                "INSERT INTO metadata(metadata_version, metadata) VALUES (?, ?)",
                (_VERSION, _yaml(self._bag.described())),
            )
            self._db.commit()
            self._db.close()
            with self._path.open("rb") as file:
                os.fsync(file.fileno())

    def abort(self) -> None:
        """Close the file, which will be removed."""
        self._db.close()

    @contextmanager
    def _failures(self) -> Iterator[None]:
        try:
            with failures(os.fspath(self._path)):
                yield
        except sqlite3.Error as error:
            full = getattr(error, "sqlite_errorcode", 0) == sqlite3.SQLITE_FULL
            kind = DiskFullError if full else HybridlogError
            raise kind(f"writing {self._path} failed: {error}") from error


def _yaml(value: object) -> str:
    text: str = yaml.dump(value, Dumper=yaml.CSafeDumper, sort_keys=False, width=1 << 20)
    return text
