"""The loads: what the generators promise, found in their messages by plain loops."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.loads.base import PAYLOADS, Load
from benchmarks.loads.hcr_like import hcr_like
from benchmarks.loads.robot import HEIGHT, TOPICS, WIDTH, robot_load, write_log
from benchmarks.loads.spool import Spool
from benchmarks.loads.streams import MIN_SIZE, pool_messages, stream
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel

pytestmark = pytest.mark.mongo("embedded")

SECOND = 1_000_000_000

# As `rosbag info` of a real PR2 gives them, and as the ROS index does.
CHECKSUMS = {
    "nav_msgs/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "sensor_msgs/Image": "060021388200f6f0f447d0fcd9c64743",
    "sensor_msgs/JointState": "3066dcd76a6cfaef579bd0f34173e9fd",
    "sensor_msgs/LaserScan": "90c7ef2dc6895d81024acba2ac42f369",
    "sensor_msgs/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "geometry_msgs/Pose": "e45d45a5a1ce597b249e23fb30fc871f",
    "geometry_msgs/PoseStamped": "d3812c3cbc69362b77dc0b19b345f8f5",
    "tf/tfMessage": "94810edda583a504dfda3829e70d7eec",
    "rosgraph_msgs/Log": "acffd30cd6b6de30f120938c17c593fb",
    "diagnostic_msgs/DiagnosticArray": "60810da900de1dd6ddd437c3503511da",
    "pr2_controllers_msgs/Pr2GripperCommand": "680acaff79486f017132a7f198d40f08",
}


class Decoded:
    """The messages of a load, decoded by rosbags from what the load says of its types."""

    def __init__(self, load: Load) -> None:
        self.load = load
        self._bytes = load.payloads.read_bytes()
        self.stores = {channel.topic: self._store(channel) for channel in load.channels}

    @staticmethod
    def _store(channel: Channel) -> tuple[Any, str]:
        assert channel.schema is not None
        store = get_typestore(Stores.EMPTY)
        name = channel.schema.name.replace("/", "/msg/")
        store.register(get_types_from_msg(channel.schema.data.decode(), name))
        return store, name

    def rows(self, *topics: str) -> Iterator[tuple[str, int, bytes]]:
        """Topic, log time and payload of all messages of some topics (all without any)."""
        load = self.load
        for number, time, offset, length in zip(
            load.channel.tolist(),
            load.log_time.tolist(),
            load.offset.tolist(),
            load.length.tolist(),
            strict=True,
        ):
            topic = load.channels[number].topic
            if not topics or topic in topics:
                yield topic, time, self._bytes[offset : offset + length]

    def __call__(self, *topics: str) -> Iterator[tuple[str, int, Any]]:
        for topic, time, payload in self.rows(*topics):
            yield topic, time, self.message(topic, payload)

    def message(self, topic: str, payload: bytes) -> Any:
        store, name = self.stores[topic]
        return store.deserialize_ros1(payload, name)

    def again(self, topic: str, message: Any) -> bytes:
        store, name = self.stores[topic]
        return bytes(store.serialize_ros1(message, name))


@pytest.fixture(scope="module", params=[1, 7])
def sessions(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Decoded:
    directory = tmp_path_factory.mktemp("hcr")
    return Decoded(hcr_like(directory, seed=request.param, sessions=3, minutes=3.5))


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Decoded:
    return Decoded(robot_load(tmp_path_factory.mktemp("robot"), seconds=2, seed=3))


# What is true of the sessions, each backend finds in them: see `test_queries.py`.


# --- what holds for both generators ---


def test_messages_are_what_they_say(sessions: Decoded, robot: Decoded) -> None:
    for decoded in (sessions, robot):
        seen: Counter[str] = Counter()
        for topic, time, payload in decoded.rows():
            seen[topic] += 1
            if seen[topic] % 16 != 1:
                continue
            message = decoded.message(topic, payload)
            assert decoded.again(topic, message) == payload
            header = getattr(message, "header", None)
            if hasattr(message, "transforms"):
                header = message.transforms[0].header
            if header is not None:
                stamp = header.stamp.sec * SECOND + header.stamp.nanosec
                assert 0 <= time - stamp < SECOND // 2
        for channel in decoded.load.channels:
            assert channel.schema is not None
            wanted = CHECKSUMS.get(channel.schema.name)
            assert wanted in {None, channel.metadata["md5sum"]}


def test_times(sessions: Decoded, robot: Decoded) -> None:
    for load in (sessions.load, robot.load):
        assert load.due[0] == 0
        assert (np.diff(load.due) >= 0).all()
        assert (load.due == load.log_time - load.log_time[0]).all()
        for number in range(len(load.channels)):
            times = load.log_time[load.channel == number]
            assert (np.diff(times) > 0).all(), load.channels[number].topic


def test_a_seed_gives_the_same_bytes(tmp_path: Path) -> None:
    loads = [
        (
            hcr_like(tmp_path / f"h{n}", seed=seed, sessions=1, minutes=1),
            robot_load(tmp_path / f"r{n}", seconds=1, seed=seed),
        )
        for n, seed in enumerate((4, 4, 5))
    ]
    for first, same, other in zip(*loads, strict=True):
        assert first.payloads.read_bytes() == same.payloads.read_bytes()
        assert (first.log_time == same.log_time).all()
        assert first.payloads.read_bytes() != other.payloads.read_bytes()


def test_rates_of_the_robot(robot: Decoded, tmp_path: Path) -> None:
    counts = Counter(topic for topic, _, _ in robot.rows())
    assert counts == {topic: 2 * rate for topic, (rate, *_) in TOPICS.items()}
    image = next(m for _, _, m in robot("/camera/image_raw"))
    assert image.data.size == image.width * image.height == WIDTH * HEIGHT
    # The file has the same messages.
    size = write_log(tmp_path / "robot.mcap", seconds=2, seed=3)
    assert size == robot.load.payload_bytes
    with (tmp_path / "robot.mcap").open("rb") as stream:
        found = [(c.topic, m.log_time, m.data) for _, c, m in make_reader(stream).iter_messages()]
    assert found == list(robot.rows())


def test_a_spool_that_fails_leaves_no_load(tmp_path: Path) -> None:
    hcr_like(tmp_path, seed=1, sessions=1, minutes=1)
    assert Load.is_complete(tmp_path)
    with pytest.raises(UsageError), Spool(tmp_path) as spool:
        spool.finish("nothing", None, [])
    assert not Load.is_complete(tmp_path)
    assert not (tmp_path / PAYLOADS).exists()


def make(directory: Path, **settings: Any) -> Load:
    directory.mkdir(parents=True, exist_ok=True)
    return stream(directory, **{"size": 5000, "rate": 10, "seed": 1, **settings})


@pytest.mark.parametrize("size", [MIN_SIZE, 1001, 5000, 40_003])
def test_messages_have_the_size_and_decode(tmp_path: Path, size: int) -> None:
    load = make(tmp_path / "load", size=size, topics=3, messages=4)
    assert set(load.length.tolist()) == {size}
    decoded = Decoded(load)
    seen = set()
    for topic, _, raw in decoded.rows():
        message = decoded.message(topic, raw)
        assert decoded.again(topic, message) == raw
        assert abs(message.ranges.nbytes - size / 2) < 4
        assert message.data.nbytes > 0.2 * size
        seen.add((message.header.seq, message.header.stamp.nanosec, message.header.frame_id))
    assert len(seen) == len(load)


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


@pytest.mark.parametrize(
    "settings", [{"size": MIN_SIZE - 1}, {"rate": 0}, {"topics": 0}, {"messages": 0}]
)
def test_settings_without_sense_are_refused(tmp_path: Path, settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"small|no stream"):
        make(tmp_path / "load", **settings)
