"""Silences of topics while they are recorded: the same ones as in the stored recording."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import hybridlog as hl
from hybridlog.contract import Contract, TopicRules
from hybridlog.contract.judge import broken
from hybridlog.live.incidents import SilenceWatch
from hybridlog.live.recorder import Recorder, RecorderOptions
from hybridlog.live.sources.replay import ReplaySource
from hybridlog.record.marks import MARKS
from tests.across.test_check import write_mcap
from tests.cli.running import run

MS = 10**6
SECOND = 10**9
STEADY = [n * 20 * MS for n in range(150)]


def out(begin: float, end: float) -> list[int]:
    """Times without those between two seconds."""
    return [t for t in STEADY if not begin <= t / SECOND < end]


PLANTED: dict[str, tuple[list[int], bool]] = {
    **{f"/gap{n}": (out(n / 10, n / 10 + 0.7), True) for n in range(1, 15)},
    "/late": (out(0, 0.8), True),
    "/early": (out(2, 9), True),
    "/late_and_early": (out(0, 0.8)[:50], True),
    "/twice": ([t for t in out(0.5, 1.1) if not 2 <= t / SECOND < 2.6], True),
    "/once": (STEADY[:1], True),
    "/bursts": ([t for t in STEADY if t // MS % 1000 < 100], True),
    "/steady": (STEADY, False),
    "/slow": (STEADY[::10], False),
}
"""Times of topics, and whether they are silent for more than half a second."""


def played(
    store: hl.Store, log: Path, contract: Contract, speed: float = 1.0
) -> tuple[str, list[str], dict[str, list[tuple[int, int]]]]:
    """Label of the recording, what the recorder said, and the silences that it marked."""
    said: list[str] = []
    options = RecorderOptions(reserve_bytes=0, contract=contract)
    recorder = Recorder(store, [ReplaySource(log, speed=speed)], options, said.append)
    recorder.start()
    while not recorder.wait(0.2):
        recorder.look()
    (report,) = recorder.stop()
    marked: dict[str, list[tuple[int, int]]] = defaultdict(list)
    if report.entry.manifest.marks:
        for mark in store.query([MARKS], [report.entry.id]):
            tags = mark.fields["tags"]
            assert (tags["cause"], tags["rule"]) == ("contract", "longest_gap")
            marked[tags["topic"]].append((mark.log_time_ns, mark.fields["end"]))
    assert not report.entry.losses
    return report.entry.name, said, marked


def stored(store: hl.Store, label: str, limit: str) -> dict[str, list[tuple[int, int]]]:
    """The gaps of each topic of a recording."""
    found = {}
    for topic in store.recordings(label).topics():
        gaps = store.query([topic], [label]).gaps(limit)
        if len(gaps) and topic != MARKS:
            found[topic] = [(gap.begin_ns, gap.end_ns) for gap in gaps]
    return found


def check_same(store: hl.Store, label: str, marked: dict[str, list[tuple[int, int]]]) -> set[str]:
    """Marks are gaps of the stored recording, and its verdict is the same."""
    found = stored(store, label, "500ms")
    end = store.entry(label).span[1]  # type: ignore[index]
    last = {topic: [span for span in spans if span[1] <= end] for topic, spans in marked.items()}
    closed = {topic: [span for span in spans if span[1] <= end] for topic, spans in found.items()}
    assert {t: s for t, s in last.items() if s} == {t: s for t, s in closed.items() if s}
    assert found.keys() <= marked.keys()  # the recorder may have gone on after the last message
    return {*marked}


def rules(*topics: str) -> Contract:
    return Contract({topic: TopicRules(longest_gap=SECOND // 2) for topic in topics})


def test_played_and_stored_verdicts_are_equal_and_right(tmp_path: Path) -> None:
    log = write_mcap(tmp_path / "log.mcap", {name: times for name, (times, _) in PLANTED.items()})
    contract = rules(*PLANTED)
    with hl.open(tmp_path / "s", create=True, mongo="none") as store:
        label, said, marked = played(store, log, contract)
        silent = check_same(store, label, marked)
        assert {name for name, (_, is_silent) in PLANTED.items() if is_silent} <= silent
        bad = {one.topic for one in broken(store.judge(contract, label))}
        assert bad == silent
        lines = [line for line in said if "no message for more than 500ms" in line]
        assert len(lines) == sum(map(len, marked.values()))


class Watch(SilenceWatch):
    """Looks when it is told, and returns what it notes."""

    def __init__(self, **topics: TopicRules) -> None:
        super().__init__(Contract(topics))

    def say(self, topic: str, time: int) -> None:
        self.take(topic, time, time + 1000)

    def seen(self, now: int, ended_at: int | None = None) -> list[tuple[str, int, int | None]]:
        return sorted((one.tags["topic"], one.time, one.end) for one in self.look(now, ended_at))


def test_each_silence_is_told_once_and_ends_once() -> None:
    rule = TopicRules(longest_gap=10)
    watch = Watch(a=rule, b=rule, o=TopicRules(longest_gap=10, optional=True))
    watch.say("other", 100)
    assert watch.seen(110) == []
    assert watch.seen(111) == [("a", 1100, None), ("b", 1100, None)]
    assert watch.seen(150) == []
    assert watch.silent == ["a", "b"]
    watch.say("a", 160)
    assert watch.seen(161) == [("a", 1100, 1160)]
    watch.say("a", 175)  # between two looks
    watch.say("a", 170)  # late, and not before
    assert watch.seen(176) == [("a", 1160, 1175)]
    watch.say("o", 176)  # optional, and late
    assert watch.seen(176) == [("o", 1100, 1176)]
    assert watch.breaches == 4
    assert watch.seen(177, 1177) == [("b", 1100, 1177)]


def test_the_command_tells_marks_runs_a_command_and_judges(tmp_path: Path) -> None:
    logs = {"/a": out(0.4, 2.2), "/b": STEADY}
    log = write_mcap(tmp_path / "log.mcap", logs)
    rules = tmp_path / "robot.yaml"
    rules.write_text("topics: {/a: {longest_gap: 500ms}, /b: {optional: true}}")
    asked = ("record", "--replay", log, "--contract", rules, "--speed", 2, "--reserve", "0")
    done = run(*asked, store=tmp_path / "s", code=12)
    assert "/a: no message for more than 500ms (longest_gap of the contract)" in done.err
    assert "/a breaks longest_gap 500ms: " in done.err
    again = run("check", "--contract", rules, "--json", store=tmp_path / "s", code=12).json
    assert [(row["topic"], row["rule"]) for row in again if not row["holds"]] == [
        ("/a", "longest_gap")
    ]
    run("record", log, "--contract", rules, store=tmp_path / "s", code=2)
    run(*asked, "--ring", "5s", store=tmp_path / "s", code=2)
