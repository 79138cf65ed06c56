"""Logs of many topics, and what a mongod takes."""

from __future__ import annotations

import struct
from pathlib import Path

from mcap.writer import Writer

import hybridlog as hl

BASE = 1_600_000_000 * 10**9


def topic(number: int, prefix: str = "/robot") -> str:
    """The name of a topic."""
    return f"{prefix}/sub{number // 50}/signal{number}"


def write_log(
    path: Path, topics: int, messages: int = 5, *, start: int = BASE, prefix: str = "/robot"
) -> Path:
    """Write a log of Float32 topics; message `m` of topic `t` says `m + t / 65536`."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1", library="test")
        schema = writer.register_schema("std_msgs/Float32", "ros1msg", b"float32 data\n")
        channels = [
            writer.register_channel(topic(number, prefix), "ros1", schema)
            for number in range(topics)
        ]
        time = start
        for message in range(messages):
            for number, channel in enumerate(channels):
                data = struct.pack("<f", message + number / 65536)
                writer.add_message(channel, time, data, time)
                time += 10**5
        writer.finish()
    return path


def mongod_of(store: hl.Store) -> Path:
    """The directory in /proc of the embedded mongod."""
    return Path("/proc", (store.directory.mongod / "data/mongod.lock").read_text().strip())
