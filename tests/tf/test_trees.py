"""Trees of several robots, topics and recordings; and stamps that are not set."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog_storage.errors import TopicError, UsageError
from hybridlog_storage.messages import Channel
from tests.cli.running import run
from tests.odd_messages import ros_channel
from tests.ros_values import ROS2
from tests.tf.test_tree import BEGIN, MOVING, S, said

TYPES = ROS2.types
TF, POINT = "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PointStamped"


def header(frame: str, stamp: int) -> Any:
    time = TYPES["builtin_interfaces/msg/Time"](*divmod(stamp, S))
    return TYPES["std_msgs/msg/Header"](time, frame)


def moved(parent: str, child: str, stamp: int, x: float) -> Any:
    place = TYPES["geometry_msgs/msg/Vector3"](x, 0.0, 0.0)
    turned = TYPES["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = TYPES["geometry_msgs/msg/Transform"](place, turned)
    return TYPES["geometry_msgs/msg/TransformStamped"](header(parent, stamp), child, pose)


def tf(parent: str, child: str, stamp: int, x: float) -> Any:
    return TYPES[TF]([moved(parent, child, stamp, x)])


def point(frame: str, stamp: int, x: float = 0) -> Any:
    return TYPES[POINT](header(frame, stamp), TYPES["geometry_msgs/msg/Point"](x, 0.0, 0.0))


Said = tuple[str, Any, int]  # topic, message, log time


def recorded(store: hl.Store, name: str, messages: Sequence[Said]) -> None:
    kinds = {topic: message.__msgtype__ for topic, message, _ in messages}
    channels = {topic: ros_channel(topic, kind, 2) for topic, kind in kinds.items()}
    with store.start(name) as recording:
        for topic, message, at in messages:
            data = bytes(ROS2.serialize_cdr(message, kinds[topic]))
            recording.write(channels[topic], data, log_time=at)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        yield store


def places(query: hl.Query) -> list[float | None]:
    return query.to_arrow()["point.x"].to_pylist()


def test_each_robot_has_its_tree(store: hl.Store, tmp_path: Path) -> None:
    """Frames that a namespace lacks come from the root's; Foxglove's belong to that anywhere."""
    at = BEGIN + S
    recorded(
        store,
        "two",
        [
            ("/a/tf", tf("odom", "base", at, 1), at),
            ("/b/tf", tf("odom", "base", at, 50), at),
            ("/tf_static", tf("map", "odom", at, 100), at),
            ("/tf", tf("odom", "base", at, 9), at),
            ("/motion", moved("odom", "base", at, 7000), at),
            ("/a/cam/p", point("base", at), at),
            ("/b/p", point("base", at), at),
            ("/p", point("odom", at), at),
        ],
    )
    for topic, odom, of_map in (("/a/cam/p", 1, 101), ("/b/p", 50, 150)):
        assert places(store.topic(topic).in_frame("odom")) == [odom]
        assert places(store.topic(topic).in_frame("map")) == [of_map]
        assert store.tf(of=topic).transform("odom", "base", at).translation[0] == odom
    assert places(store.topic("/p").in_frame("map")) == [100]
    assert places(store.topic("/b/p").in_frame("odom", tf_topics=["/a/tf"])) == [1]
    assert store.tf().names == ["map", "odom", "base"]
    assert store.tf(topics=["/motion"]).transform("odom", "base", at).translation[0] == 7000
    path = tmp_path / "store"
    rows = [json.loads(line) for line in run("tf", "-F", "jsonl", store=path).out.splitlines()]
    assert [(row["tree"], row["frame"]) for row in rows] == [
        ("/tf", "map"), ("/tf", "odom"), ("/tf", "base"),
        ("/a/tf", "map"), ("/a/tf", "odom"), ("/a/tf", "base"),
        ("/b/tf", "map"), ("/b/tf", "odom"), ("/b/tf", "base"),
    ]  # fmt: skip
    way = ("tf", "odom", "base", "--at", "start", "-F", "jsonl")
    assert json.loads(run(*way, "--tf-topic", "/b/tf", store=path).out)["x"] == 50
    fetch = ("fetch", "/b/p", "--in-frame", "odom", "-F", "jsonl", "--fields", "point.x")
    assert json.loads(run(*fetch, "--tf-topic", "a/tf", store=path).out)["point.x"] == 1


def test_trees_without_a_root_are_chosen(store: hl.Store) -> None:
    recorded(store, "one", [("/a/tf", tf("odom", "base", BEGIN, 1), BEGIN)])
    assert store.tf("one").names == ["odom", "base"]  # the only one
    recorded(store, "two", [(f"/{n}/tf", tf("odom", "base", BEGIN, 1), BEGIN) for n in "ab"])
    with pytest.raises(TopicError, match=r"choose one .* /a/tf, /b/tf"):
        store.tf("two")


def test_foxglove_frames_are_the_roots(store: hl.Store) -> None:
    with store.start("fox") as recording:
        channel = Channel("/robot/frames", "json", MOVING.schema)
        recording.write(channel, said(0, "map", "base", (3, 0, 0)), log_time=BEGIN)
    assert store.tf().transform("map", "base", BEGIN).translation[0] == 3


def test_topics_that_give_a_frame_two_parents(store: hl.Store) -> None:
    at = BEGIN + S
    messages = [
        ("/tf", tf("odom", "base", BEGIN, 1), BEGIN),
        ("/tf", tf("odom", "base", at, 1), at),
        ("/tf_static", tf("map", "base", at, 2), at),
        ("/tf_static", tf("map", "odom", at, 3), at),
        ("/p", point("base", at), at),
    ]
    recorded(store, "x", messages)
    found = store.topic("/p").in_frame("map")
    assert places(found) == [None]
    told = "base is below odom by /tf, and at the same time below map by /tf_static"
    assert told in " ".join(found.completeness().sentences)
    assert told in " ".join(store.tf().problems()).lower()
    assert store.tf().transform("map", "odom", at).translation[0] == 3


def test_topics_that_give_a_frame_a_parent_one_after_the_other(store: hl.Store) -> None:
    messages = [("/tf", tf("odom", "base", BEGIN + n, 1), BEGIN + n) for n in range(2)]
    with store.start("x") as recording:
        channel = Channel("/fox", "json", MOVING.schema)
        recording.write(channel, said(9, "map", "base", (3, 0, 0)), log_time=BEGIN + 9 * S)
        for topic, message, at in messages:
            data = bytes(ROS2.serialize_cdr(message, TF))
            recording.write(ros_channel(topic, TF, 2), data, log_time=at)
    frame = store.tf().frames["base"]
    assert (frame.parents, frame.conflict) == (("odom", "map"), "")


def test_a_static_transform_that_changes(store: hl.Store) -> None:
    later = BEGIN + 10 * S
    messages = [("/tf_static", tf("map", "base", 5, x), BEGIN + n) for n, x in enumerate((1, 1))]
    recorded(store, "x", [*messages, ("/tf_static", tf("map", "base", 5, 2), later)])
    tree = store.tf()
    times = [5, BEGIN, later - 1, later, later + S]
    assert tree.lookup("map", "base", times).translation[:, 0].tolist() == [1, 1, 1, 2, 2]
    assert "base is static and changed 1 time: until 2023" in " ".join(tree.problems())


def test_a_recording_without_transforms(store: hl.Store) -> None:
    for n in range(3):
        at = BEGIN + n * S
        frames = [("/tf", tf("map", "base", at, n), at)] if n != 1 else []
        recorded(store, f"r{n}", [*frames, ("/p", point("base", at), at)])
    query = store.topic("/p").in_frame("map")
    assert places(query) == [0, None, 2]
    assert "1 message without a transform to map: no such frame" in " ".join(
        query.completeness().sentences
    )
    with pytest.raises(TopicError, match="no frame 'maap'"):
        store.topic("/p").in_frame("maap").to_arrow()


def test_a_stamp_of_zero_is_no_time(store: hl.Store) -> None:
    """It matches nothing, lies in no range of the header clock, and is counted."""
    stamps = [0, S, 2 * S, 0, 3 * S]
    recorded(
        store,
        "x",
        [
            (topic, point("base", stamp, n), BEGIN + n * S + m)
            for n, stamp in enumerate(stamps)
            for m, topic in enumerate(("/a", "/b"))
        ],
    )
    sets = store.sync(["/a", "/b"])
    assert [tuple(m.fields["point"]["x"] for m in one) for one in sets] == [(1, 1), (2, 2), (4, 4)]
    assert sets.left_out == (2, 2)
    (entry,) = store.recordings()
    known = [c.stats.first_stamp for c in entry.channels if c.stats.first_stamp is not None]
    assert min(known) == S
    query = store.topic("/a").clock("header")
    assert places(query.between("+0s", "+1.5s")) == [1, 2]  # begins at the first that is set
    whole = query.between(None, None)
    assert places(whole) == [1, 2, 4]
    assert "2 messages are at no time of the header clock" in " ".join(
        whole.completeness().sentences
    )
    assert store.topic("/a").fields("stamp").to_arrow()["stamp"].null_count == 2
    rows = store.align("/a", ["/b"], clock="header").to_arrow()
    assert rows["b.point.x"].to_pylist() == [None, 1, 2, None, 4]
    assert store.topic("/a").limit(1).to_arrow()["header.stamp"].cast("int64").to_pylist() == [0]
    (message,) = store.topic("/a").limit(1)
    assert message.header_stamp_ns is None


def test_topics_by_type(store: hl.Store, tmp_path: Path) -> None:
    messages = [(topic, point("base", S), BEGIN) for topic in ("/a", "/b")]
    recorded(store, "x", [*messages, ("/tf", tf("map", "base", S, 1), BEGIN)])
    assert store.topics("PointStamped") == store.topics("geometry_msgs/*") == ["/a", "/b"]
    assert store.recordings("x").topics(POINT, "TFMessage") == store.topics()
    with pytest.raises(TopicError, match=r"did you mean .*PointStamped"):
        store.topics("PointStampd")
    path = tmp_path / "store"
    assert run("fetch", "--topic-type", "Point*", "--count", store=path).out == "2\n"
    assert run("fetch", "tf", "--topic-type", "Point*", "--count", store=path).out == "3\n"


def test_a_closed_store(store: hl.Store) -> None:
    recorded(store, "x", [("/gps/battery/state", point("base", S), BEGIN)])
    query = store.topic("state")
    store.close()
    for asked in (query.count, query.to_arrow, store.topics):
        with pytest.raises(UsageError, match="is closed: open it again"):
            asked()


def test_an_unset_stamp_has_no_transform(store: hl.Store, tmp_path: Path) -> None:
    messages: list[Said] = [
        ("/tf", tf("map", "base", 0, -1000), BEGIN),
        *(("/tf", tf("map", "base", BEGIN + n * S, 1), BEGIN + n * S) for n in range(2)),
        ("/tf_static", tf("base", "cam", 0, 5), BEGIN),
        *(("/p", point("cam", n * (BEGIN + S)), BEGIN + S) for n in range(2)),
    ]
    recorded(store, "x", messages)
    for frame, wanted in (("map", 6), ("base", 5)):
        query = store.topic("/p").in_frame(frame)
        assert places(query) == [None, wanted]
        assert "1 message without a transform to " in " ".join(query.completeness().sentences)
        assert "a stamp of zero, which is not set" in " ".join(query.completeness().sentences)
    tree = store.tf()
    assert tree.invalid == {"a stamp of zero, which is not set": 1}
    assert tree.frames["base"].stamps.tolist() == [BEGIN, BEGIN + S]
    assert repr(tree) == "<FrameTree map, base, cam>"
    path = tmp_path / "store"
    said = run("tf", "map", "--topic-type", "PointStamped", "-F", "jsonl", store=path)
    assert [json.loads(line)["x"] for line in said.lines] == [None, 6]
    rows = run("align", "--to", "/p", "--topic-type", "TFMessage", "-F", "jsonl", store=path)
    assert all("transforms" in line for line in rows.lines)
