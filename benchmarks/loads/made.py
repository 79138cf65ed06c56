"""Messages that are made: their types, times and values."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks.simulator.topics import Types
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Times = NDArray[np.int64]

Values = dict[str, Any]
_STALL_PART, _STALL_NS = 0.001, (5e6, 25e6)


class RobotTypes(Types):
    """The message types of ROS 1, and the channels of a bag."""

    def channel(self, topic: str, msgtype: str, node: str) -> Channel:
        """The channel of a topic, as a ROS 1 bag describes it."""
        text, checksum = self.store.generate_msgdef(msgtype, ros_version=1)
        schema = Schema(msgtype.replace("/msg/", "/"), "ros1msg", text.encode())
        metadata = {"callerid": node, "latching": "0", "md5sum": checksum}
        return Channel(topic, "ros1", schema, metadata, has_publish_time=False)


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """The random numbers of one stream: others do not change when one is left out."""
    parts = [zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names]
    return np.random.default_rng([seed, *parts])


def steady(
    rng: np.random.Generator, hz: float, seconds: float, *, phase: float = 0.0, jitter: float = 0.01
) -> Times:
    """Header stamps of a driver that is triggered by a clock.

    Returns:
        int64[n], ns in `[0, seconds)` since the start, ascending, distinct.
    """
    count = max(0, int(np.ceil((seconds - phase) * hz - 1e-9)))
    late = jitter * rng.random(count)
    stamps = np.rint((phase + (np.arange(count) + late) / hz) * 1e9).astype(np.int64)
    return stamps[stamps < round(seconds * 1e9)]


def received(rng: np.random.Generator, stamps: Times, least: float, mean: float) -> Times:
    """Log times: transport takes a little, and now and then something stalls.

    What follows a message that was held up arrives right behind it, as from a socket.

    Returns:
        int64[n], ns, ascending, distinct.
    """
    count = len(stamps)
    delay = 1e9 * (least + mean * rng.standard_exponential(count))
    stalled = rng.random(count) < _STALL_PART
    delay += np.where(stalled, rng.uniform(*_STALL_NS, count), 0.0)
    room = 2_000 * np.arange(count)
    return np.maximum.accumulate(stamps + np.rint(delay).astype(np.int64) - room) + room


def payloads(types: Types, msgtype: str, values: Values, columns: Values) -> Iterator[bytes]:
    """Serialized messages, one for each row of the columns."""
    message = types.make(msgtype, values)
    count = len(next(iter(columns.values())))
    for filled in types.filled(message, columns, count):
        yield types.encode(filled, msgtype)


# --- values ---------------------------------------------------------------------------


def yaw(path: str, heading: Floats) -> Values:
    """A turn about the vertical axis."""
    return {f"{path}.z": np.sin(heading / 2), f"{path}.w": np.cos(heading / 2)}


def xyz(path: str, *columns: Any) -> Values:
    """Up to three columns of a vector."""
    return {f"{path}.{axis}": column for axis, column in zip("xyz", columns, strict=False)}
