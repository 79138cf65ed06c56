"""Rules of retention: what goes, in what order, why, and what never goes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from msgspec import UNSET

from hybridlog.maintenance.edit import pin_of
from hybridlog.maintenance.retention import Held, Plan, Rules, held_of, past_ring, plan
from hybridlog_storage.errors import UsageError
from hybridlog_storage.manifest import Channel, File, Manifest, Part, replace

DAY = 86_400 * 10**9
NOW = 20_000 * DAY  # 2024
MB = 10**6
CAMERA, SCAN = "/camera/front", "/scan"
Recording = tuple[Manifest, list[Held]]


SIZES = {CAMERA: 8 * MB, SCAN: 2 * MB}


def sealed(
    number: int,
    age: float,
    *topics: str,
    last: int | None = None,
    group: int = 999,
    **other: Any,
) -> File:
    """A log of 8 MB of a camera, or 2 MB of a scan, or both, that was written so many days ago.

    Args:
        number: Its number.
        age: Days.
        topics: Its topics; by default a camera in even ones, and a scan in odd ones.
        last: Log time of all its messages; None for the day before it was written.
        group: Number of its group.
        other: Further attributes.
    """
    at = NOW - round(age * DAY)
    span = (at - DAY, at - 1) if last is None else (last, last)
    own = topics or ([CAMERA, SCAN][number % 2],)
    parts = {[*SIZES].index(topic): Part(9, SIZES[topic], *span) for topic in own}
    name, digest, size = f"{number:06d}.mcap", f"{number:064x}", sum(SIZES[one] for one in own)
    return File(number, group, name, "log", size, digest, at, *span, parts, **other)


def gone(number: int, age: float) -> list[File]:
    """The lines of one that has expired."""
    log = sealed(number, age, gone="expired")
    rows = replace(log, name=f"{number:06d}.rows.parquet", kind="rows", gone=UNSET)
    return [log, rows]


def held(name: str, *files: File, ended: bool = True, **values: Any) -> Recording:
    manifest = Manifest(
        f"{name}-{sum(name.encode()):016x}",
        name,
        NOW - 400 * DAY,
        status="complete" if ended else "open",
        channels={0: Channel(CAMERA), 1: Channel(SCAN)},
        files=files,
        **values,
    )
    return manifest, held_of(manifest, NOW)


def made(
    rules: Mapping[str, Any], *recordings: Recording, used: float = 0, free: float = 1e12
) -> Plan:
    return plan(recordings, Rules.of(rules), used=round(used), free=round(free), now=NOW)


def told(found: Plan) -> list[tuple[str, tuple[int, ...], str]]:
    return [(one.recording, one.segments, one.reason) for one in found.steps]


def both(*ages: float) -> list[File]:
    """A log of the camera and one of the scan of each age."""
    return [sealed(n, age) for n, age in enumerate(age for age in ages for _ in range(2))]


OLD = held("old", *both(50, 40, 20))
NEW = held("new", *both(10, 5))


def test_payloads_of_topics_go_at_their_age_and_segments_at_theirs() -> None:
    rules = {"max-age": "30d", "topic": {"/camera/**": "7d"}}
    assert told(made(rules, NEW, OLD)) == [
        ("old", (0, 1, 2, 3), "older than 30d"),
        ("old", (4,), "/camera/** older than 7d"),
        ("new", (0,), "/camera/** older than 7d"),
    ]
    assert [one.bytes for one in made(rules, OLD).steps] == [20 * MB, 8 * MB]
    assert made({"max-age": "60d"}, OLD, NEW).steps == []


@pytest.mark.parametrize(
    ("used", "free", "steps"),
    [
        # Below 90 % of 100 MB nothing, then down to 80 %: the camera, then whole segments.
        (90, 99, []),
        (91, 99, [("old", (0, 2))]),
        (104, 99, [("old", (0, 2, 4))]),
        (121, 99, [("old", (0, 2, 4)), ("new", (0, 2)), ("old", (1,))]),
        # Free space acts alike: 20 MB are to stay free.
        (1, 20, []),
        (1, 19, [("old", (0,))]),
        (1, 5, [("old", (0, 2, 4))]),
        (95, 5, [("old", (0, 2, 4))]),
    ],
)
def test_when_room_is_short_the_oldest_goes(used: int, free: int, steps: list[Any]) -> None:
    rules = {"quota": "100MB", "min-free": "20MB", "topic": {CAMERA: "1y"}}
    found = made(rules, NEW, OLD, used=used * MB, free=free * MB)
    assert [one[:2] for one in told(found)] == steps
    assert not found.is_short


def test_a_reason_says_what_was_short() -> None:
    rules = {"min-free": "20MB", "topic": {CAMERA: "1y"}}
    (low,) = made(rules, OLD, used=1, free=19 * MB).steps
    assert low.reason == "/camera/front: less than 20.0 MB is free"


def test_topics_go_in_the_order_of_their_rules() -> None:
    rules = {"quota": "100MB", "topic": {"scan": "1y", "/**": "2y"}}
    found = made(rules, NEW, OLD, used=98 * MB)
    # 18 MB: the scan of all five segments is 10 MB.
    assert told(found) == [
        ("old", (1, 3, 5), "scan: more than 90% of 100.0 MB is used"),
        ("new", (1, 3), "scan: more than 90% of 100.0 MB is used"),
        ("old", (0,), "/**: more than 90% of 100.0 MB is used"),
    ]


def test_the_first_log_of_a_group_stays() -> None:
    first = held("old", sealed(0, 50, group=0), sealed(1, 50, group=0))
    assert told(made({"max-age": "30d"}, first)) == [("old", (1,), "older than 30d")]
    found = made({"quota": "1MB"}, first, used=100 * MB)
    # When nothing else is left, it goes with its group.
    assert told(found) == [
        ("old", (1,), "more than 90% of 1.0 MB is used"),
        ("old", (), "more than 90% of 1.0 MB is used, and no payloads are left to go"),
    ]
    assert [one.bytes for one in found.steps] == [2 * MB, 8 * MB]
    assert found.is_short


def test_what_tables_give_back_is_measured_before_fields_go() -> None:
    """Tables with arrays shrink with the payloads; whole recordings went for what they had."""
    first = held("old", sealed(0, 50, group=0), sealed(1, 50, group=0))
    rules, room = Rules.of({"quota": "1MB"}), {"used": 100 * MB, "free": 10**12, "now": NOW}
    (step,) = plan([first], rules, **room, has_arrays=True).steps
    assert step.segments == (1,)
    gone = held("old", sealed(0, 50, group=0))
    (step,) = plan([gone], rules, **room, has_arrays=True).steps
    assert step.segments == ()


def test_whole_groups_go_the_oldest_first() -> None:
    """When no payloads are left to go; not those that a pin touches, or that are recorded."""
    first = [sealed(n, 50 - n, CAMERA, group=n) for n in range(3)]
    rules = {"quota": "100MB"}
    (step,) = made(rules, held("old", *first), used=96 * MB).steps
    assert (step.segments, step.groups, step.bytes) == ((), (0, 1), 16 * MB)
    pin = pin_of("a", (NOW - 51 * DAY, NOW - 50 * DAY), None, "")
    (step,) = made(rules, held("old", *first, pins=(pin,)), used=99 * MB).steps
    assert (step.groups, step.bytes) == ((1, 2), 16 * MB)
    (step,) = made(rules, held("old", *first), used=120 * MB).steps
    assert (step.segments, step.groups, step.bytes) == ((), (), 24 * MB)
    running = held("old", *first, ended=False)
    assert made(rules, running, used=120 * MB).steps == []
    urgent = Rules(quota=100 * MB, is_urgent=True)
    (step,) = plan([running], urgent, used=120 * MB, free=10**12, now=NOW).steps
    assert step.groups == (0, 1, 2)


def test_a_quota_below_what_must_stay_takes_nothing() -> None:
    pin = pin_of("a", (NOW - 51 * DAY, NOW - 50 * DAY), None, "")
    pinned = held("old", *both(50, 40, 20), pins=(pin,))
    room: dict[str, Any] = {"used": 200 * MB, "free": 10**12, "now": NOW}
    rules = Rules.of({"quota": "60MB", "max-age": "30d"})
    found = plan([pinned], rules, others=51 * MB, **room)
    # 10 MB are pinned. Other rules hold all the same.
    assert told(found) == [("old", (2, 3), "older than 30d")]
    assert found.is_short
    assert "A quota of 60.0 MB cannot be kept" in found.warnings[0]
    assert "61.0 MB must stay" in found.warnings[0]
    assert len(plan([pinned], rules, others=50 * MB, **room).steps) > 1
    tagged = plan([OLD], Rules.of({"quota": "20MB"}), others=21 * MB, **room)
    assert not tagged.steps


def test_a_ring_lets_groups_go_but_for_latched_messages_in_force() -> None:
    logs = [sealed(n, 0, SCAN, group=n // 2 * 2) for n in range(4)]
    latched = {"latching": "1"}
    channels = {0: Channel(CAMERA), 1: Channel(SCAN, metadata=latched, encoding="ros1")}
    manifest = replace(held("ring", *logs, tags={"keep": "yes"})[0], channels=channels)
    (first,) = past_ring(manifest, [0])
    assert (first.groups, first.but, first.bytes) == ((0,), (), 4 * MB)
    (last,) = past_ring(manifest, [2])
    assert (last.groups, last.but, last.bytes) == ((2,), (3,), 2 * MB)
    pinned = replace(manifest, pins=(pin_of("a", (None, None), None, ""),))
    assert past_ring(pinned, [0, 2]) == []


def test_a_topic_that_shares_its_log_goes_with_it() -> None:
    shared = held("old", sealed(0, 50, CAMERA, SCAN), sealed(2, 20))
    found = made({"topic": {CAMERA: "7d"}}, shared)
    assert told(found) == [("old", (2,), "/camera/front older than 7d")]
    assert found.warnings == [
        "/camera/front: older files have other topics, too, and go with these. A rule for a "
        "topic holds for files that are opened after it."
    ]
    found = made({"topic": {"/**": "7d"}}, shared)
    assert told(found) == [("old", (0, 2), "/** older than 7d")]
    assert not found.warnings


@pytest.mark.parametrize(
    ("pin", "left"),
    [
        ({}, []),
        ({"span": (NOW - 41 * DAY, NOW - 40 * DAY)}, [0, 1, 4, 5]),
        # Half-open: it ends where the second ones begin.
        ({"span": (None, NOW - 41 * DAY)}, [2, 3, 4, 5]),
        ({"span": (NOW - 40 * DAY, None)}, [0, 1, 2, 3]),
        ({"topics": [SCAN]}, [0, 2, 4]),
        ({"topics": [CAMERA], "span": (NOW - 30 * DAY, None)}, [0, 1, 2, 3, 5]),
        ({"topics": ["/other"]}, [0, 1, 2, 3, 4, 5]),
    ],
)
def test_what_a_pin_touches_never_goes(pin: dict[str, Any], left: list[int]) -> None:
    files = both(50, 40, 20)
    pins = (pin_of("a", pin.get("span", (None, None)), pin.get("topics"), ""),)
    for rules in ({"max-age": "1d"}, {"topic": {CAMERA: "1d"}}):
        found = made(
            {**rules, "quota": "100MB", "fields-age": "10d"}, held("r", *files, pins=pins), used=1e9
        )
        assert sorted(n for one in found.steps for n in one.segments) == left
    assert found.is_short
    without = held("r", *files)
    assert [one.segments for one in made({"max-age": "1d"}, without).steps] == [(0, 1, 2, 3, 4, 5)]


def test_nothing_pinned_is_no_reason() -> None:
    (warning,) = made({"quota": "0kB"}, NEW, used=100 * MB).warnings
    assert "all that is left must stay" in warning


def test_a_tag_keeps_a_recording() -> None:
    tagged = held("old", sealed(0, 50, CAMERA, SCAN), tags={"keep": "yes"})
    for tag in ("keep=yes", "keep"):
        rules = {"max-age": "1d", "fields-age": "1d", "quota": "10MB", "never-tag": [tag]}
        found = made(rules, tagged, NEW, used=20 * MB)
        assert [one.recording for one in found.steps] == ["new"]
    rules = {"max-age": "1d", "never-tag": ["keep=no"]}
    assert [one.recording for one in made(rules, tagged).steps] == ["old"]
    assert made({"quota": "20MB", "never-tag": ["keep"]}, tagged).warnings == []


def test_fields_go_with_their_recording() -> None:
    rules = {"fields-age": "25d", "max-age": "1d"}
    assert (
        told(made(rules, OLD, NEW))
        == [
            ("new", (0, 1, 2, 3), "older than 1d"),
            ("old", (0, 1, 2, 3, 4, 5), "older than 1d"),
        ][::-1]
    )
    rules["fields-age"] = "20d"
    assert told(made(rules, OLD, NEW))[0] == ("old", (), "fields older than 20d")
    running = held("old", sealed(0, 50), ended=False)
    assert told(made(rules, running)) == [("old", (0,), "older than 1d")]


@pytest.mark.parametrize(
    ("ages", "last", "old"),
    [
        # A log of long ago that was recorded now is new; one with times to come, too.
        ([1], -4000, []),
        ([1], 4000, []),
        # The clock was ahead, and was set: a segment is not newer than those behind it.
        ([-4000, 50], None, [0, 1]),
        ([-4000, 5], None, []),
        # The clock was not set yet: nobody knows how old it is.
        ([19_990, 5], None, []),
        ([19_990, 50], None, [1]),
    ],
)
def test_ages_in_spite_of_clocks(ages: list[int], last: int | None, old: list[int]) -> None:
    files = [sealed(number, age) for number, age in enumerate(ages)]
    if last is not None:
        files[0] = sealed(0, ages[0], last=NOW + last * DAY)
    found = made({"max-age": "30d"}, held("r", *files))
    assert [n for one in found.steps for n in one.segments] == old
    # By room they go all the same, in their order.
    room = made({"quota": "1MB"}, held("r", *files), used=1e9)
    assert [n for one in room.steps for n in one.segments] == [*range(len(ages))]


@pytest.mark.parametrize(
    ("quota", "size"),
    [("1MB", 4 << 20), ("1GB", 20_000_000), ("200GB", 1 << 30), (None, float("inf"))],
)
def test_a_quota_says_how_large_segments_are(quota: str | None, size: float) -> None:
    assert Rules.of({} if quota is None else {"quota": quota}).segment_size == size


@pytest.mark.parametrize(
    "values",
    [
        {"quota": "much"},
        {"max-age": "old"},
        {"min_free": "1GB"},
        {"topic": ["/camera"]},
        {"topic": {"/camera": "x"}},
        {"topic": {"re:(": "7d"}},
        {"never-tag": "=x"},
        {"never-tag": 5},
        {"fields-age": "-1d"},
        {"quota": 200},
        {"min-free": "1.5"},
        {"max-age": 30},
        {"max-age": "30M"},
        {"topic": {"/camera": 7}},
    ],
)
def test_rules_that_are_none(values: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        Rules.of(values)


def test_no_rule_lets_nothing_go() -> None:
    assert Rules.of({}).is_empty
    assert Rules.of({"never-tag": ["keep"]}).is_empty
    assert not Rules.of({"min-free": "1GB"}).is_empty
    assert made({}, OLD, NEW, used=1e15, free=0).steps == []
