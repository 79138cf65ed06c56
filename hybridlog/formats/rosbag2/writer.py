"""Writes bags of ROS 2: a directory with MCAP files and `metadata.yaml`, as Jazzy writes it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import yaml
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from hybridlog.formats.mcap.writer import McapWriter
from hybridlog.formats.rosbag2.directory import NAME
from hybridlog.formats.writing import FileWriter, Target, failures, new_directory
from hybridlog.formats.yaml_values import YamlError, parse_yaml
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Batch, Channel
    from hybridlog_storage.segments.attachments import Attachment

MAX_FILE: Final = 2 << 30
"""Bytes of payload at which a file ends."""
_VERSION: Final = 9


@dataclass(slots=True)
class _Span:
    """Messages of a file or of the bag."""

    messages: int = 0
    first: int = 2**63 - 1
    last: int = 0

    def add(self, batch: Batch) -> None:
        self.messages += len(batch)
        self.first = min(self.first, int(batch.log_time.min()))
        self.last = max(self.last, int(batch.log_time.max()))

    def described(self) -> dict[str, Any]:
        first = self.first if self.messages else 0
        return {
            "duration": {"nanoseconds": self.last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self.messages,
        }


@dataclass(slots=True)
class _Topic:
    """A topic of one type, with the hash of its type."""

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


class Rosbag2Writer(FileWriter):
    """Writes a bag.

    Args:
        target: Its directory, which must be missing or empty.
        max_file: Bytes of payload at which a file ends.

    Raises:
        UsageError: The target is a stream, not empty, or cannot be written.
    """

    def __init__(self, target: Target, *, max_file: int = MAX_FILE) -> None:
        super().__init__()
        if not isinstance(target, str | os.PathLike):
            raise UsageError("rosbag2 makes a directory: name one with -o.")
        self._name = os.fspath(target)
        self._max_file = max_file
        with failures(self._name):
            self._final, self._unfinished = new_directory(target, "a bag of ROS 2 is a directory")
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._known: dict[Channel, _Topic] = {}
        self._files: dict[str, _Span] = {}
        self._all = _Span()
        self._log: McapWriter | None = None
        self._size = 0

    def write(self, batch: Batch, channels: Sequence[Channel]) -> None:
        """Append messages in the order of the rows.

        Raises:
            UsageError: A channel has another encoding than CDR, or a time is before 1970.
            DiskFullError: No space left.
        """
        if not len(batch):
            return
        topics = {number: self._topic(channels[number]) for number in set(batch.channel.tolist())}
        for number in batch.channel.tolist():
            topics[number].messages += 1
        if self._log is None or self._size >= self._max_file:
            self._next_file()
        assert self._log is not None
        self._log.write(batch, channels)
        self._size += batch.payload_bytes
        self._all.add(batch)
        self._files[next(reversed(self._files))].add(batch)

    def declare(self, channels: Sequence[Channel]) -> None:
        """Add channels, which need have no messages; those that fit into no bag are left out."""
        for channel in channels:
            if channel.message_encoding == "cdr" and channel.schema is not None:
                self._topic(channel)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a metadata record to the current file."""
        self._current().add_metadata(name, values)

    def add_attachment(self, attachment: Attachment) -> None:
        """Add an attachment to the current file, piece by piece."""
        self._current().add_attachment(attachment)

    def _current(self) -> McapWriter:
        if self._log is None:
            self._next_file()
        assert self._log is not None
        return self._log

    def _next_file(self) -> None:
        if self._log is not None:
            self._log.close()
        name = f"{self._final.name}_{len(self._files)}.mcap"
        self._files[name] = _Span()
        self._size = 0
        self._log = McapWriter(self._unfinished.path / name, profile="ros2")

    def _topic(self, channel: Channel) -> _Topic:
        if channel not in self._known:
            if channel.message_encoding != "cdr" or channel.schema is None:
                raise UsageError(
                    f"{channel.topic} has {channel.message_encoding or 'unknown'} messages"
                    f"{'' if channel.schema else ' without a definition'}, and a ROS 2 bag holds "
                    "ROS 2 messages only; nothing is converted, so that every byte stays as it "
                    "came: write --format mcap, or leave the topic out with -t"
                )
            own = _Topic(channel.metadata.get("topic_type_hash", "").strip())
            found = self._topics.setdefault((channel.topic, channel.schema.name), own)
            found.offered[channel.metadata.get("offered_qos_profiles", "")] = None
            self._known[channel] = found
        return self._known[channel]

    def _finish(self) -> None:
        self._current().close()
        bag = {
            "version": _VERSION,
            "storage_identifier": "mcap",
            **self._all.described(),
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
                for (name, kind), topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [*self._files],
            "files": [{"path": name, **one.described()} for name, one in self._files.items()],
            "custom_data": None,
            "ros_distro": "hybridlog",
        }
        described = {"rosbag2_bagfile_information": bag}
        text = yaml.dump(described, Dumper=yaml.CSafeDumper, sort_keys=False, width=1 << 20)
        with failures(self._name):
            with (self._unfinished.path / NAME).open("x", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            self._unfinished.publish(self._final)

    def _discard(self) -> None:
        if self._log is not None:
            self._log.abort()
        self._unfinished.remove()
