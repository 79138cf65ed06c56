"""Changes of fields that have values of several kinds, null, or nothing; statistics of arrays."""

from __future__ import annotations

import json
import math
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog_storage.errors import WhereError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings

CASES = Path(__file__).parents[1] / "cases"
BASE = 1_700_000_000 * 10**9
NAMES = count()


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Any:
    with hl.open(tmp_path_factory.mktemp("changes") / "store", create=True) as opened:
        yield opened


def _record(store: hl.Store, messages: list[Any]) -> str:
    name = f"log{next(NAMES)}"
    small = SegmentSettings(chunk_size=1024)  # two messages in a chunk
    with store.start(name, settings=small) as recording:
        for number, message in enumerate(messages):
            payload = json.dumps(message | {"pad": "x" * 400}).encode()
            recording.write(Channel("/state", "json", None), payload, log_time=BASE + number)
    return name


def _steps(store: hl.Store, name: str, *fields: str, begin: int = 0) -> list[int]:
    query = store.topic("/state").in_recording(name)
    if begin:
        query = query.between(BASE + begin, None)
    found = query.changes(*fields, pause=0)
    assert all(change.messages == 1 and change.end_ns == change.begin_ns + 1 for change in found)
    return [change.begin_ns - BASE for change in found]


def test_null_and_missing_are_alike(store: hl.Store) -> None:
    messages = [{"m": 1}, {"m": None}, {}, {"m": None}, {"m": 1}, {"m": 1}]
    name = _record(store, messages)
    assert _steps(store, name, "m") == [1, 4]
    assert _steps(store, name, "m", begin=2) == [4]
    below = [{"o": {"m": 1}}, {"o": {"m": None}}, {"o": {}}, {"o": None}, {}]
    name = _record(store, below)
    assert _steps(store, name, "o.m") == [1]
    assert _steps(store, name, "o") == [1]
    in_list = [{"a": [{"m": None}, {"m": 1}]}, {"a": [{}, {"m": 1}]}, {"a": [{"m": 1}]}]
    name = _record(store, in_list)
    assert _steps(store, name, "a[].m") == _steps(store, name, "a") == [2]


@pytest.mark.parametrize(
    ("file", "topic", "field", "wanted"),
    [
        ("changes_json_mixed", "/param", "value", [2, 4, 5]),
        ("changes_json_mixed", "/param", "name", []),
        ("one_int_str", "/s", "v", [1, 2, 3, 4, 5]),
        ("one_int_str", "/s", "k", []),
    ],
)
def test_mixed_kinds_and_definitions(
    store: hl.Store, file: str, topic: str, field: str, wanted: list[int]
) -> None:
    if file not in {entry.name for entry in store.recordings()}:
        store.record(CASES / f"{file}.mcap", name=file)
    found = store.topic(topic).in_recording(file).changes(field, pause="1us")
    assert [(change.begin_ns - BASE) // 10**8 for change in found] == wanted


def test_summaries_where_definitions_differ(store: hl.Store) -> None:
    with store.start("two") as recording:
        for number, (kind, width, values) in enumerate(
            [("float64", 8, [1, 4]), ("float32", 4, [4, 1]), ("float32", 4, [1, 4, 2])]
        ):
            schema = Schema("my/msg/A", "ros2msg", f"{kind}[] a\n".encode())
            head = b"\x00\x01\x00\x00" + len(values).to_bytes(4, "little") + b"\0" * (width - 4)
            raw = head + np.array(values, f"<f{width}").tobytes()
            recording.write(Channel("/two", "cdr", schema), raw, log_time=BASE + number)
    query = store.topic("/two")
    assert len(query.changes("a.min", "a.max", pause=0)) == 0
    assert [c.begin_ns - BASE for c in query.changes("a.n", pause=0)] == [2]
    assert [c.begin_ns - BASE for c in query.changes("a", pause=0)] == [1, 2]


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


numbers = st.none() | st.sampled_from([0, 1, 1.0, -0.0, 0.5, math.nan, math.inf])
words = st.none() | st.sampled_from(["", "1", "a"])
lists = st.recursive(st.integers(0, 1), lambda inner: st.lists(inner, max_size=2), max_leaves=4)
messages = st.lists(
    st.fixed_dictionaries({}, optional={"a": numbers, "b": words, "c": lists}), min_size=1
)


@settings(max_examples=25)
@given(messages=messages)
def test_as_a_plain_comparison(store: hl.Store, messages: list[Any]) -> None:
    name = _record(store, messages)
    for field in ("a", "b", "c"):
        values = [message.get(field) for message in messages]
        wanted = [
            number
            for number, (one, other) in enumerate(pairwise(values), 1)
            if not (one == other or (one != one and other != other))
        ]
        assert _steps(store, name, field) == wanted
