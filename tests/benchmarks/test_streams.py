"""The streams of study 1, read with rosbags."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.loads.base import Load
from benchmarks.loads.streams import MIN_SIZE, pool_messages, stream

pytestmark = pytest.mark.mongo("embedded")


def make(directory: Path, **settings: Any) -> Load:
    directory.mkdir(parents=True, exist_ok=True)
    return stream(directory, **{"size": 5000, "rate": 10, "seed": 1, **settings})


def payload(load: Load, row: int) -> bytes:
    start = int(load.offset[row])
    return bytes(load.map()[start : start + int(load.length[row])])


def decoder(load: Load) -> Any:
    """A rosbags typestore that knows the stream's type from its definition alone."""
    schema = load.channels[0].schema
    assert schema is not None
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(schema.data.decode(), "hybridlog_benchmarks/msg/Frame"))
    return store


@pytest.mark.parametrize("size", [MIN_SIZE, 1001, 5000, 40_003])
def test_messages_have_the_size_and_decode(tmp_path: Path, size: int) -> None:
    load = make(tmp_path / "load", size=size, topics=3, messages=4)
    assert set(load.length.tolist()) == {size}
    store = decoder(load)
    seen = set()
    for row in range(len(load)):
        raw = payload(load, row)
        message = store.deserialize_ros1(raw, "hybridlog_benchmarks/msg/Frame")
        assert bytes(store.serialize_ros1(message, "hybridlog_benchmarks/msg/Frame")) == raw
        assert abs(message.ranges.nbytes - size / 2) < 4
        assert message.data.nbytes > 0.2 * size
        seen.add((message.header.seq, message.header.stamp.nanosec, message.header.frame_id))
    assert len(seen) == len(load)


def test_half_is_noise_and_half_is_smooth(tmp_path: Path) -> None:
    load = make(tmp_path / "load", size=40_000, topics=1, messages=3)
    store = decoder(load)
    message = store.deserialize_ros1(payload(load, 1), "hybridlog_benchmarks/msg/Frame")
    ranges, data = message.ranges, message.data
    assert len(zlib.compress(data.tobytes(), 9)) > 0.99 * len(data)
    assert ranges.min() > 0
    assert np.abs(np.diff(ranges)).max() < 0.02
    millimetres = ranges.astype(np.float64) * 1000
    assert np.abs(millimetres - np.rint(millimetres)).max() < 0.01
    assert len(zlib.compress(ranges.tobytes(), 9)) < 0.7 * ranges.nbytes


def test_channels_are_those_of_a_ros_1_bag(tmp_path: Path) -> None:
    load = make(tmp_path / "load", topics=12, messages=2)
    store = decoder(load)
    text, md5sum = store.generate_msgdef("hybridlog_benchmarks/msg/Frame")
    channel = load.channels[11]
    assert [channel.topic for channel in load.channels] == [f"/frames/{n:02}" for n in range(12)]
    assert channel.metadata["md5sum"] == md5sum
    assert channel.schema is not None
    assert (channel.schema.name, channel.schema.encoding) == (
        "hybridlog_benchmarks/Frame",
        "ros1msg",
    )
    # A bag spells the types of std_msgs without their package.
    assert (
        channel.schema.data.decode().split()
        == text.replace("std_msgs/Header header", "Header header").split()
    )
    assert channel.message_encoding == "ros1"


@given(topics=st.integers(1, 30), messages=st.integers(1, 30), rate=st.floats(0.5, 2000))
def test_schedule(
    tmp_path_factory: pytest.TempPathFactory, topics: int, messages: int, rate: float
) -> None:
    load = make(
        tmp_path_factory.mktemp("load"), size=200, topics=topics, messages=messages, rate=rate
    )
    assert np.bincount(load.channel, minlength=topics).tolist() == [messages] * topics
    for channel in range(topics):
        at = load.due[load.channel == channel] / 1e9
        expected = (np.arange(messages) + channel / topics) / rate
        assert np.abs(at - expected).max() < 1e-8
    assert (np.diff(load.due) >= 0).all()
    assert (np.diff(load.log_time) == np.diff(load.due)).all()


@pytest.mark.parametrize(
    ("size", "topics", "messages", "expected"),
    [(5000, 20, 500, 10_000), (640_000, 20, 500, 104), (10**7, 20, 500, 100), (10**7, 2, 3, 6)],
)
def test_pool(size: int, topics: int, messages: int, expected: int) -> None:
    assert pool_messages(size, topics, messages) == expected


def test_same_seed_same_bytes_and_pools_are_shared(tmp_path: Path) -> None:
    one = make(tmp_path / "one", topics=2, messages=5)
    again = make(tmp_path / "again", topics=2, messages=5)
    other = make(tmp_path / "other", topics=2, messages=5, seed=2)
    faster = make(tmp_path / "faster", topics=2, messages=5, rate=100, pool=one.payloads)
    assert one.payloads.read_bytes() == again.payloads.read_bytes()
    assert one.payloads.read_bytes() != other.payloads.read_bytes()
    assert faster.payloads.samefile(one.payloads)
    opened = Load.open(tmp_path / "faster")
    assert opened.payloads == tmp_path / "faster" / "payloads.bin"
    assert [c.topic for c in opened.channels] == [c.topic for c in one.channels]
    assert opened.due[-1] == one.due[-1] // 10


def test_rows_share_payloads_beyond_the_pool(tmp_path: Path) -> None:
    load = make(tmp_path / "load", size=1_000_000, topics=50, messages=3)
    assert load.payloads.stat().st_size == 100 * 1_000_000
    assert len(load) == 150
    assert load.offset[100] == 0
    assert load.payload_bytes == 150 * 1_000_000


@pytest.mark.parametrize(
    "settings", [{"size": MIN_SIZE - 1}, {"rate": 0}, {"topics": 0}, {"messages": 0}]
)
def test_settings_without_sense_are_refused(tmp_path: Path, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"small|no stream"):
        make(tmp_path / "load", **settings)
