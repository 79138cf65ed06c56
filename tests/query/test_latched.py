"""Latched messages in front of a slice: those that a subscriber receives which joins then."""

from __future__ import annotations

import io
import random
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from mcap.reader import make_reader

import hybridlog as hl
from hybridlog.cli.answers import write_answer
from hybridlog.columns.rows import reduced
from hybridlog.formats.slices import Front
from hybridlog.query.latching import KEEP_ALL, LatchedFront, depth_of
from hybridlog.query.query import Query
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.errors import ResourceError
from hybridlog_storage.messages import REDUCED, Batch, Channel, Schema, left_channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.independent import write_mcap
from tests.limits import Limit

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND


def profile(**policies: object) -> str:
    """A profile as rosbag2 writes it."""
    lines = [f"{name}: {value}" for name, value in policies.items()]
    lines += ["deadline:", "  sec: 9223372036", "  nsec: 854775807", "liveliness: 1"]
    return "- " + "\n  ".join(lines) + "\n"


ONE = profile(history=1, depth=1, reliability=1, durability=1)
TEN = profile(history=1, depth=10, reliability=1, durability=1)
VOLATILE = profile(history=1, depth=5, reliability=1, durability=2)
NAMED = profile(history="keep_last", depth=3, reliability="reliable", durability="transient_local")
UNKNOWN = profile(history=3, depth=0, reliability=1, durability=1)
ALL = profile(history="keep_all", depth=0, reliability="reliable", durability="transient_local")


@pytest.mark.parametrize(
    ("offered", "depth"),
    [
        ("", 0),
        (VOLATILE, 0),
        (ONE, 1),
        (TEN, 10),
        (TEN + NAMED, 13),
        (VOLATILE + TEN + VOLATILE, 10),
        (UNKNOWN + UNKNOWN, 2),
        (ALL, KEEP_ALL),
        (ONE + ALL, KEEP_ALL),
        (profile(history=2, depth=7, durability=1), KEEP_ALL),
        (profile(durability=1), 1),
        (profile(history=0, depth=4, durability="TRANSIENT_LOCAL"), 4),
        (profile(depth=2, durability="RMW_QOS_POLICY_DURABILITY_TRANSIENT_LOCAL"), 2),
        (profile(durability="volatile", depth=1), 0),
        (profile(durability=12, depth=1), 0),
        ('[{"history": "keep_last", "depth": 6, "durability": "transient_local"}]', 6),
        (repr(TEN + ONE).replace("'", '"'), 11),
        (ONE.removeprefix("- ").replace("\n  ", "\n"), 1),
        (TEN * 400, 4000),
        (TEN + "}{\n" + TEN, 20),
    ],
)
def test_depths_of_ros_2_profiles(offered: str, depth: int) -> None:
    assert depth_of(Channel("/t", "cdr", None, {"offered_qos_profiles": offered})) == depth


class Sent(NamedTuple):
    """A message, and the publishers that it is one of."""

    time: int
    topic: str
    publishers: str
    text: str


class Sender(NamedTuple):
    """A channel: topic, encoding, metadata, publishers, times of its messages in seconds."""

    topic: str
    metadata: dict[str, str]
    publishers: str
    times: list[float]
    encoding: str = "cdr"


def offered(*profiles: str) -> dict[str, str]:
    return {"offered_qos_profiles": "".join(profiles)}


def latch(caller: str = "", latching: str = "1") -> dict[str, str]:
    return {"latching": latching, **({"callerid": caller} if caller else {})}


SENDERS = [
    Sender("/map", offered(ONE), "map", [n * 1.0 for n in range(84)]),
    Sender("/two", offered(TEN, NAMED), "two", [n * 0.7 for n in range(100)]),
    Sender("/mixed", offered(VOLATILE, TEN), "mixed", [n * 1.1 for n in range(70)]),
    Sender("/unknown", offered(UNKNOWN, UNKNOWN), "unknown", [n * 2.0 for n in range(40)]),
    Sender("/all", offered(ALL), "all", [n * 0.5 for n in range(150)]),
    Sender("/few", offered(TEN), "few", [0.0, 3.0, 41.0]),
    Sender("/later", offered(TEN), "later", [60.0, 61.0]),
    Sender("/volatile", offered(VOLATILE), "", [n * 1.0 for n in range(80)]),
    # Two channels of one topic are publishers of their own.
    Sender("/twice", offered(ONE), "twice a", [n * 3.0 for n in range(20)]),
    Sender("/twice", offered(NAMED), "twice b", [1.0, 2.0, 2.5, 39.0]),
    # The node /n1 was started twice: one of its messages is current, not one a connection.
    Sender("/tf_static", latch("/n1"), "n1", [0.0, 5.0], "ros1"),
    Sender("/tf_static", latch("/n1"), "n1", [30.0, 50.0], "ros1"),
    Sender("/tf_static", latch("/n2", "true"), "n2", [4.0, 55.0], "ros1"),
    Sender("/tf_static", latch("/n3", "0"), "", [6.0, 7.0], "ros1"),
    Sender("/tf_static", latch(), "nobody", [8.0, 9.0], "ros1"),
    Sender("/tf_static", latch(), "nobody else", [9.5], "ros1"),
]
DEPTHS = {"two": 13, "mixed": 10, "unknown": 2, "all": 10**6, "few": 10, "later": 10, "twice b": 3}


def sent() -> list[Sent]:
    found = [
        Sent(BEGIN + round(time * SECOND), one.topic, one.publishers, f"{number} {time}")
        for number, one in enumerate(SENDERS)
        for time in one.times
    ]
    return sorted(found)


def in_force(at: int) -> list[Sent]:
    """What a subscriber to everything receives from before a time."""
    by_publishers: dict[str, list[Sent]] = {}
    for message in sent():
        if message.publishers and message.time < at:
            by_publishers.setdefault(message.publishers, []).append(message)
    return sorted(
        message
        for publishers, messages in by_publishers.items()
        for message in messages[-DEPTHS.get(publishers, 1) :]
    )


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The messages, out of order."""
    path = tmp_path_factory.mktemp("log") / "log.mcap"
    messages = sent()
    random.Random(7).shuffle(messages)
    schemas = {
        "cdr": Schema("p/msg/T", "ros2msg", b"string data"),
        "ros1": Schema("p/T", "ros1msg", b"string data"),
    }
    channels = [Channel(s.topic, s.encoding, schemas[s.encoding], s.metadata) for s in SENDERS]
    rows = [
        (channels[int(m.text.split()[0])], m.time, m.text.encode(), m.time - 5) for m in messages
    ]
    return write_mcap(path, rows, chunk_size=1000)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory, log: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("latched") / "store", create=True) as opened:
        opened.record(log, name="log")
        yield opened


def written(query: Query, front: Front | None = None) -> list[tuple[int, int, str]]:
    """Log time, publish time and text of the messages of a slice, as they stand in the file."""
    target = io.BytesIO()
    write_answer(query, "mcap", target, front=front or Front())
    reader = make_reader(io.BytesIO(target.getvalue()))
    return [
        (message.log_time, message.publish_time, message.data.decode())
        for _, _, message in reader.iter_messages(log_time_order=False)
    ]


@pytest.mark.parametrize("at", [0.5, 10, 45.5, 80])
def test_a_slice_begins_with_what_a_late_subscriber_receives(store: hl.Store, at: float) -> None:
    begin, end = BEGIN + round(at * SECOND), BEGIN + round((at + 2) * SECOND)
    query = store.query(store.topics(), [store.entry("log").id]).between(begin, end)
    front = in_force(begin)
    inside = [m for m in sent() if begin <= m.time < end]
    found = written(query)
    assert sorted(found[: len(front)]) == sorted((begin, m.time - 5, m.text) for m in front)
    assert sorted(found[len(front) :]) == sorted((m.time, m.time - 5, m.text) for m in inside)
    assert (query.counters.latched, query.counters.messages) == (len(front), len(inside))
    # With their own times, all messages are in order.
    kept = written(query, Front(original_times=True))
    assert [time for time, _, _ in kept] == sorted(m.time for m in [*front, *inside])
    assert sorted(text for _, _, text in kept) == sorted(m.text for m in [*front, *inside])
    assert sorted(written(query, Front(latched=False))) == sorted(found[len(front) :])
    assert query.counters.latched == 0


def test_only_chunks_of_what_is_in_force_are_read(store: hl.Store) -> None:
    schema = Schema("p/msg/T", "ros2msg", b"string data")
    large, small = (Channel(f"/in_order/{n}", "cdr", schema, offered(TEN)) for n in "ab")
    with store.start("in order", settings=SegmentSettings(chunk_size=1 << 10)) as recording:
        for n in range(84):
            recording.write(large, b"x" * 500, log_time=BEGIN + n * SECOND)
            if n < 3:
                recording.write(small, b"x", log_time=BEGIN + n * SECOND)

    def read(topic: str) -> int:
        query = store.topic(topic).between(BEGIN + 80 * SECOND, None)
        assert sum(len(batch) for batch, _ in query.latched()) == min(10, 3 if "b" in topic else 10)
        return query.counters.chunks_read

    # Those of ten messages, once to find the first and once to give them.
    assert read("/in_order/a") <= 2 * 11
    # Three messages are fewer than ten: the rest of the topic is not searched for more.
    assert read("/in_order/b") <= 3


def test_a_range_by_another_clock_begins_with_its_first_message(store: hl.Store) -> None:
    query = store.all_topics().in_recording("log").clock("publish")
    begin = BEGIN + 41 * SECOND
    # Messages are published 5 ns before they are logged.
    found = written(query.between(begin - 5, begin + SECOND))
    front = in_force(begin)
    assert sorted(found[: len(front)]) == sorted((begin, m.time - 5, m.text) for m in front)


@pytest.mark.parametrize("original_times", [False, True])
@pytest.mark.parametrize("at", [3, 41, 45.5])
def test_a_recorded_slice_begins_with_the_same(
    store: hl.Store, log: Path, *, at: float, original_times: bool
) -> None:
    begin, end = BEGIN + round(at * SECOND), BEGIN + round((at + 2) * SECOND)
    report = store.record(
        log,
        name=f"slice {at} {original_times}",
        between=(begin, end),
        again=True,
        original_times=original_times,
    )
    front = in_force(begin)
    inside = [m for m in sent() if begin <= m.time < end]
    assert (report.latched, report.entry.messages) == (len(front), len(front) + len(inside))
    assert report.skipped == len(sent()) - report.entry.messages
    messages = [*store.query(store.topics(), [report.entry.id])]
    found = [(m.log_time_ns, m.publish_time_ns, bytes(m.raw).decode()) for m in messages]
    want = [(m.time if original_times else begin, m.time - 5, m.text) for m in front]
    want += [(m.time, m.time - 5, m.text) for m in inside]
    assert sorted(found) == sorted(want)
    # The current message of each topic is the last one, although the log is out of order.
    for topic in ("/map", "/few"):
        newest = max(m for m in [*front, *inside] if m.topic == topic)
        query = store.query([topic], [report.entry.id])
        assert bytes(query.at(end - 1).raw).decode() == newest.text
        at_begin = max(m for m in [*front, *inside] if m.topic == topic and m.time <= begin)
        assert bytes(query.at(begin).raw).decode() == at_begin.text


def test_a_latched_message_without_payload_is_counted(store: hl.Store) -> None:
    channel = Channel("/reduced", "ros1", Schema("p/T", "ros1msg", b"uint8 x"), latch("/n4"))
    small = left_channel(channel, REDUCED)
    with store.start("reduced") as recording:
        recording.write(channel, b"a", log_time=BEGIN)
        recording.write(small, reduced(codec_for(channel), b"b"), log_time=BEGIN + 1)
        recording.write(channel, b"c", log_time=BEGIN + 2)
    query = store.topic("/reduced").between(BEGIN + 2, None)
    assert list(query.latched()) == []
    assert (query.counters.latched, query.counters.reduced) == (0, 1)


def test_times_of_a_front_without_publish_times() -> None:
    channels = [
        Channel("/map", "ros1", None, latch("/n"), has_publish_time=False),
        Channel("/map", "ros1", None, latch("/m"), has_publish_time=True),
        Channel("/log", "cdr", None, offered(ALL), has_publish_time=False),
    ]
    times = np.array([1, 2, 3], np.int64)
    rows = np.arange(3)
    batch = Batch(
        b"abc",
        rows,
        np.ones(3, np.int64),
        rows.astype(np.int32),
        times,
        times.copy(),
        rows.astype(np.uint32),
    )
    front = LatchedFront(10, original_times=False)
    assert not front.split(batch, np.zeros(3, np.bool_), channels).any()
    (held,) = front.batches()
    assert held.log_time.tolist() == [10, 10, 10]
    assert held.publish_time.tolist() == [10, 2, 10]
    assert front.messages == 3


def test_what_does_not_fit_in_memory_is_told(store: hl.Store, log: Path, limit: Limit) -> None:
    limit(latched_held=1)
    begin = BEGIN + 45 * SECOND
    report = store.record(log, name="tight", between=(begin, begin + SECOND), again=True)
    front = in_force(begin)
    kept = {m.publishers: m for m in front}.values()  # the last message of each publisher
    assert report.latched == len(kept)
    assert report.latched_left_out >= len(front) - len(kept)
    query = store.query(store.topics(), [report.entry.id]).between(begin, begin + 1)
    assert {bytes(m.raw).decode() for m in query} >= {m.text for m in kept}
    with pytest.raises(ResourceError, match="--no-latched"):
        list(store.topic("/map").in_recording("log").between(begin, None).latched())
