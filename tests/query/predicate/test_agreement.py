"""One question, one answer: of a message alone, among others, and of its summaries."""

from __future__ import annotations

import json
import random
from collections.abc import Iterable

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import Phase, example, given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from hybridlog.columns.rows import reduced
from hybridlog.query.predicate.evaluate import matches, on_columns, statistic_of
from hybridlog.query.predicate.parser import parse
from hybridlog.query.question import Part, RecordedChannel
from hybridlog.schema.arrow_types import objects_array
from hybridlog.schema.codec import no_messages
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.catalog import ChannelStats, RecordingEntry
from hybridlog_storage.manifest import Manifest
from hybridlog_storage.messages import REDUCED, Batch, Channel, Schema, left_channel
from tests.query import test_engines as engines

Message = dict[str, object]
Types = dict[str, str] | None

CODEC = codec_for(
    Channel("/r", "cdr", Schema("demo/msg/Thing", "ros2msg", engines.FULL_DEFINITION.encode()))
)
TYPES = {path.path: path.type for path in CODEC.paths()}
ARROW = CODEC.columns_of(no_messages(), None).arrow().type
NUMBERS = {"a": pa.float64(), "k": pa.uint64()}
"""Arrays at the top of a message that summaries may stand for."""


def _summary(kind: pa.DataType) -> pa.DataType:
    return pa.struct([("n", pa.int64()), ("min", kind), ("max", kind), ("mean", pa.float64())])


SUMMARIES = pa.struct(
    [(one.name, _summary(NUMBERS[one.name]) if one.name in NUMBERS else one.type) for one in ARROW]
)


def holding(where: str, types: Types, messages: pa.StructArray) -> list[bool]:
    """The messages for which a predicate holds, and that it is known of all."""
    found = on_columns(parse(where), types, messages)
    assert not found.open.any(), where
    return found.holds.tolist()


def ask(messages: list[Message], questions: Iterable[str], types: Types) -> None:
    together = objects_array(messages, None)
    apart = [objects_array([message], None) for message in messages]
    if types is not None:
        whole = pa.array(messages, ARROW)
        left = pa.array([summarised(message) for message in messages], SUMMARIES)
    for where in questions:
        alone = [held for one in apart for held in holding(where, types, one)]
        assert holding(where, types, together) == alone, where
        if types is None:
            continue
        assert holding(where, types, whole) == alone, where  # type: ignore[arg-type]
        found = on_columns(parse(where), types, left, left=True)  # type: ignore[arg-type]
        for held, holds, fails in zip(alone, *found, strict=True):
            assert not (fails if held else holds), where


def summarised(message: Message) -> Message:
    """The message with summaries for the arrays of numbers at its top, whatever their length."""
    shorter: Message = {}
    for name in NUMBERS:
        values = message[name]
        assert isinstance(values, list)
        shorter[name] = {stat: statistic_of(values, stat) for stat in ("n", "min", "max", "mean")}
    return {**message, **shorter}


SLOW = settings(
    max_examples=15,
    phases=[Phase.explicit, Phase.generate],  # to shrink takes minutes
    derandomize=True,
)
seeds = st.integers(0, 1 << 30).map(random.Random)


@SLOW
@given(
    seeds.map(lambda rng: [engines.json_message(rng) for _ in range(12)]),
    st.lists(engines.json_condition, min_size=4, max_size=12),
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
    ask([*messages.values()], [where], None)
    mask = holding(where, None, objects_array([*messages.values()], None))
    assert [name for name, holds in zip(messages, mask, strict=True) if holds] == expected.split()


ROS_QUESTIONS = [
    *("m.n == 1", "m[0].n > 0", "m.q.n >= 4", "names.n == 1", "flags.mean > 0.5", "flags == true"),
    *("names[0] == 'a'", "m.names.n > 0", "x[0:2] > 0", "m missing", "y exists", "s < 'b'"),
    *("a > 1", "a < 0", "not a > 1", "a != 1", "not m.v == 1", "a == inf", "k[4] > 1"),
    *("a[0:2] > 1", "a[1:3].max > 1", "not a[1:].min < 1", "k[1:].n == 3", "k[3:].mean > 1"),
    *("a[9:] missing", "a[1:3].n >= 2", "flags[2:] == true", "flags[1:].max >= 1"),
    *("k.max >= 9223372036854775809", "u < 9223372036854775809", "k == 9223372036854775809"),
]

ROS = get_typestore(Stores.ROS2_HUMBLE)
ROS.register(get_types_from_msg(engines.DEFINITION, "demo/msg/Thing"))


def _ros_messages(rng: random.Random) -> list[Message]:
    return [engines.as_dict(engines.ros_message(ROS, rng, 10**9)) for _ in range(12)]


@SLOW
@given(seeds.map(_ros_messages), st.lists(engines.ros_condition, min_size=8, max_size=16))
@example(_ros_messages(random.Random(1)), ROS_QUESTIONS)
def test_of_ros_messages(messages: list[Message], questions: list[str]) -> None:
    ask(messages, questions, TYPES)


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
