"""One question, one answer: of triggers, of MongoDB and of columns in memory.

Messages are made as JSON and as ROS messages, with arrays that the index holds whole and
arrays that it holds as summaries. Each engine is asked the same of what their codecs give.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from hybridlog.query.evaluate import holds
from hybridlog.query.filters import check_filter
from hybridlog.query.where import compile_filter, parse
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pymongo.collection import Collection

from hybridlog.query.column_filter import column_filter
from hybridlog.schema.codec import Codec, codec_for
from hybridlog.schema.column import Scalars
from hybridlog_storage.messages import Channel, Schema
from tests.schema.wire_oracle import oracle

Document = dict[str, object]
Ask = Callable[[list[Document], Iterable[str], dict[str, str] | None], None]

LIMIT = 3
"""Elements of an array that the index holds whole, here."""

DEFINITION = """\
float64 x
int32 i
bool b
float64[] a
int64[] k
bool[] flags
string[] names
Part[] m
================================================================================
MSG: demo/Part
int32 v
int32 n
float32[] q
Leaf[] leaves
================================================================================
MSG: demo/Leaf
uint8 level
"""
SINGLES = {"x": np.float64, "i": np.int32, "b": np.bool_}


@pytest.fixture(scope="module")
def ask(collection: Collection[Document]) -> Ask:
    def ask(
        documents: list[Document], questions: Iterable[str], types: dict[str, str] | None
    ) -> None:
        collection.delete_many({})
        collection.insert_many([{"_id": n, **document} for n, document in enumerate(documents)])
        for where in questions:
            compiled = compile_filter(where, field_types=types)
            query = check_filter(compiled)
            stored = {found["_id"] for found in collection.find(query, {"_id": 1})}
            expression = parse(where)
            in_memory = {n for n, d in enumerate(documents) if holds(expression, d, types)}
            assert in_memory == stored, (where, [documents[n] for n in in_memory ^ stored])  # type: ignore[index]
            by_columns = None if types is None else column_filter(compiled, types)
            if by_columns is not None and by_columns.fields <= SINGLES.keys():
                columns = {
                    name: Scalars(np.array([d[name] for d in documents], SINGLES[name]))
                    for name in by_columns.fields
                }
                mask = by_columns.mask(columns, len(documents))
                assert set(np.flatnonzero(mask).tolist()) == stored, where

    return ask


ordered = st.sampled_from(["<", "<=", ">", ">="])
equal = st.sampled_from(["==", "!="])
# Multiples of 1/4, so that means are exact; others between integers; beyond doubles.
bounds = st.sampled_from(["0", "1", "2", "3", "0.5", "1.5", "-1", "inf", "9007199254740993"])
values = bounds | st.sampled_from(["null", "nan", "true", "'a'", "-9007199254740993", "-inf"])


def questions_on(paths: list[str], compared: st.SearchStrategy[str] = values):  # type: ignore[no-untyped-def]
    path = st.sampled_from(paths)
    lists = st.lists(compared, min_size=1, max_size=3).map(", ".join)
    one = st.one_of(
        st.builds("{} {} {}".format, path, ordered, bounds),
        st.builds("{} {} {}".format, path, equal, compared),
        st.builds("{} {}in [{}]".format, path, st.sampled_from(["", "not "]), lists),
        st.builds("{} {}".format, path, st.sampled_from(["exists", "missing"])),
    )
    return one | st.builds("not ({} and {})".format, one, one) | st.builds("not {}".format, one)


small = st.sampled_from([-1, 0, 1, 2, 0.25, 1.5, 2**53 + 1, True, False])
plain = small | st.sampled_from([None, "a", ""])
names = st.sampled_from(["a", "n", "min", "q", "0"])


def lists_of(elements: st.SearchStrategy[object]) -> st.SearchStrategy[list[object]]:
    return st.lists(elements, max_size=2) | st.lists(elements, min_size=4, max_size=5)


arrays = lists_of(small) | lists_of(plain) | lists_of(lists_of(small))
json_values = st.recursive(
    plain | arrays,
    lambda inner: st.dictionaries(names, inner, max_size=3) | lists_of(inner),
    max_leaves=8,
)
json_messages = st.dictionaries(st.sampled_from(["a", "m"]), json_values, max_size=2)
json_paths = [
    *("a", "a.n", "a[0]", "a[1][0]", "a[0][1][0]", "a[0].n", "a[5]", "a.a", "a[*].q", "a.q.n"),
    *("m.n", "m.min", "m.max", "m.mean", "m[0].q", "m[1].q.min", "m[*].q.max", "m.a.n", "m.a[0]"),
    *("m[0][0]", "m[1].min", "m.n.n", "m.q.mean", "m.a.q.n", "m[0].a[1].n", "`m`.`0`"),
]


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
@given(
    st.lists(json_messages, min_size=4, max_size=16),
    st.lists(questions_on(json_paths), min_size=4, max_size=8),
)
@example([{"a": [1, 2]}, {"a": [1] * 40}, {"a": [{"n": 5}]}, {"a": []}], ["a.n >= 2", "a.n < 1"])
@example([{"a": [[1, 2], [3]]}, {"a": [{"0": 1}]}], ["a[0] == 1", "a[0][1] == 2", "a[0].n == 2"])
@example([{"a": [2**53 + 1] * 3}], ["a.max == 9007199254740993", "a.mean > 9007199254740992"])
def test_of_json(ask: Ask, messages: list[Document], questions: list[str]) -> None:
    codec = codec_for(Channel("/j", "json", None), array_limit=LIMIT)
    ask([codec.fields(json.dumps(message).encode()) for message in messages], questions, None)


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("a < 100", "short long far"),  # any element
        ("a.n >= 3", "short long far parts named"),
        ("a.n == 40", "long far"),
        ("a.n < 3", "none nested"),
        ("a.n != 40", "short none parts nested named"),
        ("a.n == 9", "named"),  # a field of that name, no count
        ("a.min < 100", "short long far"),
        ("a.max > 100", "far"),
        ("a.mean == 2", "short long"),
        ("a.min == null", "none"),
        ("a.min missing", "parts nested named"),
        ("a[0] == 2", "short nested"),
        ("a[0].n == 2", "nested"),
        ("a[1][0] == 5", "nested"),
        ("a.v == 7", "parts"),
    ],
)
def test_what_json_arrays_answer(ask: Ask, where: str, expected: str) -> None:
    messages = {
        "short": [2, 1, 3],
        "long": [2] * 40,
        "far": [*[50] * 39, 500],
        "none": [],
        "parts": [{"v": 7}, {"v": 8}, {"v": 9}],
        "nested": [[1, 2], [5]],
        "named": [{"n": 9}, {"n": 8}],
    }
    codec = codec_for(Channel("/j", "json", None))
    documents = {name: codec.fields(json.dumps({"a": a}).encode()) for name, a in messages.items()}
    ask(list(documents.values()), [where], None)
    found = [name for name, document in documents.items() if holds(parse(where), document)]
    assert found == expected.split()


def ros_codec() -> Codec:
    schema = Schema("demo/Whole", "ros1msg", DEFINITION.encode())
    return codec_for(Channel("/r", "ros1", schema), array_limit=LIMIT)


doubles = st.sampled_from([-1.0, 0.0, 0.25, 1.0, 1.5, 2.0, math.nan, math.inf, -math.inf])
integers = st.sampled_from([-1, 0, 1, 2, 2**53 + 1])
fixed = st.fixed_dictionaries
parts = fixed(
    {
        "v": st.integers(-1, 2),
        "n": st.integers(0, 3),
        "q": lists_of(doubles),
        "leaves": lists_of(fixed({"level": st.integers(0, 2)})),
    }
)
ros_messages = fixed(
    {
        "x": doubles,
        "i": st.integers(-1, 3),
        "b": st.booleans(),
        "a": lists_of(doubles),
        "k": lists_of(integers),
        "flags": lists_of(st.booleans()),
        "names": lists_of(st.sampled_from(["", "a", "b"])),
        "m": lists_of(parts),
    }
)
numbers = bounds | st.sampled_from(["nan", "null", "-inf", "-9007199254740993"])
ros_paths = [
    *("x", "i", "a", "a[0]", "k", "k[1]", "m.v", "m.n", "m[1].n", "m[*].q", "m.q[0]", "names.n"),
    *(f"{path}.{stat}" for path in ("a", "k", "flags", "m.q") for stat in ("n", "min", "max")),
    *("a.mean", "k.mean", "flags.mean", "m[0].q.mean", "m[1].q.n", "m.leaves.n", "m[0].leaves.n"),
    *("m[*].leaves[*].level", "m[0].leaves[1].level", "m.leaves.level"),
]
ros_questions = questions_on(ros_paths, numbers) | st.sampled_from(
    ["b == true", "b != true", "flags == false", "names == 'a'", "names != 'a'", "m.leaves.n >= 2"]
)


@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
@given(
    st.lists(ros_messages, min_size=4, max_size=12),
    st.lists(ros_questions, min_size=4, max_size=8),
)
def test_of_ros_messages(ask: Ask, messages: list[Document], questions: list[str]) -> None:
    codec = ros_codec()
    types = {path.path: path.type for path in codec.paths()}
    ask([codec.fields(serialised(message)) for message in messages], questions, types)


STORE = oracle("demo/msg/Whole", DEFINITION)


def serialised(message: Document) -> bytes:
    made = STORE.types
    whole = made["demo/msg/Whole"](
        **{**message, "m": [part(element) for element in message["m"]]},  # type: ignore[attr-defined]
    )
    for name, kind in (("a", np.float64), ("k", np.int64), ("flags", np.bool_)):
        setattr(whole, name, np.array(message[name], kind))
    return bytes(STORE.serialize_ros1(whole, "demo/msg/Whole"))


def part(values: Document) -> object:
    leaf = STORE.types["demo/msg/Leaf"]
    return STORE.types["demo/msg/Part"](
        v=values["v"],
        n=values["n"],
        q=np.array(values["q"], np.float32),
        leaves=[leaf(**inner) for inner in values["leaves"]],  # type: ignore[attr-defined]
    )


texts = st.text(st.sampled_from("abA1 _éÉ٣\n"), max_size=4)
patterns = st.sampled_from(
    [r"\w$", r"^\W", r"\d", r"\bé", r"a\Z", r"\S\s", "[^a]", r"(?i)É", r"\\Z"]
)


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(texts, min_size=4, max_size=16), st.lists(patterns, min_size=2, max_size=4))
def test_of_patterns(ask: Ask, words: list[str], asked: list[str]) -> None:
    questions = [
        f"s {operator} {json.dumps(p, ensure_ascii=False)}"
        for p in asked
        for operator in ("~", "!~")
    ]
    questions = [question.replace("\\\\", "\\") for question in questions]
    ask([{"s": word} for word in words], questions, None)
    ask([{"s": word} for word in words], questions, {"s": "string"})
