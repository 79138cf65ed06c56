"""Logs without definitions, or with odd ones, and every type of sensor_msgs, in every output."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

import hybridlog as hl
from hybridlog_storage.messages import SUPPLIED, Channel, Schema
from tests.cli.running import run
from tests.every_output import compare_every_output
from tests.formats.test_rosbag2 import MESSAGES, TOPICS, database
from tests.independent import write_mcap
from tests.ros_values import ROS1, ROS2, message_of, plain_of
from tests.some import EXHAUSTIVE

CASES = Path(__file__).parent / "cases"
FOXY = get_typestore(Stores.ROS2_FOXY)
START = 1_700_000_000_000_000_000
IN_DB3 = [
    ("/marker", "visualization_msgs/msg/Marker", FOXY),
    ("/shape", "shape_msgs/msg/SolidPrimitive", FOXY),
    ("/range", "sensor_msgs/msg/Range", FOXY),
    ("/parameter", "rcl_interfaces/msg/ParameterDescriptor", ROS2),
    ("/text", "std_msgs/msg/String", FOXY),
    ("/new_marker", "visualization_msgs/msg/Marker", ROS2),
]
IN_MCAP = [
    ("/ros1", "ros1", "sensor_msgs/msg/Imu", "", b""),
    ("/ros1/empty", "ros1", "nav_msgs/msg/Odometry", "ros1msg", b""),
    ("/ros2/prose", "cdr", "sensor_msgs/msg/LaserScan", "ros2msg", b"Scans of the robot.\n"),
    ("/ros2/name", "cdr", "sensor_msgs/msg/Range", "ros2msg", b"sensor_msgs/Range"),
]
SENSORS = [
    (f"/sensors{ros}/{name.rpartition('/')[2]}", encoding, name, f"ros{ros}msg", text.encode())
    for ros, encoding, types in ((1, "ros1", ROS1), (2, "cdr", ROS2))
    for name in sorted(types.fielddefs)
    if name.startswith("sensor_msgs/")
    for text, _ in [types.generate_msgdef(name, ros_version=ros)]
]


def messages(store: Typestore, name: str, write: str = "serialize_cdr") -> list[tuple[Any, bytes]]:
    made = [message_of(store, name, np.random.default_rng(seed)) for seed in range(3)]
    return [(message, bytes(getattr(store, write)(message, name))) for message in made]


def write_db3(path: Path) -> None:
    topics = [
        f"INSERT INTO topics VALUES ({number}, '{topic}', '{name}', 'cdr')"
        for number, (topic, name, _) in enumerate(IN_DB3, 1)
    ]
    rows = [
        (None, number, START + at, payload)
        for number, (_, name, types) in enumerate(IN_DB3, 1)
        for at, (_, payload) in enumerate(messages(types, name))
    ]
    database(path, TOPICS, MESSAGES, *topics, rows=rows)


def write_logs_mcap(path: Path) -> None:
    said = []
    for topic, encoding, name, kind, data in IN_MCAP + SENSORS:
        spelled = name.replace("/msg/", "/") if encoding == "ros1" else name
        channel = Channel(topic, encoding, Schema(spelled, kind, data))
        pairs = messages(*types_of(encoding, name))
        said += [(channel, START + at, payload) for at, (_, payload) in enumerate(pairs)]
    write_mcap(path, said)


def types_of(encoding: str, name: str) -> tuple[Typestore, str, str]:
    if encoding == "ros1":
        return ROS1, name, "serialize_ros1"
    return ROS2, name, "serialize_cdr"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    folder = tmp_path_factory.mktemp("definitions")
    write_db3(folder / "old.db3")
    write_logs_mcap(folder / "bare.mcap")
    with hl.open(folder / "store", create=True) as opened:
        for path in (folder / "old.db3", folder / "bare.mcap"):
            opened.record(path)
        for name in (
            "webviz653_empty_def_known.bag",
            "genpy137_formfeed.bag",
            "mcap404_no_newline.mcap",
        ):
            opened.record(CASES / name)
        yield opened


@pytest.mark.parametrize(("topic", "name", "types"), IN_DB3)
def test_a_db3_without_definitions(
    store: hl.Store, tmp_path: Path, topic: str, name: str, types: Typestore
) -> None:
    pairs = messages(types, name)
    wanted = [plain_of(types, name, message) for message, _ in pairs]
    compare_every_output(store.topic(topic), wanted, [payload for _, payload in pairs], tmp_path)
    (channel,) = [c for c in store.entry("old").channels if c.topic == topic]
    assert channel.metadata[SUPPLIED].endswith("fits the messages")
    assert channel.stats.unreadable == channel.stats.surplus == 0


@pytest.mark.parametrize(
    ("topic", "encoding", "name"),
    [case[:3] for case in IN_MCAP + SENSORS[::3]]
    + [pytest.param(*case[:3], marks=EXHAUSTIVE) for case in SENSORS[1::3] + SENSORS[2::3]],
)
def test_an_mcap_with_and_without_definitions(
    store: hl.Store, tmp_path: Path, topic: str, encoding: str, name: str
) -> None:
    types, _, write = types_of(encoding, name)
    pairs = messages(types, name, write)
    wanted = [plain_of(types, name, message) for message, _ in pairs]
    query = store.topic(topic)
    compare_every_output(query, wanted, [payload for _, payload in pairs], tmp_path)
    assert query.counters.unreadable == 0


def decoded(path: Path, topic: str, name: str, text: str | None) -> tuple[list[Any], list[bytes]]:
    """The messages of a bag as rosbags reads them with a definition."""
    types = get_typestore(Stores.ROS1_NOETIC)
    if text is not None:
        types.register(get_types_from_msg(text, name))
    with Reader(path) as reader:
        raw = [bytes(data) for _, _, data in reader.messages(reader.topics[topic].connections)]
    return [plain_of(types, name, types.deserialize_ros1(data, name)) for data in raw], raw


@pytest.mark.parametrize(
    ("log", "topic", "name", "text"),
    [
        ("webviz653_empty_def_known.bag", "/pt", "geometry_msgs/msg/PointStamped", None),
        (
            "genpy137_formfeed.bag",
            "/some",
            "my_msgs/msg/SomeMessage",
            "float64 x\nfloat64 y\n",
        ),
    ],
)
def test_bags_with_odd_definitions(
    store: hl.Store, tmp_path: Path, log: str, topic: str, name: str, text: str | None
) -> None:
    compare_every_output(store.topic(topic), *decoded(CASES / log, topic, name, text), tmp_path)


def test_one_byte_too_many(tmp_path: Path) -> None:
    path = CASES / "rosserial_trailing.bag"
    topic = "/ros_car/left_wheel_cmd"
    folder = tmp_path / "store"
    told = run("record", path, store=folder).err
    assert told.count("bytes left over") == 1
    assert f"{topic}: 5 messages with bytes left over behind" in told
    again = run("record", path, "--again", "--json", store=folder)
    assert again.json["messages_surplus"] == 5
    assert "bytes left over" not in run("record", path, "--again", "--quiet", store=folder).err
    assert "5 with bytes left over" in run("info", "rosserial_trailing", store=folder).out
    with hl.open(tmp_path / "store") as store:
        query = store.topic(topic).in_recording("rosserial_trailing")
        with Reader(path) as reader:
            raw = [bytes(data) for _, _, data in reader.messages()]
        values = [np.frombuffer(data[:4], "<f4")[0] for data in raw]
        assert {len(data) for data in raw} == {5}
        compare_every_output(query, [{"data": value} for value in values], raw, tmp_path)
        assert [message.decode().data for message in query] == values
        assert query.where("data >= 2").count() == sum(value >= 2 for value in values)
