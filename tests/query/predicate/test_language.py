from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hybridlog.query.predicate.evaluate import on_columns
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.tree import Condition, Predicate, check
from hybridlog.schema.arrow_types import objects_array
from hybridlog_storage.errors import WhereError

Document = dict[str, object]


def checked(where: str, field_types: dict[str, str] | None = None) -> Predicate:
    predicate = parse(where)
    check(predicate, field_types)
    return predicate


TYPES = {
    "x": "float64",
    "i": "int64",
    "s": "string",
    "b": "bool",
    "t": "time",
    "a": "float64[]",
    "nine": "float32[9]",
    "flags": "bool[]",
    "names": "string[]",
    "o.y": "int32",
    "m[].v": "int32",
    "m[].q": "float32[]",
}


ANYTHING = dict.fromkeys(
    ["x", "y", "z", "w", "s", "in", "not", "status[].level", "position", "a-b.in"], "any"
) | {"s": "string", "u": "uint64"}
"""Fields of a kind that nothing is known of, so that any value may stand beside them."""


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("x < 5", "x < 5"),
        ("x = 5", "x == 5"),
        ("x != 5", "x != 5"),
        ("5 > x", "x < 5"),
        ("5 == x", "x == 5"),
        ("0 < x < 5", "x > 0 and x < 5"),
        ("1 <= x < 2", "x >= 1 and x < 2"),
        ("x IN [1, 2.5, -3]", "x in [1, 2.5, -3]"),
        ("x in [1, null]", "x missing or x in [1]"),
        ("x not in [null, 1]", "x not in [1]"),
        ("in in[1]", "in in [1]"),
        ("s ~ '^\\d+\"$'", 's ~ "^\\d+\\"$"'),
        ("s ~ 'slip: '", "s ~ 'slip: '"),
        ("s !~ '^a'", "s !~ '^a'"),
        ("x exists", "x exists"),
        ("x MISSING", "x missing"),
        ("x == null", "x missing"),
        ("x != null", "x exists"),
        ("x == true", "x == true"),
        ("x == 0x1F", "x == 31"),
        ("x == 1e-3", "x == 0.001"),
        ("x == .5", "x == 0.5"),
        ("x < -inf", "x < -inf"),
        ("abs(x) < 5", "5 > abs(x)"),
        ("x < y", "x<y"),
        ("x == 9223372036854775807", "x == 9223372036854775807"),
        ("x == -9223372036854775808", "x == -9223372036854775808"),
        ("x == 9223372036854775808", "x == 9223372036854775808"),
        ("u == 18364758544493064721", "u == 18364758544493064721"),
        ("u < 18364758544493064721", "u < 18364758544493064721"),
        ("x < 5ms", "x < 5000000"),
        ("x > -1m30s", "x > -90000000000"),
        ('x > t"1970-01-01T00:00:01.000000001Z"', "x > 1000000001"),
        ('x == "a\\"\\n\\u00e9\\ud83d\\ude00"', "x == 'a\"\\né😀'"),
        ("x == 'it is \"so\"'", "x == 'it is \"so\"'"),
        ("status[].level == 2", "status.level == 2"),
        ("status[*].level == 2", "status.level == 2"),
        ("position[0] == 2", "position.0 == 2"),
        ("position.0 == 2", "position.0 == 2"),
        ("`a-b`.`in`[3] == 2", "`a-b`.in.3 == 2"),
        ("x[3:8] == 2", "x[3:8] == 2"),
        ("`not` == 2", "2 == not"),
        ("_meta.t >= 5", "_meta.t >= 5"),
        ("not x < 1", "not (x < 1)"),
        ("x<1 or y<2 and !(z<3 || w<4)", "x < 1 or (y < 2 and not (z < 3 or w < 4))"),
    ],
)
def test_grammar(where: str, expected: str) -> None:
    assert checked(where, ANYTHING) == parse(expected)
    if "_meta" not in where:
        assert parse(where).fields()


def test_nan() -> None:
    node = checked("x == NaN", {"x": "float64"}).root
    assert isinstance(node, Condition)
    assert isinstance(node.operands[0], float)
    assert math.isnan(node.operands[0])


@pytest.mark.parametrize(
    ("where", "message", "column"),
    [
        ("x <", "expected a value", 3),
        ("abs(x", "expected '\\)'", 5),
        ("abs(x) < y", "no abs", 9),
        ("0 < x < y", "strings need quotes", 8),
        ("(x < 1", "expected '\\)'", 6),
        ("x < 1)", "expected 'and'", 5),
        ("x < nan", "nan", 4),
        ("x < true", "order", 4),
        ("x ~ 'ab(?=c)'", "refused: .*without looking around", 4),
        (r"x ~ '(a)\1'", "back references", 4),
        ("x ~ '('", "missing", 4),
        ("x ~ '" + "a" * 1001 + "'", "longer than 1000", None),
        (r"x ~ '(\pL{100}){9}'", "too large", None),
        ('x == "a\\q"', "escapes that JSON has not", 5),
        ('x == "\\ud800"', "escapes that JSON has not", 5),
        ("x == 'abc", "no meaning", 5),
        ("x == 5furlongs", "is not a duration", 5),
        ("x == 1e999", "too large", 5),
        ("x == " + "9" * 500, "400 characters", None),
        ("x == t'noon'", "not a time", 5),
        ("x == t'+5s'", "relative to a recording", 5),
        ("5 < 6", "name of a field", 4),
        ("x", "expected an operator", 1),
        ("$where == 1", "no meaning", 0),
        ("`a.b` == 1", "no meaning", 0),
        ("x in []", "expected a value", 6),
        ("x in 5", "expected a list", 5),
        ("x between 5 and 3", "expected an operator", 2),
        ("x[*][0] == 1", "only of named", 4),
        ("x[0:2][0] == 1", "only of named", 6),
        ("x[-1] == 1", "expected an operator", 1),
        ("x[3:2] == 1", "slice is empty", 1),
        ("x < 1 < 2", "expected 'and'", 6),
        ("_id == 5", "_meta.t", 0),
        ("_meta.inserted_at < 5", "no field _meta.inserted_at", 0),
        ("_meta.tt < 5", "did you mean _meta.t", 0),
        ("_meta.rec == 5", "quotes", 13),
        ("x == -'a'", "expected a number", 6),
        ("x == 1 and\n  y = = 2", "expected a value", 6),
        ("x[99999999999] == 1", "index", 1),
    ],
)
def test_errors_point_at_the_place(where: str, message: str, column: int | None) -> None:
    with pytest.raises(WhereError, match=message) as caught:
        checked(where)
    *_, line, caret = str(caught.value).splitlines()
    assert caret.strip() == "^"
    if column is not None:
        assert len(caret) - 3 == column, str(caught.value)
        assert line[2:] in where


def test_limits() -> None:
    with pytest.raises(WhereError, match="at most 10000"):
        checked("x == '" + "a" * 10_000 + "'")
    with pytest.raises(WhereError, match="deeper than 50"):
        checked("(" * 60 + "x < 1" + ")" * 60)
    with pytest.raises(WhereError, match="deeper than 50"):
        checked("not " * 60 + "x < 1")
    with pytest.raises(WhereError, match="is empty"):
        checked("  ")
    with pytest.raises(WhereError, match="not int"):
        parse(5)  # type: ignore[arg-type]
    with pytest.raises(WhereError) as caught:
        checked("\x1b[2J")
    assert "\x1b" not in str(caught.value).splitlines()[1]


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("X < 5", "did you mean x"),
        ("o.z < 5", "did you mean"),
        ("y < 5", "did you mean o.y"),
        ("s < 5", "quotes"),
        ("x == 'a'", "is a number, the value is a string"),
        ("b == 1", "true or false"),
        ("x == true", "is a number"),
        ("t > '2015-01-01'", 't"'),
        ("x ~ 'a'", "not a string"),
        ("x in [1, 'a']", "string"),
        ("a.min == 'a'", "number"),
        ("names.min < 5", "no field names.min"),
        ("a.median < 5", "no field a.median"),
        ("o > 5", "o is a message.*: o.y"),
        ("m == 5", "m is a message.*: m.v, m.q"),
        ("log_time > 5", "did you mean _meta.t"),
        ("nine[9] > 1", "nine has 9 elements"),
        ("t > 1760000000", 't"1760000000" for seconds'),
        ("1760000000.5 < t", 't"1760000000.5" for seconds'),
        ("1760000000000 < _meta.t < 1770000000000", "nanoseconds here"),
        ("x == s", "strings need quotes"),
        ("a > x", "no arrays"),
        ("m.v > x", "no arrays"),
        ("t > x", "two numbers, or two times"),
        ("abs(t) > 5", r"abs\(\) is of numbers"),
    ],
)
def test_types(where: str, message: str) -> None:
    with pytest.raises(WhereError, match=message):
        checked(where, TYPES)


@pytest.mark.parametrize(
    "where",
    ["t > 0", "t < 50", 't > t"1760000000"', 't > t"1760000000ns"', "t > 1760000000000000000"],
)
def test_times_that_are_what_they_say(where: str) -> None:
    checked(where, TYPES)


@given(st.text(alphabet="xyt.[]()<>=!~&|'\"`0159emsinorad -+,_\\\n", max_size=40))
@example("`")
@example("t'")
def test_any_text_is_a_filter_or_an_error(where: str) -> None:
    try:
        predicate = parse(where)
    except WhereError:
        return
    on_columns(predicate, None, objects_array([{}], None))
    assert parse(predicate.text) == predicate


# Against plain evaluation -------------------------------------------------------------


NAN = math.nan


def summary(values: list[float]) -> Document:
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return {"n": len(values), "min": None, "max": None, "mean": None}
    mean = sum(finite) / len(finite)
    return {"n": len(values), "min": min(finite), "max": max(finite), "mean": mean}


# Multiples of 1/4, so that means of up to four are exact however they are added up.
numbers = st.sampled_from([-2.0, -1.0, 0.0, 0.25, 1.0, 2.0, NAN, math.inf, -math.inf])
arrays = st.sampled_from([0, 1, 2, 4]).flatmap(lambda n: st.lists(numbers, min_size=n, max_size=n))
ints = st.sampled_from([-(2**63), -1, 0, 1, 2, 2**53 + 1, 2**63 - 1])
words = st.sampled_from(["", "a", "b", "ab", 'q"\\', "é", "$x"])

documents = st.fixed_dictionaries(
    {},
    optional={
        "x": numbers,
        "i": ints,
        "s": words,
        "b": st.booleans(),
        "z": st.none() | ints,
        "a": arrays,
        "flags": st.lists(st.booleans(), max_size=2),
        "o": st.fixed_dictionaries({"y": ints}),
        "m": st.lists(st.fixed_dictionaries({"v": ints}, optional={"q": arrays}), max_size=4),
    },
)


def spell(value: object) -> str:
    if value is None or isinstance(value, bool):
        return str(value).lower().replace("none", "null")
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return repr(value)


orders = st.sampled_from(["==", "!=", "<", "<=", ">", ">="])
Question = tuple[object, ...]


def comparisons(paths: list[str], values: st.SearchStrategy[object]) -> st.SearchStrategy[Question]:
    path = st.sampled_from(paths)
    return st.tuples(st.just("compare"), path, orders, values).filter(
        lambda question: question[2] in {"==", "!="} or question[3] == question[3]
    ) | st.tuples(st.sampled_from(["in", "not in"]), path, st.lists(values, min_size=1, max_size=3))


stats = ["a.min", "a.max", "a.mean", "a.n", "m.q.min", "m.q.max", "m[].q.n", "m[1].q.min"]
finite = st.sampled_from([-1.0, 0.0, 0.25, 1.0, 2])
conditions = (
    comparisons(["x", "a", "a[1]"], numbers)
    | comparisons(["i", "o.y", "m[].v", "m.v", "m[0].v", "z", "x"], ints)
    | comparisons([*stats, "flags.min", "flags.max", "flags.mean", "flags.n"], finite)
    | comparisons(["s"], words)
    | st.tuples(st.just("compare"), st.sampled_from(["b", "flags"]), st.just("=="), st.booleans())
    | st.tuples(
        st.just("compare"),
        st.sampled_from(["z", "a.min", "x", "m.q.min"]),
        st.sampled_from(["==", "!="]),
        st.none(),
    )
    | comparisons(["abs(x)", "abs(i)", "abs(a)", "abs(m.v)", "abs(a.min)"], finite.map(abs))
    | st.tuples(st.just("fields"), st.permutations(["x", "i", "z", "o.y"]), orders)
    | st.tuples(
        st.sampled_from(["exists", "missing"]),
        st.sampled_from(["x", "z", "o", "o.y", "m", "m.v", "a", "a[0]", "m[1].v", *stats]),
    )
    | st.tuples(
        st.sampled_from(["~", "!~"]),
        st.just("s"),
        st.sampled_from(["^a", "b$", "a|b", "[^a]", "é"]),
    )
)
questions: st.SearchStrategy[Question] = st.recursive(
    conditions,
    lambda inner: (
        st.tuples(st.sampled_from(["and", "or"]), inner, inner) | st.tuples(st.just("not"), inner)
    ),
    max_leaves=4,
)


def write(question: Question) -> str:
    match question:
        case ("compare", path, order, value):
            return f"{path} {order} {spell(value)}"
        case ("fields", [left, right, *_], order):
            return f"{left} {order} {right}"
        case ("in" | "not in" as word, path, values):
            return f"{path} {word} [{', '.join(map(spell, values))}]"
        case ("exists" | "missing" as word, path):
            return f"{path} {word}"
        case ("~" | "!~" as word, path, pattern):
            return f'{path} {word} "{pattern}"'
        case ("and" | "or" as word, left, right):
            return f"({write(left)}) {word} ({write(right)})"
        case ("not", inner):
            return f"not ({write(inner)})"
    raise AssertionError(question)


def reached(value: object, parts: list[str]) -> list[object]:
    """Everything a path leads to; a list at the end is itself and all of its elements."""
    if not parts:
        return [value]
    name = parts[0]
    if isinstance(value, list):
        if name.isdigit():
            index = int(name)
            return reached(value[index], parts[1:]) if index < len(value) else []
        return [leaf for item in value if isinstance(item, dict) for leaf in reached(item, parts)]
    if isinstance(value, dict) and name in value:
        inner = value[name]
        return reached(inner, parts[1:])
    return []


def leaves(document: Document, path: str) -> list[object]:
    parts = re.sub(r"\[(\d*)\]", lambda m: f".{m[1]}" if m[1] else "", path).split(".")
    last = parts[-1]
    if last in {"n", "min", "max", "mean"}:
        return [
            summary([float(item) for item in array])[last]
            for array in reached(document, parts[:-1])
            if isinstance(array, list)
        ]
    return reached(document, parts)


def absolute(leaf: Any) -> object:
    """Numbers without their signs; of a list, those of its elements."""
    if isinstance(leaf, list):
        return [absolute(value) for value in leaf]
    return abs(leaf)


def same_kind(left: object, right: object) -> bool:
    def kind(value: object) -> str:
        if isinstance(value, bool) or value is None or isinstance(value, str):
            return type(value).__name__
        return "number" if isinstance(value, int | float) else "other"

    return kind(left) == kind(right)


def compares(left: object, order: str, right: object) -> bool:
    if not same_kind(left, right):
        return False
    if isinstance(left, float) and isinstance(right, float) and left != left and right != right:
        return order == "=="
    tests = {
        "==": lambda: left == right,
        "<": lambda: left < right,  # type: ignore[operator]
        "<=": lambda: left <= right,  # type: ignore[operator]
        ">": lambda: left > right,  # type: ignore[operator]
        ">=": lambda: left >= right,  # type: ignore[operator]
    }
    return bool(tests[order]())


def holds(question: Question, document: Document) -> bool:
    match question:
        case ("and", left, right):
            return holds(left, document) and holds(right, document)
        case ("or", left, right):
            return holds(left, document) or holds(right, document)
        case ("not", inner):
            return not holds(inner, document)
        case ("fields", [left, right, *_], order):
            both = (leaves(document, path) for path in (left, right))
            sides = [[leaf for leaf in side if leaf is not None] for side in both]
            if not all(sides):
                return False
            one, other = (side[0] for side in sides)
            is_equal = one == one and compares(one, "==", other)
            return not is_equal if order == "!=" else compares(one, str(order), other)
    word, path, *rest = question
    is_absolute = str(path).startswith("abs(")
    asked = str(path).removeprefix("abs(").removesuffix(")")
    found = [leaf for leaf in leaves(document, asked) if leaf is not None]
    if is_absolute:
        found = [absolute(leaf) for leaf in found]
    values = [item for leaf in found for item in (leaf if isinstance(leaf, list) else [leaf])]
    match word, rest:
        case "exists", _:
            return bool(found)
        case "missing", _:
            return not found
        case "compare", [order, None]:
            return bool(found) == (order == "!=")
        case "compare", ["!=", value]:
            return bool(found) and not any(compares(item, "==", value) for item in values)
        case "compare", [order, value]:
            if order != "==":  # of arrays, it is about finite elements
                values = [
                    item
                    for leaf in found
                    for item in (
                        [item for item in leaf if math.isfinite(item)]
                        if isinstance(leaf, list)
                        else [leaf]
                    )
                    if not isinstance(item, dict)
                ]
            return any(compares(item, order, value) for item in values)
        case "in", [wanted]:
            return (None in wanted and not found) or any(
                compares(item, "==", value) for item in values for value in wanted
            )
        case "not in", [wanted]:
            return bool(found) and not any(
                compares(item, "==", value) for item in values for value in wanted
            )
        case "~", [pattern]:
            return any(isinstance(v, str) and re.search(pattern, v) for v in values)
        case "!~", [pattern]:
            return bool(found) and not any(
                isinstance(v, str) and re.search(pattern, v) for v in values
            )
    raise AssertionError(question)


@settings(derandomize=True)
@given(st.lists(documents, min_size=5, max_size=40), st.lists(questions, min_size=5, max_size=15))
def test_messages_answer_as_the_language_says(docs: list[Document], asked: list[Question]) -> None:
    types = {**TYPES, "z": "any"}
    for question in asked:
        where = write(question)
        expected = {n for n, document in enumerate(docs) if holds(question, document)}

        def wrong(found: set[object], where: str = where, expected: set[int] = expected) -> object:
            return where, [docs[n] for n in found ^ expected]  # type: ignore[index]

        predicate = parse(where)
        mask = on_columns(predicate, types, objects_array(docs, None)).holds
        in_memory: set[object] = {*np.flatnonzero(mask).tolist()}
        assert in_memory == expected, wrong(in_memory)


def test_the_deepest_predicate_is_taken() -> None:
    for where in ("not " * 49 + "m.q.min < 5", " or ".join(["m.q.mean < 5"] * 200)):
        records = objects_array([{"m": [{"q": [1.0]}]}], None)
        mask = on_columns(checked(where, TYPES), TYPES, records).holds
        assert mask.tolist() == ["not" not in where]
