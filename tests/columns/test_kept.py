"""Answers out of kept columns, against those that MongoDB gives to the same questions."""

from __future__ import annotations

import gc
import math
import random
import struct
import time
import weakref
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

import hybridlog as hl
from hybridlog.columns import answers as column_answers
from hybridlog.columns import kept as kept_columns
from hybridlog.columns import stored
from hybridlog.columns.judged import Judged
from hybridlog.columns.kept import MOST_BYTES
from hybridlog.columns.topic import TopicColumns
from hybridlog.frames import answer as tables
from hybridlog.query.column_filter import ColumnFilter, column_filter
from hybridlog.reader import Query
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.errors import TimeError
from hybridlog_storage.segment_writer import SegmentSettings

Filter = dict[str, Any]

SECOND = 1_000_000_000
BASE = 1_700_000_000 * SECOND
DEFINITION = b"""\
float64 f64
float32 f32
int64 i64
uint32 u32
int8 i8
bool yes
time at
duration took
string name
uint64 u64
float32[] many
Inner inner
================================================================================
MSG: test/Inner
float64 x
"""
NAN, INF = math.nan, math.inf
FLOATS = [NAN, INF, -INF, 0.0, -0.0, 1.0, 1.5, 0.1, 2.0**53, 2.0**53 + 2, -3.0, 1e300, 5e-324]
INTEGERS = [0, 1, -1, 2, 2**31, 2**53, 2**53 + 1, 2**63 - 1, -(2**63), -(2**53) - 1, 3]
NAMES = ["", "a", "ab", "b", "ä", "\U0001d11e", "\uffff", "a\0b", "laser"]
POOLS: dict[str, list[Any]] = {
    "f64": FLOATS,
    "f32": [v for v in FLOATS if abs(v) < 1e30 or not math.isfinite(v)],
    "i64": INTEGERS,
    "u32": [0, 1, 2**31, 2**32 - 1],
    "i8": [0, 1, -1, 127, -128],
    "yes": [True, False],
    "at": [0, 1, BASE, BASE + 5],
    "took": [0, -1, -SECOND - 1, 7 * SECOND],
    "name": NAMES,
    "u64": [0, 1, 2**63, 2**64 - 1],
    "inner.x": [0.0, 1.5, NAN],
}


def message(values: dict[str, Any]) -> bytes:
    """A message as ROS 1 writes it."""
    name = values["name"].encode()
    return b"".join(
        (
            struct.pack("<dfqIb?", *(values[k] for k in ("f64", "f32", "i64", "u32", "i8", "yes"))),
            struct.pack("<II", *divmod(values["at"], SECOND)),
            struct.pack("<ii", *divmod(values["took"], SECOND)),
            struct.pack("<I", len(name)) + name,
            struct.pack("<QI2fd", values["u64"], 2, 0.5, 1.5, values["inner.x"]),
        )
    )


def usual(**values: Any) -> dict[str, Any]:
    return {name: pool[1] for name, pool in POOLS.items()} | values


def write_log(path: Path, said: Sequence[tuple[int, str, bytes]], mark: str = "") -> None:
    """A log of messages (log time, topic, payload); `/state` has two publishers."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("test/State", "ros1msg", DEFINITION)
        channels = {
            (topic, place): writer.register_channel(
                topic, "ros1", schema, {"mark": mark, "publisher": str(place)}
            )
            for topic in sorted({"/state", "/other"} | {topic for _, topic, _ in said})
            for place in range(2)
        }
        for place, (time, topic, payload) in enumerate(said):
            writer.add_message(channels[topic, place % 2], time, payload, time)
        writer.finish()  # type: ignore[no-untyped-call]


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    place = tmp_path_factory.mktemp("columns") / "store"
    with hl.open(place, create=True, require_database=True) as opened:
        yield opened


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store with one message of every value, and many of mixed ones."""
    place = tmp_path_factory.mktemp("mixed")
    dice = random.Random(5)
    said = [usual(**{name: value}) for name, pool in POOLS.items() for value in pool]
    said += [{n: dice.choice(pool) for n, pool in POOLS.items()} for _ in range(100)]
    path = place / "mixed.mcap"
    write_log(path, [(BASE + n, "/state", message(v)) for n, v in enumerate(said)])
    with hl.open(place / "store", create=True, require_database=True) as opened:
        opened.record(path)
        yield opened


def get_by(patch: pytest.MonkeyPatch, way: str, price: float = 0.0) -> None:
    """Let columns be got in one way only, and cost so much."""
    from_others = {"segments": kept_columns._from_segments, "index": kept_columns._from_index}

    def only(
        kept: kept_columns.KeptColumns, recording: RecordingEntry, topic: str, _: object
    ) -> kept_columns._Way:
        if way == "file":
            opened = partial(kept._store.columns, recording.id)
            return kept_columns._Way(price, partial(kept_columns._from_file, opened, topic))
        question = partial(kept._question, recording, topic)
        return kept_columns._Way(price, partial(from_others[way], question))

    patch.setattr(kept_columns.KeptColumns, "_cheapest_way", only)


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let columns cost nothing, so that they are got at the first question."""
    get_by(monkeypatch, "segments")


@pytest.fixture(params=["file", "segments", "index"])
def each_way(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    """The same, in each of the ways."""
    get_by(monkeypatch, request.param)


# --- filters --------------------------------------------------------------------------

values = st.sampled_from([*FLOATS, *INTEGERS, *NAMES, True, False, None, BASE, 0.5, -0.5])
orders = st.sampled_from(["$eq", "$ne", "$lt", "$lte", "$gt", "$gte"])
operations = st.one_of(
    st.dictionaries(orders, values, min_size=1, max_size=2),
    st.fixed_dictionaries({"$in": st.lists(values, max_size=3)}),
    st.fixed_dictionaries({"$nin": st.lists(values, max_size=3)}),
    st.fixed_dictionaries({"$exists": st.booleans()}),
    st.just({"$type": "null"}),
    st.just({"$type": "string"}),
    st.just({"$regex": "a"}),
)
conditions = st.one_of(
    values, operations, st.fixed_dictionaries({"$not": operations.filter(lambda o: o)})
)
fields = st.sampled_from([*POOLS, "many", "many.0", "inner", "missing"])
leaves = st.dictionaries(fields, conditions, min_size=1, max_size=2)
filters = st.recursive(
    leaves,
    lambda inner: st.dictionaries(
        st.sampled_from(["$and", "$or", "$nor"]),
        st.lists(inner, min_size=1, max_size=3),
        min_size=1,
        max_size=2,
    ),
    max_leaves=5,
)


def _seqs(parts: Sequence[Judged]) -> list[int]:
    return [seq for part in parts for seq in part.columns.seq[part.rows()].tolist()]


@settings(
    max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(query=filters)
@example(query={"i64": {"$gt": 2.0**53}})
@example(query={"i64": {"$lt": 2**53 + 1}})
@example(query={"i64": {"$gte": 2.0**63}})
@example(query={"f32": 0.1})
@example(query={"f32": {"$lte": NAN}})
@example(query={"name": {"$lt": "\U0001d11e"}})
@example(query={"yes": {"$gt": False}})
def test_columns_satisfy_what_documents_do(mixed: hl.Store, each_way: None, query: Filter) -> None:
    mixed.kept.clear()
    alone = mixed.topic("/state").where(query)
    for asked in (alone, alone.where({"i8": {"$gt": 1}})):
        found = column_answers.judged(asked, "/state", as_rows=True)
        if found is not None:
            assert _seqs(found) == [d["_meta"]["seq"] for d in asked.documents()]


@pytest.mark.parametrize(
    ("query", "is_answered"),
    [
        ({"f64": {"$lt": 1, "$gte": -3}}, True),
        ({"$or": [{"name": "a"}, {"$nor": [{"yes": True}]}]}, True),
        ({"i8": {"$not": {"$in": [1, 2]}}}, True),
        ({"inner.x": {"$exists": True}}, True),
        ({"at": {"$gte": BASE}, "took": {"$lt": 0}}, True),
        ({"u64": 1}, False),  # beyond int64 the index has floats
        ({"many": 0.5}, False),
        ({"many.0": 0.5}, False),
        ({"name": {"$regex": "^a"}}, False),
        ({"$expr": {"$gt": ["$f64", "$f32"]}}, False),
        ({"_meta.seq": 1}, False),
        ({"f64": 2**53 + 1}, False),
    ],
)
def test_which_filters_columns_answer(mixed: hl.Store, query: Filter, *, is_answered: bool) -> None:
    types = mixed.kept.types(mixed.recordings()[0], "/state")
    assert types is not None
    assert (column_filter(query, types) is not None) is is_answered


# --- whole questions ------------------------------------------------------------------

moments = st.integers(0, 12)
said = st.tuples(
    moments,
    st.sampled_from(["/state", "/state", "/other"]),
    st.fixed_dictionaries(
        {
            "f64": st.sampled_from([0.0, 1.0, 2.5, NAN]),
            "i8": st.integers(0, 2),
            "name": st.sampled_from(["a", "b"]),
        }
    ),
)
logs = st.fixed_dictionaries(
    {name: st.lists(said, min_size=1, max_size=20) for name in ("one", "two")}
)
_marks = iter(range(10**6))


def recorded(store: hl.Store, content: dict[str, Any]) -> None:
    """Put logs in the place of what the store has."""
    for entry in store.recordings():
        store.remove(entry.id)
    for name, rows in content.items():
        path = store.directory.path / f"{name}.mcap"
        messages = [(BASE + t * SECOND, topic, message(usual(**v))) for t, topic, v in rows]
        write_log(path, messages, str(next(_marks)))
        store.record(path, name=name, settings=SegmentSettings(chunk_size=1024))


def answers(store: hl.Store, where: str, bounds: tuple[int, int] | None) -> dict[str, Any]:
    """What a store answers to one of each kind of question."""
    query = store.topic("/state").where(where)
    other = store.topic("/state")
    if bounds is not None:
        query, other = (
            q.between(BASE + bounds[0] * SECOND, BASE + bounds[1] * SECOND) for q in (query, other)
        )

    def rows(found: Any) -> list[tuple[Any, ...]]:
        return [(i.recording, i.begin_ns, i.end_ns, i.messages) for i in found]

    def streamed(asked: Query) -> dict[str, Any]:
        parts = list(tables.stream(asked))
        assert all(len(part) for part in parts[1:])
        return pa.concat_tables(parts).to_pydict()

    events = store.topic("/state").where("i8 == 1").windows("1s", "1500ms")
    kinds = {
        "count": query.count,
        "every": query.every(2).limit(3).count,
        "all": store.all_topics().where(where).count,
        "windows": lambda: rows(query.windows("1s")),
        "states": lambda: rows(query.intervals(max_gap="2s")),
        "changes": lambda: rows(query.changes("f64", "name", "inner", pause="1s")),
        "near": lambda: rows(other.changes("f64", pause="1s", tolerance=1)),
        "containing": lambda: rows(events.containing(query)),
        "during": query.during(events).count,
        "nothing": lambda: rows(query.where("i8 > 100").windows("1s").containing(query.limit(1))),
        "frame": lambda: query.fields("f64", "name", "at").to_pandas(),
        "reversed": lambda: query.reverse().fields("i8").to_pandas(),
        "arrow": lambda: query.fields("name").to_arrow().to_pydict(),
        "stream": lambda: streamed(query.fields("i8", "name")),
        "backwards": lambda: streamed(query.reverse().fields("at")),
    }
    found: dict[str, Any] = {}
    for name, ask in kinds.items():
        try:
            found[name] = ask()  # type: ignore[operator]
        except TimeError as error:
            found[name] = str(error)
    return found


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    content=logs,
    where=st.sampled_from(
        ["i8 == 1", "f64 >= 1 and name == 'a'", "not (f64 < 2)", "name in ['b']", "i8 > 5"]
    ),
    bounds=st.none() | st.tuples(st.integers(-1, 12), st.integers(1, 9)),
    rows=st.sampled_from([3, 65_536]),
)
def test_questions_have_the_answers_of_mongodb(
    store: hl.Store,
    each_way: None,
    monkeypatch: pytest.MonkeyPatch,
    content: dict[str, Any],
    where: str,
    bounds: tuple[int, int] | None,
    rows: int,
) -> None:
    if not all(any(topic == "/state" for _, topic, _ in rows) for rows in content.values()):
        content = {name: [*rows, (3, "/state", {})] for name, rows in content.items()}
    recorded(store, content)
    monkeypatch.setattr(tables, "_BLOCK_ROWS", rows)
    if bounds is not None:
        bounds = bounds[0], bounds[0] + bounds[1]
    kept = answers(store, where, bounds)
    assert store.kept._kept
    store.kept.most_bytes = 0
    try:
        asked = answers(store, where, bounds)
    finally:
        store.kept.most_bytes = MOST_BYTES
    for name, answer in asked.items():
        if isinstance(answer, pd.DataFrame):
            pd.testing.assert_frame_equal(kept[name], answer)
            assert kept[name].dtypes.equals(answer.dtypes)
        else:
            assert kept[name] == answer, name


# --- when -----------------------------------------------------------------------------


@pytest.fixture
def plain(store: hl.Store) -> hl.Store:
    rows = [(n % 12, "/state", {"i8": n % 3, "f64": float(n)}) for n in range(60)]
    recorded(store, {"one": rows})
    return store


def test_columns_come_when_asking_has_cost_as_much(plain: hl.Store) -> None:
    for file in plain.directory.path.glob(f"recordings/*/{stored.NAME}"):
        file.unlink()
    query = plain.topic("/state").where("i8 == 1")
    looks = []
    for _ in range(6):
        assert query.count() == 20
        looks.append(query.counters.chunks_read + query.counters.documents_read)
    first = next(n for n, look in enumerate(looks) if look)
    assert 0 < first < 5
    assert looks[first + 1 :] == [0] * (5 - first)
    # Another field is asked for anew, what is kept of the first one is not lost.
    other = plain.topic("/state").where("f64 < 10 and i8 == 1")
    assert [other.count() for _ in range(6)] == [3] * 6
    query.count()
    assert query.counters.chunks_read + query.counters.documents_read == 0


def test_what_is_recorded_or_removed_meanwhile_is_seen(
    plain: hl.Store, at_once: None, tmp_path: Path
) -> None:
    query = "i8 == 1"
    assert plain.topic("/state").where(query).count() == 20
    write_log(tmp_path / "more.mcap", [(BASE, "/state", message(usual(i8=1)))], "more")
    report = plain.record(tmp_path / "more.mcap", name="more")
    assert plain.topic("/state").where(query).count() == 21
    plain.remove(report.entry.id)
    assert plain.topic("/state").where(query).count() == 20


def test_columns_take_no_more_memory_than_they_may(
    plain: hl.Store, at_once: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(plain.kept, "most_bytes", 60 * 8 * 3 + 100)
    one = plain.topic("/state").where("i8 == 1")
    two = plain.topic("/state").where("i8 == 1 and f64 > 3 and f64 < 50 and u32 == 1")
    for _ in range(3):
        assert one.count() == 20
        assert two.count() == 16
    assert sum(c.nbytes for c in plain.kept._kept.values()) <= plain.kept.most_bytes


def test_what_a_question_means_is_found_out_once(
    plain: hl.Store, at_once: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def counted(query: Mapping[str, object], types: Mapping[str, str]) -> ColumnFilter | None:
        made.append(query)
        return column_filter(query, types)

    monkeypatch.setattr(column_answers, "column_filter", counted)
    for _ in range(3):
        assert plain.topic("/state").where("i8 == 1").count() == 20
        assert plain.topic("/state").where("i8 == 1").between("+3s", "+6s").count() == 5
    assert len(made) == 2, "once without the order of messages, once with it"
    # Equal in Python, and another question.
    assert plain.topic("/state").where({"yes": 0}).count() == 0
    assert plain.topic("/state").where({"yes": False}).count() == 60
    plain.refresh()
    assert plain.topic("/state").where("i8 == 1").count() == 20
    assert made[-1] == {"i8": {"$eq": 1}}, "asked for anew"


def test_columns_that_are_looked_at_stay_and_others_are_let_go(
    store: hl.Store, at_once: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [(n % 12, topic, {"f64": float(n)}) for n in range(60) for topic in ("/a", "/b", "/c")]
    recorded(store, {"one": rows})
    # Two fields, log times and arrival numbers, of two of the three topics.
    monkeypatch.setattr(store.kept, "most_bytes", 2 * 60 * 8 * 4 + 100)

    def ask(topic: str) -> weakref.ref[Any]:
        query = store.topic(topic).where("f64 >= 0 and i64 == 1").between("+1s", "+3s")
        assert query.count() == 10
        (columns,) = [c for key, c in store.kept._kept.items() if key[1] == topic]
        return weakref.ref(columns.fields["f64"].values)

    first, second = ask("/a"), ask("/b")
    ask("/a")  # out of what is remembered of the question
    ask("/c")
    gc.collect()
    assert first() is not None
    assert second() is None, "nothing else holds it"


def test_payloads_that_cannot_be_read_are_left_to_mongodb(store: hl.Store, each_way: None) -> None:
    recorded(store, {})
    path = store.directory.path / "torn.mcap"
    rows = [(BASE + n, "/state", message(usual(i8=1))) for n in range(4)]
    write_log(path, [*rows, (BASE + 9, "/state", b"torn")], "torn")
    store.record(path)
    assert store.topic("/state").where({"i8": {"$ne": 1}}).count() == 1
    assert store.topic("/state").where({"i8": 1}).count() == 4


def test_strings_that_are_no_text_are_those_of_the_index(store: hl.Store, each_way: None) -> None:
    recorded(store, {})
    path = store.directory.path / "odd.mcap"
    good, odd = message(usual(name="abc")), message(usual(name="abc")).replace(b"abc", b"a\xffc")
    write_log(path, [(BASE, "/state", good), (BASE + 1, "/state", odd)], "odd")
    store.record(path)
    query = store.topic("/state").where({"name": "a\ufffdc"})
    assert query.count() == 1
    assert query.fields("name").to_pandas()["name"].tolist() == ["a\ufffdc"]
    assert store.kept._kept


def test_a_damaged_segment_leaves_the_answer_to_mongodb(store: hl.Store, at_once: None) -> None:
    rows = [(n % 12, "/state", {"i8": n % 3, "f64": float(n)}) for n in range(60)]
    recorded(store, {"one": rows})
    (entry,) = store.recordings()
    segment = store.directory.recording(entry.label) / "000000.mcap"
    content = bytearray(segment.read_bytes())
    chunks = store.catalog.chunks(entry)
    assert len(chunks) > 4
    for chunk in chunks[::2]:
        content[chunk.offset + chunk.length // 2] ^= 0xFF
    segment.write_bytes(content)
    assert store.topic("/state").where("i8 == 1").count() == 20


def test_a_question_about_a_moment_gets_no_columns(
    plain: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads = []
    load = kept_columns.KeptColumns._load
    monkeypatch.setattr(
        kept_columns.KeptColumns, "_load", lambda *given: loads.append(given) or load(*given)
    )
    # As if each message took MongoDB a millisecond, and columns a tenth of that.
    monkeypatch.setattr(kept_columns, "_LOOK_S", 1e-3)
    monkeypatch.setattr(kept_columns, "_DOCUMENT_S", 1e-3)
    get_by(monkeypatch, "segments", 60 * 1e-4)
    moment = plain.topic("/state").where("i8 == 1").between(BASE, BASE + SECOND // 100)
    for ask in (
        moment.count,
        moment.intervals,
        lambda: moment.changes("f64"),
        lambda: moment.windows("1ms"),
        lambda: moment.fields("f64").to_pandas(),
    ):
        plain.refresh()
        ask()
    assert not loads
    plain.topic("/state").where("i8 == 1").count()
    assert len(loads) == 1


def test_events_are_looked_for_in_recordings_that_a_range_is_not_in(
    store: hl.Store, at_once: None
) -> None:
    later = [(100 + n, "/state", {"i8": n % 3}) for n in range(5)]
    recorded(store, {"one": [(n, "/state", {"i8": n % 3}) for n in range(5)], "two": later})
    topic = store.topic("/state")
    in_one = topic.between(BASE, BASE + 3 * SECOND)
    for most in (MOST_BYTES, 0):
        store.kept.most_bytes = most
        assert len(topic.windows(after="100ms").containing(in_one)) == 3
    store.kept.most_bytes = MOST_BYTES


def test_a_message_at_the_end_of_time(store: hl.Store, each_way: None) -> None:
    recorded(store, {})
    path = store.directory.path / "last.mcap"
    write_log(path, [(t, "/state", message(usual(i8=1))) for t in (BASE, 2**63 - 1)], "last")
    last = store.record(path).entry.id
    assert [store.topic("/state").where("i8 == 1").count() for _ in range(3)] == [2, 2, 2]
    for most in (0, MOST_BYTES):
        store.kept.most_bytes = most
        asked = store.topic("/state").where("i8 == 1")
        ((begin, end),) = asked.intervals().of_recording(last).tolist()
        assert (begin, end) == (BASE, 2**63 - 1)
        windows = asked.windows(before="2ns", after="1ns").of_recording(last).tolist()
        assert windows == [[BASE, BASE + 1], [2**63 - 3, 2**63 - 1]]
        # The last moment of all begins no interval.
        assert store.topic("/state").during(asked.intervals()).count() == 1


def test_columns_that_were_on_their_way_when_all_was_forgotten(
    plain: hl.Store, at_once: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = kept_columns.KeptColumns._load

    def slowly(kept: kept_columns.KeptColumns, *given: Any) -> TopicColumns:
        loaded = load(kept, *given)
        kept.clear()
        return loaded

    monkeypatch.setattr(kept_columns.KeptColumns, "_load", slowly)
    assert plain.topic("/state").where("i8 == 1").count() == 20
    assert not plain.kept._kept


def test_what_several_want_at_once_is_got_once(
    plain: hl.Store, at_once: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    loads = []
    load = kept_columns.KeptColumns._load

    def counted(*given: Any) -> TopicColumns:
        loads.append(given)
        time.sleep(0.2)
        return load(*given)

    monkeypatch.setattr(kept_columns.KeptColumns, "_load", counted)
    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(plain.topic("/state").where("i8 == 1").count) for _ in range(4)]
        assert [one.result() for one in asked] == [20] * 4
    assert len(loads) == 1


def test_counters_are_of_one_answer(plain: hl.Store, at_once: None) -> None:
    query = plain.topic("/state").where("i8 == 1").fields("f64")
    assert [query.to_pandas().attrs["hybridlog"]["messages"] for _ in range(3)] == [20] * 3
    assert query.counters.bytes_read == 0
    assert query.counters.elapsed_s > 0
    query.windows("1s")
    assert query.counters.messages == 0
