"""Batches for the tests of writers."""

from __future__ import annotations

import numpy as np

from hybridlog_storage.messages import Batch, Channel, Schema

STRING = Schema("std_msgs/String", "ros1msg", b"string data\n")
STRING_MD5 = "992ce8a1687cec8c8bd883ec73ca41d1"


def ros1_channels() -> list[Channel]:
    return [
        Channel(
            "/chatter",
            "ros1",
            STRING,
            {"md5sum": STRING_MD5, "callerid": "/talker", "latching": "1", "hybridlog.x": "y"},
        ),
        Channel("/chatter", "ros1", STRING, {"md5sum": STRING_MD5, "callerid": "/other"}),
        Channel(
            "odd topic/é",
            "ros1",
            Schema("my_msgs/Odd", "ros1msg", b"# caf\xe9, in Latin-1\nint32 x\n"),
            {"md5sum": "0123456789abcdef0123456789abcdef"},
        ),
    ]


def batch(
    payloads: list[bytes],
    channel: list[int],
    log_time: list[int],
    publish_time: list[int] | None = None,
) -> Batch:
    """Payloads behind three bytes that belong to nobody."""
    length = np.array([len(payload) for payload in payloads], np.int64)
    offset = 3 + np.concatenate([[0], np.cumsum(length)[:-1]]).astype(np.int64)
    if not payloads:
        offset = np.zeros(0, np.int64)
    return Batch(
        b"???" + b"".join(payloads),
        offset,
        length,
        np.array(channel, np.int32),
        np.array(log_time, np.int64),
        np.array(publish_time or log_time, np.int64),
        np.arange(len(payloads), dtype=np.uint32) + 7,
    )


def many(count: int, *, channels: int = 3, start: int = 10**18) -> Batch:
    """Messages of growing size, two to a nanosecond."""
    return batch(
        [bytes([row % 256]) * (row % 50) for row in range(count)],
        [row % channels for row in range(count)],
        [start + row // 2 for row in range(count)],
        [start + row // 2 - 5 for row in range(count)],
    )
