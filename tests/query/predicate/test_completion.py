"""Completion of predicates."""

from __future__ import annotations

import pytest

from hybridlog.query.predicate.completion import complete

SCAN = {
    "header.frame_id": "string",
    "range_max": "float32",
    "ranges": "float32[]",
    "odd-name": "bool",
    "`quoted.name`": "string",
}
ODOM = {"pose.x": "float64", "speed": "float64"}


def offered(text: str) -> list[str]:
    """Candidates at the mark `|`, put into the text."""
    text = text[: text.index("|")]
    begin, found = complete(
        text, ["/odom", "/imu"], lambda topic: ODOM if topic == "/odom" else SCAN
    )
    return [text[:begin] + one.text for one in found]


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("range|", ["range_max", "ranges", "ranges.n", "ranges.min", "ranges.max", "ranges.mean"]),
        ("RANGES.M|", ["ranges.min", "ranges.max", "ranges.mean"]),
        ("frame|", ["header.frame_id"]),
        ("not ra|nges", ["not range_max"]),
        ("(header.f|", ["(header.frame_id"]),
        ("odd|", ["`odd-name`"]),
        ("quoted|", ["`quoted.name`"]),
        ("ranges.min < 0.5 a|", ["ranges.min < 0.5 and"]),
        ("ranges.min e|", ["ranges.min exists"]),
        ("a == t|", ["a == true"]),
        ("/o|", ["/odom: "]),
        ("range_max > 1 and im|", ["range_max > 1 and /imu: "]),
        ("/odom: sp|", ["/odom: speed"]),
        ("/odom: (speed > 1 or po|", ["/odom: (speed > 1 or pose.x"]),
        ("(/odom: speed > 1) and header|", ["(/odom: speed > 1) and header.frame_id"]),
        ('header.frame_id == "ran|', []),
        ("header.frame_id == 'ran|'", []),
        ("_meta.p|", ["_meta.pub"]),
    ],
)
def test_what_fits_is_offered(text: str, want: list[str]) -> None:
    found = offered(text)
    assert found[: len(want)] == want
    assert bool(found) == bool(want)


def test_candidates_are_few_and_say_what_they_are() -> None:
    fields = {f"f{n}": "int32" for n in range(1000)} | {"a": "float64[]"}
    assert len(complete("f", [], lambda _: fields)[1]) == 50
    first, *_, count = complete("a", [], lambda _: fields, most=5)[1]
    assert first == ("a", "field", "float64[]")
    assert (count.text, count.kind) == ("a.mean", "field")
    assert complete("x" * 20_000, [], lambda _: fields)[1] == []
    assert [one.kind for one in complete("im", ["/imu"], lambda _: None)[1]] == ["topic"]
