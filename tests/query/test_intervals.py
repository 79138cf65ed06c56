"""Intervals, changes and windows against loops over decoded messages, written naively."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.query.answers.interval_queries import rows_differ
from hybridlog.query.intervals import Interval, Intervals, changing, holding
from hybridlog_storage.errors import HybridlogError, TimeError, UsageError, WhereError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.independent import write_mcap

SECOND = 10**9
BASE = 1_748_937_600 * SECOND
Rows = list[tuple[int, int, int]]


def listed(rows: np.ndarray[Any, Any]) -> Rows:
    return [(int(b), int(e), int(m)) for b, e, m in rows]


def intervals(*rows: tuple[str, int, int]) -> Intervals:
    return Intervals((name, np.array([[begin, end, 1]], np.int64)) for name, begin, end in rows)


# --- the parts ------------------------------------------------------------------------


@pytest.mark.parametrize("max_gap", [2**62, 2**63 - 2, 2**63 - 1])
def test_a_state_may_be_believed_for_ever(max_gap: int) -> None:
    """No time that a recording can have is beyond what is believed."""
    begin = 1_400_000_000 * SECOND
    times = np.array([begin, begin + SECOND])
    found = holding(times, np.array([True, True]), begin + 2 * SECOND, max_gap)
    assert listed(found) == [(begin, begin + 2 * SECOND, 2)]


@given(st.lists(st.integers(0, 40), max_size=20), st.integers(0, 6))
def test_steps_that_are_near_are_one_change(times: list[int], pause: int) -> None:
    times = sorted(times)
    found = listed(changing(np.array(times, np.int64), pause))
    want: Rows = []
    for time in times:
        if want and time - (want[-1][1] - 1) <= pause:
            want[-1] = (want[-1][0], time + 1, want[-1][2] + 1)
        else:
            want.append((time, time + 1, 1))
    assert found == want


spans = st.lists(
    st.tuples(st.sampled_from("ab"), st.integers(0, 20), st.integers(0, 6)).map(
        lambda row: (row[0], row[1], row[1] + row[2])
    ),
    max_size=8,
)


def covered(rows: Iterator[Interval] | Intervals) -> set[tuple[str, int]]:
    return {(row.recording, t) for row in rows for t in range(row.begin_ns, row.end_ns)}


@given(spans, spans)
def test_intervals_cover_what_sets_of_times_do(
    one: list[tuple[str, int, int]], other: list[tuple[str, int, int]]
) -> None:
    left, right = intervals(*one), intervals(*other)
    assert [row.begin_ns for row in left] == sorted(begin for _, begin, _ in one)
    merged = left.merged()
    assert covered(merged) == covered(left)
    assert covered(left.common(right)) == covered(left) & covered(right)
    assert covered(left.union(right)) == covered(left) | covered(right)
    assert covered(left.without(right)) == covered(left) - covered(right)
    assert all(i.begin_ns < i.end_ns for i in left.without(right))
    for name in "ab":
        rows = merged.of_recording(name).tolist()
        assert rows == left.of_recording(name).tolist()
        # Apart: none of them touches the next one.
        assert all(high < low for (_, high), (low, _) in pairwise(rows))
    assert len(left.widened("3ns", "2ns")) == len(one)
    wide = {(n, t) for n, b, e in one for t in range(max(b - 3, 0), e + 2)}
    assert covered(left.widened("3ns", "2ns")) == wide
    inside = left.within({"a": (5, 12), "b": (0, 3)})
    assert covered(inside) == covered(left) & {
        *(("a", t) for t in range(5, 12)),
        *(("b", t) for t in range(3)),
    }
    assert len(left.at_least("4ns")) == sum(e - b >= 4 for _, b, e in one)


def test_intervals_as_a_frame() -> None:
    found = intervals(("b", BASE, BASE + 5), ("a", BASE - 1, BASE + 1))
    frame = found.to_pandas()
    assert list(frame.columns) == ["recording", "begin", "end", "duration", "messages"]
    assert frame["recording"].tolist() == ["a", "b"]
    assert frame["begin"].tolist() == [pd.Timestamp(t, tz="UTC") for t in (BASE - 1, BASE)]
    assert frame["end"].iloc[1] == pd.Timestamp(BASE + 5, tz="UTC")
    assert frame["duration"].tolist() == [pd.Timedelta(2), pd.Timedelta(5)]
    assert found.duration_ns == 7
    assert (found[0].recording, found[-1].end_ns) == ("a", BASE + 5)
    assert "5ns" in repr(found[1])
    assert "2, 7ns" in repr(found)
    empty = intervals().to_pandas()
    assert len(empty) == 0
    assert empty.dtypes.tolist() == frame.dtypes.tolist()


def test_intervals_refuse_what_cannot_be() -> None:
    found = intervals(("a", 0, 10**15))
    with pytest.raises(TimeError):
        found.at_least("soon")
    assert found.widened(after=timedelta(days=100_000))[0].end_ns <= 2**63 - 1


def test_nan_equals_nan_and_null_only_null() -> None:
    one = np.arange(1, 7)
    numbers = pa.array([math.nan, math.nan, None, None, 0.0, -0.0, 1.0])
    assert rows_differ(numbers, one, one - 1).tolist() == [False, True, False, True, False, True]
    words = pa.array(["", None, None, "", "", "a", "a"])
    assert rows_differ(words, one, one - 1).tolist() == [True, False, True, False, True, False]
    lists = pa.array([[1.0, 2.0], [1.25, 2.0], [1.25, 2.5], [1.25], None, [], [math.inf]])
    found = rows_differ(lists, one, one - 1, 0.25).tolist()
    assert found == [False, True, True, True, True, True]


# --- in a store -----------------------------------------------------------------------


@dataclass(frozen=True)
class Said:
    """A message of the model: what was written, and when."""

    time: int
    topic: str
    value: dict[str, Any]


class Model:
    """Recordings that overlap in time, by id, and the naive answers about them."""

    def __init__(self, logs: dict[str, list[Said]], ids: dict[str, str]) -> None:
        self.ids = ids
        """Of each recording, by the name it was given."""
        self.logs = {name: sorted(log, key=lambda m: m.time) for name, log in logs.items()}

    def of(self, name: str, topic: str = "/state") -> list[Said]:
        return [m for m in self.logs[name] if m.topic == topic]

    def span(self, name: str) -> tuple[int, int]:
        times = [m.time for m in self.logs[name]]
        return min(times), max(times) + 1

    def states(
        self, holds: Callable[[Said], bool], between: tuple[int, int], max_gap: int | None
    ) -> set[tuple[str, int]]:
        """Every second at whose beginning the state holds."""
        found = set()
        for name in self.logs:
            start, end = self.span(name)
            for now in range(max(start, between[0]), min(end, between[1]), SECOND):
                past = [m for m in self.of(name) if m.time <= now]
                if past and holds(past[-1]) and (max_gap is None or now - past[-1].time < max_gap):
                    found.add((name, now))
        return found

    def steps(
        self, key: Callable[[Said], object], between: tuple[int, int]
    ) -> set[tuple[str, int]]:
        found = set()
        for name in self.logs:
            mine = self.of(name)
            for one, other in zip(mine[1:], mine, strict=False):
                if key(one) != key(other) and between[0] <= one.time < between[1]:
                    found.add((name, one.time))
        return found


values = st.fixed_dictionaries(
    {"s": st.integers(0, 2)},
    optional={
        "x": st.sampled_from([1, 1.0, 1.5, 2]),
        "name": st.sampled_from(["", "a", "b"]),
        "v": st.sampled_from([[], [1.0], [1.0, 2.0], [0.5] * 40]),
    },
)
log = st.lists(
    st.tuples(st.integers(0, 12), st.sampled_from(["/state", "/state", "/other"]), values),
    min_size=1,
    max_size=24,
)


def write_log(path: Path, said: list[tuple[int, str, dict[str, Any]]], mark: int) -> list[Said]:
    # The mark makes equal logs different ones.
    about = {"mark": str(mark)}
    channels = {topic: Channel(topic, "json", None, about) for topic in ("/state", "/other")}
    found = [Said(BASE + second * SECOND, topic, value) for second, topic, value in said]
    rows = [(channels[one.topic], one.time, json.dumps(one.value).encode()) for one in found]
    write_mcap(path, rows)
    return found


_marks = iter(range(10**6))


def recorded(store: hl.Store, logs: dict[str, Any]) -> Model:
    """Put logs in the place of what the store has."""
    for entry in store.recordings():
        store.remove(entry.id)
    said, ids = {}, {}
    for name, rows in logs.items():
        path = store.directory.path / f"{name}.mcap"
        messages = write_log(path, rows, next(_marks))
        report = store.record(path, name=name, settings=SegmentSettings(chunk_size=1024))
        ids[name] = report.entry.id
        said[report.entry.id] = messages
    return Model(said, ids)


HOLDS = {
    "s == 1": lambda m: m.value["s"] == 1,
    "s >= 1 and name != 'a'": lambda m: m.value["s"] >= 1 and m.value.get("name", "a") != "a",
    "x > 1": lambda m: m.value.get("x", 0) > 1,
}


def seconds(found: Intervals) -> set[tuple[str, int]]:
    """The whole seconds at which intervals hold."""
    return {
        (row.recording, t)
        for row in found
        for t in range(-(-row.begin_ns // SECOND) * SECOND, row.end_ns, SECOND)
    }


several = settings(max_examples=15)


@several
@given(
    logs=st.fixed_dictionaries({"a": log, "b": log}),
    text=st.sampled_from(sorted(HOLDS)),
    between=st.none() | st.tuples(st.integers(-1, 12), st.integers(1, 9)),
    gap=st.none() | st.integers(1, 4),
)
def test_what_a_store_says_is_what_a_loop_says(
    store: hl.Store,
    logs: dict[str, Any],
    text: str,
    between: tuple[int, int] | None,
    gap: int | None,
) -> None:
    model = recorded(store, logs)
    if "/state" not in store.topics():
        return
    query = store.topic("/state")
    span = (0, 2**62)
    if between is not None:
        span = BASE + between[0] * SECOND, BASE + (between[0] + between[1]) * SECOND
        query = query.between(f"{span[0]}ns", f"{span[1]}ns")
        if all(not _meet(model.span(name), span) for name in query.recordings):
            with pytest.raises(TimeError, match="Nothing was recorded"):
                query.intervals()
            return

    holds = HOLDS[text]
    max_gap = None if gap is None else f"{gap}s"
    found = query.where(text).intervals(max_gap=max_gap)
    limit = None if gap is None else gap * SECOND
    assert seconds(found) == model.states(holds, span, limit)
    for row in found:
        # Whole: what is before and after is another state, or not asked about.
        start, end = model.span(row.recording)
        assert max(start, span[0]) <= row.begin_ns < row.end_ns <= min(end, span[1])
        mine = [m for m in model.of(row.recording) if row.begin_ns <= m.time < row.end_ns]
        assert row.messages == sum(holds(m) for m in mine)
    assert len(found) == len(found.merged())
    long = [row.duration_ns for row in found if row.duration_ns >= 2 * SECOND]
    assert found.at_least("2s").duration_ns == sum(long)

    for fields in (("s",), ("x",), ("name", "v"), ("s", "x", "name", "v")):
        if not any(f in m.value for name in model.logs for m in model.of(name) for f in fields):
            continue
        steps = model.steps(_key(fields), span)
        apart = query.changes(*fields, pause=0)
        assert {(row.recording, row.begin_ns) for row in apart} == steps, fields
        joined = query.changes(*fields, pause="2s")
        assert sum(row.messages for row in joined) == sum(row.messages for row in apart)
        assert len(joined) == sum(
            not any((name, t - back * SECOND) in steps for back in (1, 2)) for name, t in steps
        )


def _meet(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] < other[1] and other[0] < one[1]


def _key(fields: Sequence[str]) -> Callable[[Said], object]:
    def key(message: Said) -> object:
        found = []
        for name in fields:
            value = message.value.get(name)
            if isinstance(value, list) and len(value) > 32:
                value = "long"
            found.append(json.dumps(float(value) if isinstance(value, int | float) else value))
        return found

    return key


@pytest.fixture
def plain(store: hl.Store) -> hl.Store:
    rows = [(second, "/state", {"s": second % 2, "x": 1.5}) for second in range(10)]
    recorded(store, {"a": [*rows, (20, "/other", {"s": 0})]})
    return store


def test_nothing_found_is_no_error(plain: hl.Store) -> None:
    query = plain.topic("/state")
    none = query.where("s == 7")
    assert len(none.intervals()) == 0
    assert list(none.windows("5s")) == []
    assert len(query.changes("x")) == 0
    nothing = plain.all_topics().during(none.windows("5min"))
    assert nothing.count() == 0
    assert list(nothing) == []
    assert nothing.during(query.intervals()).count() == 0
    assert len(query.during(none.intervals()).intervals()) == 0


def test_the_cost_is_counted_and_no_payload_is_read(plain: hl.Store) -> None:
    query = plain.topic("/state").where("s == 1")
    for _ in range(2):
        query.intervals()
        assert query.counters.documents_read == 0
        assert query.counters.elapsed_s > 0
        assert 0 < query.counters.bytes_read < 5000
        assert query.counters.chunks_read == 0
    query.changes("s", "x")
    assert query.counters.chunks_read == 1
    near = plain.topic("/state").during(query.windows("1s"))
    assert near.to_pandas().attrs["hybridlog"]["chunks_read"] <= 2


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda s: s.limit(1).intervals(), UsageError, "cannot be combined"),
        (lambda s: s.every(2).changes("s"), UsageError, "cannot be combined"),
        (lambda s: s.reverse().intervals(), UsageError, "cannot be combined"),
        (lambda s: s.windows("1s").containing(s.limit(1)), UsageError, "cannot be combined"),
        (lambda s: s.clock("publish").between("+1s", "+2s").intervals(), UsageError, "publish"),
        (lambda s: s.intervals(max_gap=0), UsageError, "max_gap is 0"),
        (lambda s: s.intervals(state="on"), UsageError, "choose held, not held or unknown"),
        (lambda s: s.changes(), UsageError, "Name at least one field"),
        (lambda s: s.changes("s", tolerance=math.nan), UsageError, "tolerance"),
        (lambda s: s.windows(), UsageError, "give before, after or both"),
        (lambda s: s.windows("soon"), TimeError, "not a duration"),
        (lambda s: s.between("2020-01-01", "2020-01-02").intervals(), TimeError, "Nothing was"),
        (lambda s: s.during(s.intervals()).at("+1s"), UsageError, "during"),
        (lambda s: s.where("s <").intervals(), WhereError, "expected a value"),
    ],
)
def test_wrong_questions(
    plain: hl.Store, ask: Callable[[hl.Query], object], error: type[HybridlogError], words: str
) -> None:
    with pytest.raises(error, match=words):
        ask(plain.topic("/state"))


def test_intervals_are_one_topics(plain: hl.Store) -> None:
    with pytest.raises(UsageError, match="name one of /other, /state"):
        plain.all_topics().intervals()
    with pytest.raises(UsageError, match="one topic"):
        plain.all_topics().limit(1).windows("1s")
