"""Questions to a store: what they cost, and what they refuse."""

from __future__ import annotations

import gc
import tracemalloc
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import asdict

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
from tests import independent, places
from tests.format_reader import Segment

SECOND = 10**9
Truth = dict[str, list[independent.Seen]]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("reader")


@pytest.fixture(scope="module")
def store(base: Path) -> Iterator[hl.Store]:
    """`robot`: four seconds of the simulated robot."""
    write_bag(base / "robot.bag", duration_s=4.0)
    with hl.open(base / "store", create=True) as opened:
        opened.record(base / "robot.bag", settings=SegmentSettings(span_size=0))
        yield opened


@pytest.fixture(scope="module")
def robot(base: Path, store: hl.Store) -> Truth:
    found: Truth = defaultdict(list)
    for message in independent.read_bag(base / "robot.bag"):
        found[message.topic].append(message)
    return found


def chunks_of(store: hl.Store, topic: str) -> int:
    """How many chunks hold a message of a topic, by the page of the format."""
    found = 0
    for _, path in places.segments(store.directory.path, store.entry("robot").id):
        segment = Segment(path)
        own = {number for number, about in segment.channels.items() if about[1] == topic}
        parts = [segment.parts_of(number) for number in range(len(segment.chunks))]
        found += sum(any(part.channel in own for part in chunk) for chunk in parts)
    return found


def start_of(store: hl.Store) -> int:
    span = store.entry("robot").span
    assert span is not None
    return span[0]


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


@pytest.mark.parametrize("topic", ["/base/scan", "/imu/data", "/camera/front/image_raw"])
def test_each_chunk_is_read_once(store: hl.Store, robot: Truth, topic: str) -> None:
    query, want = store.topic(topic), [m.payload for m in robot[topic]]
    assert [m.raw for m in query] == want
    counters = query.counters
    assert counters.chunks_read == chunks_of(store, topic)
    assert (counters.messages, counters.payload_bytes) == (len(want), sum(map(len, want)))
    # The same again counts anew, not on top.
    before = asdict(counters) | {"elapsed_s": 0}
    list(query)
    assert asdict(query.counters) | {"elapsed_s": 0} == before
    backwards = query.reverse()
    assert [m.raw for m in backwards] == want[::-1]
    assert backwards.counters.chunks_read == counters.chunks_read


def test_a_slice_reads_only_chunks_with_its_times(store: hl.Store, robot: Truth) -> None:
    begin = start_of(store) + SECOND
    query = store.topic("/base/scan").between(begin, begin + SECOND // 10)
    said = robot["/base/scan"]
    want = [m.payload for m in said if begin <= m.log_time < begin + SECOND // 10]
    assert [m.raw for m in query] == want != []
    assert 0 < query.counters.chunks_read <= 3 < chunks_of(store, "/base/scan")


def test_a_predicate_reads_only_chunks_with_an_answer(store: hl.Store, robot: Truth) -> None:
    wanted = robot["/base/scan"][40].payload
    query = store.topic("/base/scan").where(f"header.seq == {int.from_bytes(wanted[:4], 'little')}")
    assert [m.raw for m in query] == [wanted]
    assert (query.counters.chunks_read, query.counters.documents_read) == (1, 0)


def test_a_limit_bounds_what_is_read(store: hl.Store, robot: Truth) -> None:
    query = store.topic("/camera/front/image_raw").limit(1)
    (message,) = query
    assert message.raw == robot["/camera/front/image_raw"][0].payload
    assert query.counters.messages == 1
    assert query.counters.chunks_read <= 4
    query = query.limit(0)
    assert list(query) == []
    assert query.counters.chunks_read == 0


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda s: s.topic("/odom").fields("pose.pose.positon"), TopicError, "position"),
        (lambda s: s.topic("/odom").in_recording("x"), TopicError, "robot"),
        (lambda s: s.topic("/odom").clock("wall"), UsageError, "publish"),
        (lambda s: s.topic("/odom").every(1.5), UsageError, "at least 1"),
        (lambda s: s.topic("/odom").every(0), UsageError, "at least 1"),
        (lambda s: s.topic("/odom").limit("3"), UsageError, "whole number"),
        (lambda s: s.topic("/odom").limit(-1), UsageError, "whole number"),
        (lambda s: s.topic("/odom").fields(["n"]), UsageError, "names"),
        (lambda s: s.query("/odom"), UsageError, r"topic\('/odom'\)"),
        (lambda s: s.topic("/odom").between("+1s", "+2s").at("+3s"), UsageError, "combined"),
        (lambda s: s.topic("/imu/data").clock("header").at("+3s"), UsageError, "combined"),
        (lambda s: s.topic("/odom").between("+1h", "+2h").count(), TimeError, "spans"),
        (
            lambda s: [*s.topic("/cmd_vel").clock("header").between("+1s", "+2s")],
            *(TopicError, "header.stamp"),
        ),
        (
            lambda s: s.topic("/odom").clock("publish").between("+1s", "+2s").count(),
            *(TopicError, "publish"),
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


def test_memory_is_bounded_by_chunks_not_by_the_store(tmp_path: Path) -> None:
    topic = "/camera/front/image_raw"
    write_bag(tmp_path / "robot.bag", duration_s=25.0, topics=[topic])
    with hl.open(tmp_path / "store", create=True) as store:
        options = RecordOptions(settings=SegmentSettings(compression="none"))
        size = store.record(tmp_path / "robot.bag", options).entry.stored_bytes
        assert size > 25_000_000
        query = store.topic(topic)
        for each in (query, query.reverse(), query.where("height > 0"), query.every(2)):
            gc.collect()
            tracemalloc.start()
            total = sum(len(m.payload) for m in each)
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert total > 0
            assert peak < size / 3, each
