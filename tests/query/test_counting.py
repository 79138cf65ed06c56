"""Intervals that contain a message, and statistics of arrays, against loops."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.query.intervals import Intervals
from hybridlog_storage.errors import UsageError, WhereError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.query.test_intervals import (
    BASE,
    SECOND,
    Model,
    intervals,
    log,
    recorded,
    several,
)

pytestmark = pytest.mark.mongo


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    place = tmp_path_factory.mktemp("counting") / "store"
    with hl.open(place, create=True, require_database=True) as opened:
        yield opened


# --- intervals that contain a message -------------------------------------------------


def contained(model: Model, rows: Intervals, topics: set[str], least: int) -> list[bool]:
    return [
        any(
            row.begin_ns <= m.time < row.end_ns and m.topic in topics and m.value["s"] >= least
            for m in model.logs[row.recording]
        )
        for row in rows
    ]


@several
@given(
    logs=st.fixed_dictionaries({"a": log, "b": log}),
    spans=st.lists(st.tuples(st.sampled_from("ab"), st.integers(-1, 12), st.integers(0, 4))),
)
def test_intervals_that_contain_a_message_are_what_a_loop_finds(
    store: hl.Store, logs: dict[str, Any], spans: list[tuple[str, int, int]]
) -> None:
    model = recorded(store, logs)
    rows = intervals(
        *((model.ids[name], BASE + b * SECOND, BASE + (b + n) * SECOND) for name, b, n in spans)
    )
    for topics in (store.topics(), ["/state"]):
        if not set(topics) <= set(store.topics()):
            continue
        for least in (0, 2):
            query = store.topic(*topics)
            query = query.where(f"s >= {least}") if least else query
            found = list(rows.containing(query))
            want = contained(model, rows, set(topics), least)
            assert found == [row for row, is_in in zip(rows, want, strict=True) if is_in]


@pytest.fixture
def plain(store: hl.Store) -> hl.Store:
    rows = [(second, "/state", {"s": second % 2}) for second in range(10)]
    recorded(store, {"a": [*rows, (20, "/other", {"s": 0})]})
    return store


def test_containing_keeps_to_what_is_asked(plain: hl.Store) -> None:
    state = plain.topic("/state")
    windows = state.windows("100ms", "100ms")
    assert len(windows.containing(state)) == 10
    assert len(windows.containing(state.where("s == 1"))) == 5
    assert len(windows.containing(state.between("+2s", "+4s"))) == 2
    assert len(windows.containing(state.during(windows).reverse())) == 10
    assert len(windows.containing(state.during(state.where("s == 1").windows("1s", "1ns")))) == 10
    assert len(windows.containing(plain.topic("/other"))) == 0
    assert len(state.windows("5s", "5s").containing(state.where("s == 1"))) == 10
    for wrong in (state.limit(1), state.every(2)):
        with pytest.raises(UsageError, match="cannot be combined"):
            windows.containing(wrong)


def test_statistics_of_arrays_of_which_some_have_only_a_summary(tmp_path: Path) -> None:
    """Short arrays stand in the table with their elements, long ones with a summary."""
    channel = Channel("/a", "ros1", Schema("t/A", "ros1msg", b"float32[] r\n"))
    settings = SegmentSettings(segment_size=1 << 16, chunk_size=1 << 12)
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("x", settings=settings) as recording:
            for n in range(6000):
                size = 3 if n < 3000 else 40
                numbers = np.arange(n, n + size, dtype=np.float32).tobytes()
                recording.write(
                    channel, size.to_bytes(4, "little") + numbers, log_time=BASE + n * 10**6
                )
        table = store.session.table(store.recordings()[0], "/a")
        assert table is not None
        for file in table.files:
            kinds = [str(file.schema.field(name).type)[:4] for name in ("r", "r_summary")]
            assert kinds == ["list", "stru"]
        for where, count in {
            "r.min < 10": 10,
            "r.min >= 2990": 3010,
            "r.n == 3": 3000,
            "not r.max < 3100": 6000 - 3061,
            "r.mean == 11": 1,
        }.items():
            query = store.topic("/a").where(where)
            assert query.count() == count, where
            assert query.counters.chunks_read == 0
        changes = {"r.n": [3000], "r.min": [*range(1, 6000)]}
        for field, expected in changes.items():
            found = store.topic("/a").changes(field, pause=0)
            assert [(one.begin_ns - BASE) // 10**6 for one in found] == expected
        late = store.topic("/a").between(BASE + 3000 * 10**6, None).changes("r.n", pause=0)
        assert len(late) == 1  # compared with the message before the range


def test_elements_of_an_array_that_has_two_lengths(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        for size in (9, 3):
            kind = Schema("t/A", "ros1msg", f"float32[{size}] box\n".encode())
            with store.start(f"of {size}") as recording:
                recording.write(Channel("/a", "ros1", kind), np.ones(size, np.float32).tobytes())
        assert store.topic("/a").where("box[7] > 0").count() == 1
        with pytest.raises(WhereError, match="3 elements"):
            store.topic("/a").in_recording("of 3").where("box[7] > 0")
