"""An MCAP file with everything that a log should not have."""

from __future__ import annotations

import struct
from pathlib import Path

from mcap.writer import CompressionType

from hybridlog_storage.messages import Channel, Schema
from tests.independent import write_mcap

START = 10**18
STEP = 10**8
HOSTILE_NAME = "/\x1b[31mred\x07\n/x"
PER_TOPIC = 3


def text(value: str) -> bytes:
    data = value.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def number(value: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<i", value)


def claims_4_gb() -> bytes:
    return b"\0\1\0\0" + struct.pack("<I", 0xFFFFFFFF) + b"xx"


def write(path: Path) -> None:
    """Three messages a topic and type, all in order of log time."""

    def define(name: str, definition: str) -> Schema:
        return Schema(name, "ros2msg", definition.encode())

    string = define("std_msgs/msg/String", "string data\n")
    integer = define("std_msgs/msg/Int32", "int32 data\n")
    code = define("x/msg/Code", 'int32 __import__("os").system("true")\n')
    recursive = define("x/msg/Recursive", "x/Recursive child\n")
    long = define("x/msg/Long", "uint8[] data\n")
    parts = [
        (Channel("/a/b", "cdr", string), text("one")),
        (Channel("/a__b", "cdr", string), text("two")),
        (Channel("a/b", "cdr", string), text("three")),
        (Channel("/code", "cdr", code), number(1)),
        (Channel("/recursive", "cdr", recursive), number(1)),
        (Channel("/long", "cdr", long), claims_4_gb()),
        (Channel("/no_definition", "cdr", None), b"abc"),
        (Channel("/json", "json", None), b'{"a": 1, "b": [1, 2]}'),
        (Channel("/cbor", "cbor", None), b"\xa0"),
        (Channel("/change", "cdr", string), text("x")),
        (Channel("/change", "cdr", integer), number(7)),
        (Channel(HOSTILE_NAME, "cdr", string), text("\x1b[2Jboo")),
    ]
    said = [part for part in parts for _ in range(PER_TOPIC)]
    rows = [(channel, START + n * STEP, data) for n, (channel, data) in enumerate(said)]
    write_mcap(path, rows, compression=CompressionType.NONE)
