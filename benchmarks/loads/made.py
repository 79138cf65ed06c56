"""Messages that are made: types, rates and values of topics as rows of a table."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rosbags.typesys import get_types_from_msg

from hybridlog.demo.topics import Types
from hybridlog_storage.messages import Channel, Schema

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from benchmarks.loads.spool import Spool

    Floats = NDArray[np.float64]
    Times = NDArray[np.int64]

Values = dict[str, Any]
TF_TYPE = "tf/msg/tfMessage"
"""What /tf had before ROS Hydro."""
_BLOCK = 4 << 20
"""Bytes of payloads that are made at once, about."""
_STALL_PART, _STALL_NS = 0.001, (5e6, 25e6)


class OldTypes(Types):
    """The message types of ROS 1, with those that only old robots have."""

    def __init__(self) -> None:
        super().__init__(1)
        definition = "geometry_msgs/TransformStamped[] transforms\n"
        self.store.register(get_types_from_msg(definition, TF_TYPE))

    def channel(self, topic: str, msgtype: str, node: str) -> Channel:
        """The channel of a topic, as a ROS 1 bag describes it."""
        text, checksum = self.store.generate_msgdef(msgtype, ros_version=1)
        schema = Schema(msgtype.replace("/msg/", "/"), "ros1msg", text.encode())
        metadata = {"callerid": node, "latching": "0", "md5sum": checksum}
        return Channel(topic, "ros1", schema, metadata, has_publish_time=False)


class Moments(NamedTuple):
    """Some messages of a topic: seconds since the start, stamps in ns, and noise."""

    seconds: Floats
    stamps: Times
    rng: np.random.Generator


class Topic(NamedTuple):
    """A row of the table.

    Attributes:
        msgtype: As rosbags spells it.
        phase: Seconds after the start of the first message.
        delay: Seconds from header stamp to log time: the least, and the mean on top.
        values: Values of every message by field path.
        columns: Makes the values that differ, by field path.
        clock: Topics with the same clock have the same stamps.
        size: Bytes of a message, about.
    """

    name: str
    msgtype: str
    node: str
    hz: float
    phase: float
    delay: tuple[float, float]
    values: Callable[[Types], Values]
    columns: Callable[[Moments], Values] = lambda _moments: {}
    clock: str = ""
    size: int = 1000


def generator(seed: int, *names: str | int) -> np.random.Generator:
    """The random numbers of one stream: others do not change when one is left out."""
    parts = [zlib.crc32(name.encode()) if isinstance(name, str) else name for name in names]
    return np.random.default_rng([seed, *parts])


def schedule(topic: Topic, seconds: float, seed: int, place: int) -> tuple[Times, Times]:
    """Header stamps and log times, ns since the start: a clock that jitters, and transport."""
    clock = generator(seed, "clock", topic.clock or str(place))
    stamps = steady(clock, topic.hz, seconds, phase=topic.phase)
    return stamps, received(generator(seed, "transport", place), stamps, *topic.delay)


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


def of_two_sources(first: Times, second: Times) -> tuple[Times, Times]:
    """Log times of two publishers of one topic, made distinct by a nanosecond."""
    return first & ~1, second | 1


def payloads(types: Types, msgtype: str, values: Values, columns: Values) -> Iterator[bytes]:
    """Serialized messages, one for each row of the columns."""
    message = types.make(msgtype, values)
    count = len(next(iter(columns.values())))
    for filled in types.filled(message, columns, count):
        yield types.encode(filled, msgtype)


def write(
    spool: Spool,
    number: int,
    types: Types,
    topic: Topic,
    times: tuple[int, Times, Times],
    *,
    seed: int,
) -> None:
    """Add the messages of a topic.

    Args:
        spool: Where.
        number: Of the channel.
        types: Message types.
        topic: Its row.
        times: Log time of the start; header stamps and log times, ns since then.
        seed: Of the noise.
    """
    start_ns, stamps, log_times = times
    step = max(1, _BLOCK // topic.size)
    values = topic.values(types)
    for first in range(0, len(stamps), step):
        here = stamps[first : first + step]
        rng = generator(seed, topic.name, topic.node, first)
        columns = topic.columns(Moments(here / 1e9, start_ns + here, rng))
        numbers = np.arange(first, first + len(here))
        if "transforms" in values:
            shown = types.times(start_ns + here)
            for link in range(len(values["transforms"])):
                path = f"transforms.{link}.header"
                columns |= {f"{path}.stamp": shown, f"{path}.seq": numbers}
        else:
            columns |= {"header.stamp": start_ns + here, "header.seq": numbers}
        made = payloads(types, topic.msgtype, values, columns)
        spool.messages(np.full(len(here), number), made, start_ns + log_times[first : first + step])


# --- values ---------------------------------------------------------------------------


def fixed(**values: Any) -> Callable[[Types], Values]:
    """Values that need no types; `__` in a name is a dot."""
    found = {name.replace("__", "."): value for name, value in values.items()}
    return lambda _types: dict(found)


def transforms(*links: tuple[str, str]) -> Callable[[Types], Values]:
    """A message of transforms from parents to children."""

    def values(types: Types) -> Values:
        kind = "geometry_msgs/msg/TransformStamped"
        frames = [{"header.frame_id": one, "child_frame_id": other} for one, other in links]
        return {"transforms": [types.make(kind, frame) for frame in frames]}

    return values


def diagonal(*values: float) -> Floats:
    """A covariance."""
    return np.diag(values).ravel()


def yaw(path: str, heading: Floats) -> Values:
    """A turn about the vertical axis."""
    return {f"{path}.z": np.sin(heading / 2), f"{path}.w": np.cos(heading / 2)}


def xyz(path: str, *columns: Any) -> Values:
    """Up to three columns of a vector."""
    return {f"{path}.{axis}": column for axis, column in zip("xyz", columns, strict=False)}


def vector(path: str, rng: np.random.Generator, count: int, scale: float = 1.0) -> Values:
    """Noise in three axes."""
    return xyz(path, *(scale * rng.standard_normal((3, count))))


def room(moments: Moments, beams: int) -> NDArray[np.float32]:
    """Ranges of a laser in a room that it moves through, metres, float32[n, beams]."""
    angle = np.linspace(-2.3, 2.3, beams)
    turned = angle + moments.seconds[:, None] / 5
    ranges = 5 + 3 * np.sin(3 * turned) + 0.3 * np.sin(17 * turned)
    ranges += 0.01 * moments.rng.standard_normal(ranges.shape)
    return ranges.astype(np.float32)


def scene(rng: np.random.Generator, first: int, shape: tuple[int, int, int]) -> NDArray[np.uint8]:
    """Camera frames, uint8[n, height, width]: smooth surfaces under the noise of a sensor.

    It is the noise, of one grey level in the mean square, that makes frames slow to compress.
    """
    count, height, width = shape
    noise = np.rint(rng.standard_normal(height * width + (1 << 16))).astype(np.int8).view(np.uint8)
    surface = smooth(height, width) // 2 + 30
    frames = np.empty(shape, np.uint8)
    for row, shift in enumerate(rng.integers(0, 1 << 16, count).tolist()):
        grain = noise[shift : shift + height * width].reshape(height, width)
        np.add(np.roll(surface, first + row, axis=1), grain, out=frames[row])
    return frames


def smooth(height: int, width: int) -> NDArray[np.uint8]:
    """A surface that is easy to compress."""
    slope = np.arange(height)[:, None] // 4 + np.arange(width) // 4
    return (slope % 256).astype(np.uint8)
