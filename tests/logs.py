"""Small logs whose content is known, and stores that hold them."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.independent import write_mcap

HEADER = (
    "std_msgs/Header header\nint32 n\n"
    + "=" * 80
    + ("\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n")
)
BEGIN_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
CHANNELS = {
    "/number": Channel("/number", "ros1", Schema("a/Number", "ros1msg", b"int32 n\nfloat64 x\n")),
    "/stamped": Channel("/stamped", "ros1", Schema("a/Stamped", "ros1msg", HEADER.encode())),
    "/text": Channel("/text", "json", Schema("a/Text", "jsonschema", b'{"type":"object"}')),
    "/scan": Channel("/scan", "ros1", Schema("a/Scan", "ros1msg", b"int32 n\nfloat32[] ranges\n")),
}
SETTINGS = SegmentSettings(chunk_size=1 << 10, segment_size=4_000, compression="none")


@dataclass(frozen=True)
class Said:
    """A message of a log, and the number that stands in its field `n`."""

    time: int
    payload: bytes
    n: int


Content = Mapping[str, tuple[Said, ...]]
"""What a log holds, by topic."""


def content(first: int, count: int, *, scans: bool = False) -> Content:
    """Messages of three topics: numbers, JSON, and such with a header stamp.

    Args:
        first: Number of the first message of each topic.
        count: Of how many there are of each.
        scans: True for a fourth topic, of long arrays.
    """
    found: dict[str, list[Said]] = {"/number": [], "/text": [], "/stamped": []}
    if scans:
        found["/scan"] = []
    for n in range(first, first + count):
        time = BEGIN_NS + n * STEP_NS
        stamp = struct.pack("<II", (time - 1000) // 10**9, (time - 1000) % 10**9)
        payloads = {
            "/number": struct.pack("<id", n, n / 7),
            "/text": json.dumps({"n": n, "s": "x" * (n % 5)}).encode(),
            "/stamped": struct.pack("<I", n) + stamp + struct.pack("<I2si", 2, b"ab", n),
        }
        if scans:
            ranges = [(n + i) / 8 for i in range(300 + n % 3)]
            payloads["/scan"] = struct.pack(f"<iI{len(ranges)}f", n, len(ranges), *ranges)
        for place, (topic, payload) in enumerate(payloads.items()):
            found[topic].append(Said(time + place, payload, n))
    return {topic: tuple(said) for topic, said in found.items()}


def write(path: Path, said: Content) -> Path:
    """A log with these messages, as an MCAP file."""
    everything = [(CHANNELS[topic], one) for topic, part in said.items() for one in part]
    ordered = sorted(everything, key=lambda item: item[1].time)
    return write_mcap(path, [(channel, one.time, one.payload) for channel, one in ordered])


def record(
    store: Path, uri: str, log: Path, name: str, settings: SegmentSettings = SETTINGS
) -> None:
    """Record a log in several segments."""
    with hl.open(store, mongo=uri, create=True) as opened:
        opened.record(log, name=name, settings=settings)
