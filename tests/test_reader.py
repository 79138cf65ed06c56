"""Questions to a store: what they answer, what they cost, and what they refuse."""

from __future__ import annotations

import gc
import tracemalloc
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import asdict
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
)
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.indexed import documents_of

pytestmark = pytest.mark.mongo

SECOND = 10**9


@dataclass(frozen=True)
class Decoded:
    """A message as `rosbags` decodes it."""

    log_time: int
    raw: bytes
    message: Any


Truth = dict[str, list[Decoded]]


def decoded(path: Path) -> Truth:
    """Messages of a log by topic, in order of log time."""
    store = get_typestore(Stores.ROS1_NOETIC)
    found: Truth = defaultdict(list)
    with AnyReader([path], default_typestore=store) as reader:
        for connection, log_time, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found[connection.topic].append(Decoded(log_time, bytes(raw), message))
    return dict(found)


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reader")


@pytest.fixture(scope="module")
def store(base: Path) -> Iterator[hl.Store]:
    """`robot`: four seconds of the simulated robot."""
    write_bag(base / "robot.bag", duration_s=4.0)
    with hl.open(base / "store", create=True, require_database=True) as opened:
        opened.record(base / "robot.bag", settings=SegmentSettings(span_size=0))
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
    entry = store.entry(recording)
    assert entry.span is not None
    return entry.span[0]


@pytest.mark.parametrize("topic", ["/base/scan", "/imu/data", "/camera/front/image_raw"])
def test_each_chunk_is_read_once(store: hl.Store, robot: Truth, topic: str) -> None:
    query = store.topic(topic)
    assert [m.raw for m in query] == [m.raw for m in robot[topic]]
    counters = query.counters
    assert counters.chunks_read == chunks_of(store, topic)
    assert counters.messages == len(robot[topic])
    assert counters.payload_bytes == sum(len(m.raw) for m in robot[topic])
    # The same again counts anew, not on top.
    before = asdict(counters) | {"elapsed_s": 0}
    list(query)
    assert asdict(query.counters) | {"elapsed_s": 0} == before
    backwards = query.reverse()
    assert [m.raw for m in backwards] == [m.raw for m in reversed(robot[topic])]
    assert backwards.counters.chunks_read == counters.chunks_read


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


def test_a_limit_bounds_what_is_read(store: hl.Store, robot: Truth) -> None:
    query = store.topic("/camera/front/image_raw").limit(1)
    (message,) = query
    assert message.raw == robot["/camera/front/image_raw"][0].raw
    assert query.counters.messages == 1
    assert query.counters.chunks_read <= 4
    query = query.limit(0)
    assert list(query) == []
    assert query.counters.chunks_read == 0


# What is refused.


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda s: s.topic("/odom").fields("pose.pose.positon"), TopicError, "position"),
        (lambda s: s.topic("/odom").in_recording("x"), TopicError, "robot"),
        (lambda s: s.topic("/odom").clock("wall"), UsageError, "publish"),
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
        (lambda s: s.topic("/odom").between("+1h", "+2h").count(), TimeError, "spans"),
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
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        with store.start("x") as recording:
            recording.write(Channel("/raw", "something", None), b"abc", log_time=5)
        query = store.topic("/raw")
        with pytest.raises(DefinitionError, match="/raw"):
            query.to_pandas()
        (message,) = query
        assert (message.raw, message.fields, message.type) == (b"abc", {}, "")
        with pytest.raises(DefinitionError):
            message.decode()


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
