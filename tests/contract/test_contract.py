"""Verdicts by contracts, and differences: what is planted is found by its rule alone."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from msgspec import structs

import hybridlog as hl
from hybridlog.contract import MAX_RULES, Contract, contract_of
from hybridlog.contract.judge import broken
from hybridlog.formats.yaml_values import MAX_BYTES
from hybridlog.query.topics import matcher
from hybridlog.record.losses import Cause
from hybridlog_storage.errors import UsageError
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import Channel, Schema
from tests.cli.running import run as process
from tests.cli.within import answer as run
from tests.data import DATA, needs_data

MS = 10**6
SECOND = 10**9
START = 1_700_000_000 * SECOND
HEADER = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
DEFINITION = ("std_msgs/Header header\nfloat64 x\n" + HEADER).encode()
GOOD = """\
lost: 0
topics:
  /scan:
    type: test_msgs/Scan
    rate: 20
    tolerance: 5%
    longest_gap: 200ms
    jitter: 10ms
    late_start: 100ms
    early_stop: 100ms
    lost: 0
    least_age: -1ms
    greatest_age: 20ms
    stamps_in_order: true
    offset: {/odom: 30ms}
    share: {"x > 0": 90%, "x < 100": 1}
  /odom:
    type: test_msgs/Odom
    rate: 50
    longest_gap: 0.5s
  /rare:
    optional: true
    type: test_msgs/Rare
"""


@dataclass(frozen=True)
class Sent:
    topic: str
    time: int
    stamp: int
    type: str
    x: float = 1.0
    seq: int = 0


def good() -> list[Sent]:
    scans = [START + n * 50 * MS for n in range(100)]
    odoms = [START + n * 20 * MS for n in range(250)]
    return [
        *(Sent("/scan", t, t - 5 * MS, "test_msgs/Scan") for t in scans),
        *(Sent("/odom", t, t, "test_msgs/Odom") for t in odoms),
    ]


Change = Callable[[list[Sent]], list[Sent]]


def without(topic: str, begin: float = 0, end: float = 100) -> Change:
    """No messages of a topic between seconds from the start."""

    def is_out(one: Sent) -> bool:
        return one.topic == topic and begin <= (one.time - START) / SECOND < end

    return lambda sent: [one for one in sent if not is_out(one)]


def changed(topic: str, every: int = 1, **values: Callable[[Sent], object]) -> Change:
    """Every n-th message of a topic with other values."""

    def change(sent: list[Sent]) -> list[Sent]:
        places = [n for n, one in enumerate(sent) if one.topic == topic][::every]
        found = list(sent)
        for n in places:
            found[n] = replace(sent[n], **{k: make(sent[n]) for k, make in values.items()})
        return found

    return change


def shaken(ms: int) -> Change:
    """Every second scan is late, with its stamp."""
    return changed("/scan", 2, time=lambda m: m.time + ms * MS, stamp=lambda m: m.stamp + ms * MS)


PLANTED: dict[str, tuple[Change, set[tuple[str, str]]]] = {
    "nothing": (lambda sent: sent, set()),
    "no scan": (without("/scan"), {("/scan", "messages")}),
    "no odom": (without("/odom"), {("/odom", "messages"), ("/scan", "offset")}),
    "rare of its type": (lambda s: [*s, Sent("/rare", START, START, "test_msgs/Rare")], set()),
    "rare of another": (
        lambda s: [*s, Sent("/rare", START, START, "test_msgs/Other")],
        {("/rare", "type")},
    ),
    "type": (changed("/scan", type=lambda _: "test_msgs/Other"), {("/scan", "type")}),
    "two types": (changed("/odom", 3, type=lambda _: "test_msgs/Other"), {("/odom", "type")}),
    "half the rate": (
        lambda s: [m for m in s if m.topic == "/odom" or (m.time - START) % (100 * MS) == 0],
        {("/scan", "rate")},
    ),
    "rate of odom": (
        lambda s: [m for m in s if m.topic == "/scan" or (m.time - START) % (60 * MS)],
        {("/odom", "rate")},
    ),
    "gap": (
        without("/scan", 2, 2.24),
        {("/scan", "longest_gap"), ("/scan", "jitter"), ("/scan", "rate")},
    ),
    "gap of odom": (without("/odom", 2, 2.6), {("/odom", "longest_gap"), ("/odom", "rate"),
                                              ("/scan", "offset")}),
    "jitter": (shaken(21), {("/scan", "jitter")}),
    "late": (without("/scan", 0, 0.14), {("/scan", "late_start")}),
    "early": (without("/scan", 4.85), {("/scan", "early_stop")}),
    "late beyond the gap": (
        without("/scan", 0, 0.3),
        {("/scan", "late_start"), ("/scan", "longest_gap")},
    ),
    "early beyond the gap": (
        without("/scan", 4.7),
        {("/scan", "early_stop"), ("/scan", "longest_gap")},
    ),
    "one stamp from the future": (
        changed("/scan", 100, stamp=lambda m: m.time + 2 * MS),
        {("/scan", "least_age")},
    ),
    "old stamps": (
        changed("/scan", stamp=lambda m: m.time - 25 * MS),
        {("/scan", "greatest_age")},
    ),
    "stamps backwards": (
        changed("/scan", 2, stamp=lambda m: m.time - (65 if m.time == START + SECOND else 5) * MS),
        {("/scan", "stamps_in_order"), ("/scan", "greatest_age")},
    ),
    "too few positive": (changed("/scan", 5, x=lambda _: -1.0), {("/scan", "share")}),
    "few negative": (changed("/scan", 20, x=lambda _: -1.0), set()),
    "one too great": (changed("/scan", 100, x=lambda _: 1000.0), {("/scan", "share")}),
}  # fmt: skip


def channel(topic: str, name: str) -> Channel:
    return Channel(topic, "ros1", Schema(name, "ros1msg", DEFINITION), {})


def play(store: hl.Store, sent: list[Sent], name: str, lost: int | None = 0) -> str:
    """Record messages; losses are of /scan."""
    channels = {(m.topic, m.type): channel(m.topic, m.type) for m in sent}
    with store.start(name) as live:
        for one in sorted(sent, key=lambda m: m.time):
            sec, nsec = divmod(one.stamp, SECOND)
            payload = struct.pack("<3II d".replace(" ", ""), one.seq, sec, nsec, 0, one.x)
            live.write(channels[one.topic, one.type], payload, log_time=one.time)
        if lost != 0:
            live.ledger.note(Loss(Cause.QUEUE, "/scan", lost, first=START, last=START))
            live.ledger.note(Loss(Cause.THROTTLE, "/scan", 9, first=START, last=START))
    return live.name


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("contract") / "s", create=True, mongo="none") as store:
        for name, (change, _) in PLANTED.items():
            play(store, change(good()), name.replace(" ", "-"))
        play(store, good(), "lost", 2)
        play(store, good(), "lost-unknown", None)
        yield store


def found(store: hl.Store, label: str) -> set[tuple[str, str]]:
    results = store.judge(Contract.parse(GOOD), label)
    return {(one.topic, one.rule) for one in broken(results)}


@pytest.mark.parametrize("name", PLANTED)
def test_each_planted_breach_is_found_by_its_rules_alone(store: hl.Store, name: str) -> None:
    assert found(store, name.replace(" ", "-")) == PLANTED[name][1]


@pytest.mark.parametrize("label", ["lost", "lost-unknown"])
def test_losses_of_a_topic_and_of_the_recording(store: hl.Store, label: str) -> None:
    assert found(store, label) == {("", "lost"), ("/scan", "lost")}


def test_predicates_that_do_not_fit_and_stamps_that_are_not_there(store: hl.Store) -> None:
    text = "topics: {/scan: {share: {'y > 0': 0.1}, offset: {/none: 1s}}}"
    results = store.judge(Contract.parse(text), "nothing")
    assert [(one.rule, one.holds) for one in results] == [
        ("messages", True),
        ("offset", False),
        ("share", False),
    ]
    assert "y" in results[-1].found
    with store.start("plain") as live:
        live.write(Channel("/scan", "json", None, {}), b"{}", log_time=START)
    text = "topics: {/scan: {stamps_in_order: true, least_age: 0, greatest_age: 1s, rate: 1}}"
    results = store.judge(Contract.parse(text), "plain")
    assert [one.rule for one in broken(results)] == [
        "rate",
        "least_age",
        "greatest_age",
        "stamps_in_order",
    ]


def test_the_command(store: hl.Store, tmp_path: Path) -> None:
    path = store.directory.path
    rules, report = tmp_path / "robot.yaml", tmp_path / "report.xml"
    rules.write_text(GOOD)
    good = run("check", "-r", "nothing", "--contract", rules, store=path)
    assert (good.code, good.out, "none broken" in good.err) == (0, "", True)
    asked = ("check", "-r", "late", "-r", "nothing", "--contract", rules)
    bad = process(*asked, "--junit", report, store=path, code=12)
    assert [line.split()[:3] for line in bad.lines[1:]] == [["late", "/scan", "late_start"]]
    suites = {one.get("name"): one for one in ET.parse(report).getroot()}
    assert {n: s.get("failures") for n, s in suites.items()} == {"late": "1", "nothing": "0"}
    assert [c.get("name") for c in suites["late"] if len(c)] == ["late_start: 100ms"]
    as_json = process(*asked, "--json", store=path, code=12)
    assert [r["rule"] for r in as_json.json if not r["holds"]] == ["late_start"]
    assert len(as_json.json) == sum(len(suite) for suite in suites.values())
    run(*asked, "-t", "scan", store=path, code=2)
    run(*asked, "--make", tmp_path / "other", store=path, code=2)
    run(*asked, "--junit", report, store=path, code=2)  # it exists
    run("check", "-r", "no-such", "--contract", rules, store=path, code=2)


@pytest.mark.parametrize(
    ("text", "cure"),
    [
        ("topics: {/a: {rat: 5}}", "/a: there is no rule `rat`; there are type, rate"),
        ("topics: {/a: {rate: fast}}", "at `$.rate`"),
        ("topics: {/a: {rate: nan}}", "at `$.rate`"),
        ("topics: {/a: {}}\nlost: -1", ">= 0"),
        ("topics: {/a: {longest_gap: 5 parsecs}}", "500ms"),
        ("topics: {/a: {tolerance: 110%}}", "95%"),
        ("topics: {/a: {stamps_in_order: perhaps}}", "/a: Expected `bool`"),
        ("topics: {/a: {share: {'x >': 1}}}", "x >"),
        ("topics: {/a: {share: {'/b: x > 1': 1}}}", "leave the other topic out"),
        ("topics: {/a: {share: {'_meta.t > 1': 1}}}", "fields of the message"),
        ("topics: {/a: {offset: 5}}", "/a: Expected `object`"),
        ("topics: {/a: 5}", "Expected `object | null`"),
        ("rules: 1", "unknown field `rules`"),
        ("- 1", "Expected `object`"),
        ("{", "did not find expected node"),
        ("topics: {/a: {rate: 1}, /a: {rate: 2}}", "repeated"),
    ],
)
def test_what_is_no_contract_names_rule_and_cure(text: str, cure: str) -> None:
    with pytest.raises(UsageError, match="is no contract") as caught:
        Contract.parse(text, "robot.yaml")
    assert cure in str(caught.value)


def test_a_contract_is_bounded(tmp_path: Path) -> None:
    many = ", ".join(f"'x > {n}': 1" for n in range(MAX_RULES + 1))
    with pytest.raises(UsageError, match="more than"):
        Contract.parse(f"topics: {{/a: {{share: {{{many}}}}}}}")
    large = tmp_path / "large.yaml"
    large.write_bytes(b"#" * (MAX_BYTES + 1))
    with pytest.raises(UsageError, match="larger than"):
        Contract.read(large)
    with pytest.raises(UsageError, match="cannot be read"):
        Contract.read(tmp_path)
    bomb = "a: &a [x, x]\n" + "".join(f"b{n}: &b{n} [*a, *a]\n" for n in range(50))
    inside = ", ".join(f"x{n}: &a{n} [*a{n - 1}, *a{n - 1}]" for n in range(1, 50))
    for text in (bomb, f"topics: {{/a: {{x0: &a0 [x, x], {inside}}}}}"):
        with pytest.raises(UsageError, match="no contract"):
            Contract.parse(text)


@needs_data
@pytest.mark.parametrize("name", ["auv_ros2.mcap", "tilt_laser.bag"])
def test_a_good_real_log_keeps_its_own_contract(name: str, tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        store.record(DATA / "real" / name)
        checked = store.check()
        contract = Contract.parse(contract_of(checked))
        assert contract.topics.keys() == {one.topic for one in checked if one.messages}
        assert not broken(store.judge(contract))
        if name != "tilt_laser.bag":  # its topics come now and then
            assert any(rules.rate for rules in contract.topics.values())
        (label,) = store.recordings().names
        path = tmp_path / "made.yaml"
        assert run("check", "-r", label, "--make", path, store=tmp_path / "s").code == 0
        assert Contract.read(path) == contract
        store.mark(label, "start", "here")
        assert contract_of(store.check()) == contract_of(checked)
        store.record(DATA / "real" / name, name="again", again=True)
        assert not store.diff(label, "again")
        gone = next(one.topic for one in checked if one.messages)
        kept = matcher(["**"], [gone])
        store.record(DATA / "real" / name, name="other", matcher=kept, again=True)
        bad = broken(store.judge(contract, "other"))
        assert ("messages", gone) in {(one.rule, one.topic) for one in bad}


COUNTS = {"messages", "rate", "jitter"}
LATE = START + 2 * SECOND


def at(topic: str, **values: object) -> Change:
    """The message of a topic two seconds after the start has other values."""

    def change(sent: list[Sent]) -> list[Sent]:
        return [replace(m, **values) if (m.topic, m.time) == (topic, LATE) else m for m in sent]

    return change


EXTRA = Sent("/new", START, START, "test_msgs/New")
DIFFERING: dict[str, tuple[Change, set[tuple[str, str]]]] = {
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
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    with hl.open(tmp_path_factory.mktemp("diff") / "s", create=True, mongo="none") as store:
        play(store, good(), "base")
        for name, (change, _) in DIFFERING.items():
            play(store, change(good()), f"n-{name.replace(' ', '-')}")
        play(store, good(), "lost", 2)
        yield store


@pytest.mark.parametrize("name", DIFFERING)
def test_each_planted_change_is_found_alone(pairs: hl.Store, name: str) -> None:
    label = f"n-{name.replace(' ', '-')}"
    found = pairs.diff("base", label)
    assert {(one.topic, one.what) for one in found} == DIFFERING[name][1]
    assert len(found) == len(DIFFERING[name][1])
    back = pairs.diff(label, "base")
    assert [(one.topic, one.what, one.b, one.a) for one in back] == [
        (one.topic, one.what, one.a, one.b) for one in found
    ]


def test_losses_choices_and_tolerance(pairs: hl.Store) -> None:
    assert [(d.topic, d.what, d.a, d.b) for d in pairs.diff("base", "lost")] == [
        ("/scan", "lost", "0", "2")
    ]
    assert not pairs.diff("n-a-*", "n-a-*")
    assert {d.what for d in pairs.diff("base", "n-nothing", tolerance=0.0)} == set()
    assert not pairs.diff("base", "n-a-value", tolerance=1.0)
    assert pairs.diff("base", "n-no-scan", tolerance=1.0)


def test_counters_and_stamps_are_left_out_unless_asked(tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        for name in ("a", "b"):
            play(store, [replace(m, seq=m.seq + 7 * (name == "b")) for m in good()], name)
        assert not store.diff("a", "b")
        assert {one.what for one in store.diff("a", "b", counters=True)} == {"header.seq"}
        made = contract_of(store.check())
        assert not broken(store.judge(Contract.parse(made)))
        assert '"a", "b"' in made


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
    done = process(*asked, store=path, code=12)
    assert len(done.lines) == 2
    assert only[2] in done.lines[1]
    assert done.err == f"The first 1 of {2 + len(others)} differences.\n"
    assert process("diff", "all", "begin", "--between", "+1s", "+1.5s", store=path).out == ""


def test_latched_topics_neither_start_late_nor_stop_early(tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        for name, late in (("a", 0), ("b", 140_000)):
            with store.start(name) as live:
                odom = channel("/odom", "test_msgs/Odom")
                latched = structs.replace(
                    channel("/map", "test_msgs/Map"), metadata={"latching": "1"}
                )
                for time in (0, SECOND):
                    live.write(odom, bytes(24), log_time=START + time)
                live.write(latched, bytes(24), log_time=START + late)
        assert store.diff("a", "b") == []


def test_the_command_for_differences(pairs: hl.Store, tmp_path: Path) -> None:
    path = pairs.directory.path
    assert process("diff", "base", "n-nothing", store=path).out == ""
    shown = process("diff", "base", "n-a-value", store=path, code=12)
    assert [line.split()[:2] for line in shown.lines] == [["topic", "what"], ["/scan", "x"]]
    as_json = process("diff", "base", "n-a-new-topic", "--json", store=path, code=12).json
    assert as_json == [{"topic": "/new", "what": "topic", "a": "", "b": "1 message", "share": None}]
    shown = process("diff", "base", "n-a-message-less", store=path, code=12)
    rows = {(d.topic, d.what): d for d in pairs.diff("base", "n-a-message-less")}
    assert rows["/odom", "messages"].share == pytest.approx(1 / 250)
    near = sum(one.share is not None and one.share <= 0.05 for one in rows.values())
    assert len(pairs.diff("base", "n-a-message-less", tolerance=0.05)) == len(rows) - near
    assert process("diff", "base", "n-a-value", "--tolerance", "100%", store=path).out == ""
    process("diff", "base", "n-a-value", "--tolerance", "much", store=path, code=2)
    process("diff", "base", "no-such", store=path, code=2)
