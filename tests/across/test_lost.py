"""What answers say about losses, against what was taken away."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.query.answers.completeness import Completeness
from hybridlog.query.intervals import Intervals
from hybridlog.query.query import at_time
from hybridlog_storage.errors import IncompleteError, UsageError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer as run

BASE = 1_750_000_000 * 10**9
SECOND = 10**9
VALUES = [1, 1, 0, 1, 0, 0, 1, 1, 1, 0, 1, 1]
GONE = {4, 5, 8}
"""Messages whose segments are taken away."""


@dataclass
class Damaged:
    store: hl.Store
    path: Path


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Damaged]:
    """A message a second and segment on /n, and one on /other before each."""
    path = tmp_path_factory.mktemp("lost") / "store"
    n, other = (Channel(name, "json", None, {}) for name in ("/n", "/other"))
    with hl.open(path, create=True) as store:
        settings = SegmentSettings(chunk_size=1 << 10, segment_size=1)
        with store.start("part", settings=settings) as recording:
            for second, value in enumerate(VALUES):
                payload = json.dumps({"v": value, "pad": "-" * 2000}).encode()
                recording.write(n, payload, log_time=BASE + second * SECOND)
            recording.write(other, payload, log_time=BASE + 12 * SECOND)
        with store.start("whole", settings=settings) as recording:
            recording.write(n, payload, log_time=BASE)
    for segment, file in places.logs_of(path, "part", "/n"):
        if file.first is not None and (file.first - BASE) // SECOND in GONE:
            segment.unlink()
    with hl.open(path) as store:
        yield Damaged(store, path)


def test_counts_have_limits(damaged: Damaged) -> None:
    topic = damaged.store.topic("n").in_recording("part")
    for query, lost in (
        (topic, 3),
        (topic.where("v == 1"), 3),
        (topic.between("+0s", "+4s"), 0),
        (topic.between("+4s", "+5s"), 1),
        (topic.between("+5s", "+9s").where("v == 1"), 2),
        (topic.between("+8001ms", "end"), 0),
        (damaged.store.topic("other"), 0),
        (damaged.store.topic("n").in_recording("whole"), 0),
        (topic.during(topic.between("+6s", "+7s").windows("1s", "500ms")), 1),
    ):
        found = query.completeness()
        assert (found.messages, found.is_exact, found.has_losses) == (lost, True, lost > 0)
        assert len(found.rows) == lost
        count = query.count()
        assert found.limits(count) == (count, count + lost)
    assert topic.completeness().describe(9) == "9; 3 lost in this range: 9 to 12"
    assert topic.limit(2).completeness().describe(2, 2) == "2; 3 lost in this range: 2 to 2"
    # A condition on a topic with losses may hold at other times, too.
    near = damaged.store.topic("other").where("n: v == 1", within="2s")
    assert (near.completeness().messages, near.completeness().is_exact) == (0, False)


def test_numbers_that_nobody_knows() -> None:
    assert (
        Completeness(4, is_exact=False).describe(297)
        == "297; at least 4 lost in this range: 297 or more"
    )
    unknown = Completeness(0, is_exact=False)
    assert unknown.describe(1) == "1; an unknown number lost in this range: 1 or more"
    assert str(unknown) == "an unknown number of messages are lost"
    assert str(Completeness(4, is_exact=True, reduced=6, expired=1)) == (
        "4 messages are lost; 5 messages have no payload, which was dropped under pressure; "
        "1 message has no payload, which was deleted to make room"
    )


def seconds(found: Intervals) -> list[tuple[float, float, int]]:
    return [
        ((i.begin_ns - BASE) / SECOND, round((i.end_ns - BASE) / SECOND, 3), i.messages)
        for i in found
    ]


def test_states_with_losses(damaged: Damaged) -> None:
    query = damaged.store.topic("n").in_recording("part").where("v == 1")
    # As stored, a lost message changes nothing.
    assert seconds(query.intervals()) == [(0, 2, 2), (3, 9, 3), (10, 12, 2)]
    assert seconds(query.intervals(state="held")) == [(0, 2, 2), (3, 4, 1), (6, 8, 2), (10, 12, 2)]
    assert seconds(query.intervals(state="not held")) == [(2, 3, 1), (9, 10, 1)]
    assert seconds(query.intervals(state="unknown")) == [(4, 6, 0), (8, 9, 0)]
    # A loss before the range leaves its beginning open.
    late = query.between("+5500ms", "+8500ms")
    assert seconds(late.intervals(state="unknown")) == [(5.5, 6, 0), (8, 8.5, 0)]
    assert seconds(late.intervals(state="held")) == [(6, 8, 2)]
    short = query.between("+0s", "+4s")
    assert seconds(short.intervals(max_gap="500ms", state="unknown")) == [
        (0.5, 1, 0), (1.5, 2, 0), (2.5, 3, 0), (3.5, 4, 0),
    ]  # fmt: skip
    with pytest.raises(UsageError, match="choose held"):
        query.intervals(state="maybe")
    # Before the first message, nothing is known.
    other = damaged.store.topic("other").in_recording("part")
    assert seconds(other.intervals(state="unknown")) == [(0, 12, 0)]


def test_an_answer_that_must_be_complete(damaged: Damaged) -> None:
    for command in (
        ("fetch", "-t", "n", "--where", "v == 1", "--count"),
        ("intervals", "-t", "n", "--where", "v == 1"),
        ("stats", "-t", "n", "--fields", "v"),
        ("align", "--to", "other", "-t", "n"),
    ):
        assert run(*command, "--strict", store=damaged.path, code=11).out == ""
    topic = damaged.store.topic("n")
    topic.between("+0s", "+4s").completeness().check(payloads=True)
    with pytest.raises(IncompleteError, match="3 messages are lost in this range"):
        topic.completeness().check()


def test_python_says_what_the_commands_say(damaged: Damaged) -> None:
    store, path = damaged.store, damaged.path
    topic = store.topic("n").in_recording("part")
    lack = "part is not complete, so this answer may not be: {}; `hybridlog info part` says where."
    whole = [lack.format("3 messages lost in 3 places (segment)")]
    for ask, command in (
        (topic.count, ("fetch", "--count", "-t", "n")),
        (topic.to_arrow, ("fetch", "-t", "n")),
        (lambda: topic.stats("v"), ("stats", "-t", "n", "--fields", "v")),
        (topic.intervals, ("intervals", "-t", "n")),
    ):
        ask()
        assert [*topic.completeness().sentences] == whole
        assert whole[0] in run(*command, "-r", "part", store=path).err.splitlines()
    for aligned, command in (
        (topic.resample("1s"), ("align", "-t", "n", "--step", "1s")),
        (store.align(topic, []), ("align", "--to", "n", "-t", "n")),
    ):
        assert aligned.remarks() == whole
        assert whole[0] in run(*command, "-r", "part", store=path).err.splitlines()
    answer = store.sql("select v from n where recording = 'part'")
    answer.to_arrow()
    assert answer.sentences() == whole
    # Only what is lost in the range.
    for begin, end, said in (
        ("+0s", "+4s", []),
        ("+8s", "+9s", [lack.format("1 message lost in 1 place (segment)")]),
    ):
        asked = topic.between(begin, end)
        found = asked.completeness()
        assert ([*found.sentences], found.has_losses) == (said, bool(said))
    # The message that was lost may have been the current one.
    assert [*at_time(topic, "+4.5s").completeness().sentences] == [
        lack.format("1 message lost in 1 place (segment)")
    ]
    assert at_time(topic, "+4.5s").completeness().has_losses
    assert not at_time(topic, "+3.5s").completeness().sentences
    with pytest.raises(IncompleteError):
        at_time(topic, "+4.5s").completeness().check()
