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
    place = text.index("|")
    text = text.replace("|", "")
    found = complete(
        text, place, ["/odom", "/imu"], lambda topic: ODOM if topic == "/odom" else SCAN
    )
    return [text[: found.begin] + one.text for one in found.candidates]


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
        ("ranges.min e|", ["ranges.min exists", "ranges.min between"]),
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
    assert len(complete("f", 1, [], lambda _: fields).candidates) == 50
    first, *_, count = complete("a", 1, [], lambda _: fields, most=5).candidates
    assert (first.text, first.kind, first.type) == ("a", "field", "float64[]")
    assert (count.text, count.kind) == ("a.mean", "field")
    assert complete("x" * 20_000, 20_000, [], lambda _: fields).candidates == ()
    assert [one.kind for one in complete("im", 2, ["/imu"], lambda _: None).candidates] == ["topic"]
