"""A recording of odd messages: deep, long, hostile, damaged, at equal times, and text logs."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from tests.ros_values import ROS1, ROS2

MS = 10**6
START = 1_748_937_600 * 10**9
HOSTILE = '/<img src=x onerror="document.title=1">/\'"`\\{}%s'
"""Name of a topic that is markup, quotes and escapes."""

OWN = b"""\
bool ok
uint64 id
float32 ratio
string name
time at
duration took
uint8[] data
float64[3] axis
Point[] path
string[] words
bool[] flags
================================================================================
MSG: own/Point
float64 x
"""
LONG = 5000
"""Elements of the long arrays."""


def own_payload(n: int) -> bytes:
    """Message n of `/own`."""
    text = f"name {n}".encode()
    return (
        struct.pack("<?Qf", n % 2 == 0, 2**64 - 1 - n, 0.1 * n)
        + struct.pack(f"<I{len(text)}s", len(text), text)
        + struct.pack("<IIii", 1_748_937_600 + n, 5, -3, 500_000_000)
        + struct.pack("<I", LONG)
        + bytes(k * 7 % 256 for k in range(LONG))
        + struct.pack("<3d", n, float("nan"), float("-inf"))
        + struct.pack("<I", 40)
        + struct.pack("<40d", *(k + n / 8 for k in range(40)))
        + struct.pack("<II1sI", 2, 1, b"w", 0)
        + struct.pack("<I2?", 2, True, False)
    )


def deep(levels: int) -> Any:
    """Objects within lists, so many levels."""
    value: Any = "bottom"
    for _ in range(levels):
        value = {"next": [value]}
    return value


LOOSE: Sequence[Any] = (
    {
        "<b>": "<script>alert(1)</script>",
        "big": 2**70,
        "exact": 9007199254740993,
        "mixed": [1, "a", None, {"k": 1}, {"other": True}],
        "none": None,
        "empty": {},
        "nothing": [],
        "long": "x" * 5000,
        "lone": "\ud800",
        "1.5": 1.5,
    },
    {"deep": deep(60), "n": 2},
    {"many": {f"key {n}": n for n in range(3000)}, "n": 3},
    {
        "grid": [[[0] * 40] * 40] * 40,
        "wide": {f"a{n}": {f"b{k}": k for k in range(60)} for n in range(60)},
        "n": 4,
    },
    ["a list", 5],
)

LOGS: Sequence[tuple[int, str, str]] = tuple(
    (n % 5, f"/node_{n % 3}", f'line {n} (100%) "quoted" \\ é\n<b>second</b> ' + "." * (n % 7))
    for n in range(240)
)
"""Level from 0 (debug) to 4 (fatal), sender, text."""


def ros_channel(topic: str, name: str, ros: int) -> Channel:
    types = ROS1 if ros == 1 else ROS2
    text = types.generate_msgdef(name, ros_version=ros)[0].encode()
    spelled = name.replace("/msg/", "/") if ros == 1 else name
    encoding = "ros1" if ros == 1 else "cdr"
    return Channel(topic, encoding, Schema(spelled, f"ros{ros}msg", text))


def log_time(n: int) -> int:
    """Log time of line n: five lines at each time."""
    return START + (n // 5) * 50 * MS


def write_odd(store: hl.Store, label: str = "odd") -> None:
    """Record all of it."""
    own = Channel("/own", "ros1", Schema("own/Own", "ros1msg", OWN))
    loose = Channel("/loose", "json", None)
    rosout = ros_channel("/rosout", "rosgraph_msgs/msg/Log", 1)
    rcl = ros_channel("/rosout2", "rcl_interfaces/msg/Log", 2)
    foxglove = Channel("/fox", "json", Schema("foxglove.Log", "jsonschema", b"{}"))
    chat = ros_channel(HOSTILE, "std_msgs/msg/String", 1)
    header = struct.pack("<IIII", 0, 0, 0, 0)
    with store.start(label) as recording:
        for n in range(5):
            recording.write(own, own_payload(n), log_time=START + n * 1000 * MS)
            text = json.dumps(LOOSE[n]).encode()
            recording.write(loose, text, log_time=START + n * 1000 * MS)
        # Three at one time: the last one is current. Then one that is cut.
        for n in (5, 6, 7):
            recording.write(own, own_payload(n), log_time=START + 5000 * MS)
        recording.write(own, own_payload(8)[:30], log_time=START + 6000 * MS)
        recording.write(loose, b"{not json", log_time=START + 6000 * MS)
        for n, (level, name, text) in enumerate(LOGS):
            at = log_time(n)
            data = text.encode()
            said = struct.pack(f"<I{len(data)}s", len(data), data)
            sender = struct.pack(f"<I{len(name)}s", len(name), name.encode())
            body = header + struct.pack("<b", 1 << level) + sender + said
            recording.write(rosout, body + struct.pack("<IIII", 0, 0, 0, 0), log_time=at)
            types = ROS2.types
            stamp = types["builtin_interfaces/msg/Time"](sec=n, nanosec=0)
            line = types["rcl_interfaces/msg/Log"](
                stamp=stamp,
                level=10 * (level + 1),
                name=name,
                msg=text,
                file="",
                function="",
                line=n,
            )
            cdr = bytes(ROS2.serialize_cdr(line, "rcl_interfaces/msg/Log"))
            recording.write(rcl, cdr, log_time=at)
            as_json = {"level": level + 1, "name": name, "message": text}
            recording.write(foxglove, json.dumps(as_json).encode(), log_time=at)
            recording.write(chat, said, log_time=at)
        recording.write(rosout, b"short", log_time=log_time(len(LOGS)))
