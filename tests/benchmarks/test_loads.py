"""The loads: what the generators promise, found in their messages by plain loops."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from benchmarks.loads import hcr_like as hcr
from benchmarks.loads.base import PAYLOADS, Load
from benchmarks.loads.hcr_like import hcr_like
from benchmarks.loads.made import received, steady
from benchmarks.loads.robot import HEIGHT, TOPICS, WIDTH, robot_load, write_log
from benchmarks.loads.spool import Spool
from benchmarks.loads.truth import Truth
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel

pytestmark = pytest.mark.mongo("embedded")

SECOND = 1_000_000_000
MINUTE = 60 * SECOND

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
        self._stores = {channel.topic: self._store(channel) for channel in load.channels}

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
        """Topic, log time and message."""
        for topic, time, payload in self.rows(*topics):
            yield topic, time, self.message(topic, payload)

    def message(self, topic: str, payload: bytes) -> Any:
        """A message of a topic."""
        store, name = self._stores[topic]
        return store.deserialize_ros1(payload, name)

    def again(self, topic: str, message: Any) -> bytes:
        """A message serialised once more."""
        store, name = self._stores[topic]
        return bytes(store.serialize_ros1(message, name))


@pytest.fixture(scope="module", params=[1, 7])
def sessions(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Decoded:
    """Three sessions of three and a half minutes."""
    directory = tmp_path_factory.mktemp("hcr")
    return Decoded(hcr_like(directory, seed=request.param, sessions=3, minutes=3.5))


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Decoded:
    """Two seconds of the robot's log."""
    return Decoded(robot_load(tmp_path_factory.mktemp("robot"), seconds=2, seed=3))


def truth_of(decoded: Decoded) -> Truth:
    return Truth.open(decoded.load.payloads.parent)


# --- the four questions, and the three that the paper finds hard ---


def test_q2(sessions: Decoded) -> None:
    truth = truth_of(sessions)
    behind = [m.position for _, _, m in sessions(hcr.VIEWPOINT) if m.position.x <= 0]
    assert len(behind) == truth.q2 > 500
    assert truth.q2_sum == (
        sum(p.x for p in behind),
        sum(p.y for p in behind),
        sum(p.z for p in behind),
    )
    assert any(p.x == 0 for p in behind)


def test_q4_has_nothing_near_the_edges_of_its_windows(sessions: Decoded) -> None:
    front = np.array([t for _, t, m in sessions(hcr.VIEWPOINT) if m.position.x >= 0])
    for _, time, message in sessions(hcr.RIGHT_GRIPPER):
        if message.position == 0.0:
            nearest = int(np.abs(front - time).min())
            assert nearest < SECOND // 20 or nearest > SECOND // 5
            assert nearest < 2 * SECOND // 5 or nearest > 6 * SECOND // 10


def test_the_viewpoint_turns_only_when_it_moves(sessions: Decoded) -> None:
    before = None
    for _, _, message in sessions(hcr.VIEWPOINT):
        if before is not None:
            moved = message.position != before.position
            assert moved or message.orientation == before.orientation
        before = message


def test_closed_minutes(sessions: Decoded) -> None:
    truth = truth_of(sessions)
    spells, begin = [], None
    for _, time, message in sessions(hcr.RIGHT_GRIPPER):
        if message.position == 0.0:
            begin = time if begin is None else begin
        elif begin is not None:
            spells.append((begin, time))
            begin = None
    assert begin is None, "a session must end with an open gripper"
    assert tuple(spells) == truth.closed
    minutes = []
    for start, end in spells:
        while start + MINUTE <= end:
            minutes.append(start)
            start += MINUTE
    assert tuple(minutes) == truth.closed_minutes
    assert minutes
    # Far from whole minutes, so that no clock can change the answer.
    assert all(SECOND < (end - start) % MINUTE < 59 * SECOND for start, end in spells)


@pytest.mark.parametrize("unit", [1, 1_000_000], ids=["ns", "ms"])
def test_before_errors(sessions: Decoded, unit: int) -> None:
    truth = truth_of(sessions)
    times = [time // unit for _, time, _ in sessions.rows()]
    errors = [t for _, t, m in sessions(hcr.ROSOUT) if m.level >= 8]
    assert errors == [error.log_time for error in truth.errors]
    assert len(errors) >= 3
    inside: set[int] = set()
    for error in truth.errors:
        edge = error.log_time // unit
        rows = {n for n, time in enumerate(times) if edge - 5 * MINUTE // unit <= time < edge}
        assert len(rows) == error.messages > 0
        inside |= rows
    assert len(inside) == truth.before_errors


def test_overlapping_windows_count_once() -> None:
    windows = [(0, 10), (5, 12), (20, 30)]
    assert hcr._joined(windows) == [(0, 12), (20, 30)]


def test_counts_and_sessions(sessions: Decoded) -> None:
    truth, load = truth_of(sessions), sessions.load
    counts = Counter(topic for topic, _, _ in sessions.rows())
    assert dict(counts) == truth.messages
    assert len(truth.sessions) == 3
    edges = np.array(truth.sessions).ravel()
    assert (np.diff(edges) > 0).all()
    place = np.searchsorted(edges, load.log_time, side="right")
    assert (place % 2 == 1).all(), "every message lies in a session"
    assert set(place.tolist()) == {1, 3, 5}


def test_paths_of_the_appendix(sessions: Decoded) -> None:
    for topic, path in (
        (hcr.RIGHT_GRIPPER, "position"),
        (hcr.RIGHT_GRIPPER, "max_effort"),
        (hcr.VIEWPOINT, "position.x"),
        (hcr.RIGHT_ARM, "pose.position.z"),
    ):
        _, _, message = next(sessions(topic))
        for part in path.split("."):
            message = getattr(message, part)
        assert isinstance(message, float)


def test_positions_are_exact_in_single_precision(sessions: Decoded) -> None:
    for topic, _, message in sessions(hcr.VIEWPOINT, hcr.RIGHT_ARM):
        p = message.position if topic == hcr.VIEWPOINT else message.pose.position
        for value in (p.x, p.y, p.z):
            assert float(np.float32(value)) == value
            assert not (value == 0 and np.signbit(value))


def test_faces_of_the_region_are_met(sessions: Decoded) -> None:
    assert any(m.pose.position.z == 1.0 for _, _, m in sessions(hcr.RIGHT_ARM))


# --- what holds for both generators ---


def test_messages_are_what_they_say(sessions: Decoded, robot: Decoded) -> None:
    for decoded in (sessions, robot):
        _check_messages(decoded)


def _check_messages(decoded: Decoded) -> None:
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
    for decoded in (sessions, robot):
        _check_times(decoded.load)


def _check_times(load: Load) -> None:
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


def test_a_load_is_opened_again(sessions: Decoded) -> None:
    load = sessions.load
    again = Load.open(load.payloads.parent)
    assert again.channels == load.channels or [c.topic for c in again.channels] == [
        c.topic for c in load.channels
    ]
    for name in ("channel", "due", "log_time", "offset", "length"):
        assert (getattr(again, name) == getattr(load, name)).all()


@pytest.mark.parametrize(
    ("sessions", "minutes", "seed"), [(0, 1, 1), (1, 0.5, 1), (1, float("nan"), 1), (1, 1, -1)]
)
def test_no_such_sessions(tmp_path: Path, sessions: int, minutes: float, seed: int) -> None:
    with pytest.raises(UsageError, match="choose"):
        hcr_like(tmp_path, seed=seed, sessions=sessions, minutes=minutes)


# --- the robot's log ---


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


def test_timing() -> None:
    rng = np.random.default_rng(1)
    stamps = steady(rng, 100, 30, phase=0.25, jitter=0.5)
    assert stamps[0] >= SECOND // 4
    assert stamps[-1] < 30 * SECOND
    assert len(stamps) in {2974, 2975}
    times = received(rng, stamps, 0.001, 0.0005)
    assert (np.diff(times) > 0).all()
    assert (times - stamps >= SECOND // 1000).all()
    assert int((times - stamps).max()) > 5 * SECOND // 1000, "something stalls now and then"
    assert not len(steady(rng, 1, 0.5, phase=0.75))


# --- the spool ---

_times = hnp.arrays(np.int64, st.integers(0, 6), elements=st.integers(0, 50))


@settings(max_examples=60, deadline=None)
@given(
    parts=st.lists(st.tuples(st.integers(0, 2), _times, st.integers(0, 9)), max_size=8),
)
def test_spool_against_a_model(parts: list[tuple[int, Any, int]], tmp_path_factory: Any) -> None:
    directory: Path = tmp_path_factory.mktemp("spool")
    model: list[tuple[int, int, bytes]] = []
    rng = np.random.default_rng(0)
    with Spool(directory) as spool:
        for number, (channel, times, size) in enumerate(parts):
            payloads = [rng.bytes(size + number % 2) for _ in times]
            spool.messages(np.full(len(times), channel, np.int32), payloads, times)
            model += zip(times.tolist(), [channel] * len(times), payloads, strict=True)
        channels = [Channel(f"/{n}", "raw", None) for n in range(3)]
        if not model:
            with pytest.raises(UsageError, match="no messages"):
                spool.finish("x", 1, channels)
            return
        spool.finish("x", 1, channels)
    model.sort(key=lambda row: row[0])
    first = model[0][0]
    load = Load.open(directory)
    memory = load.map()
    found = [
        (time, channel, bytes(memory[offset : offset + length]))
        for time, channel, offset, length in zip(
            load.log_time.tolist(), load.channel.tolist(), load.offset.tolist(),
            load.length.tolist(), strict=True,
        )
    ]  # fmt: skip
    memory.release()
    assert found == model
    assert load.due.tolist() == [time - first for time, _, _ in model]
    shutil.rmtree(directory)


def test_a_spool_that_fails_leaves_no_load(tmp_path: Path) -> None:
    hcr_like(tmp_path, seed=1, sessions=1, minutes=1)
    assert Load.is_complete(tmp_path)
    with pytest.raises(UsageError), Spool(tmp_path) as spool:
        spool.finish("nothing", None, [])
    assert not Load.is_complete(tmp_path)
    assert not (tmp_path / PAYLOADS).exists()


def test_no_place_for_a_load(tmp_path: Path) -> None:
    place = tmp_path / "file"
    place.write_bytes(b"")
    with pytest.raises(UsageError, match="choose another directory"):
        Spool(place / "load")
