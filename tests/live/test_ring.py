"""A ring: what ended longer ago than a time goes, unless it is pinned or latched."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.follow import child
from hybridlog.follow.child import Trigger
from hybridlog.live.recorder import RecorderOptions
from hybridlog.maintenance import keep
from hybridlog.record.losses import Cause
from hybridlog.record.marks import MARKS
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import Channel
from tests.live.speaker import TEXT, Recorded, scan, scan_channel, text, text_channel

SECOND = 1_000_000_000
LATCHED = Channel("/map", "ros1", TEXT, {"latching": "1"}, has_publish_time=False)
RING_S = 0.4
"""Of the tests; a group is sealed with each message."""


@pytest.fixture(autouse=True)
def is_prompt(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keep, "_LATE_S", 0.1)


class Robot(Recorded):
    def __init__(self, store: hl.Store, ring_s: float = RING_S, **options: object) -> None:
        made = RecorderOptions(
            name="ring",
            reserve_bytes=0,
            ring_s=ring_s,
            flush_interval_s=0.02,
            **{"derives": False, **options},  # type: ignore[arg-type]
        )
        super().__init__(store, made)
        self.store = store
        self.sent = 0

    @property
    def folder(self) -> Path:
        target = self.recorder._target
        return self.store.directory.recording(target.id)

    def run(self, seconds: float) -> None:
        """Send a number a hundredth of a second."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.speaker.say(scan_channel(), scan(self.sent, 2000))
            self.sent += 1
            self.recorder.look()
            time.sleep(0.01)

    def run_until(self, holds: Callable[[], object]) -> None:
        """Send on until something is the case."""
        end = time.monotonic() + 60
        while not holds():
            assert time.monotonic() < end
            self.run(0.1)

    def stop(self) -> hl.RecordingEntry:
        (report,) = self.recorder.stop()
        return report.entry


def ids(store: hl.Store) -> list[int]:
    return [message.fields["id"] for message in store.topic("/scan")]


def span_s(store: hl.Store) -> float:
    times = [message.log_time_ns for message in store.topic("/scan")]
    return (times[-1] - times[0]) / SECOND


@pytest.mark.mongo
def test_the_last_seconds_stay_and_nothing_else(store: hl.Store) -> None:
    robot = Robot(store, derives=True)
    robot.recorder.lost(Loss(Cause.TRANSPORT, "/scan", 4, time.time_ns(), time.time_ns()))
    robot.run(RING_S)
    robot.run_until(lambda: ids(store)[0] and span_s(store) < RING_S + 0.9)
    seen = ids(store)
    state = robot.recorder.look()
    robot.run(RING_S)
    entry = robot.stop()
    kept = ids(store)
    sent = robot.sent
    # The end of what came, without gaps.
    assert kept == [*range(sent - len(kept), sent)]
    assert span_s(store) > RING_S * 0.5
    assert seen == [*range(seen[0], seen[-1] + 1)]
    assert state.let_go
    manifest = store.directory.manifests.read(entry.id)
    assert manifest.let_go is not None
    assert manifest.let_go.messages == sent - len(kept)
    assert sum(one.messages for one in manifest.channels.values()) == entry.messages == len(kept)
    names = {file.name for file in manifest.files}
    assert {path.name for path in robot.folder.glob("*.mcap")} == names
    # All that is derived is of what is left, and what was lost before is not in it.
    assert store.topic("/scan").where("near >= 0").count() == len(kept)
    indexed = store.topic("/scan").where({"near": {"$gte": 0}})
    assert (indexed.count(), [*indexed.completeness().sentences]) == (len(kept), [])
    assert store.topic("/scan").to_arrow().num_rows == len(kept)
    assert store.sql("select count(*) as n from scan").to_pandas()["n"][0] == len(kept)
    assert entry.losses == []
    assert store.verify().findings == []


def test_questions_are_answered_while_files_go(store: hl.Store) -> None:
    robot = Robot(store, 5 * RING_S)
    robot.run(0.5)
    done = threading.Event()
    running = threading.Thread(target=robot.run_until, args=(done.is_set,))
    running.start()
    asked = 0
    with hl.open(store.directory.path, mongo="none") as other:
        while asked < 6 or not robot.recorder.look().let_go:
            assert running.is_alive()
            found = ids(other)
            assert found == [*range(found[0], found[0] + len(found))]
            assert other.topic("/scan").count() > 0
            assert other.topic("/scan").where("near >= 0").to_arrow().num_rows > 0
            assert other.sql("select count(*) as n from scan").to_pandas()["n"][0] > 0
            with hl.open(store.directory.path, mongo="none") as newer:
                (one,) = newer.recordings()
                assert one.losses == []
                assert [*newer.topic("/scan").between("-0.3s", "end")]
                assert not newer.verify().findings
            asked += 1
    done.set()
    running.join()
    robot.stop()


def test_what_is_pinned_stays(store: hl.Store) -> None:
    robot = Robot(store, 4 * RING_S, before_s=0.3, after_s=0.3)
    robot.run(0.8)
    at = time.time_ns()
    robot.recorder.fire("bump")
    robot.run(0.8)
    robot.run_until(lambda: len(found := ids(store)) < found[-1] - found[0])  # behind the pin
    entry = robot.stop()
    kept = {message.fields["id"]: message.log_time_ns for message in store.topic("/scan")}
    around = [n for n, time in kept.items() if abs(time - at) <= 0.3 * SECOND]
    assert around == [*range(around[0], around[-1] + 1)]
    assert kept[around[0]] < at < kept[around[-1]]
    (mark,) = store.topic(MARKS)
    assert mark.fields["tags"] == {"trigger": "bump"}
    during = store.topic("/scan").during(store.topic(MARKS).windows())
    assert during.count() == len(around)
    store.unpin(*(pin.id for pin in entry.manifest.pins))


def test_nothing_goes_before_triggers_have_seen_it(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = child._START
    monkeypatch.setattr(child, "_START", f"import time; time.sleep(1); {start}")
    robot = Robot(store, derives=True, triggers=[Trigger.of("/scan: id == 80")])
    robot.run(0.9)
    assert ids(store)[0] == 0
    while not robot.recorder.look().let_go:
        robot.run(0.2)
    assert ids(store)[0] > 0
    robot.stop()
    (mark,) = store.topic(MARKS)
    at = mark.fields["end"]
    assert 80 in [m.fields["id"] for m in store.topic("/scan") if m.log_time_ns <= at]


def test_latched_messages_in_force_stay_and_marks(store: hl.Store) -> None:
    robot = Robot(store)
    robot.mark("slipped", {})
    for word in ("old", "map"):
        robot.speaker.say(LATCHED, text(word))
        robot.speaker.say(text_channel(), text("small"))
        robot.run(0.3)
    robot.run_until(lambda: store.topics() == [MARKS, "/map", "/scan"])  # of others all is gone
    entry = robot.stop()
    assert [mark.fields["text"] for mark in store.topic(MARKS)] == ["slipped"]
    assert [m.fields["data"] for m in store.topic("/map")] == ["map"]
    last = store.topic("/scan").between("-0.1s", "end")
    assert last.count() > 0
    slice_ = store.query(["/map", "/scan"], [entry.id]).between("-0.1s", "end")
    front = [batch.payload(0) for batch, _ in slice_.latched()]
    assert front == [text("map")]
    store.keep({"max-age": "0s"})
    assert [m.raw for m in store.topic("/map")] == [text("map")]
