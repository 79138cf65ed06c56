"""What an answer says about itself: what it could not see, and why it may be empty."""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np
import pytest

import hybridlog as hl
from hybridlog_storage.errors import TimeError
from hybridlog_storage.messages import Channel, Schema

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
NUMBER = Schema("p/N", "ros1msg", b"int32 n\nfloat32[] ranges")
STAMPED = Schema(
    "p/S",
    "ros1msg",
    b"Header header\n" + b"=" * 80 + b"\nMSG: std_msgs/Header\n"
    b"uint32 seq\ntime stamp\nstring frame_id\n",
)


def number(n: int) -> bytes:
    return np.array([n, 0], np.int32).tobytes()


def stamp(seconds: int) -> bytes:
    return np.array([0, seconds, 0, 0], np.uint32).tobytes()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    numbers = Channel("/n", "ros1", NUMBER)
    early, near = Channel("/early", "ros1", STAMPED), Channel("/near", "ros1", STAMPED)
    text, opaque = Channel("/j", "json", None), Channel("/opaque", "cbor", None)
    path = tmp_path_factory.mktemp("remarks") / "store"
    with hl.open(path, create=True) as opened:
        with opened.start("monday") as monday:
            for n in range(6):
                at = BEGIN + n * SECOND
                monday.write(numbers, b"x" if n == 4 else number(n), log_time=at)
                monday.write(early, stamp(n) if n else b"x", log_time=at)
                monday.write(near, stamp(BEGIN // SECOND - 3600 + n), log_time=at)
                fields = {"n": n, "list": [{"deep": 1}], "long": [1.5] * 40}
                monday.write(text, json.dumps(fields).encode(), log_time=at)
                monday.write(opaque, b"abc", log_time=at)
            monday.write(Channel("/late", "ros1", NUMBER), number(0), log_time=BEGIN + 20 * SECOND)
        with opened.start("tuesday") as tuesday:
            tuesday.write(numbers, number(7), log_time=BEGIN + 86_400 * SECOND)
        yield opened


def test_an_answer_that_lacks_nothing_has_no_remarks(store: hl.Store) -> None:
    for query in (
        store.topic("/n"),
        store.topic("/j").where("n > 3 and long.min > 1 and list[0].deep == 1"),
        store.topic("/n").between(BEGIN, BEGIN + 2 * SECOND).where("n >= 0 and ranges.n == 0"),
        store.topic("/near").clock("header").between("start", "end"),
        store.topic("/j").where("n > 99"),
        store.topic("/n").limit(0),
    ):
        query.count()
        assert not query.completeness().sentences


@pytest.mark.parametrize(
    ("topic", "predicate", "words"),
    [
        ("/n", "n > 1", "1 message could not be tested: no definition that fits."),
        ("/opaque", "n > 1", "6 messages could not be tested: no definition that fits."),
    ],
)
def test_what_a_predicate_did_not_see(
    store: hl.Store, topic: str, predicate: str, words: str
) -> None:
    query = store.topic(topic).where(predicate)
    for answer in (query.count, lambda: [*query], query.to_arrow if topic == "/n" else query.count):
        answer()
        (remark,) = query.completeness().sentences
        assert remark.startswith(words)
    assert query.where("_meta.t > 0").counters.unreadable == 0


def test_messages_at_no_time_of_the_header_clock(store: hl.Store) -> None:
    for query, want in (
        (store.topic("/early").clock("header").between("start", "end"), 5),
        (store.topic("/early").clock("header").between(BEGIN, None), 0),
    ):
        assert query.count() == want
        assert [*query.completeness().sentences] == [
            "1 message is at no time of the header clock: no header stamp, or one of zero."
        ]
    by_log = store.topic("/early").between("start", "end")
    assert by_log.count() == 6
    assert not by_log.completeness().sentences


def test_times_beside_all_messages_are_refused(store: hl.Store) -> None:
    day = BEGIN + 86_400 * SECOND
    with pytest.raises(TimeError, match=r"Nothing was recorded .*: monday spans "):
        store.topic("/n").in_recording("monday").between(day, day + 1).count()
    for begin, stop in (("10", "12s"), ("10.5", None)):  # "+10" is meant
        with pytest.raises(TimeError, match=r"10\S* is 1970-\S+, .*; \+10\S* is that long after"):
            store.topic("/n").between(begin, stop).count()
    assert (
        store.topic("/n").between("0", "3s").count() == store.topic("/n").between(10, "3s").count()
    )
    with pytest.raises(TimeError, match=r"Z\.$"):
        store.topic("/n").between(day + SECOND, day + 2 * SECOND).count()


def test_messages_that_changes_and_statistics_leave_out(store: hl.Store) -> None:
    query = store.topic("/n").in_recording("monday")
    assert len(query.changes("n", pause="1ns")) == 4
    assert query.counters.unreadable == 1
    assert len(query.between(BEGIN + 5 * SECOND, None).changes("n")) == 1
    late = query.between(BEGIN + 5 * SECOND, None)
    late.changes("n")
    assert late.counters.unreadable == 0  # it is before the range
    asked = store.topic("/n").in_recording("monday")
    (row,) = asked.stats("n")
    assert (row.count, asked.counters.unreadable) == (5, 1)
