"""Counts by time alone, against loops: what chunks are known to hold, and their indexes."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.query.intervals import Intervals
from hybridlog_storage.errors import SegmentError
from tests import places
from tests.query.conftest import AWAY, PADDING
from tests.query.test_intervals import BASE, SECOND, Model, intervals, recorded, several

pytestmark = pytest.mark.mongo


rows = st.lists(
    st.tuples(
        st.integers(0, 60),
        st.sampled_from(["/state", "/state", "/other"]),
        st.just({"s": 0, "name": PADDING}),
    ),
    min_size=1,
    max_size=80,
)
times = st.integers(-2, 63)


def looped(model: Model, topics: set[str], windows: Intervals) -> int:
    return sum(
        m.topic in topics
        and any(w.begin_ns <= m.time < w.end_ns for w in windows if w.recording == name)
        for name, messages in model.logs.items()
        for m in messages
    )


@several
@given(
    logs=st.fixed_dictionaries({"a": rows, "b": rows}),
    spans=st.lists(st.tuples(st.sampled_from("ab"), times, st.integers(1, 30)), max_size=6),
    edges=st.tuples(times, st.integers(1, 40)),
    is_away=st.booleans(),
)
def test_a_count_by_time_is_what_a_loop_counts(
    store: hl.Store,
    logs: dict[str, list[tuple[int, str, dict[str, object]]]],
    spans: list[tuple[str, int, int]],
    edges: tuple[int, int],
    is_away: bool,
) -> None:
    model = recorded(store, logs)
    ids = model.ids
    windows = intervals(
        *((ids[n], BASE + b * SECOND, BASE + (b + s) * SECOND) for n, b, s in spans)
    )
    begin, end = (BASE + edges[0] * SECOND, BASE + (edges[0] + edges[1]) * SECOND)
    both = intervals((ids["a"], begin, end), (ids["b"], begin, end))
    with hl.open(store.directory.path, mongo=AWAY) if is_away else nullcontext(store) as asked:
        for topics in ({"/state"}, set(store.topics())):
            if not topics <= set(store.topics()):
                continue
            query = asked.topic(*topics)
            assert query.during(windows).count() == looped(model, topics, windows)
            between = query.between(f"{begin}ns", f"{end}ns")
            # A range beside all recordings that have the topics is refused.
            having = [ms for ms in model.logs.values() if topics & {m.topic for m in ms}]
            if any(begin <= m.time < end for ms in having for m in ms):
                assert between.count() == looped(model, topics, both)
                common = windows.common(both)
                assert between.during(windows).count() == looped(model, topics, common)


def segment_of(store: hl.Store) -> Path:
    return places.segment(store.directory.path, "a")


def test_a_count_by_time_reads_indexes_at_its_ends_only(many: hl.Store) -> None:
    query = many.topic("/state").between("+5s", "+165s")
    assert query.count() == 160
    assert query.counters.documents_read == query.counters.chunks_read == 0
    assert 0 < query.counters.bytes_read < 1000


@pytest.mark.parametrize("damage", ["time", "place", "length", "opcode", "arrivals"])
def test_a_damaged_message_index_is_not_believed(many: hl.Store, damage: str) -> None:
    """Whether or not what it says could be: the messages of its chunk tell the times."""
    path = segment_of(many)
    whole = path.read_bytes()
    chunk = many.session.chunks(
        many.recordings()[0], [many.recordings()[0].channels[0].id], None, "log"
    )[0]
    index = chunk.place.offset + chunk.place.length
    entry = 9 + 6 + 16  # the second one: record head, channel, length, the first one
    at = {
        "opcode": 0,
        "length": 2,
        "time": entry,
        "place": entry + 8,
        "arrivals": chunk.place.trailer - 1,
    }[damage]
    damaged = bytearray(whole)
    damaged[index + at] ^= 1
    path.write_bytes(damaged)
    try:
        with hl.open(many.directory.path, mongo=AWAY) as alone:
            query = alone.topic("/state").between("+5s", "+165s")
            assert query.count() == 160  # messages have a checksum of their own
            if damage == "arrivals":
                with pytest.raises(SegmentError, match=f"{chunk.place.offset} of .*{path.name}"):
                    list(query)
            else:
                assert len(list(query)) == 160
            # Within one range the chunk is not looked at.
            assert alone.topic("/state").between("+20s", "+165s").count() == 145
    finally:
        path.write_bytes(whole)
