"""Logs of many topics."""

from __future__ import annotations

import struct
from pathlib import Path

from hybridlog_storage.messages import Channel, Schema
from tests.independent import write_mcap

BASE = 1_600_000_000 * 10**9
FLOAT = Schema("std_msgs/Float32", "ros1msg", b"float32 data\n")


def topic(number: int, prefix: str = "/robot") -> str:
    """The name of a topic."""
    return f"{prefix}/sub{number // 50}/signal{number}"


def write_log(
    path: Path, topics: int, messages: int = 5, *, start: int = BASE, prefix: str = "/robot"
) -> Path:
    """Write a log of Float32 topics; message `m` of topic `t` says `m + t / 65536`."""
    channels = [Channel(topic(number, prefix), "ros1", FLOAT) for number in range(topics)]
    values = [m + n / 65536 for m in range(messages) for n in range(topics)]
    said = [
        (channels[at % topics], start + at * 10**5, struct.pack("<f", value))
        for at, value in enumerate(values)
    ]
    return write_mcap(path, said)
