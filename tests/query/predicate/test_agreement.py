"""One question, one answer: of a message alone, among others, and of its summaries."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st

from hybridlog.columns.rows import reduced
from hybridlog.query.predicate.evaluate import matches, on_columns, statistic_of
from hybridlog.query.predicate.parser import parse
from hybridlog.query.question import Part, RecordedChannel
from hybridlog.schema.arrow_columns import objects_array
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.catalog import ChannelStats, RecordingEntry
from hybridlog_storage.manifest import Manifest
from hybridlog_storage.messages import REDUCED, Batch, Channel, Schema, left_channel

Message = dict[str, object]
Types = dict[str, str] | None

DEFINITION = """\
float64 x
float32 f
int32 i
uint64 u
bool b
string s
float64[] a
int64[] k
uint64[] w
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
SUMMARISED = ("a", "k", "w")


def holding(where: str, types: Types, messages: list[Message]) -> list[bool]:
    """The messages for which a predicate holds, and that it is known of all."""
    found = on_columns(parse(where), types, objects_array(messages, None))
    assert not found.open.any(), where
    return found.holds.tolist()


def ask(messages: list[Message], questions: Iterable[str], types: Types) -> None:
    for where in questions:
        alone = [held for one in messages for held in holding(where, types, [one])]
        assert holding(where, types, messages) == alone, where
        if types is None:
            continue
        whole = on_columns(parse(where), types, pa.array(messages, ARROW))  # type: ignore[arg-type]
        assert whole.holds.tolist() == alone, where
        left = pa.array([summarised(message) for message in messages], SUMMARIES)
        found = on_columns(parse(where), types, left, left=True)  # type: ignore[arg-type]
        for held, holds, fails in zip(alone, *found, strict=True):
            assert not (fails if held else holds), where


def summarised(message: Message) -> Message:
    """The message with summaries for the arrays of numbers at its top, whatever their length."""
    shorter: Message = {}
    for name in SUMMARISED:
        values = message[name]
        assert isinstance(values, list)
        shorter[name] = {stat: statistic_of(values, stat) for stat in ("n", "min", "max", "mean")}
    return {**message, **shorter}


PART = pa.struct(
    [
        ("v", pa.int32()),
        ("n", pa.int32()),
        ("q", pa.list_(pa.float32())),
        ("leaves", pa.list_(pa.struct([("level", pa.uint8())]))),
    ]
)
SINGLES = [
    ("x", pa.float64()),
    ("f", pa.float32()),
    ("i", pa.int32()),
    ("u", pa.uint64()),
    ("b", pa.bool_()),
    ("s", pa.string()),
]
LISTS = [
    ("flags", pa.list_(pa.bool_())),
    ("names", pa.list_(pa.string())),
    ("m", pa.list_(PART)),
]
NUMBERS = {"a": pa.float64(), "k": pa.int64(), "w": pa.uint64()}
ARROW = pa.struct([*SINGLES, *LISTS, *((n, pa.list_(kind)) for n, kind in NUMBERS.items())])
SUMMARIES = pa.struct(
    [
        *SINGLES,
        *LISTS,
        *(
            (
                name,
                pa.struct(
                    [("n", pa.int64()), ("min", kind), ("max", kind), ("mean", pa.float64())]
                ),
            )
            for name, kind in NUMBERS.items()
        ),
    ]
)

BIG = [2**53 + 1, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1, -(2**63), -(2**63) - 1, 2**70 + 1]
ordered = st.sampled_from(["<", "<=", ">", ">="])
equal = st.sampled_from(["==", "!="])
# Multiples of 1/4; others between integers; beyond doubles, int64 and uint64.
bounds = st.sampled_from(
    ["0", "1", "2", "3", "0.5", "1.5", "-1", "inf", "-0.0", "-inf", *map(str, BIG), "1e19", "1e300"]
)
values = bounds | st.sampled_from(["null", "nan", "true", "'a'", "'é'", "''", "'\\ud83d\\ude00'"])
patterns = st.sampled_from(
    ["a", "^a", "a$", ".", "^$", "[^a]", "(?i)A", "é", r"\\d", r"\\pL", "(a|b)*c", "(a+)+$", "\n"]
)


def questions_on(paths: list[str], compared: st.SearchStrategy[str] = values):  # type: ignore[no-untyped-def]
    path = st.sampled_from(paths)
    lists = st.lists(compared, min_size=1, max_size=3).map(", ".join)
    one = st.one_of(
        st.builds("{} {} {}".format, path, ordered, bounds),
        st.builds("{} {} {}".format, path, equal, compared),
        st.builds("{} {}in [{}]".format, path, st.sampled_from(["", "not "]), lists),
        st.builds("{} {}".format, path, st.sampled_from(["exists", "missing"])),
        st.builds("{} {} 'a'".format, path, ordered),
        st.builds("{} {} '{}'".format, path, st.sampled_from(["~", "!~"]), patterns),
    )
    two = st.builds("{} {} {}".format, one, st.sampled_from(["and", "or"]), one)
    return st.one_of(one, two, st.builds("not ({})".format, two), st.builds("not {}".format, one))


small = st.sampled_from([-1, 0, 1, 2, 0.25, 1.5, -0.0, 2**53 + 1, True, False])
plain = small | st.sampled_from(
    [None, "a", "", "é", "abc", "😀", "a\n", math.nan, math.inf, -math.inf, *BIG, 10**400]
)
names = st.sampled_from(["a", "n", "min", "q", "0"])


def lists_of(elements: st.SearchStrategy[object]) -> st.SearchStrategy[list[object]]:
    return st.lists(elements, max_size=2) | st.lists(elements, min_size=4, max_size=5)


arrays = lists_of(small) | lists_of(plain) | lists_of(lists_of(small) | lists_of(lists_of(plain)))
json_values = st.recursive(
    plain | arrays,
    lambda inner: st.dictionaries(names, inner, max_size=3) | lists_of(inner),
    max_leaves=8,
)
json_messages = st.dictionaries(st.sampled_from(["a", "m"]), json_values, max_size=2)
# Such as Arrow can hold: one type a field, with nulls and without some fields.
even_messages = st.fixed_dictionaries(
    {},
    optional={
        "a": st.none() | st.lists(st.none() | st.integers(-1, 2), max_size=5),
        "h": st.lists(
            st.lists(st.lists(st.fixed_dictionaries({}, optional={"a": small}), max_size=5))
        ),
        "m": st.none()
        | st.lists(
            st.fixed_dictionaries(
                {},
                optional={
                    "a": st.none() | st.integers(-1, 2) | st.sampled_from([2**53 + 1]),
                    "q": st.none() | st.lists(st.sampled_from([0.5, 1.5, math.nan, math.inf])),
                    "n": st.none() | st.integers(0, 2),
                },
            ),
            max_size=5,
        ),
        "d": st.none()
        | st.fixed_dictionaries({}, optional={"a": st.none() | st.text("aé", max_size=2)}),
        "g": st.none() | st.lists(st.none() | st.lists(st.integers(-1, 2), max_size=5), max_size=3),
    },
)
json_paths = [
    *("a", "a.n", "a[0]", "a[1][0]", "a[0][1][0]", "a[0].n", "a[5]", "a.a", "a[*].q", "a.q.n"),
    *("m.n", "m.min", "m.max", "m.mean", "m[0].q", "m[1].q.min", "m[*].q.max", "m.a.n", "m.a[0]"),
    *("m[0][0]", "m[1].min", "m.n.n", "m.q.mean", "m.a.q.n", "m[0].a[1].n", "`m`.`0`", "a.max"),
    *(
        "a[0:2]",
        "a[1:4]",
        "a[4:]",
        "a[:3].n",
        "a[1:].min",
        "a[0][1:3]",
        "m[0:2].q",
        "m.a[1:]",
        "m[1:].n",
    ),
    *("a[0:2].a", "a[:1].max", "m.q[1:3].mean", "m[0:2].q[1:].n"),
]
even_paths = [
    *("a", "a.n", "a.min", "a.mean", "a[0]", "a[4]", "m", "m.a", "m.q", "m.q.max", "m[1].q[0]"),
    *("m.n", "d", "d.a", "g", "g[0]", "g[0][1]", "g.n", "g[1].n", "m.q.n", "m[0].a", "m[0].n"),
    *(
        "a[1:3]",
        "a[4:]",
        "a[:2].min",
        "a[1:].n",
        "m[0:2].a",
        "m[1:].q[0:2]",
        "m.q[1:].max",
        "g[0][1:3]",
    ),
    *(
        "m[:1].n",
        "g[0:2]",
        "g[0:2].n",
        "d[0:2]",
        "d[0:2].a",
        "h.a",
        "h[0].a",
        "h[1:].a",
        "h[0][1].a",
    ),
]

SLOW = settings(
    max_examples=15,
    phases=[Phase.explicit, Phase.generate],  # to shrink takes minutes
    derandomize=True,
)


@SLOW
@given(
    st.lists(json_messages, min_size=4, max_size=16) | st.lists(even_messages, min_size=4),
    st.lists(questions_on([*json_paths, *even_paths]), min_size=4, max_size=12),
)
@example([{"a": [1, 2]}, {"a": [1] * 40}, {"a": [{"n": 5}]}, {"a": []}], ["a.n >= 2", "a.n < 1"])
@example([{"a": [[1, 2], [3]]}, {"a": [{"0": 1}]}], ["a[0] == 1", "a[0][1] == 2", "a[0].n == 2"])
@example([{"a": [2**53 + 1] * 3}], ["a.max == 9007199254740993", "a.mean > 9007199254740992"])
@example([{"a": [1, "x"] * 20}, {"a": {"n": 40}}], ["a == 1", "a > 0", "a.n == 40", "a.b missing"])
@example([{"a": [[1, 0, 0, -1, 1], None]}, {"a": [[1] * 5]}], ["a.n == 2", "a.n in [1]", "a.n > 4"])
@example([{"a": [[0, 1, 2, 3]]}, {"a": {"0": [1] * 5}}], ["a.max != 1", "a[0].n exists"])
@example([{"m": {"n": {}}}, {"m": {"n": 4}}], ["m.`0` missing", "`m`.`0` missing", "m[1] exists"])
@example([{"a": [{"n": 1}] * 40}], ["a.n >= 40", "a.n == 1", "a.min missing"])
@example([{"g": [None, [0, 1, 2, 3]]}], ["g[0][1:3] !~ '^$'", "g[1][1:3] == 2"])
def test_of_json(messages: list[Message], questions: list[str]) -> None:
    ask(messages, questions, None)


JSON_ARRAYS: dict[str, dict[str, Message]] = {
    "flat": {
        "short": {"a": [2, 1, 3]},
        "long": {"a": [2] * 40},
        "far": {"a": [*[50] * 39, 500]},
        "none": {"a": []},
        "parts": {"a": [{"v": 7}, {"v": 8}, {"v": 9}]},
        "nested": {"a": [[1, 2], [5]]},
        "named": {"a": [{"n": 9}, {"n": 8}]},
    },
    "nested": {
        "flat": {"a": [5]},
        "two": {"a": [[5, 6]]},
        "three": {"a": [[[5], [6]], [[{"w": 3}]]]},
        "mixed": {"a": [[8, "x", None], [[5, {"w": 3}], 9]]},
        "long": {"a": [list(range(6, 46))]},
        "empty": {"a": [[], [[]]]},
    },
}


@pytest.mark.parametrize(
    ("kind", "where", "expected"),
    [
        ("flat", "a < 100", "short long far nested"),  # any element, also of the arrays in an array
        ("flat", "a == 500", "far"),
        ("flat", "a != 500", "short long none parts nested named"),
        ("flat", "a[39] == 500", "far"),
        ("flat", "a.n >= 3", "short long far parts named"),
        ("flat", "a.n < 3", "none nested"),
        ("flat", "a.n == 9", "named"),  # a field of that name, no count
        ("flat", "a.min < 100", "short long far"),
        ("flat", "a.max > 100", "far"),
        ("flat", "a.mean == 2", "short long"),
        ("flat", "a.min == null", "none parts nested named"),
        ("flat", "a.min != null", "short long far"),
        ("flat", "a[0] == 2", "short long nested"),
        ("flat", "a[0].n == 2", "nested"),
        ("flat", "a[1][0] == 5", "nested"),
        ("flat", "a.v == 7", "parts"),
        ("flat", "a[1:3] < 3", "short long"),  # the elements 1 and 2
        ("flat", "a[39:] == 500", "far"),
        ("flat", "a[2:1000].n == 1", "short parts"),
        ("flat", "a[5:] != 500", "short long none parts nested named"),
        ("flat", "a[1:].v == 7", ""),
        ("flat", "a[0][1:] == 2", "nested"),
        ("nested", "a == 5", "flat two three mixed"),
        ("nested", "a[:1] == 5", "flat two three"),
        ("nested", "a[1:] == 5", "mixed"),
        ("nested", "a[0][0] == 5", "two three"),
        ("nested", "a[0][0][0] == 5", "three"),
        ("nested", "a != 5", "long empty"),
        ("nested", "a < 7", "flat two three mixed long"),
        ("nested", "a == 45", "long"),
        ("nested", "a ~ '^x$'", "mixed"),
        ("nested", "a == null", ""),  # of elements it is not asked
        ("nested", "a.w == 3", "three mixed"),
        ("nested", "a.w exists", "three mixed"),
        ("nested", "a.w missing", "flat two long empty"),
        ("nested", "a.n == 2", "three mixed empty"),
    ],
)
def test_what_json_arrays_answer(kind: str, where: str, expected: str) -> None:
    """Arrays in an array are looked into."""
    messages = JSON_ARRAYS[kind]
    ask(list(messages.values()), [where], None)
    mask = holding(where, None, [*messages.values()])
    assert [name for name, holds in zip(messages, mask, strict=True) if holds] == expected.split()


doubles = st.sampled_from([-1.0, 0.0, -0.0, 0.25, 1.0, 1.5, 2.0, math.nan, math.inf, -math.inf])
integers = st.sampled_from([-1, 0, 1, 2, 2**53 + 1, 2**63 - 1])
unsigned = st.sampled_from([0, 1, 2, 2**53 + 1, 2**63 - 1, 2**63, 2**63 + 1, 2**64 - 1])
fixed = st.fixed_dictionaries
texts = st.text(st.sampled_from("abA1 _éÉ٣\n😀"), max_size=4)
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
        "x": doubles | st.sampled_from([2.0**63, 2.0**64, 1e19]),
        "f": doubles,
        "i": st.integers(-1, 3),
        "u": unsigned,
        "b": st.booleans(),
        "s": texts,
        "a": lists_of(doubles),
        "k": lists_of(integers),
        "w": lists_of(unsigned),
        "flags": lists_of(st.booleans()),
        "names": lists_of(st.sampled_from(["", "a", "b"])),
        "m": lists_of(parts),
    }
)
ros_paths = [
    *("x", "f", "i", "u", "b", "s", "a", "a[0]", "a[4]", "k", "k[1]", "w", "w[0]", "flags"),
    *("m.v", "m.n", "m[1].n", "m[*].q", "m.q[0]", "names.n", "names", "names[0]", "m"),
    *(f"{path}.{stat}" for path in ("a", "k", "w", "flags", "m.q") for stat in ("n", "min", "max")),
    *("a.mean", "k.mean", "flags.mean", "m[0].q.mean", "m[1].q.n", "m.leaves.n", "m[0].leaves.n"),
    *("m[*].leaves[*].level", "m[0].leaves[1].level", "m.leaves.level", "w.mean", "y", "m.y"),
    *("a[0:2]", "a[3:]", "k[1:3]", "w[:2]", "flags[1:4]", "names[0:1]", "m[0:2].v", "m[1:].q[:2]"),
    *(
        f"{path}.{stat}"
        for path in ("a[1:3]", "k[:2]", "w[4:]", "flags[:3]")
        for stat in ("n", "min", "max")
    ),
    *("a[2:].mean", "m.q[1:].min", "m[0:2].q.max", "m[0:1].leaves[1:].level", "m[2:].n", "x[0:2]"),
]


@SLOW
@given(
    st.lists(ros_messages, min_size=4, max_size=12),
    st.lists(questions_on(ros_paths), min_size=8, max_size=16),
)
def test_of_ros_messages(messages: list[Message], questions: list[str]) -> None:
    codec = codec_for(Channel("/r", "ros1", Schema("demo/Whole", "ros1msg", DEFINITION.encode())))
    types = {path.path: path.type for path in codec.paths()}
    ask(messages, [*questions, *ROS_QUESTIONS], types)


ROS_QUESTIONS = [
    *("m.n == 1", "m[0].n > 0", "m.q.n >= 4", "names.n == 1", "flags.mean > 0.5", "flags == true"),
    *("a > 1", "a < 0", "not a > 1", "a != 1", "not m.v == 1", "a == inf", "k[4] == 1"),
    *("a[0:2] > 1", "a[1:3].max > 1", "not a[1:].min < 1", "k[1:].n == 3", "w[3:].mean > 1"),
    *("a[9:] missing", "a[1:3].n >= 2", "flags[2:] == true", "flags[1:].max >= 1"),
    *("w.max >= 9223372036854775809", "u < 9223372036854775809", "w == 9223372036854775809"),
]


@pytest.mark.parametrize(
    ("where", "holds"),
    [("r.max > 5", True), ("r.n == 1000", True), ("r.max > 999", False)]
    # What a summary cannot decide is told, with `not` in front of it, too.
    + [(f"{word}{test}", False) for word in ("", "not ") for test in ("r > 5", "r == 5", "r != 5")]
    # What decides by itself needs no array.
    + [("r > 5 or r.n == 1000", True), ("r > 5 and r.n == 1", False)],
)
def test_reduced_json_has_summaries(where: str, holds: bool) -> None:
    channel = Channel("/r", "json", None, {}, has_publish_time=False)
    payload = reduced(codec_for(channel), json.dumps({"r": [*range(1000)]}).encode())
    zero = np.zeros(1, np.int64)
    batch = Batch(payload, zero, zero + len(payload), zero, zero, zero, zero)
    entry = RecordingEntry(Manifest(f"a-{0:016x}", "a", 0), "complete")
    recorded = RecordedChannel(entry, 0, left_channel(channel, REDUCED), ChannelStats())
    part = Part(entry, "/r", (recorded,), parse(where))
    found, unreadable, lacking = matches(part, recorded, batch, zero)
    assert found.tolist() == [holds]
    assert unreadable == lacking == ("r." not in where)
