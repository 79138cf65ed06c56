"""A known sequence of messages, and what is right about the beginning of it.

Written once more in plain Python, and decoded by nobody: each message has its fields from
where it was made. Nothing of the project answers here.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hybridlog_storage.messages import Channel, Schema

MS = 10**6
SECOND = 10**9
START = 1_700_000_000 * SECOND
STEP = 20 * MS

_RULE = "=" * 80
_HEADER = (
    f"{_RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    f"{_RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
_ARM = "std_msgs/Header header\nint32 n\nfloat64[] position\nfloat32[] ranges\nstring name\n"
_IMAGE = (
    "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data\n"
)
_MARK = (
    b'{"type":"object","properties":{"text":{"type":"string"},'
    b'"tags":{"type":"object","additionalProperties":{"type":"string"}}}}'
)

SAID = Channel("/said", "json", Schema("demo/Said", "jsonschema", b"{}"))
ARM = Channel("/arm", "cdr", Schema("demo/msg/Arm", "ros2msg", (_ARM + _HEADER).encode()))
CAMERA = Channel(
    "/cam", "cdr", Schema("sensor_msgs/msg/Image", "ros2msg", (_IMAGE + _HEADER).encode())
)
MAP = Channel(
    "/map",
    "ros1",
    Schema("std_msgs/String", "ros1msg", b"string data\n"),
    {"latching": "1", "callerid": "/map_server", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"},
)
OPAQUE = Channel("/opaque", "cbor", None)
MARKS = Channel("/hybridlog/marks", "json", Schema("hybridlog.Mark", "jsonschema", _MARK), {})
CHANNELS = {channel.topic: channel for channel in (SAID, ARM, CAMERA, MAP, OPAQUE, MARKS)}

_types = get_typestore(Stores.ROS2_HUMBLE)
_types.register(get_types_from_msg(_ARM, "demo/msg/Arm"))


@dataclass(frozen=True, slots=True)
class Sent:
    """A message as it is written.

    Attributes:
        topic: Its topic.
        log_time: Log time, ns.
        publish_time: Publish time, ns.
        stamp: Header stamp, ns; None without a header.
        seq: Arrival number.
        fields: Its fields; None if nobody can decode it.
        raw: Its payload.
    """

    topic: str
    log_time: int
    publish_time: int
    stamp: int | None
    seq: int
    fields: dict[str, Any] | None
    raw: bytes

    @property
    def order(self) -> tuple[int, int]:
        return self.log_time, self.seq


def time_of(step: int) -> int:
    """Log time of a step: each tenth one is 50 ms late."""
    return START + step * STEP - (50 * MS if step % 10 == 9 else 0)


def _said(step: int) -> tuple[dict[str, Any], bytes]:
    fields = {
        "n": step,
        "x": math.floor(1000 * math.sin(step / 9)) / 8,
        "state": "abc"[step // 17 % 3],
        "list": [step, 2 * step, step % 3],
        "big": 2**53 + step,
        "pad": f"{step:x}" * 30,
    }
    return fields, json.dumps(fields).encode()


def _header(stamp: int) -> Any:
    made = _types.types
    time = made["builtin_interfaces/msg/Time"](*divmod(stamp, SECOND))
    return made["std_msgs/msg/Header"](stamp=time, frame_id="base")


def _arm(step: int, stamp: int) -> tuple[dict[str, Any], bytes]:
    position = [step / 4, -step / 8, 1.0]
    ranges = [float(step % 7) + k / 4 for k in range(100)]
    message = _types.types["demo/msg/Arm"](
        header=_header(stamp),
        n=step,
        position=np.array(position, np.float64),
        ranges=np.array(ranges, np.float32),
        name=f"arm {step % 4}",
    )
    fields = {
        "header": {"stamp": stamp, "frame_id": "base"},
        "n": step,
        "position": position,
        "ranges": ranges,
        "name": f"arm {step % 4}",
    }
    return fields, bytes(_types.serialize_cdr(message, "demo/msg/Arm"))


def _image(step: int, stamp: int) -> tuple[dict[str, Any], bytes]:
    data = np.arange(step, step + 8 * 6 * 3).astype(np.uint8)
    shape = {"height": 6, "width": 8, "encoding": "rgb8", "is_bigendian": 0, "step": 24}
    message = _types.types["sensor_msgs/msg/Image"](header=_header(stamp), **shape, data=data)
    fields = {"header": {"stamp": stamp, "frame_id": "base"}, **shape, "data": data.tolist()}
    return fields, bytes(_types.serialize_cdr(message, "sensor_msgs/msg/Image"))


def _of_step(step: int) -> Iterable[tuple[str, int | None, dict[str, Any] | None, bytes]]:
    """Topic, stamp, fields and payload of each message of a step."""
    now = time_of(step)
    if step % 60 == 1:
        text = f"map {step}".encode()
        yield MAP.topic, None, {"data": text.decode()}, struct.pack("<I", len(text)) + text
    yield SAID.topic, None, *_said(step)
    if step % 2 == 0:
        stamp = now - 300 * MS - step % 5 * 7 * MS
        yield ARM.topic, stamp, *_arm(step, stamp)
    if step % 8 == 3:
        yield CAMERA.topic, now - 40 * MS, *_image(step, now - 40 * MS)
    if step % 5 == 0:
        yield OPAQUE.topic, None, None, bytes([step % 256]) * 5
    if step % 50 == 20:
        fields = {"text": f"mark {step}", "tags": {"step": str(step)}}
        yield MARKS.topic, None, fields, json.dumps(fields).encode()


def messages(begin: int, end: int, first: int) -> list[Sent]:
    """The messages of some steps.

    Args:
        begin: The first step.
        end: The step after the last one.
        first: Arrival number of the first message.
    """
    found: list[Sent] = []
    for step in range(begin, end):
        for topic, stamp, fields, raw in _of_step(step):
            sent = time_of(step) - (step * 13 % 50) * MS
            seq = first + len(found)
            found.append(Sent(topic, time_of(step), sent, stamp, seq, fields, raw))
    return found


class Known:
    """The beginning of the sequence, by topic.

    Args:
        sent: All messages in the order in which they were written.
        counts: The number of messages of each topic that are there; None for all.

    Attributes:
        sent: Those that are there, in the order in which they were written.
    """

    def __init__(self, sent: Iterable[Sent], counts: dict[str, int] | None = None) -> None:
        left = None if counts is None else dict(counts)
        self.sent: list[Sent] = []
        for one in sent:
            if left is None:
                self.sent.append(one)
            elif left.get(one.topic, 0) > 0:
                left[one.topic] -= 1
                self.sent.append(one)
        assert left is None or not any(left.values()), "more messages than were written"

    @property
    def counts(self) -> dict[str, int]:
        """The number of messages of each topic."""
        found = dict.fromkeys(CHANNELS, 0)
        for one in self.sent:
            found[one.topic] += 1
        return found

    @property
    def span(self) -> tuple[int, int]:
        """First and last log time, ns."""
        times = [one.log_time for one in self.sent]
        return min(times), max(times)

    def of(
        self,
        *topics: str,
        between: tuple[int, int] | None = None,
        clock: str = "log",
        where: Callable[[dict[str, Any]], bool] | None = None,
    ) -> list[Sent]:
        """Messages in the order of an answer.

        Args:
            topics: Their topics; without, all.
            between: `[begin, end)`, ns.
            clock: The clock of it.
            where: What their fields satisfy.
        """
        found = [one for one in self.sent if not topics or one.topic in topics]
        if between is not None:
            begin, end = between
            found = [one for one in found if begin <= time_by(one, clock) < end]
        if where is not None:
            found = [one for one in found if one.fields is not None and where(one.fields)]
        return sorted(found, key=lambda one: one.order)

    def clock_span(self, clock: str, topics: Collection[str]) -> tuple[int, int]:
        """`[first, end)` of some topics by a clock, ns."""
        times = [time_by(one, clock) for one in self.of(*topics)]
        return min(times), max(times) + 1


def time_by(one: Sent, clock: str) -> int:
    """The time of a message by a clock, ns."""
    if clock == "publish":
        return one.publish_time
    if clock == "header":
        assert one.stamp is not None
        return one.stamp
    return one.log_time
