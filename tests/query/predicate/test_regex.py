"""Patterns of RE2: linear in time, one meaning in Arrow and in memory."""

from __future__ import annotations

import pyarrow as pa
import pytest

from hybridlog.query.predicate.evaluate import on_columns
from hybridlog.query.predicate.parser import parse
from hybridlog.schema.arrow_columns import objects_array

JOINTS = "joint_{0}: pos=-1.503 vel=0.204 temp=9{0} state=ok;"


@pytest.mark.parametrize(
    ("pattern", "found"),
    [
        ("(a+)+$", [False] * 5),
        ("(a|a)*b", [False] * 5),
        (r"pos=.*vel=.*temp=9\d.*state=bad|FAULT", [True] * 5),
        ("joint_.*pos=.*vel=.*temp=.*error|FAULT code", [True] * 5),
        ("(?i)pos=.*temp=.*overheat|fault", [True] * 5),
        (r"joint_\d+: .*temp=\d+ .*state=(bad|err)|FAULT", [True] * 5),
        (r"FAULT code=\d+$", [True] * 5),
        ("pos=.*vel=.*temp=.*state=.*FAULT code=18", [False] * 5),
    ],
)
def test_long_lines_are_matched_to_their_end(pattern: str, found: list[bool]) -> None:
    lines = [
        " ".join(JOINTS.format(n % 10) for n in range(count)) + " FAULT code=17"
        for count in (5, 20, 80, 160, 2_000)
    ]
    for operator, expected in (("~", found), ("!~", [not each for each in found])):
        predicate = parse(f's {operator} "{pattern}"')
        records = pa.StructArray.from_arrays([pa.array(lines)], ["s"])
        assert on_columns(predicate, None, records).holds.tolist() == expected


def test_strings_that_are_no_unicode() -> None:
    for where in ("s ~ '^.$'", "s == '\N{REPLACEMENT CHARACTER}'"):
        assert on_columns(parse(where), None, objects_array([{"s": "\ud800"}], None)).holds.all()
