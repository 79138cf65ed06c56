"""An MCAP file with everything that a log should not have."""

from __future__ import annotations

import struct
from pathlib import Path

from mcap.writer import CompressionType, Writer

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
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start(profile="ros2")

        def define(name: str, definition: str) -> int:
            return writer.register_schema(name, "ros2msg", definition.encode())

        string = define("std_msgs/msg/String", "string data\n")
        integer = define("std_msgs/msg/Int32", "int32 data\n")
        code = define("x/msg/Code", 'int32 __import__("os").system("true")\n')
        recursive = define("x/msg/Recursive", "x/Recursive child\n")
        long = define("x/msg/Long", "uint8[] data\n")
        parts = [
            ("/a/b", string, "cdr", text("one")),
            ("/a__b", string, "cdr", text("two")),
            ("a/b", string, "cdr", text("three")),
            ("/code", code, "cdr", number(1)),
            ("/recursive", recursive, "cdr", number(1)),
            ("/long", long, "cdr", claims_4_gb()),
            ("/no_definition", 0, "cdr", b"abc"),
            ("/json", 0, "json", b'{"a": 1, "b": [1, 2]}'),
            ("/cbor", 0, "cbor", b"\xa0"),
            ("/change", string, "cdr", text("x")),
            ("/change", integer, "cdr", number(7)),
            (HOSTILE_NAME, string, "cdr", text("\x1b[2Jboo")),
        ]
        time = START
        for topic, schema, encoding, payload in parts:
            channel = writer.register_channel(topic, encoding, schema)
            for _ in range(PER_TOPIC):
                writer.add_message(channel, time, payload, time)
                time += STEP
        writer.finish()
