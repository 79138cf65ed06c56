"""Predicates on one topic, messages of another, against loops over what was written."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from pathlib import Path

import pytest

from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.tree import And, Near, Node, Not, Or
from hybridlog_storage.errors import HybridlogError, TopicError, UsageError, WhereError
from tests.cli.within import answer as run
from tests.independent import read_mcap

from .conftest import MS, Logs, Said


def near(topic: str, text: str) -> Near:
    return Near(topic, parse(text).root if text else And(()))


ODOM = near("/odom", "v > 0.5")
A = near("/a", "b == 1")
X = parse("x < 1").root


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("/odom: v > 0.5", ODOM),
        ("  odom:   v > 0.5 ", near("odom", "v > 0.5")),
        ("/odom:", near("/odom", "")),
        ("1 <= x < 2 and /odom:", And((parse("1 <= x < 2").root, near("/odom", "")))),
        ("/odom: v > 0.5 and /a: b == ': c /d: e'", And((ODOM, near("/a", "b == ': c /d: e'")))),
        ("/odom: v > 0.5 or /a: b == 1 && /c:", Or((ODOM, And((A, near("/c", "")))))),
        ("/odom: v > 0.5 && !/a: b == 1", And((ODOM, Not(A)))),
        ("not (/odom: v > 0.5 || /a: b == 1) and x < 1", And((Not(Or((ODOM, A))), X))),
        (
            "/odom: v > 1 or v < 0 and w < 2 and (not /a: b == 1)",
            And((near("/odom", "v > 1 or v < 0 and w < 2"), Not(A))),
        ),
        (
            "re:/tf(_static)?: x < 1 and /camera/*/image_[rb]aw: y > 0",
            And((near("re:/tf(_static)?", "x < 1"), near("/camera/*/image_[rb]aw", "y > 0"))),
        ),
        ("((/odom: v > 0.5))", ODOM),
        ("/odom: name != 'x' and v !~ 'y'", near("/odom", "name != 'x' and v !~ 'y'")),
    ],
)
def test_conditions_on_topics(text: str, want: Node) -> None:
    assert parse(text).is_across
    assert parse(text).root == want


@pytest.mark.parametrize(
    "text",
    [
        "x > 1",
        "x == ': y'",
        "`a: b` > 1",
        't == t"2025-06-03 08:00:01"',
        "a[3: 8] > 1",
        "a[ 3: 8 ] > 1",
    ],
)
def test_predicates_without_topics(text: str) -> None:
    assert not parse(text).is_across


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("x > 1 or y > 2 and /odom: v > 1", "joined by `and`"),
        ("x > 1 /odom: v > 1", "expected 'and'"),
        ("x > (1 /odom: v > 1)", "expected a value"),
        ("/odom: (v > 1 and /a: b == 1)", "expected '\\)' here"),
        ("/odom: not /a: b == 1", "cannot stand behind this one"),
        ("and /odom: v > 1", "expected an operator"),
        ("(/odom: v > 1", "expected '\\)'"),
        ("/odom: v > 1) and x > 1", "or the end here"),
        ("/odom: v > 1 and", "expected a condition"),
        ("not " * 60 + "/odom: v > 1", "deeper than 50"),
        ("(" * 60 + "/odom: v > 1" + ")" * 60, "deeper than 50"),
        ("/a: b == 1 or " * 3000 + "/a:", "at most 10000"),
        ("a:b > 1", "has no meaning"),
    ],
)
def test_conditions_that_are_refused(logs: Logs, text: str, said: str) -> None:
    with pytest.raises(WhereError, match=said):
        logs.store.topic("base").where(text.replace("/odom", "/left/pose"), within="1ms")


Holds = Callable[[Callable[[str, Callable[[Said], bool]], bool], Said], bool]
ON: Callable[[Said], bool] = lambda m: bool(m.fields["on"])  # noqa: E731
STOP: Callable[[Said], bool] = lambda m: m.fields["state"] == "stop"  # noqa: E731


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        (
            "x > 0 and left/pose: on == true and state == 'stop'",
            lambda near, m: m.fields["x"] > 0 and near("/left/pose", lambda o: ON(o) and STOP(o)),
        ),
        (
            "left/pose: state == 'stop' or right/pose:",
            lambda near, m: near("/left/pose", STOP) or near("/right/pose", lambda o: True),
        ),
        (
            "(x > 0 or x < -1) and not left/pose: on == true",
            lambda near, m: (
                not near("/left/pose", ON) and (m.fields["x"] > 0 or m.fields["x"] < -1)
            ),
        ),
    ],
)
@pytest.mark.parametrize(("between", "within"), [(None, 3), (("+150ms", "+600ms"), 0)])
def test_messages_near_others(
    logs: Logs, text: str, holds: Holds, between: tuple[str, str] | None, within: int
) -> None:
    query = logs.store.topic("base")
    query = query if between is None else query.between(*between)
    query = query.where(text, within=f"{within}ms")
    want = []
    for label in logs.said:
        start = logs.said[label][0].time
        for message in logs.of(label, "/base"):

            def near(topic: str, fits: Callable[[Said], bool], at: int = message.time) -> bool:
                return any(
                    abs(o.time - at) <= within * MS and fits(o)
                    for o in logs.of(label, topic)  # noqa: B023
                )

            inside = between is None or 150 * MS <= message.time - start < 600 * MS
            if inside and holds(near, message):
                want.append((label, message.number))
    found = [
        (logs.store.entry(m.recording).name, m.fields["header"]["seq"])  # type: ignore[index]
        for m in query
    ]
    assert sorted(found) == sorted(want)
    assert query.count() == len(want)


def test_before_and_after(logs: Logs) -> None:
    text = "right/pose: state == 'stop'"
    events = logs.store.topic("right/pose").where("state == 'stop'")
    base = logs.store.topic("base")
    assert base.where(text, within=("5ms", "9ms")) == base.during(events.windows("5ms", "9ms"))
    assert base.where(text, within=("5ms", 0)) == base.during(events.windows("5ms"))


def test_only_what_belongs_to_the_answer_is_read(logs: Logs) -> None:
    base = logs.store.topic("base").in_recording("b")
    whole = copy(base)
    list(whole)
    few = base.where("right/pose: header.seq < 440", within="2ms")
    (condition,) = few.conditions
    assert condition.counters.bytes_read > 0
    assert condition.counters.chunks_read == 0  # columns of the table
    messages = list(few)
    assert 0 < len(messages) < 20
    assert few.counters.bytes_read < whole.counters.bytes_read / 3
    assert few.limit(1).conditions == few.conditions
    # A range bounds what is asked about the other topic.
    assert few.between("+0ms", "+100ms").count() <= len(messages)
    none = base.where("right/pose: header.seq < 0", within="2ms")
    assert (none.count(), len(list(none)), none.counters.chunks_read) == (0, 0, 0)


REFUSED: list[tuple[object, object, str]] = [
    ("left/pose: x > 1", None, "time within which"),
    ("x > 1", "1s", "on other topics"),
    ({"x": 1}, "1s", "on other topics"),
    ({"$or": [{"x": 1}, {"xx": {"$gt": 1}}]}, None, "no field xx"),
    ("x > 1 or left/pose: x > 1", "1s", "joined by `and`"),
    ("not (x > 1 and left/pose: x > 1)", "1s", "joined by `and`"),
    ("nothing: x > 1", "1s", "no topic"),
    ("left/pose: xx > 1", "1s", "xx"),
    ("left/pose: x > 1", "soon", "soon"),
]


def test_what_is_refused(logs: Logs) -> None:
    base = logs.store.topic("base")
    for text, within, said in REFUSED:
        with pytest.raises(HybridlogError, match=said):
            base.where(text, within=within)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="Topics are names"):
        logs.store.topic(["base"])  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="Fields are names"):
        base.fields(0)  # type: ignore[arg-type]
    with pytest.raises(TopicError):
        base.in_recording("c").where("right/pose: x > 1", within="1s")


def test_a_slice_of_another_topic(logs: Logs, tmp_path: Path) -> None:
    store = logs.store.directory.path
    path = tmp_path / "slice.mcap"
    asked = ("fetch", "-t", "base", "--where", "/left/pose: on == true and right/pose: x > -100")
    run(*asked, "--within", "4ms", "-o", path, store=store)
    query = logs.store.topic("base").where(asked[-1], within="4ms")
    assert [m.payload for m in read_mcap(path)] == [m.raw for m in query]
    cost = sum(one.counters.bytes_read for one in (query, *query.conditions))
    assert 0 < cost < 200_000
    for code, arguments in (
        (0, ("--before", "2ms", "--count")),
        (2, ()),
        (2, ("--within", "1s", "--after", "1s")),
        (2, ("--within", "1s", "--at", "+1s")),
    ):
        run(*asked, *arguments, store=store, code=code)
    run("fetch", "-t", "base", "--within", "1s", store=store, code=2)
