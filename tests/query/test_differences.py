"""Questions on which engines once differed, or were silently wrong."""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.query.intervals import Intervals
from hybridlog_storage.errors import TopicError
from hybridlog_storage.messages import Channel, Schema
from tests.query.test_engines import WAYS, only

SECOND = 10**9
NUMBER = Schema("pkg/N", "ros1msg", b"float64 x")


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, mongo="none") as opened:
        yield opened


def record(store: hl.Store, rows: list[tuple[Channel, bytes]], name: str = "log") -> None:
    with store.start(name) as recording:
        for number, (channel, payload) in enumerate(rows):
            recording.write(channel, payload, log_time=(number + 1) * SECOND, publish_time=number)


def as_json(*values: Any) -> list[tuple[Channel, bytes]]:
    channel = Channel("/j", "json", None)
    return [(channel, json.dumps(value).encode()) for value in values]


def number(value: float) -> bytes:
    return np.array([value], np.float64).tobytes()


def counts(store: hl.Store, topic: str, predicate: Any) -> set[int]:
    """Counts and numbers of messages, in each way that can answer."""
    found = set()
    for way in WAYS:
        with only(way):
            query = store.topic(topic).where(predicate)
            found |= {query.count(), len(list(query))}
    return found


def test_a_field_may_begin_as_ours_do(store: hl.Store) -> None:
    rows = as_json({"_metadata": 1}, {"_metadata": 3}, {"y": 1})
    record(store, [*rows, (rows[0][0], b"{broken")])
    assert counts(store, "/j", "_metadata missing") == {1}
    assert counts(store, "/j", "not (_metadata > 1)") == {2}


def test_publish_times_of_two_channels(store: hl.Store) -> None:
    silent = Channel("/n", "ros1", NUMBER, {"of": "one"}, has_publish_time=False)
    telling = Channel("/n", "ros1", NUMBER, {"of": "other"})
    record(store, [*[(silent, number(1))] * 3, *[(telling, number(2))] * 4])
    assert counts(store, "/n", "_meta.pub exists") == {4}
    assert counts(store, "/n", "_meta.pub missing") == {3}


def test_equal_questions_ask_the_same(store: hl.Store) -> None:
    record(store, as_json(*[{"n": n} for n in range(10)]))
    asked = store.topic("/j")
    nanoseconds, seconds = asked.between(0, 5), asked.between(0.0, 5.0)
    assert nanoseconds != seconds
    assert seconds == asked.between(0, 5 * SECOND)
    assert len({nanoseconds, seconds, asked.between(0, 5)}) == 2
    windows = asked.where("n == 1").windows("1s", "1s")
    again = Intervals([(windows[0].recording, np.array([[SECOND, 3 * SECOND, 1]]))])
    assert asked.during(again) == asked.during(windows)
    question = asked.where("n ~ 'x' and n > 1").during(windows).every(2).question
    assert pickle.loads(pickle.dumps(question)) == question
    assert hash(pickle.loads(pickle.dumps(question))) == hash(question)


def test_a_recording_that_is_gone_is_not_left_out(store: hl.Store) -> None:
    record(store, as_json({"n": 1}), "a")
    record(store, as_json({"n": 1}, {"n": 2}), "b")
    query = store.topic("/j").in_recording("a", "b").where("n >= 1")
    assert query.count() == 3
    everything = store.topic("/j").where("n >= 1")
    with hl.open(store.directory.path) as other:
        other.remove("a")
    store.refresh()
    for ask in (query.count, lambda: list(query), query.to_pandas):
        with pytest.raises(TopicError, match="removed"):
            ask()
    assert everything.count() == 2  # of whatever there is now


# Messages that a predicate cannot be asked of.

TEXTS = Schema("pkg/T", "ros1msg", b"int32 n\nstring text")


def text_of(n: int, text: str) -> bytes:
    return np.int32(n).tobytes() + np.uint32(len(text)).tobytes() + text.encode()


@pytest.fixture(scope="module")
def blind(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """Topics with unreadable payloads and no definition."""
    large = "x" * 9_000
    ros, as_text = Channel("/r", "ros1", TEXTS), Channel("/j", "json", None)
    mixed = [Channel("/mixed", "ros1", TEXTS), Channel("/mixed", "cbor", None)]
    nothing = Channel("/nothing", "ros1", None)
    rows: list[tuple[Channel, bytes]] = []
    for n in range(6):
        text = large if n % 3 == 2 else "abc"
        rows.append((ros, b"short" if n == 4 else text_of(n, text)))
        fields = b"{broken" if n == 4 else json.dumps({"n": n, "text": text}).encode()
        rows.append((as_text, fields))
        rows.append((mixed[n % 2], text_of(n, "abc")))
        rows.append((nothing, b"abc"))
    path = tmp_path_factory.mktemp("blind") / "store"
    with hl.open(path, create=True, mongo="none") as opened:
        with opened.start("log") as recording:
            for number, (channel, payload) in enumerate(rows):
                recording.write(channel, payload, log_time=(1 + number // 4) * SECOND)
        yield opened


@pytest.mark.parametrize("way", [*WAYS])
@pytest.mark.parametrize(
    ("topic", "between", "predicate", "want", "unasked"),
    [
        ("/r", None, "n > 1", [3, 4, 6], 1),
        ("/r", None, "not (n > 1)", [1, 2], 1),
        ("/r", None, "text ~ 'xxx'", [3, 6], 1),
        ("/r", (4, 6), "n > 1", [4], 1),
        ("/r", None, "_meta.t > 1", [1, 2, 3, 4, 5, 6], 0),
        ("/j", None, "n > 1", [3, 4, 6], 1),
        ("/mixed", None, "n > 1", [3, 5], 3),
        ("/mixed", (1, 3), "n != 9", [1], 1),
        ("/nothing", (2, 4), "n missing", [], 2),
        ("/nothing", None, "_meta.t > 1", [1, 2, 3, 4, 5, 6], 0),
    ],
)
def test_what_a_predicate_cannot_be_asked_of_is_counted(
    blind: hl.Store,
    way: str,
    topic: str,
    between: tuple[int, int] | None,
    predicate: Any,
    want: list[int],
    unasked: int,
) -> None:
    query = blind.topic(topic).where(predicate)
    if between is not None:
        query = query.between(between[0] * SECOND, between[1] * SECOND)
    with only(way):
        assert (query.count(), query.counters.unreadable) == (len(want), unasked)
        assert [m.log_time_ns // SECOND for m in query] == want
        assert query.counters.unreadable == unasked
        found = query.windows(0, "1ns")
        assert (len(found), query.counters.unreadable) == (len(want), unasked)
        held = query.intervals(max_gap="1ns")
        assert (sum(i.messages for i in held), query.counters.unreadable) == (len(want), unasked)
