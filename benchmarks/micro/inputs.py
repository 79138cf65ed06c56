"""What the benchmarks read: ROS 1 bags made once, so that both sources get equal bytes.

They are read by rosbags, not by the source that is measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from rosbags.rosbag1 import Reader

from benchmarks.micro.isolation import need

SMALL = "small.bag"
"""A thousand poses, IMU messages, transforms and joint states each."""
IMU = "imu.bag"
"""20 000 IMU messages at 200 Hz."""
DRIVE = "drive.bag"
"""Four seconds of a laser scanner and two cameras, 307 kB an image."""

_SEED = 1


def make(directory: Path) -> None:
    """Write the bags.

    Args:
        directory: It exists.
    """
    from benchmarks.speed import logs

    logs.write_small(directory / SMALL, 4000, _SEED)
    logs.write_imu(directory / IMU, 20_000, _SEED)
    logs.write_drive(directory / DRIVE, 4.0, _SEED)


@dataclass(frozen=True, eq=False, slots=True)
class Stream:
    """The messages of one topic.

    Attributes:
        topic: Name.
        msgtype: As ROS 1 spells it.
        definition: Text of the definition.
        payloads: In order of log time.
        log_times: ns.
    """

    topic: str
    msgtype: str
    definition: bytes
    payloads: list[bytes]
    log_times: list[int]

    def channel(self) -> object:
        """The `Channel` of the source that is measured."""
        found = need("hybridlog_storage.messages", "Channel", "Schema")
        schema = found.Schema(self.msgtype, "ros1msg", self.definition)
        return found.Channel(self.topic, "ros1", schema, {}, has_publish_time=False)

    def batches(self, size: int) -> list[object]:
        """All messages, `size` to a `Batch` of the source that is measured."""
        found = need("hybridlog_storage.messages", "Batch")
        made = []
        for first in range(0, len(self.payloads), size):
            payloads = self.payloads[first : first + size]
            length = np.array([len(payload) for payload in payloads], np.int64)
            log_time = np.array(self.log_times[first : first + size], np.int64)
            made.append(
                found.Batch(
                    b"".join(payloads),
                    np.cumsum(length) - length,
                    length,
                    np.zeros(len(payloads), np.int32),
                    log_time,
                    log_time,
                    np.zeros(len(payloads), np.uint32),
                )
            )
        return made


@lru_cache(maxsize=8)
def read(bag: Path, topic: str, limit: int) -> Stream:
    """The first messages of a topic.

    Args:
        bag: One of the bags.
        topic: One of its topics.
        limit: Most messages.

    Raises:
        StopIteration: There is no such topic.
    """
    with Reader(bag) as reader:
        connection = next(c for c in reader.connections if c.topic == topic)
        stream = Stream(
            topic,
            connection.msgtype.replace("/msg/", "/"),
            connection.msgdef.data.encode(),
            [],
            [],
        )
        for _, log_time, payload in reader.messages([connection]):
            if len(stream.payloads) == limit:
                break
            stream.payloads.append(bytes(payload))
            stream.log_times.append(log_time)
    return stream
