from __future__ import annotations

import math
import re

import numpy as np
import pytest
from bson import Code, Int64, ObjectId, Regex
from hybridlog.query.filters import check_filter
from hybridlog.query.where import compile_filter, parse
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from pymongo.collection import Collection

from hybridlog.query import evaluate
from hybridlog_storage.errors import WhereError

Document = dict[str, object]

TYPES = {
    "x": "float64",
    "i": "int64",
    "s": "string",
    "b": "bool",
    "t": "time",
    "a": "float64[]",
    "flags": "bool[]",
    "names": "string[]",
    "o.y": "int32",
    "m[].v": "int32",
    "m[].q": "float32[]",
}


ANYTHING = dict.fromkeys(
    ["x", "y", "z", "w", "s", "in", "not", "status[].level", "position", "a-b.in"], "any"
)
"""Fields of a kind that nothing is known of, so that any value may stand beside them."""


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("x < 5", {"x": {"$lt": 5}}),
        ("x = 5", {"x": {"$eq": 5}}),
        ("x != 5", {"x": {"$ne": 5, "$exists": True}}),
        ("5 > x", {"x": {"$lt": 5}}),
        ("5 == x", {"x": {"$eq": 5}}),
        ("0 < x < 5", {"$and": [{"x": {"$gt": 0}}, {"x": {"$lt": 5}}]}),
        ("x between 1 and 2", {"$and": [{"x": {"$gte": 1}}, {"x": {"$lt": 2}}]}),
        ("x IN [1, 2.5, -3,]", {"x": {"$in": [1, 2.5, -3]}}),
        ("x not in ('a')", {"x": {"$nin": ["a"], "$exists": True}}),
        ("in in[1]", {"in": {"$in": [1]}}),
        ("s ~ '^\\d+\"$'", {"s": {"$regex": '^\\d+"$'}}),
        ("s !~ 'a'", {"s": {"$not": {"$regex": "a"}, "$exists": True}}),
        ("x exists", {"x": {"$exists": True}}),
        ("x MISSING", {"x": {"$exists": False}}),
        ("x == null", {"x": {"$type": "null"}}),
        ("x == true", {"x": {"$eq": True}}),
        ("x == 0x1F", {"x": {"$eq": 31}}),
        ("x == 1e-3", {"x": {"$eq": 0.001}}),
        ("x == .5", {"x": {"$eq": 0.5}}),
        ("x < -inf", {"x": {"$lt": -math.inf}}),
        ("x == 9223372036854775807", {"x": {"$eq": 2**63 - 1}}),
        ("x == -9223372036854775808", {"x": {"$eq": -(2**63)}}),
        ("x == 9223372036854775808", {"x": {"$eq": 2.0**63}}),
        ("x < 5ms", {"x": {"$lt": 5_000_000}}),
        ("x > -1m30s", {"x": {"$gt": -90_000_000_000}}),
        ('x > t"1970-01-01T00:00:01.000000001Z"', {"x": {"$gt": 1_000_000_001}}),
        (r'x == "a\"\n\u00e9\ud83d\ude00"', {"x": {"$eq": 'a"\né😀'}}),
        ("x == 'it is \"so\"'", {"x": {"$eq": 'it is "so"'}}),
        ("status[].level == 2", {"status.level": {"$eq": 2}}),
        ("status[*].level == 2", {"status.level": {"$eq": 2}}),
        ("position[0] == 2", {"position.0": {"$eq": 2}}),
        ("position.0 == 2", {"position.0": {"$eq": 2}}),
        ("`a-b`.`in`[3] == 2", {"a-b.in.3": {"$eq": 2}}),
        ("`not` == 2", {"not": {"$eq": 2}}),
        ("_meta.t >= 5", {"_meta.t": {"$gte": 5}}),
        ("not x < 1", {"$nor": [{"x": {"$lt": 1}}]}),
        (
            "x<1 or y<2 and !(z<3 || w<4)",
            {
                "$or": [
                    {"x": {"$lt": 1}},
                    {
                        "$and": [
                            {"y": {"$lt": 2}},
                            {"$nor": [{"$or": [{"z": {"$lt": 3}}, {"w": {"$lt": 4}}]}]},
                        ]
                    },
                ]
            },
        ),
    ],
)
def test_grammar(where: str, expected: Document) -> None:
    assert compile_filter(where, field_types=ANYTHING) == expected
    check_filter(expected)
    if "_meta" not in where:
        assert parse(where).fields()


def test_nan() -> None:
    (condition,) = compile_filter("x == NaN").values()
    assert isinstance(condition, dict)
    assert math.isnan(condition["$eq"])


@pytest.mark.parametrize(
    ("where", "message", "column"),
    [
        ("x <", "expected a value", 3),
        ("x == base", "strings need quotes", 5),
        ("(x < 1", "expected '\\)'", 6),
        ("x < 1)", "expected 'and'", 5),
        ("x < nan", "nan", 4),
        ("x < true", "order", 4),
        ("x ~ '(a+)+'", "take forever", 9),
        ("x ~ '('", "not a regular", 5),
        ("x ~ '" + "a" * 1001 + "'", "longer than 1000", None),
        ("x ~ '.*.*.*.*.*.*.*b'", "unbounded", None),
        ('x == "a\\q"', "no escape", 7),
        ('x == "\\ud800"', "surrogate", 5),
        ("x == 'abc", "not closed", 5),
        ("x.", "does not end", 1),
        ("x == 5furlongs", "nor a duration", 5),
        ("x == 1e999", "too large", 5),
        ("x == " + "9" * 399, "too large", None),
        ("x == " + "9" * 500, "400 characters", None),
        ("x == t'noon'", "not a time", 5),
        ("x == t'+5s'", "counts from a recording", 5),
        ("5 < 6", "name of a field", 4),
        ("x", "expected an operator", 1),
        ("$where == 1", "no meaning", 0),
        ("`$where` == 1", "begin with", 0),
        ("`a.b` == 1", "must not", 0),
        ("`` == 1", "must not", 0),
        ("x in []", "list is empty", 2),
        ("x in 5", "expected a list", 5),
        ("x between 5 and 3", "empty", 10),
        ("x not 5", "expected 'in'", 6),
        ("x[*][0] == 1", "only of named", 4),
        ("x[][*] == 1", "only of named", 3),
        ("x[].0 == 1", "only of named", 3),
        ("x < 1 < 2", "expected 'and'", 6),
        ("_id == 5", "_meta.t", 0),
        ("_meta.inserted_at < 5", "milliseconds", 20),
        ("_meta.tt < 5", "did you mean _meta.t", 0),
        ("_meta.rec == 5", "quotes", 13),
        ("x == -'a'", "expected a number", 6),
        ("x == 1 and\n  y = = 2", "expected a value", 6),
        ("x[99999999999] == 1", "index", 1),
    ],
)
def test_errors_point_at_the_place(where: str, message: str, column: int | None) -> None:
    with pytest.raises(WhereError, match=message) as caught:
        compile_filter(where)
    *_, line, caret = str(caught.value).splitlines()
    assert caret.strip() == "^"
    if column is not None:
        assert len(caret) - 3 == column, str(caught.value)
        assert line[2:] in where
    assert len(line) <= 110


def test_limits() -> None:
    with pytest.raises(WhereError, match="at most 10000"):
        compile_filter("x == '" + "a" * 10_000 + "'")
    with pytest.raises(WhereError, match="deeper than 50"):
        compile_filter("(" * 60 + "x < 1" + ")" * 60)
    with pytest.raises(WhereError, match="deeper than 50"):
        compile_filter("not " * 60 + "x < 1")
    with pytest.raises(WhereError, match="words"):
        compile_filter("x in [" + "1," * 1500 + "1]")
    with pytest.raises(WhereError, match="is empty"):
        compile_filter("  ")
    with pytest.raises(WhereError, match="not int"):
        parse(5)  # type: ignore[arg-type]
    with pytest.raises(WhereError) as caught:
        compile_filter("\x1b[2J")
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
        ("a.min ~ 'a'", "not a string"),
        ("names.min < 5", "no field names.min"),
        ("a.median < 5", "no field a.median"),
        ("o > 5", "o is a message.*: o.y"),
        ("m == 5", "m is a message.*: m.v, m.q"),
        ("o in [1]", "o is a message"),
        ("_meta > 1", "_meta is a message.*_meta.t,"),
        ("m[0] ~ 'a'", "m is a message"),
    ],
)
def test_types(where: str, message: str) -> None:
    with pytest.raises(WhereError, match=message):
        compile_filter(where, field_types=TYPES)


@given(st.text(alphabet="xyt.[]()<>=!~&|'\"`0159emsinorad -+,_\\\n", max_size=40))
@example("`")
@example("t'")
def test_any_text_is_a_filter_or_an_error(where: str) -> None:
    try:
        compiled = compile_filter(where)
    except WhereError:
        return
    check_filter(compiled)


# Against a real server -------------------------------------------------------------


NAN = math.nan


def summary(values: list[float]) -> Document:
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return {"n": len(values), "min": None, "max": None, "mean": None}
    mean = sum(finite) / len(finite)
    return {"n": len(values), "min": min(finite), "max": max(finite), "mean": mean}


def stored(values: list[float]) -> object:
    """An array as index documents hold it; the limit here is 3, to see both forms."""
    return values if len(values) <= 3 else summary(values)


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
        "a": arrays.map(stored),
        "flags": st.lists(st.booleans(), max_size=2),
        "o": st.fixed_dictionaries({"y": ints}),
        "m": st.lists(
            st.fixed_dictionaries({"v": ints}, optional={"q": arrays.map(stored)}), max_size=2
        ),
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
    | st.tuples(
        st.sampled_from(["in", "not in"]),
        st.sampled_from(["z", "a.min", "m.q.min"]),
        st.just([None, 1]) | st.just([None]),
    )
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
        found = []
        for array in reached(document, parts[:-1]):
            if isinstance(array, list):
                found.append(summary([float(item) for item in array])[last])
            elif isinstance(array, dict):
                found.append(array[last])
        return found
    return reached(document, parts)


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
    word, path, *rest = question
    found = leaves(document, str(path))
    values = [item for leaf in found for item in (leaf if isinstance(leaf, list) else [leaf])]
    match word, rest:
        case "exists", _:
            return bool(found)
        case "missing", _:
            return not found
        case "compare", ["!=", value]:
            return bool(found) and not any(compares(item, "==", value) for item in values)
        case "compare", [order, value]:
            end = "min" if order in {"<", "<="} else "max"
            ends = [leaf[end] for leaf in found if isinstance(leaf, dict) and end in leaf]
            ends = ends if order != "==" else []
            return any(compares(item, order, value) for item in (*values, *ends))
        case "in", [wanted]:
            return any(compares(item, "==", value) for item in values for value in wanted)
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


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True
)
@given(st.lists(documents, min_size=5, max_size=40), st.lists(questions, min_size=5, max_size=15))
def test_a_server_answers_as_the_language_says(
    collection: Collection[Document], docs: list[Document], asked: list[Question]
) -> None:
    collection.delete_many({})
    collection.insert_many([{"_id": number, **document} for number, document in enumerate(docs)])
    types = {**TYPES, "z": "any"}
    for question in asked:
        where = write(question)
        compiled = compile_filter(where, field_types=types)
        for query in (compiled, check_filter(compiled)):
            found = {document["_id"] for document in collection.find(query, {"_id": 1})}
            expected = {n for n, document in enumerate(docs) if holds(question, document)}
            assert found == expected, (where, [docs[n] for n in found ^ expected])  # type: ignore[index]
        # Triggers ask the same of a message that is in no database yet.
        parsed = parse(where)
        in_memory = {
            n for n, document in enumerate(docs) if evaluate.holds(parsed, document, types)
        }
        assert in_memory == expected, (where, [docs[n] for n in in_memory ^ expected])


def test_the_deepest_predicate_is_taken(collection: Collection[Document]) -> None:
    where = "not " * 49 + "m.q.min < 5"
    collection.find_one(compile_filter(where, field_types=TYPES))
    collection.find_one(compile_filter(" or ".join(["m.q.mean < 5"] * 200), field_types=TYPES))


def test_both_engines_take_the_pattern(collection: Collection[Document]) -> None:
    collection.delete_many({})
    collection.insert_many([{"_id": 1, "s": "base_link"}, {"_id": 2, "s": "Laser 12"}])
    for pattern, ids in {
        r"(?i)^LASER \d+$": {2},
        "^(?:base|map)_": {1},
        "[aeiou]{2}": set(),
    }.items():
        found = collection.find(compile_filter(f"s ~ '{pattern}'"))
        assert {document["_id"] for document in found} == ids


# Filters of users ------------------------------------------------------------------


@pytest.mark.parametrize(
    "query",
    [
        {},
        {"position": 0.0},
        {"a.b": {"$gt": 1, "$lt": 2}, "c": None},
        {"$and": [{"a": 1}, {"$or": [{"b": 2}, {"c": {"$exists": False}}]}]},
        {"a": {"$in": [1, "x", None]}, "b": {"$nin": [1]}},
        {"a": {"$not": {"$gt": 5}}},
        {"a": {"$elemMatch": {"b": 1, "c": {"$gt": 2}}}},
        {"a": {"$elemMatch": {"$gt": 1, "$lt": 2}}},
        {"a": {"$all": [1, 2]}},
        {"a": {"$all": [{"$elemMatch": {"b": 1}}]}},
        {"a": {"$size": 3}, "b": {"$type": ["int", "double"]}, "c": {"$mod": [4, 0]}},
        {"a": {"$regex": "^x", "$options": "i"}},
        {"a": {"b": 1, "c": [1, {"d": 2}]}},
        {"_id": b"12345678901234567890"},
        {"_id": ObjectId("0123456789abcdef01234567"), "n": Int64(5)},
        {"$expr": {"$gt": [{"$size": {"$ifNull": ["$a", []]}}, 3]}},
        {"$expr": {"$let": {"vars": {"x": "$a"}, "in": {"$eq": ["$$x", {"$literal": "$b"}]}}}},
        {"a": math.inf},
    ],
)
def test_allowed(query: Document, collection: Collection[Document]) -> None:
    checked = check_filter(query)
    assert checked == query
    list(collection.find(checked))


@pytest.mark.parametrize(
    ("query", "place"),
    [
        ({"$where": "sleep(1000)"}, r"\$where"),
        ({"a": {"$where": "1"}}, r"\$where"),
        ({"$or": [{"a": 1}, {"$where": "1"}]}, r"\$or → \$where"),
        ({"$expr": {"$function": {"body": "x", "args": [], "lang": "js"}}}, r"\$function"),
        ({"$expr": {"$eq": [1, {"$accumulator": {}}]}}, r"\$accumulator"),
        ({"$expr": {"$range": [0, 10**9]}}, r"\$range"),
        ({"$expr": {"$reduce": {}}}, r"\$reduce"),
        ({"$expr": {"$gt": [1, 2], "$lt": [1, 2]}}, "one operator"),
        ({"$text": {"$search": "x"}}, r"\$text"),
        ({"$jsonSchema": {}}, r"\$jsonSchema"),
        ({"a": {"$near": [0, 0]}}, r"\$near"),
        ({"a": {"$elemMatch": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$elemMatch": {"$or": [{"$where": "1"}]}}}, r"\$where"),
        ({"a": {"$elemMatch": {"b": {"$where": "1"}}}}, r"\$where"),
        ({"a": {"$elemMatch": {"$expr": {}, "$or": [{}]}}}, r"\$expr"),
        ({"a": {"$all": [{"$elemMatch": {"$where": "1"}}]}}, r"\$where"),
        ({"a": {"$not": {"$where": "1"}}}, r"\$where"),
        ({"a": {"$not": 5}}, "mapping"),
        ({"a": {"$not": {}}}, "operators"),
        ({"a": {"$eq": {"$where": "1"}}}, r"\$where"),
        ({"a": {"b": {"$gt": 1}}}, r"\$gt"),
        ({"a": {"$gt": 1, "b": 2}}, "mixes"),
        ({"a": {"$in": 5}}, "list"),
        ({"$or": []}, "list"),
        ({"$or": {}}, "list"),
        ({"$or": [5]}, "mapping"),
        ({"a": Code("x")}, "Code"),
        ({"a": [Code("x", {})]}, "Code"),
        ({"a": {"$regex": "(a+)+"}}, "forever"),
        ({"a": {"$regex": "a", "$options": "x"}}, "options"),
        ({"a": {"$options": "i"}}, r"\$options"),
        ({"a": re.compile("(a*)*")}, "forever"),
        ({"a": re.compile("a", re.VERBOSE)}, "flags"),
        ({"a": re.compile(b"a")}, "string"),
        ({"a": Regex("(a*)*")}, "forever"),
        ({"a": 2**63}, "64 bits"),
        ({"a": object()}, "object"),
        ({"a": {1, 2}}, "set"),
        ({"a": 1j}, "complex"),
        ({"a": np.zeros(3)}, "ndarray"),
        ({"a": "\ud800"}, "surrogates"),
        ({"\ud800": 1}, "Unicode"),
        ({"a\0": 1}, "NUL"),
        ({5: 1}, "no string"),
        ({"a": "x" * 2_000_000}, "too large"),
        ({"a": [0] * 30_000}, "too large"),
    ],
)
def test_refused(query: Document, place: str) -> None:
    with pytest.raises(WhereError, match=place):
        check_filter(query)


def test_deep_filters() -> None:
    deep: object = 1
    for _ in range(5_000):
        deep = {"a": deep}
    with pytest.raises(WhereError, match="deeper"):
        check_filter({"x": deep})
    clause: Document = {"a": 1}
    for _ in range(5_000):
        clause = {"$or": [clause]}
    with pytest.raises(WhereError, match="deeper"):
        check_filter(clause)
    with pytest.raises(WhereError, match="mapping"):
        check_filter([])  # type: ignore[arg-type]


def test_values_become_plain() -> None:
    query = {
        "a": np.float32(0.5),
        "b": (1, np.int64(2)),
        "c": re.compile("^x", re.IGNORECASE),
        "d": np.str_("s"),
        "e": np.bool_(True),
    }
    checked = check_filter(query)
    assert checked == {
        "a": 0.5,
        "b": [1, 2],
        "c": {"$regex": "^x", "$options": "i"},
        "d": "s",
        "e": True,
    }
    assert type(checked["a"]) is float
    assert type(checked["d"]) is str
    assert type(checked["e"]) is bool
