"""Sets of messages against the algorithm of `message_filters`, as it is published."""

from __future__ import annotations

import multiprocessing
import pickle
import random
from collections import deque
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.across.sync import Synced, approximate_sets
from hybridlog_storage.errors import StoreError, TopicError, UsageError
from tests.copies import bring

from .conftest import MS, Logs


class ApproximateTime:
    """ROS's policy as its C++ source has it: messages come one by one and wait in queues.

    Without a limit of the queues and without lower bounds, its search with virtual messages
    finds nothing that it would not find later.
    """

    penalty = 0.1

    def __init__(self, topics: int, longest: float) -> None:
        self.deques: list[deque[int]] = [deque() for _ in range(topics)]
        self.past: list[list[int]] = [[] for _ in range(topics)]
        self.longest = longest
        self.candidate: list[int] = []
        self.start = self.end = self.pivot_time = 0
        self.pivot = -1
        self.published: list[tuple[int, ...]] = []

    def add(self, topic: int, time: int) -> None:
        self.deques[topic].append(time)
        self.process()

    def process(self) -> None:
        while all(self.deques):
            times = [queue[0] for queue in self.deques]
            end, start = max(times), min(times)
            start_index = times.index(start)
            if self.pivot < 0:
                if end - start > self.longest:
                    self.deques[start_index].popleft()
                    continue
                self.make_candidate(start, end)
                self.pivot = len(times) - 1 - times[::-1].index(end)
                self.pivot_time = end
                self.to_past(start_index)
            elif (end - self.end) * (1 + self.penalty) >= start - self.start:
                self.to_past(start_index)
            else:
                self.make_candidate(start, end)
                self.to_past(start_index)
            if (
                start_index == self.pivot
                or (end - self.end) * (1 + self.penalty) >= self.pivot_time - self.start
            ):
                self.publish()

    def make_candidate(self, start: int, end: int) -> None:
        self.candidate = [queue[0] for queue in self.deques]
        self.start, self.end = start, end
        self.past = [[] for _ in self.deques]

    def to_past(self, topic: int) -> None:
        self.past[topic].append(self.deques[topic].popleft())

    def publish(self) -> None:
        self.published.append(tuple(self.candidate))
        self.pivot = -1
        for queue, past in zip(self.deques, self.past, strict=True):
            queue.extendleft(reversed(past))
            past.clear()
            queue.popleft()

    def finish(self) -> list[tuple[int, ...]]:
        """What is found when no message follows any more."""
        while self.pivot >= 0:
            self.publish()
            self.process()
        return self.published


times = st.lists(st.integers(0, 60).map(lambda n: 10 * n), max_size=12).map(sorted)


@given(
    st.lists(times, min_size=2, max_size=4),
    st.none() | st.integers(0, 100),
    st.randoms(use_true_random=False),
)
@example([[0, 1950], [1000]], None, random.Random(0))  # later, and not shorter by a tenth
@example([[0, 1900], [1000]], None, random.Random(0))
def test_sets_are_those_of_message_filters(rows: list[list[int]], longest: int | None, rng) -> None:  # type: ignore[no-untyped-def]
    policy = ApproximateTime(len(rows), float("inf") if longest is None else longest)
    # The order of arrival across topics does not matter.
    waiting = [n for n, row in enumerate(rows) for _ in row]
    rng.shuffle(waiting)
    iterators = [iter(row) for row in rows]
    for topic in waiting:
        policy.add(topic, next(iterators[topic]))
    want = policy.finish()
    columns = [np.array(row, np.int64) for row in rows]
    found = approximate_sets(columns, longest)
    assert [tuple(columns[n][r] for n, r in enumerate(row)) for row in found.tolist()] == want
    # Each is used once, and sets do not cross.
    assert all((b > a).all() for a, b in pairwise(found))


def sets_of(
    logs: Logs, label: str, topics: list[str], longest: int, clock: str
) -> list[tuple[int, ...]]:
    policy = ApproximateTime(len(topics), longest)
    for n, topic in enumerate(topics):
        for time in sorted(m.time if clock == "log" else m.stamp for m in logs.of(label, topic)):
            policy.add(n, time)
    return policy.finish()


@pytest.mark.parametrize("clock", ["log", "header", "publish"])
@pytest.mark.parametrize(
    "topics", [["/base", "/left/pose"], ["/left/pose", "/right/pose", "/base"]]
)
def test_messages_of_sets(logs: Logs, clock: str, topics: list[str]) -> None:
    synced = logs.store.sync(topics, tolerance="20ms", clock=clock)
    want = [
        (logs.store.entry(label).id, *one)
        for label in logs.said
        if all(logs.of(label, topic) for topic in topics)
        for one in sets_of(logs, label, topics, 20 * MS, clock)
    ]
    assert len(synced) == len(want) > 10
    assert synced.topics == tuple(topics)
    sets = [*synced]
    for (recording, *own), messages, at, row in zip(
        want, sets, synced.times.tolist(), synced.recordings, strict=True
    ):
        assert [m.topic for m in messages] == topics
        assert {m.recording for m in messages} == {recording} == {row}
        names = {"log": "log_time_ns", "header": "header_stamp_ns", "publish": "publish_time_ns"}
        assert [getattr(m, names[clock]) for m in messages] == at == own
    # Each message is there once, also of those with one log time.
    used = [(m.recording, m.topic, m.seq) for row in sets for m in row]
    assert len(used) == len(set(used))


def test_sets_of_queries(logs: Logs) -> None:
    on = logs.store.topic("left/pose").where("on == true").between("+100ms", "+900ms")
    synced = logs.store.sync(["base", on], clock="log")
    assert len(synced) > 50
    sets = synced[::7]
    assert all(pose.fields["on"] is True for _, pose in sets)
    used = [(m.recording, m.topic, m.seq) for row in sets for m in row]
    assert len(used) == len(set(used))
    starts = {label: said[0].time for label, said in logs.said.items()}
    for _, pose in sets:
        start = starts[logs.store.entry(pose.recording).name]
        assert 100 * MS <= pose.log_time_ns - start < 900 * MS


def test_messages_in_no_set_are_counted(logs: Logs) -> None:
    topics = ["/base", "/right/pose"]
    for labels in (["b"], ["b", "c"]):
        queries = [logs.store.topic(topic).in_recording("b") for topic in topics]
        if "c" in labels:
            queries[0] = logs.store.topic("/base")
        sets = logs.store.sync(queries, tolerance="5ms")
        said = [sum(len(logs.of(label, topic)) for label in labels) for topic in topics]
        left_out = tuple(number - len(sets) for number in said)
        assert sets.left_out == left_out
        assert min(left_out) > 0
        assert sets.remarks() == [
            f"In no set: {left_out[0]} messages of /base.",
            f"In no set: {left_out[1]} messages of /right/pose.",
        ]
    some = logs.store.topic("/base").where("on == true")
    asked = logs.store.sync([some, "/left/pose"])
    assert asked.left_out == (some.count() - len(asked), 600 - len(asked))
    assert logs.store.sync([some, some]).remarks() == []
    assert pickle.loads(pickle.dumps(asked)).remarks() == asked.remarks()


def test_only_times_are_read_before_a_set_is_asked_for(logs: Logs) -> None:
    synced = logs.store.sync(["base", "left/pose"])
    assert synced.counters.chunks_read == 0
    assert 0 < synced.counters.bytes_read < 60_000
    first = synced[0]
    assert synced.counters.chunks_read <= 4
    assert [m.raw for m in synced[-len(synced)]] == [m.raw for m in first]
    assert [[m.raw for m in row] for row in synced[1:3]] == [
        [m.raw for m in synced[n]] for n in (1, 2)
    ]
    with pytest.raises(IndexError):
        synced[len(synced)]


def collated(sets: list[tuple[hl.Message, ...]]) -> np.ndarray:
    """What a `collate_fn` makes of the sets of a batch."""
    return np.array([[m.decode().header.seq for m in messages] for messages in sets])


def load(synced: Synced, batches: list[list[int]]) -> list[np.ndarray]:
    """A worker of a data loader: batches of places come, arrays go back."""
    return [collated([synced[place] for place in places]) for places in batches]


def test_a_data_loader_reads_shuffled_batches(logs: Logs) -> None:
    """As PyTorch's does: workers serve several epochs. Forked ones: `tests/test_forks.py`."""
    synced = logs.store.sync(["base", "left/pose"], tolerance="30ms")
    want = collated(synced[:40])
    orders = [np.random.default_rng(epoch).permutation(40) for epoch in range(2)]
    batches = [one.tolist() for order in orders for one in np.array_split(order, 10)]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = pool.starmap(load, [(synced, batches[::2]), (synced, batches[1::2])])
    for own, arrays in zip((batches[::2], batches[1::2]), found, strict=True):
        for places, array in zip(own, arrays, strict=True):
            np.testing.assert_array_equal(array, want[places])
    np.testing.assert_array_equal(collated(synced[:3]), want[:3])


def test_what_is_refused(logs: Logs) -> None:
    store = logs.store
    with pytest.raises(UsageError, match="two topics or more"):
        store.sync(["base"])
    with pytest.raises(UsageError, match="choose log"):
        store.sync(["base", "left/pose"], clock="wall")
    with pytest.raises(UsageError, match="limit, every"):
        store.sync([store.topic("base").every(2), "left/pose"])
    with pytest.raises(TopicError, match=r"weather has no header\.stamp"):
        store.sync(["base", "weather"])


def test_messages_that_are_gone(tmp_path: Path, logs: Logs) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        bring(store, logs.store.directory.path, ["c"])
        again: Synced = pickle.loads(pickle.dumps(store.sync(["base", "left/pose"])))
        store.remove("c")
        with pytest.raises((StoreError, TopicError)):
            again[0]
