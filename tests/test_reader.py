"""Questions to a store: what they answer, what they cost, and what they refuse."""

from __future__ import annotations

import dataclasses
import gc
import json
import os
import shutil
import subprocess
import sys
import threading
import tracemalloc
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import hybridlog as hl
from benchmarks.simulator.write import write_bag
from hybridlog.record.recorder import RecordOptions
from hybridlog_storage.errors import (
    DefinitionError,
    HybridlogError,
    TimeError,
    TopicError,
    UsageError,
    WhereError,
)
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.data import DATA
from tests.indexed import documents_of
from tests.other_user import User, open_place

pytestmark = pytest.mark.mongo

SECOND = 10**9
LOGS = ["tilt_laser.bag", "auv_ros2.mcap", "compressed_image.bag", "luminar_pointcloud.bag"]


@dataclasses.dataclass(frozen=True)
class Decoded:
    """A message as `rosbags` decodes it."""

    log_time: int
    raw: bytes
    message: Any


Truth = dict[str, list[Decoded]]


def decoded(path: Path, topics: list[str] | None = None) -> Truth:
    """Messages of a log by topic, in order of log time."""
    store = get_typestore(Stores.ROS1_NOETIC)
    found: Truth = defaultdict(list)
    with AnyReader([path], default_typestore=store) as reader:
        chosen = [c for c in reader.connections if topics is None or c.topic in topics]
        for connection, log_time, raw in reader.messages(chosen):
            message = reader.deserialize(raw, connection.msgtype)
            found[connection.topic].append(Decoded(log_time, bytes(raw), message))
    return dict(found)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reader")


@pytest.fixture(scope="module")
def store(base: Path) -> Iterator[hl.Store]:
    """`robot` (four seconds of the simulated robot) and, where they are, real logs."""
    write_bag(base / "robot.bag", duration_s=4.0)
    with hl.open(base / "store", create=True, require_database=True) as opened:
        opened.record(base / "robot.bag", settings=SegmentSettings(span_size=0))
        for name in LOGS if DATA.is_dir() else []:
            opened.record(DATA / "real" / name, name=name.split(".")[0])
        yield opened


@pytest.fixture(scope="module")
def robot(base: Path, store: hl.Store) -> Truth:
    return decoded(base / "robot.bag")


def chunks_of(store: hl.Store, topic: str, begin: int = 0, end: int = 1 << 63) -> int:
    """How many chunks hold a message of a topic in a time range, by the index documents."""
    return len(
        {
            (d["_meta"]["rec"], d["_meta"]["ref"]["seg"], d["_meta"]["ref"]["chunk"])
            for d in documents_of(store, topic)
            if begin <= d["_meta"]["t"] < end
        }
    )


# What an answer costs.


def test_a_count_reads_no_payload(store: hl.Store, robot: Truth) -> None:
    query = store.topic("/base/scan")
    assert query.count() == len(robot["/base/scan"]) == query.counters.messages
    assert query.counters.chunks_read == query.counters.bytes_read == 0
    near = query.where("range_min < 100").between("+1s", "+2s")
    assert near.count() == sum(
        SECOND <= m.log_time - start_of(store) < 2 * SECOND for m in robot["/base/scan"]
    )
    assert near.counters.chunks_read == near.counters.documents_read == 0
    assert 0 < near.counters.bytes_read < 5000  # columns of the table


def start_of(store: hl.Store, recording: str = "robot") -> int:
    (entry,) = store.select([recording])
    assert entry.span is not None
    return entry.span[0]


def test_summaries_beside_their_arrays(store: hl.Store, robot: Truth) -> None:
    query = store.topic("/base/scan").fields("header.seq", "ranges.min", "ranges", "ranges.n")
    frame = query.to_pandas()
    assert query.counters.documents_read == 0
    assert query.counters.messages == len(frame)
    assert list(frame.columns) == ["header.seq", "ranges.min", "ranges", "ranges.n"]
    assert frame["header.seq"].tolist() == [m.message.header.seq for m in robot["/base/scan"]]
    want = [m.message.ranges[np.isfinite(m.message.ranges)].min() for m in robot["/base/scan"]]
    assert frame["ranges.min"].tolist() == [float(value) for value in want]
    assert frame["ranges.n"].tolist() == [len(cell) for cell in frame["ranges"]]
    indexed = [document["ranges"]["min"] for document in documents_of(store, "/base/scan")]
    assert frame["ranges.min"].tolist() == indexed
    assert frame.attrs["hybridlog"]["chunks_read"] > 0


@pytest.mark.parametrize("topic", ["/base/scan", "/imu/data", "/camera/front/image_raw"])
def test_each_chunk_is_read_once(store: hl.Store, robot: Truth, topic: str) -> None:
    query = store.topic(topic)
    assert [m.raw for m in query] == [m.raw for m in robot[topic]]
    counters = query.counters
    assert counters.chunks_read == chunks_of(store, topic)
    assert counters.messages == len(robot[topic])
    assert counters.payload_bytes == sum(len(m.raw) for m in robot[topic])
    # The same again counts anew, not on top.
    before = dataclasses.asdict(counters) | {"elapsed_s": 0}
    list(query)
    assert dataclasses.asdict(query.counters) | {"elapsed_s": 0} == before
    backwards = query.reverse()
    assert [m.raw for m in backwards] == [m.raw for m in reversed(robot[topic])]
    assert backwards.counters.chunks_read == counters.chunks_read


def test_all_topics_at_once_read_each_chunk_once(store: hl.Store) -> None:
    query = store.all_topics().in_recording("robot")
    (entry,) = store.select(["robot"])
    times = [m.log_time_ns for m in query]
    assert times == sorted(times)
    assert query.counters.chunks_read == entry.chunks
    assert query.counters.messages == entry.messages
    assert query.counters.bytes_read <= entry.stored_bytes


def test_a_slice_reads_only_chunks_with_its_times(store: hl.Store, robot: Truth) -> None:
    start = start_of(store)
    begin, end = start + SECOND, start + SECOND + 100_000_000
    query = store.topic("/base/scan").between(begin, end)
    want = [m.raw for m in robot["/base/scan"] if begin <= m.log_time < end]
    assert [m.raw for m in query] == want != []
    assert 0 < query.counters.chunks_read <= 3 < chunks_of(store, "/base/scan")


def test_a_predicate_reads_only_chunks_with_an_answer(store: hl.Store, robot: Truth) -> None:
    wanted = robot["/base/scan"][40].message.header.seq
    query = store.topic("/base/scan").where(f"header.seq == {wanted}")
    assert [m.raw for m in query] == [robot["/base/scan"][40].raw]
    assert query.counters.chunks_read == 1
    assert query.counters.documents_read == 0


def test_no_message_reads_no_chunk(store: hl.Store) -> None:
    query = store.topic("/odom").limit(0)
    assert list(query) == []
    assert query.counters.chunks_read == 0


def test_one_message_reads_one_chunk(store: hl.Store, robot: Truth) -> None:
    query = store.topic("/camera/front/image_raw").limit(1)
    (message,) = query
    assert message.raw == robot["/camera/front/image_raw"][0].raw
    assert query.counters.messages == 1
    assert query.counters.chunks_read <= 4


# What it answers.


def test_a_table_without_rows_has_all_columns(store: hl.Store) -> None:
    start = start_of(store)
    query = store.topic("/battery").between(start, start + 1)
    assert query.count() == 0
    assert query.to_arrow().num_rows == 0
    whole = store.topic("/battery").to_arrow().column_names
    assert query.to_arrow().column_names == whole
    assert list(query.to_pandas().columns) == whole[1:]
    assert list(query) == []


def test_messages_decode_as_they_were(store: hl.Store, robot: Truth) -> None:
    types = get_typestore(Stores.ROS1_NOETIC)
    for topic in ("/imu/data", "/diagnostics", "/lidar/points"):
        for got, want in zip(store.topic(topic).in_recording("robot"), robot[topic], strict=True):
            name = got.type.replace("/", "/msg/")
            assert types.serialize_ros1(got.decode(), name) == want.raw
            assert (got.log_time_ns, got.publish_time_ns) == (want.log_time, None)
            assert topic in repr(got)


def test_fields_of_a_message_are_its_document(store: hl.Store) -> None:
    for topic in ("/base/scan", "/imu/data", "/tf", "/diagnostics"):
        query = store.topic(topic).in_recording("robot").limit(20)
        key = store.entry("robot").key
        own = [d for d in documents_of(store, topic) if d["_meta"]["rec"] == key]
        for message, document in zip(query, own[:20], strict=True):
            meta = document.pop("_meta")
            document.pop("_id")
            # NaN equals NaN here, and nothing is rounded.
            assert json.dumps(message.fields) == json.dumps(document)
            assert (meta["seq"], meta["t"]) == (message.seq, message.log_time_ns)


# Which messages.


def write_json(
    path: Path, messages: Sequence[tuple[str, int, object]], metadata: dict[str, str] | None = None
) -> None:
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start()
        channels: dict[str, int] = {}
        for topic, time, value in messages:
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", 0, metadata or {})
            writer.add_message(channels[topic], time, json.dumps(value).encode(), time)
        writer.finish()  # type: ignore[no-untyped-call]


def test_a_range_that_is_empty_in_some_recordings(tmp_path: Path) -> None:
    """`2025-01-01` to `end` leaves out what was recorded before, and is no mistake."""
    first, later = 1_600_000_000 * SECOND, 1_700_000_000 * SECOND
    for name, epoch in (("first", first), ("later", later)):
        write_json(tmp_path / f"{name}.mcap", [("/x", epoch + SECOND * t, {}) for t in range(5)])
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        for name in ("first", "later"):
            store.record(tmp_path / f"{name}.mcap")
        query = store.topic("/x")
        for begin, end, want in (
            (1_650_000_000 * SECOND, "end", [later + SECOND * t for t in range(5)]),
            ("+3s", 1_650_000_000.0, [first + SECOND * 3, first + SECOND * 4]),
            ("2023-01-01", "-3s", [later, later + SECOND]),
        ):
            asked = query.between(begin, end)
            assert [m.log_time_ns for m in asked] == want
            assert asked.count() == len(want)
            assert len(asked.to_pandas()) == len(want)
        for begin, end, words in (
            ("2030-01-01", "end", "first spans .*; later spans"),
            ("start", "1999-01-01", "first spans .*; later spans"),
            ("2030-01-01", "2029-01-01", "empty"),
            ("-1s", "+1s", "empty"),
            (1_650_000_000, 1_650_000_001, "later spans"),
        ):
            with pytest.raises(TimeError, match=words):
                list(query.between(begin, end))


# What is refused.


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda s: s.topic("/nothing"), TopicError, "/base/scan"),
        (lambda s: s.topic("od"), TopicError, "/odom"),
        (lambda s: s.topic(), TopicError, "/base/scan"),
        (lambda s: s.topic("/odom").fields("pose.pose.positon"), TopicError, "position"),
        (lambda s: s.topic("/odom").in_recording("x"), TopicError, "robot"),
        (lambda s: s.topic("/odom").clock("wall"), UsageError, "publish"),
        (lambda s: s.topic("/odom").limit(-1), UsageError, "negative"),
        (
            lambda s: s.topic("/odom").between("+1s", "+2s").at("+3s"),
            UsageError,
            "cannot be combined",
        ),
        (
            lambda s: s.topic("/imu/data").clock("header").at("+3s"),
            UsageError,
            "cannot be combined",
        ),
        (lambda s: s.topic("/odom").every(0), UsageError, "at least 1"),
        (lambda s: s.topic("/odom").where("header.seq >"), WhereError, "header.seq"),
        (lambda s: s.topic("/odom").where("nothing > 1"), HybridlogError, "nothing"),
        (lambda s: s.topic("/odom").where({"$where": "1"}), WhereError, "where"),
        (lambda s: list(s.topic("/odom").between("+2s", "+1s")), TimeError, "empty"),
        (lambda s: list(s.topic("/odom").between("x", None)), TimeError, "x"),
        (lambda s: list(s.topic("/odom").between("1999-01-01", "1999-01-02")), TimeError, "spans"),
        (lambda s: s.topic("/odom").between("+1h", "+2h").count(), TimeError, "spans"),
        (
            lambda s: s.topic("/odom").between("1999-01-01", "2000-01-01").to_pandas(),
            TimeError,
            "spans",
        ),
        (
            lambda s: list(s.topic("/cmd_vel").clock("header").between("+1s", "+2s")),
            TopicError,
            "header.stamp",
        ),
        (
            lambda s: s.topic("/odom").clock("publish").between("+1s", "+2s").count(),
            TopicError,
            "publish",
        ),
    ],
)
def test_wrong_questions(
    store: hl.Store, ask: Any, error: type[HybridlogError], words: str
) -> None:
    with pytest.raises(error, match=words):
        ask(store)


def test_a_topic_without_a_definition_makes_no_table(tmp_path: Path) -> None:
    with (tmp_path / "x.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/raw", "something", 0)
        writer.add_message(channel, 5, b"abc", 5)
        writer.finish()  # type: ignore[no-untyped-call]
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        store.record(tmp_path / "x.mcap")
        query = store.topic("/raw")
        with pytest.raises(DefinitionError, match="/raw"):
            query.to_pandas()
        (message,) = query
        assert (message.raw, message.fields, message.type) == (b"abc", {}, "")
        with pytest.raises(DefinitionError):
            message.decode()


# Without leave to write.


AS_A_READER = """
import sys
import hybridlog as hl
from hybridlog_storage.errors import HybridlogError

store, log = sys.argv[1:]
with hl.open(store) as opened:
    assert opened.database is None
    query = opened.topic("/odom").in_recording("robot")
    print(query.count(), sum(len(m.raw) for m in query))
    try:
        opened.record(log, again=True)
    except HybridlogError:
        print("refused")
"""


def test_a_store_that_cannot_be_written_can_be_read(
    base: Path, store: hl.Store, robot: Truth
) -> None:
    with open_place() as place:
        shutil.copytree(base / "store", place / "store", ignore=shutil.ignore_patterns("mongod"))
        shutil.copy(base / "robot.bag", place)
        for path in [place, *place.rglob("*")]:
            path.chmod(0o555 if path.is_dir() else 0o444)
        arguments = ["-c", AS_A_READER, str(place / "store"), str(place / "robot.bag")]
        try:
            if os.geteuid() == 0:  # root is stopped by no permission, so another user asks
                place.chmod(0o755)
                out = User(place).python(*arguments).out
            else:
                command = [sys.executable, *arguments]
                out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        finally:
            for path in [place, *place.rglob("*")]:
                path.chmod(0o755)
    size = sum(len(m.raw) for m in robot["/odom"])
    assert out.split() == [str(len(robot["/odom"])), str(size), "refused"]


# Memory and threads.


def test_memory_is_bounded_by_chunks_not_by_the_store(tmp_path: Path) -> None:
    write_bag(tmp_path / "robot.bag", duration_s=25.0, topics=["/camera/front/image_raw"])
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        options = RecordOptions(settings=SegmentSettings(compression="none"))
        report = store.record(tmp_path / "robot.bag", options)
        size = report.entry.stored_bytes
        assert size > 25_000_000
        query = store.topic("/camera/front/image_raw")
        for each in (query, query.reverse(), query.where("height > 0"), query.every(2)):
            gc.collect()
            tracemalloc.start()
            total = sum(len(m.payload) for m in each)
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert total > 0
            assert peak < size / 3, each


def test_several_threads_share_a_store(store: hl.Store, robot: Truth) -> None:
    topics = ["/odom", "/base/scan", "/imu/data", "/camera/front/image_raw"]
    problems: list[object] = []

    def ask(topic: str) -> None:
        try:
            for _ in range(3):
                query = store.topic(topic).in_recording("robot")
                assert [m.raw for m in query] == [m.raw for m in robot[topic]]
                assert query.where("header.seq >= 0").count() == len(robot[topic])
                assert len(query.to_pandas()) == len(robot[topic])
        except BaseException as error:
            problems.append(error)

    threads = [threading.Thread(target=ask, args=(topic,)) for topic in topics]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert problems == []


def test_an_answer_survives_its_store(base: Path, store: hl.Store, robot: Truth) -> None:
    with hl.open(base / "store", require_database=True) as other:
        messages = list(other.topic("/odom").in_recording("robot").limit(10))
    assert [m.raw for m in messages] == [m.raw for m in robot["/odom"][:10]]
    stamps = [m.message.header.stamp for m in robot["/odom"][:10]]
    assert [m.header_stamp_ns for m in messages] == [s.sec * SECOND + s.nanosec for s in stamps]


def test_tables_in_parts_are_one_table_in_order(tmp_path: Path) -> None:
    """Parts of bounded size end between messages, on every topic at the same time."""
    types = get_typestore(Stores.ROS2_HUMBLE)
    count = 75_000
    with (tmp_path / "many.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)
        writer.start("ros2")
        definition, _ = types.generate_msgdef("std_msgs/msg/Int32", ros_version=2)
        schema = writer.register_schema("std_msgs/msg/Int32", "ros2msg", definition.encode())
        channels = [writer.register_channel(topic, "cdr", schema) for topic in ("/x", "/y")]
        for number in range(count):
            for channel in channels:
                payload = b"\0\1\0\0" + number.to_bytes(4, "little")
                writer.add_message(channel, SECOND + number, payload, SECOND + number)
        writer.finish()  # type: ignore[no-untyped-call]
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        store.record(tmp_path / "many.mcap", settings=SegmentSettings(chunk_size=1 << 20))
        for query in (store.topic("/x", "/y"), store.topic("/x", "/y").reverse()):
            parts = list(query.to_tables())
            assert len(parts) > 1
            numbers = [n for part in parts for n in part["data"].to_pylist()]
            assert len(numbers) == 2 * count
            assert numbers == sorted(numbers, reverse=query.question.reverse)


def test_words_mean_what_is_in_the_store_now(tmp_path: Path) -> None:
    """Topics and predicates whose meaning is remembered are understood anew after a change."""
    number = Schema("std_msgs/Int32", "ros1msg", b"int32 data\n")
    string = Schema("std_msgs/String", "ros1msg", b"string data\n")
    with hl.open(tmp_path / "store", create=True, require_database=True) as store:
        with store.start("numbers") as recording:
            recording.write(Channel("/a/talk", "ros1", number), (7).to_bytes(4, "little"))
        for _ in range(2):
            assert store.topic("talk").where("data == 7").count() == 1
            with pytest.raises(WhereError, match="a number, the value is a string"):
                store.topic("talk").where("data == 'seven'")
        with hl.open(tmp_path / "store") as other, other.start("strings") as recording:
            recording.write(Channel("/b/talk", "ros1", string), b"\x05\0\0\0seven")
            recording.write(Channel("/a/talk", "ros1", string), b"\x05\0\0\0seven")
        for _ in range(2):
            with pytest.raises(TopicError, match="/b/talk"):
                store.topic("talk")
            assert store.topic("/a/talk").where("data == 'seven'").count() == 1
