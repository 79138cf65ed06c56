"""The other ways with files: the `mcap` package, and rosbags with a loop."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.typesys import Stores, get_typestore

from benchmarks.side import Values
from benchmarks.speed.logs import bag_to_mcap
from benchmarks.speed.ours import digest

if TYPE_CHECKING:
    from collections.abc import Iterable

    import pandas as pd

_IMU = "sensor_msgs/msg/Imu"
_SCALARS = (
    "header.seq",
    "header.stamp",
    "header.frame_id",
    *(f"orientation.{axis}" for axis in "xyzw"),
    *(f"angular_velocity.{axis}" for axis in "xyz"),
    *(f"linear_acceleration.{axis}" for axis in "xyz"),
)
_ARRAYS = (
    "orientation_covariance",
    "angular_velocity_covariance",
    "linear_acceleration_covariance",
)


def copy(bag: str, path: str, *, sync: bool) -> Values:
    """Copy a bag into one MCAP file with the `mcap` package's writer."""
    target = Path(path)
    started = time.perf_counter()
    bag_to_mcap(Path(bag), target)
    if sync:
        with target.open("rb") as stream:
            os.fsync(stream.fileno())
    elapsed = time.perf_counter() - started
    return {"seconds": elapsed, "stored_bytes": target.stat().st_size}


def slices(path: str, topic: str, starts: list[int], length_ns: int) -> Values:
    """Read the payloads of one topic in several time ranges with the `mcap` reader."""
    from mcap.reader import make_reader

    before = time.perf_counter()
    with Path(path).open("rb") as stream:
        reader = make_reader(stream)
        reader.get_summary()
        open_s = time.perf_counter() - before
        seconds, found = [], []
        for start in starts:
            began = time.perf_counter()
            messages = reader.iter_messages([topic], start, start + length_ns)
            payloads = [message.data for _, _, message in messages]
            seconds.append(time.perf_counter() - began)
            found.append(payloads)
    return {
        "open_s": open_s,
        "seconds": seconds,
        "answers": [digest(payloads) for payloads in found],
    }


def rosbags_frame(bag: str, topic: str) -> Values:
    """A frame from a loop over rosbags: deserialize, pick the fields, collect."""
    import pandas as pd  # noqa: F401
    from rosbags.highlevel import AnyReader

    with AnyReader([Path(bag)]) as reader:
        started = time.perf_counter()
        connections = [c for c in reader.connections if c.topic == topic]
        messages = (
            (log_time, reader.deserialize(payload, connection.msgtype))
            for connection, log_time, payload in reader.messages(connections)
        )
        made = _frame(messages)
        return _about(made, time.perf_counter() - started)


def mcap_frame(path: str, topic: str) -> Values:
    """A frame from a loop over the `mcap` reader, decoded with rosbags' deserializer."""
    import pandas as pd  # noqa: F401
    from mcap.reader import make_reader

    types = get_typestore(Stores.ROS1_NOETIC)
    with Path(path).open("rb") as stream:
        started = time.perf_counter()
        messages = (
            (message.log_time, types.deserialize_ros1(message.data, _IMU))
            for _, _, message in make_reader(stream).iter_messages([topic])
        )
        made = _frame(messages)
        return _about(made, time.perf_counter() - started)


def _frame(messages: Iterable[tuple[int, Any]]) -> pd.DataFrame:
    """The same columns as hybridlog's frame."""
    import pandas as pd

    times: list[int] = []
    rows: list[tuple[object, ...]] = []
    for log_time, m in messages:
        stamp, turn = m.header.stamp, m.orientation
        spin, push = m.angular_velocity, m.linear_acceleration
        times.append(log_time)
        rows.append(
            (
                m.header.seq,
                stamp.sec * 1_000_000_000 + stamp.nanosec,
                m.header.frame_id,
                turn.x,
                turn.y,
                turn.z,
                turn.w,
                spin.x,
                spin.y,
                spin.z,
                push.x,
                push.y,
                push.z,
                m.orientation_covariance,
                m.angular_velocity_covariance,
                m.linear_acceleration_covariance,
            )
        )
    index = pd.to_datetime(np.array(times), unit="ns", utc=True)
    return pd.DataFrame(rows, columns=[*_SCALARS, *_ARRAYS], index=index)


def _about(made: pd.DataFrame, elapsed: float) -> Values:
    return {
        "seconds": elapsed,
        "rows": len(made),
        "sum": float(made["angular_velocity.x"].sum()),
        "last_covariance": [float(v) for v in made["orientation_covariance"].iloc[-1]],
    }
