"""Logs for tables, and what their messages hold when they are decoded one by one."""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hybridlog as hl
from hybridlog.columns.tables import Tables, TopicTable
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.messages import Channel, Schema
from tests.independent import write_mcap

SECOND = 1_000_000_000
BASE = 1_700_000_000 * SECOND
DEFINITION = b"""\
Header header
int8 i8
uint64 u64
float64 f64
bool yes
duration took
string name
float32[] many
float64[9] nine
float64[36] covariance
string[] words
Point[] points
Nothing nothing
uint64 t
int32 Name
int32 state
================================================================================
MSG: test/Header
uint32 seq
time stamp
string frame_id
================================================================================
MSG: test/Point
float32 x
float32 X
uint8[] data
================================================================================
MSG: test/Nothing
"""
"""Fields of all kinds: names of ours, names that differ in case, and a message without fields."""
STATE = Schema("test/State", "ros1msg", DEFINITION)


def _text(value: str) -> bytes:
    data = value.encode()
    return struct.pack("<I", len(data)) + data


def payload(
    n: int,
    *,
    i8: int = 0,
    u64: int = 0,
    f64: float = 0.0,
    name: str = "",
    many: Sequence[float] = (),
    points: Sequence[tuple[float, float, bytes]] = (),
    words: Sequence[str] = (),
) -> bytes:
    """A message as ROS 1 writes it, with a number in several places."""
    stamp = BASE - SECOND + n
    return b"".join(
        (
            struct.pack("<III", n, *divmod(stamp, SECOND)),
            _text("map"),
            struct.pack("<bQd?ii", i8, u64, f64, n % 2, -1, 999_999_999),
            _text(name),
            struct.pack(f"<I{len(many)}f", len(many), *many),
            struct.pack("<9d36d", *range(n, n + 9), *([0.25] * 36)),
            struct.pack("<I", len(words)),
            *map(_text, words),
            struct.pack("<I", len(points)),
            *(struct.pack("<ffI", x, y, len(data)) + data for x, y, data in points),
            struct.pack("<Qii", n * 3, -n, n % 4),
        )
    )


def varied(n: int) -> bytes:
    """A message with values that are easily mistaken."""
    floats = [math.nan, math.inf, -math.inf, -0.0, 1.5, float(n)]
    numbers = [0, 1, 2**53 + 1, 2**63, 2**64 - 1, n]
    return payload(
        n,
        i8=n % 5 - 2,
        u64=numbers[n % 6],
        f64=floats[n % 6],
        name=["", "a", "ä", "\U0001d11e", "laser"][n % 5],
        many=[floats[(n + k) % 6] for k in range(n % 7)],
        points=[(k, k + 0.5, b"\1\2"[: n % 3]) for k in range(n % 4)],
        words=["x" * k for k in range(n % 3)],
    )


def write_log(
    path: Path,
    said: Sequence[tuple[int, str, bytes]],
    schemas: Mapping[str, tuple[str, Schema]] | None = None,
) -> Path:
    """A log of messages (log time, topic, payload); each topic has two publishers."""
    channels = {
        (topic, place): Channel(
            topic, *(schemas or {}).get(topic, ("ros1", STATE)), {"publisher": str(place)}
        )
        for topic in {topic for _, topic, _ in said}
        for place in range(2)
    }
    return write_mcap(
        path,
        [
            (channels[topic, n % 2], time, data, time + 7)
            for n, (time, topic, data) in enumerate(said)
        ],
    )


def channel(topic: str, schema: Schema = STATE) -> Channel:
    return Channel(topic, "ros1", schema)


class Decoded:
    """A message, decoded by itself.

    Attributes:
        value: The message; None if it does not fit its definition.
        t: Log time, ns.
        seq: Arrival number.
        raw: The payload.
    """

    def __init__(self, message: hl.Message) -> None:
        self.t, self.seq = message.log_time_ns, message.seq
        self.pub = message.publish_time_ns
        self.raw = message.raw
        try:
            self.value = message.decode()
        except PayloadError:
            self.value = None


_DECODED: dict[tuple[str, str], list[Decoded]] = {}


def decoded(store: hl.Store, recording: str, topic: str) -> list[Decoded]:
    """All messages of a topic, in order, decoded one by one; each only once."""
    entry = store.entry(recording)
    key = entry.id, topic
    if key not in _DECODED:
        if len(_DECODED) > 50:
            _DECODED.clear()
        _DECODED[key] = [Decoded(message) for message in store.query([topic], [entry.id])]
    return _DECODED[key]


def table_of(store: hl.Store, topic: str = "/a") -> TopicTable:
    """The table of a topic of the only recording."""
    (entry,) = store.recordings()
    found = Tables(store.directory.path).of(entry, topic)
    assert found is not None
    return found


def same(cell: Any, value: Any) -> bool:
    """Whether a cell of a table says what a field of a decoded message does."""
    if hasattr(value, "sec"):
        return bool(getattr(cell, "value", cell) == value.sec * SECOND + value.nanosec)
    if isinstance(cell, dict):
        if set(cell) in ({"n"}, {"n", "min", "max", "mean"}) and not hasattr(value, "n"):
            return _summarises(cell, value)
        return all(same(inner, getattr(value, name)) for name, inner in cell.items())
    if isinstance(value, list | tuple | np.ndarray):
        return len(cell) == len(value) and all(map(same, cell, value))
    if isinstance(cell, bool) and not isinstance(value, bool | np.bool_):
        return True  # a message without fields
    if isinstance(value, float | np.floating):
        return bool(cell == value) or (math.isnan(cell) and math.isnan(value))
    return bool(cell == value)


def _summarises(cell: dict[str, Any], value: Any) -> bool:
    if cell["n"] != len(value):
        return False
    if len(cell) == 1:
        return True
    numbers = np.asarray(value)
    finite = numbers[np.isfinite(numbers)]
    if not len(finite):
        return cell["min"] is cell["max"] is cell["mean"] is None
    mean = float(np.mean(finite, dtype=np.float64))
    return bool(
        cell["min"] == finite.min()
        and cell["max"] == finite.max()
        and math.isclose(cell["mean"], mean, rel_tol=1e-9, abs_tol=1e-9)
    )
