"""Tables and chunks give the same answer, that of a plain evaluation of decoded messages.

Two recordings overlap in time and have ties; their topics are JSON and ROS 2 messages with
NaN, -0.0, missing and null values, nested and long arrays and integers beyond 2^53 and 2^63.
"""

from __future__ import annotations

import json
import math
import random
from bisect import bisect_left
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import hybridlog as hl
from hybridlog.query.intervals import Intervals
from hybridlog.query.predicate.evaluate import on_columns
from hybridlog.query.predicate.parser import parse
from hybridlog.query.query import Query, field_types
from hybridlog.query.rows import Rows
from hybridlog.schema.arrow_types import objects_array
from hybridlog_storage.errors import DatabaseError, TimeError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from hybridlog_storage.settings import EMBEDDED, NONE
from tests.independent import write_mcap

SECOND = 10**9
BASE = 1_700_000_000 * SECOND
DEFINITION = """\
std_msgs/Header header
float64 x
int32 i
uint64 u
bool b
string s
float64[] a
uint64[] k
bool[] flags
string[] names
demo/Part[] m
================================================================================
MSG: demo/Part
int32 v
int32 n
float32[] q
"""
FULL_DEFINITION = (
    DEFINITION
    + "=" * 80
    + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + "=" * 80
    + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
)
WAYS = ("as the rule says", "chunks")


@dataclass(frozen=True)
class Sent:
    """A message as it was written.

    `fields` is what an independent decoder makes of it.
    """

    recording: str
    topic: str
    log_time: int
    publish_time: int
    stamp: int | None
    seq: int
    fields: dict[str, Any]
    raw: bytes


def ros_message(types: Any, rng: random.Random, stamp: int) -> Any:
    numbers = [0.0, -0.0, 1.0, 1.5, -2.25, math.nan, math.inf, 2.0**53 + 2]
    unsigned = [0, 1, 2**53 + 1, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1]
    make = types.types
    length = rng.choice([0, 1, 2, 40])
    part = make["demo/msg/Part"]
    return make["demo/msg/Thing"](
        header=make["std_msgs/msg/Header"](
            stamp=make["builtin_interfaces/msg/Time"](sec=stamp // SECOND, nanosec=stamp % SECOND),
            frame_id=rng.choice(["", "laser", "base"]),
        ),
        x=rng.choice(numbers),
        i=rng.choice([-3, 0, 1, 2, 2**31 - 1]),
        u=rng.choice(unsigned),
        b=rng.random() < 0.5,
        s=rng.choice(["", "a", "slip 1", "SLIP", "é\n"]),
        a=np.array([rng.choice(numbers) for _ in range(length)], np.float64),
        k=np.array([rng.choice(unsigned) for _ in range(length)], np.uint64),
        flags=np.array([rng.random() < 0.5 for _ in range(rng.choice([0, 1, 3]))], np.bool_),
        names=[rng.choice(["", "a", "b"]) for _ in range(rng.choice([0, 1, 3]))],
        m=[
            part(
                v=rng.randrange(3),
                n=rng.randrange(3),
                q=np.array(rng.choices(numbers[:7], k=rng.choice([0, 1, 5])), np.float32),
            )
            for _ in range(rng.choice([0, 1, 3]))
        ],
    )


def as_dict(value: Any) -> Any:
    """A message of rosbags as plain values; times as nanoseconds."""
    if hasattr(value, "sec") and hasattr(value, "nanosec"):
        return value.sec * SECOND + value.nanosec
    if hasattr(value, "__dataclass_fields__"):
        names = [n for n in value.__dataclass_fields__ if not n.startswith("__")]
        return {name: as_dict(getattr(value, name)) for name in names}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [as_dict(each) for each in value] if isinstance(value, list) else value


def json_message(rng: random.Random) -> dict[str, Any]:
    numbers = [0, -0.0, 1, 1.5, 2**53 + 1, -(2**53) - 1, 2**63, 2**64 - 1, 2**64, 2**70, True]
    found: dict[str, Any] = {}
    for name, make in (
        ("x", lambda: rng.choice([*numbers, None, "1"])),
        ("n", lambda: rng.choice([0, 1, 2])),
        ("s", lambda: rng.choice(["", "a", "slip 1", None, "SLIP"])),
        ("a", lambda: [rng.choice(numbers) for _ in range(rng.choice([0, 1, 3, 40]))]),
        ("o", lambda: {"v": rng.choice([1, None])}),
        ("l", lambda: [[rng.choice(numbers)] for _ in range(rng.choice([0, 2]))]),
        ("g", lambda: [[rng.choice(numbers[:4])] * rng.choice([1, 40]) for _ in range(2)]),
        ("h", lambda: [[[{"v": rng.choice(numbers)}]], [rng.choice([[], 1])]]),
    ):
        if rng.random() < 0.8:
            found[name] = make()
    return found


def _write(path: Path, seed: int, count: int) -> list[Sent]:
    rng = random.Random(seed)
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(DEFINITION, "demo/msg/Thing"))
    sent: list[Sent] = []
    ros = Schema("demo/msg/Thing", "ros2msg", FULL_DEFINITION.encode())
    channels = {topic: Channel(topic, "cdr", ros) for topic in ("/thing", "/other")}
    channels["/state"] = Channel(
        "/state", "json", Schema("State", "jsonschema", b"{}"), {"mark": str(seed)}
    )
    for seq in range(count):
        # Ties in log time, and times that go back.
        log_time = BASE + rng.randrange(40) * SECOND // 4 + (seed % 2)
        publish, stamp = log_time - rng.randrange(SECOND), log_time - rng.randrange(9) * SECOND
        kind = rng.randrange(3)
        if kind < 2:
            message = ros_message(types, rng, stamp)
            raw = bytes(types.serialize_cdr(message, "demo/msg/Thing"))
            fields = as_dict(message)
        else:
            fields = json_message(rng)
            raw = json.dumps(fields).encode()
        own = stamp if kind < 2 else None
        topic = [*channels][kind]
        sent.append(Sent("", topic, log_time, publish, own, seq, fields, raw))
    write_mcap(path, [(channels[m.topic], m.log_time, m.raw, m.publish_time) for m in sent])
    return sent


@dataclass(frozen=True, repr=False)
class World:
    """A store and what was written to it, in the order of an answer."""

    store: hl.Store
    sent: list[Sent]
    ids: dict[str, str]


@pytest.fixture(scope="module", params=[EMBEDDED, NONE])
def world(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[World]:
    place = tmp_path_factory.mktemp("engines")
    yield from _world(place, request.param)


def _world(place: Path, mongo: str) -> Iterator[World]:
    with hl.open(place / "store", create=True, mongo=mongo) as store:
        everything: list[Sent] = []
        ids = {}
        for seed, name in enumerate(("one", "two")):
            written = _write(place / f"{name}.mcap", seed, 400)
            settings_ = SegmentSettings(chunk_size=4096, segment_size=200_000)
            report = store.record(place / f"{name}.mcap", name=name, settings=settings_)
            ids[name] = report.entry.id
            by_place = {(m.log_time, m.raw): m for m in written}
            for message in store.all_topics().in_recording(name):
                one = by_place[message.log_time_ns, message.raw]
                everything.append(
                    Sent(
                        report.entry.id, one.topic, one.log_time, one.publish_time, one.stamp,
                        message.seq, one.fields, one.raw,
                    )
                )  # fmt: skip
            assert len(everything) == 400 * (seed + 1)
        everything.sort(key=lambda m: (m.log_time, m.recording[-16:], m.seq))
        assert (store.shared.index.reached() is None) == (mongo == NONE)
        yield World(store, everything, ids)


@contextmanager
def only(way: str) -> Iterator[None]:
    """Let chunks answer only, or whatever holds the rows."""
    with pytest.MonkeyPatch.context() as patch:
        if way == "chunks":
            patch.setattr(Rows, "tabled", lambda *_: None)
            patch.setattr(Rows, "count_of", Rows.count_in_chunks)
        yield


number = st.sampled_from(
    [
        *("0", "1", "1.5", "-0.0", "-2", "nan", "inf", "9007199254740993", "9223372036854775807"),
        *("9223372036854775808", "9223372036854775809", "18446744073709551615", "2.5e18"),
    ]
)
order = st.sampled_from(["==", "!=", "<", "<=", ">", ">="])
ros_numbers = st.sampled_from(
    [
        *("x", "i", "u", "a", "k", "m[].v", "m[0].q", "a.min", "a.n", "k.max", "k[1]", "k.mean"),
        *("a[1:3]", "a[30:].min", "k[:2].max", "m[:1].q[1:]", "m[1:].n", "m.n", "m[1].q.n"),
        *("m.q.max", "m[0].q.mean", "flags.mean", "flags[1:].n", "names.n", "i", "abs(x)"),
    ]
)
json_numbers = st.sampled_from(
    [
        *("x", "n", "a", "l", "a.n", "a.min", "l[0]", "o.v", "a[1]", "a[1:3]", "l[1:].n"),
        *("g", "g[0]", "g[1:]", "g.n", "g[1].n", "h", "h.v", "h[0].v", "h[0][0].v", "x.n"),
        *("a.max", "a[4:].mean", "g[0][1:3]", "l.n", "o.n", "h[1:].v", "h.n", "o[0:2].v"),
    ]
)
pattern = st.sampled_from(["'^slip'", "'(?i)slip'", "'[0-9]$'", "'^$'", "'l.p 1'"])


def _conditions(numbers: st.SearchStrategy[str], extra: list[str]) -> st.SearchStrategy[str]:
    one = st.one_of(
        st.builds("{} {} {}".format, numbers, order, number.filter(lambda n: n != "nan")),
        st.builds("{} {} nan".format, numbers, st.sampled_from(["==", "!="])),
        st.builds("{} in [{}, {}]".format, numbers, number, number),
        st.builds("s ~ {}".format, pattern),
        st.builds("s !~ {}".format, pattern),
        st.builds("{} {}".format, numbers, st.sampled_from(["exists", "missing"])),
        st.sampled_from(["s == 'a'", "s != ''", "s in ['a', '']", "_meta.seq < 200", *extra]),
    )
    return st.one_of(
        one,
        st.builds("not ({})".format, one),
        st.builds("({}) and ({})".format, one, one),
        st.builds("({}) or not ({})".format, one, one),
    )


ros_condition = _conditions(ros_numbers, ["b == true", "header.frame_id == 'laser'", "b != false"])
json_condition = _conditions(
    json_numbers,
    ["x exists", "x missing", "x == null", "s == null", "o.v == null", "x == true", "x == '1'"],
)


@st.composite
def questions(draw: st.DrawFn) -> dict[str, Any]:
    """A question as keyword arguments of `ask` and `expected`."""
    is_json = draw(st.booleans())
    topics = ("/state",) if is_json else draw(st.sampled_from([("/thing",), ("/thing", "/other")]))
    condition = draw(st.none() | (json_condition if is_json else ros_condition))
    if condition is None and draw(st.booleans()):
        topics = ("/thing", "/other", "/state")
    clocks = ["log", "publish"] if "/state" in topics else ["log", "publish", "header"]
    begin = draw(st.none() | st.integers(-8, 44))
    span = None
    if begin is not None:
        span = BASE + begin * SECOND // 4, BASE + (begin + draw(st.integers(1, 30))) * SECOND // 4
    windows = draw(
        st.none()
        | st.lists(
            st.tuples(st.sampled_from(["one", "two"]), st.integers(0, 40), st.integers(1, 8))
        )
    )
    return {
        "topics": topics,
        "recordings": draw(st.sampled_from([("one",), ("two",), ("one", "two")])),
        "condition": condition,
        "span": span,
        "clock": draw(st.sampled_from(clocks)),
        "windows": windows,
        "limit": draw(st.none() | st.integers(0, 30)),
        "every": draw(st.sampled_from([1, 1, 2, 7])),
        "reverse": draw(st.booleans()),
        "is_raw": draw(st.sampled_from([False, False, True])),
    }


def _windows(world: World, windows: list[tuple[str, int, int]]) -> Intervals:
    rows: dict[str, list[list[int]]] = {}
    for name, begin, length in windows:
        first = BASE + begin * SECOND // 4
        rows.setdefault(world.ids[name], []).append([first, first + length * SECOND // 4, 1])
    return Intervals((name, np.array(spans, np.int64)) for name, spans in rows.items())


def asked(world: World, question: dict[str, Any]) -> Query:
    query = world.store.topic(*question["topics"]).in_recording(*question["recordings"])
    if question["span"] is not None:
        query = query.between(*question["span"])
    query = query.clock(question["clock"])
    if question["condition"] is not None:
        query = query.where(question["condition"])
    if question["is_raw"]:
        query = query.where({"_meta.seq": {"$mod": [3, 1]}})  # only MongoDB understands it
    if question["windows"] is not None:
        query = query.during(_windows(world, question["windows"]))
    if question["every"] > 1:
        query = query.every(question["every"])
    if question["limit"] is not None:
        query = query.limit(question["limit"])
    return query.reverse() if question["reverse"] else query


def expected(world: World, question: dict[str, Any]) -> list[Sent]:
    """The plain evaluation: a loop over all that was written."""
    matching = None
    if question["condition"] is not None:  # decided alike of each alone: see test_agreement.py
        types = None if question["topics"] == ("/state",) else _types(world, question)
        sent = [one for one in world.sent if one.topic in question["topics"]]
        objects = [{**one.fields, "_meta": {"seq": one.seq}} for one in sent]
        held = on_columns(parse(question["condition"]), types, objects_array(objects, None)).holds
        matching = {id(one) for one, holds in zip(sent, held, strict=True) if holds}
    named = {world.ids[name] for name in question["recordings"]}
    found = []
    for sent in world.sent:
        time = {"log": sent.log_time, "publish": sent.publish_time, "header": sent.stamp}
        now = time[question["clock"]]
        span = question["span"]
        if sent.topic not in question["topics"] or sent.recording not in named:
            continue
        if span is not None and (now is None or not span[0] <= now < span[1]):
            continue
        if question["windows"] is not None and not any(
            world.ids[name] == sent.recording
            and BASE + begin * SECOND // 4 <= sent.log_time < BASE + (begin + n) * SECOND // 4
            for name, begin, n in question["windows"]
        ):
            continue
        if matching is not None and id(sent) not in matching:
            continue
        if question["is_raw"] and sent.seq % 3 != 1:
            continue
        found.append(sent)
    if question["reverse"]:
        found.reverse()
    seen: dict[str, int] = {}
    thinned = []
    for sent in found:
        seen[sent.topic] = seen.get(sent.topic, -1) + 1
        if seen[sent.topic] % question["every"] == 0:
            thinned.append(sent)
    return thinned if question["limit"] is None else thinned[: question["limit"]]


def _types(world: World, question: dict[str, Any]) -> dict[str, str] | None:
    return field_types(world.store.topic(*question["topics"]))


def check(world: World, question: dict[str, Any]) -> None:
    want = expected(world, question)
    for way in WAYS:
        with only(way):
            query = asked(world, question)
            try:
                count = query.count()
            except TimeError:
                assert not want, (way, question)
                continue
            except DatabaseError:
                predicate = query.question.predicate
                assert predicate is not None, question
                assert predicate.filters, question
                assert world.store.shared.index.reached() is None, question
                continue
            assert count == len(want), (way, question)
            got = [(m.recording, m.topic, m.log_time_ns, m.seq, m.raw) for m in query]
            assert got == [(s.recording, s.topic, s.log_time, s.seq, s.raw) for s in want], (
                way,
                question,
            )
            if query.question.returns_all and question["clock"] == "log":
                spans = [
                    [s.log_time - n % 3, s.log_time + 1 + n % 7 * SECOND // 4, 0]
                    for n, s in enumerate(world.sent)
                ]
                for recording in query.recordings:
                    rows = Intervals([(recording, np.array(spans, np.int64))])
                    times = sorted(s.log_time for s in want if s.recording == recording)
                    found = [(one.begin_ns, one.end_ns) for one in rows.containing(query)]
                    assert found == [
                        (one.begin_ns, one.end_ns)
                        for one in rows
                        if bisect_left(times, one.begin_ns) < bisect_left(times, one.end_ns)
                    ], way


@settings(max_examples=15)
@given(question=questions())
def test_tables_and_chunks_answer_as_a_loop_does(world: World, question: dict[str, Any]) -> None:
    check(world, question)


@pytest.mark.exhaustive
@settings(max_examples=1500)
@given(question=questions())
def test_three_thousand_questions(world: World, question: dict[str, Any]) -> None:
    check(world, question)
