"""Differences: planted changes, each in its own lines, and none of a log and itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from hybridlog.contract import Contract
from tests.cli.running import run
from tests.data import DATA, needs_data
from tests.some import EXHAUSTIVE

from .test_contract import (
    GOOD,
    MS,
    SECOND,
    START,
    Change,
    Sent,
    changed,
    channel,
    good,
    play,
    without,
)

COUNTS = {"messages", "rate", "jitter"}
LATE = START + 2 * SECOND


def at(topic: str, **values: object) -> Change:
    """The message of a topic two seconds after the start has other values."""

    def change(sent: list[Sent]) -> list[Sent]:
        return [replace(m, **values) if (m.topic, m.time) == (topic, LATE) else m for m in sent]

    return change


EXTRA = Sent("/new", START, START, "test_msgs/New")
PLANTED: dict[str, tuple[Change, set[tuple[str, str]]]] = {
    "nothing": (lambda sent: sent, set()),
    "a new topic": (lambda s: [*s, EXTRA], {("/new", "topic")}),
    "no odom": (without("/odom"), {("/odom", "topic"), ("/scan", "early_stop")}),
    "no scan": (without("/scan"), {("/scan", "topic")}),
    "type": (changed("/scan", type=lambda _: "test_msgs/Other"), {("/scan", "type")}),
    "two types": (at("/odom", type="test_msgs/Other"), {("/odom", "type")}),
    "a value": (at("/scan", x=2.0), {("/scan", "x")}),
    "a least value": (at("/scan", x=-2.0), {("/scan", "x")}),
    "a greatest value": (at("/odom", x=1e300), {("/odom", "x")}),
    "nan": (at("/odom", x=float("nan")), {("/odom", "x")}),
    "infinite": (at("/odom", x=float("inf")), {("/odom", "x")}),
    "all values": (changed("/odom", x=lambda m: m.x + 1), {("/odom", "x")}),
    "the last digit": (at("/odom", x=1.0000000000000002), {("/odom", "x")}),
    "one late message": (at("/scan", time=LATE + MS), {("/scan", "jitter"),
                                                       ("/scan", "longest_gap")}),
    "late start": (changed("/scan", 100, time=lambda m: m.time + MS), {
        ("/scan", what) for what in ("late_start", "rate", "jitter")
    }),
    "a message less": (without("/odom", 2, 2.001), {
        *(("/odom", what) for what in COUNTS | {"longest_gap"})
    }),
    "a message twice": (lambda s: [*s, *(m for m in s if (m.topic, m.time) == ("/odom", LATE))], {
        *(("/odom", what) for what in COUNTS)
    }),
    "a gap": (without("/scan", 2, 2.2), {
        *(("/scan", what) for what in COUNTS | {"longest_gap"})
    }),
    "early stop": (without("/scan", 4.9), {
        *(("/scan", what) for what in ("messages", "early_stop"))
    }),
    "both": (lambda s: at("/scan", x=3.0)(at("/odom", x=4.0)(s)), {("/scan", "x"), ("/odom", "x")}),
}  # fmt: skip


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("diff") / "s", create=True, mongo="none") as store:
        play(store, good(), "base")
        for name, (change, _) in PLANTED.items():
            play(store, change(good()), f"n-{name.replace(' ', '-')}")
        play(store, good(), "lost", 2)
        yield store


@pytest.mark.parametrize("name", PLANTED)
def test_each_planted_change_is_found_alone(store: hl.Store, name: str) -> None:
    label = f"n-{name.replace(' ', '-')}"
    found = store.diff("base", label)
    assert {(one.topic, one.what) for one in found} == PLANTED[name][1]
    assert len(found) == len(PLANTED[name][1])
    back = store.diff(label, "base")
    assert [(one.topic, one.what, one.b, one.a) for one in back] == [
        (one.topic, one.what, one.a, one.b) for one in found
    ]


def test_losses_choices_tolerance_and_verdicts(store: hl.Store) -> None:
    assert [(d.topic, d.what, d.a, d.b) for d in store.diff("base", "lost")] == [
        ("/scan", "lost", "0", "2")
    ]
    assert not store.diff("n-a-*", "n-a-*")
    assert {d.what for d in store.diff("base", "n-nothing", tolerance=0.0)} == set()
    assert not store.diff("base", "n-a-value", tolerance=1.0)
    assert store.diff("base", "n-no-scan", tolerance=1.0)
    rules = Contract.parse(GOOD)
    judged = store.diff("base", "n-early-stop", tolerance=1.0, contract=rules)
    assert [d.what for d in judged if d.what.startswith("early_stop ")] == ["early_stop 100ms"]


def test_what_only_one_has_comes_first(tmp_path: Path) -> None:
    """A longer log differs by the time that the other lacks, and not in every count."""
    sent = good()
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        play(store, sent, "all")
        play(store, [m for m in sent if m.time < LATE], "begin")
        play(store, [m for m in sent if m.time >= LATE], "rest")
        later = [replace(m, time=m.time + 100 * SECOND) for m in [*sent, EXTRA]]
        play(store, [m for m in later if m.time < LATE + 100 * SECOND], "later")

        def told(a: str, b: str, **how: Any) -> list[tuple[str, ...]]:
            return [(d.topic, d.what, d.a, d.b) for d in store.diff(a, b, **how)]

        (only,) = told("all", "begin")
        assert only[:2] == ("", "times")
        assert re.fullmatch(r"from \+1\.9\d+s to \+\d\.\d+s", only[2])
        assert only[3] == ""
        assert told("rest", "all") == [("", "times", "", "from +0s to +2s")]
        # Of different times: since the beginnings.
        first, topic, *others = told("all", "later", topics=["scan", "new"])
        assert (first, topic) == (only, ("/new", "topic", "", "1 message"))
        assert {one[0] for one in others} <= {"/scan"}
        assert told("all", "begin", between=("+1s", "+1.5s")) == []
        # All messages of a topic that the other lacks, not those of the common time.
        play(store, [m for m in sent if m.topic == "/odom" and m.time < LATE], "odom")
        assert ("/scan", "topic", "100 messages", "") in told("all", "odom")
        path = store.directory.path
    asked = ("diff", "all", "later", "-t", "scan", "-t", "new", "-n", "1")
    done = run(*asked, store=path, code=12)
    assert len(done.lines) == 2
    assert f"only a: {only[2]}" in done.lines[1]
    assert done.err == f"The first 1 of {2 + len(others)} differences.\n"
    assert run("diff", "all", "begin", "--between", "+1s", "+1.5s", store=path).out == ""


def test_latched_topics_neither_start_late_nor_stop_early(tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        for name, late in (("a", 0), ("b", 140_000)):
            with store.start(name) as live:
                odom = channel("/odom", "test_msgs/Odom")
                latched = replace(channel("/map", "test_msgs/Map"), metadata={"latching": "1"})
                for time in (0, SECOND):
                    live.write(odom, bytes(24), log_time=START + time)
                live.write(latched, bytes(24), log_time=START + late)
        assert store.diff("a", "b") == []


def test_the_command(store: hl.Store, tmp_path: Path) -> None:
    path = store.directory.path
    assert run("diff", "base", "n-nothing", store=path).out == ""
    shown = run("diff", "base", "n-a-value", store=path, code=12)
    assert [line.split()[:2] for line in shown.lines] == [["topic", "what"], ["/scan", "x"]]
    as_json = run("diff", "base", "n-a-new-topic", "--json", store=path, code=12).json
    assert as_json == [{"topic": "/new", "what": "topic", "a": "", "b": "1 message", "share": None}]
    shown = run("diff", "base", "n-a-message-less", store=path, code=12)
    rows = {(d.topic, d.what): d for d in store.diff("base", "n-a-message-less")}
    assert rows["/odom", "messages"].share == pytest.approx(1 / 250)
    near = sum(one.share is not None and one.share <= 0.05 for one in rows.values())
    assert f"--tolerance 5% leaves out {near} of the differences." in shown.err
    assert len(store.diff("base", "n-a-message-less", tolerance=0.05)) == len(rows) - near
    assert run("diff", "base", "n-a-value", "--tolerance", "100%", store=path).out == ""
    run("diff", "base", "n-a-value", "--tolerance", "much", store=path, code=2)
    run("diff", "base", "no-such", store=path, code=2)


@needs_data
@pytest.mark.parametrize(
    "name",
    [
        "auv_ros2.mcap",
        "sick_laser_radar.bag",
        *(
            pytest.param(path.name, marks=EXHAUSTIVE)
            for path in sorted((DATA / "real").iterdir() if DATA.is_dir() else [])
        ),
    ],
)
def test_a_real_log_does_not_differ_from_itself(name: str, tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        store.record(DATA / "real" / name, name="a")
        store.record(DATA / "real" / name, name="b", again=True)
        store.mark("b", "start", "here")
        assert not store.diff("a", "a")
        assert not store.diff("a", "b")
