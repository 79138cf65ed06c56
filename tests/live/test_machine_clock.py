"""The clock of the robot is set by years: everything is stored, told, marked and found."""

from __future__ import annotations

from itertools import pairwise

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.contract import Contract, TopicRules
from hybridlog.live.clocks import MachineClock
from hybridlog.live.recorder import RecorderOptions, throttle_rule
from hybridlog.query.times import format_duration
from hybridlog.record.losses import Cause
from hybridlog.record.marks import MARKS
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import Channel
from tests.live.speaker import TEXT, Recorded, Speaker, text, text_channel

SECOND = 10**9
YEAR = 365 * 86_400 * SECOND
NOW = 1_795_000_000 * SECOND
BOOT = 5 * SECOND
LATCHED = Channel("/map", "ros1", TEXT, {"latching": "1"}, has_publish_time=False)


class Clock(MachineClock):
    def __init__(self, now: int) -> None:
        self.time = now
        self.up = 77 * SECOND
        super().__init__(lambda: self.time, lambda: self.up)

    def run(self, ns: int) -> None:
        self.time += ns
        self.up += ns


class Absent(Speaker):
    @property
    def was_reached(self) -> bool:
        return False


class Robot(Recorded):
    def __init__(
        self, store: hl.Store, now: int, options: RecorderOptions, speaker: Speaker | None = None
    ) -> None:
        self.clock = Clock(now)
        super().__init__(store, replace(options, derives=False), speaker, self.clock)

    def play(self, channel: Channel, *words: str, step: int = SECOND // 10) -> None:
        for word in words:
            self.speaker.say(channel, text(word), self.clock.time)
            self.clock.run(step)


def words(begin: int, end: int) -> list[str]:
    return [str(n) for n in range(begin, end)]


def test_a_clock_that_is_set_mid_recording(store: hl.Store) -> None:
    contract = Contract({"/chatter": TopicRules(longest_gap=SECOND)})
    options = RecorderOptions(
        name="drive",
        reserve_bytes=0,
        contract=contract,
        throttles=[throttle_rule("/slow", "5Hz")],
    )
    robot = Robot(store, NOW, options)
    chatter, slow = text_channel(), text_channel("/slow")
    eras = [NOW, BOOT, NOW + 30 * YEAR, NOW + 100 * SECOND]
    for number, era in enumerate(eras):
        robot.clock.time = era
        if number:
            robot.recorder.lost(Loss(Cause.TRANSPORT, "/chatter", 1, first=NOW + YEAR, last=era))
        robot.play(chatter, *words(20 * number, 20 * number + 20), step=0)
        robot.play(slow, *words(0, 20), step=SECOND // 25)
        robot.play(chatter, "then")
        state = robot.recorder.look()
        assert [t.silent_s for t in state.topics if t.topic == "/chatter"] == [pytest.approx(0.1)]
    assert state.clock_set_s == pytest.approx((eras[-1] - NOW) / 1e9 - 2.7)
    assert 4 * 15 <= state.lost["throttle"] <= 4 * 17
    jumps = [at - before - 9 * SECOND // 10 for before, at in pairwise(eras)]
    assert robot.said == [
        f"the clock of this machine was set {'forward' if by > 0 else 'back'} by "
        f"{format_duration(abs(by))}; log times are those of the clock"
        for by in jumps
    ]
    robot.clock.run(3 * SECOND)
    robot.play(chatter, "back")
    (report,) = robot.recorder.stop()
    assert len(robot.said) == 4  # the clock is no silence
    label = report.entry.name
    query = store.query(["/chatter"], [label])
    assert [m.decode().data for m in query if m.log_time_ns < NOW][:20] == words(20, 40)
    assert query.count() == 4 * 21 + 1
    for number, era in enumerate(eras):
        found = query.between(era, era + 1)
        assert [m.decode().data for m in found] == words(20 * number, 20 * number + 20)
    assert query.between("-0.1s", "end").count() == 1  # of 2056
    assert query.between("start", "+1s").count() == 21
    marks = [(m.log_time_ns, m.decode()["tags"]) for m in store.query([MARKS], [label])]
    told = {at: int(tags["set_by_ns"]) for at, tags in marks if tags["cause"] == "clock"}
    assert told == dict(zip(eras[1:], jumps, strict=True))
    assert [at for at, tags in marks if tags["cause"] == "contract"] == [
        eras[-1] + 8 * SECOND // 10
    ]
    rows = [row for row in report.entry.losses if row["cause"] == "transport"]
    assert rows
    assert all(row["from"] <= row["to"] for row in rows)
    assert not store.verify().findings


def test_a_clock_that_is_set_between_recordings(store: hl.Store) -> None:
    told = []
    for begin in (NOW, BOOT, NOW + 30 * YEAR, BOOT):
        robot = Robot(store, begin, RecorderOptions(name="drive", reserve_bytes=0))
        robot.play(text_channel(), *words(0, 3))
        robot.recorder.look()
        (report,) = robot.recorder.stop()
        told.append((report.entry.name, len(report.entry.manifest.marks), len(robot.said)))
        assert store.query(["/chatter"], [report.entry.id]).between("-0.1s", "end").count() == 1
    # Those whose clock is behind say so, and have a mark.
    assert told == [("drive", 0, 0), ("drive-2", 1, 1), ("drive-3", 0, 0), ("drive-4", 1, 1)]
    assert robot.said[0].startswith("the clock of this machine says 1970-01-01T00:00:05Z, and rec")
    assert [m.decode()["tags"] for m in store.topic(MARKS)] == [{"cause": "clock"}] * 2
    assert len({one.id for one in store.session.look().summaries}) == 4
    assert store.topic("/chatter").between("1970-01-01", "1970-01-02").count() == 6
    # A clock that is wrong while no robot is there leaves no recording.
    robot = Robot(store, BOOT, RecorderOptions(name="drive", reserve_bytes=0), Absent())
    assert (robot.recorder.stop(), len(robot.said)) == ([], 1)


@pytest.mark.parametrize("set_to", [BOOT, NOW + 30 * YEAR])
def test_a_ring_goes_by_the_time_that_passes(store: hl.Store, set_to: int) -> None:
    options = RecorderOptions(name="ring", reserve_bytes=0, ring_s=10, before_s=5, after_s=2)
    robot = Robot(store, NOW, options)
    chatter = text_channel()
    robot.play(LATCHED, "map")
    robot.play(chatter, *words(0, 20), step=SECOND)
    robot.clock.time = set_to
    robot.play(chatter, *words(20, 23), step=SECOND)
    robot.recorder.look()
    robot.recorder.fire("by hand")
    robot.play(chatter, *words(23, 27), step=SECOND)
    (report,) = robot.recorder.stop()
    messages = [m.decode().data for m in store.topic("/chatter")]
    assert sorted(messages, key=int) == words(0, 27)  # in no more than a second of this test
    (pin,) = report.entry.manifest.pins
    at = set_to + 3 * SECOND
    assert (pin.first, pin.last) == (max(at - 5 * SECOND, 0), at + 2 * SECOND)  # log times
    (mark,) = (one for one in report.entry.manifest.marks if "cause" not in one.tags)
    assert mark.end == pin.last
