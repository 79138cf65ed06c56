"""The recorder: what was received is what is stored, and what the ledger says."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import random
import shutil
import threading
import time
from collections import Counter
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.live import recorder as recorder_module
from hybridlog.live.recorder import (
    WHOLE_BELOW,
    Recorder,
    RecorderOptions,
    Throttle,
    first_fit,
    priority_rule,
    throttle_rule,
)
from hybridlog.live.state import choose, read, running
from hybridlog.record.losses import Cause
from hybridlog.record.marks import MARKS
from hybridlog.schema.codecs import unindexed
from hybridlog_storage.disk import append_file, files
from hybridlog_storage.errors import (
    DiskFullError,
    PayloadError,
    SourceError,
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.manifest import Loss
from hybridlog_storage.messages import SUPPLIED, Channel, Schema
from hybridlog_storage.segments.segment_writer import RecordingWriter
from tests import places
from tests.calls import Calls
from tests.indexed import documents_of, misindexed
from tests.limits import Limit
from tests.live.speaker import Recorded, Speaker, scan, scan_channel, text, text_channel
from tests.waiting import wait_for

SECOND = 1_000_000_000
FREE = RecorderOptions(reserve_bytes=0, derives=False)


class Running(Recorded):
    def __init__(self, store: hl.Store, options: RecorderOptions = FREE) -> None:
        super().__init__(store, options)

    def rows(self) -> Counter[tuple[str, str]]:
        (report,) = self.recorder.stop()
        found: Counter[tuple[str, str]] = Counter()
        for row in report.entry.losses:
            found[row["topic"], row["cause"]] += row["count"]
        return found


def block_writing(calls: Calls) -> threading.Event:
    """Nothing is laid into chunks until the event is set."""
    blocked = threading.Event()
    calls(RecordingWriter, "append", lambda *_: blocked.wait())
    return blocked


def in_segments(store: hl.Store, recording: str) -> Counter[tuple[str, str]]:
    """Messages by topic and encoding, as the official reader finds them."""
    found: Counter[tuple[str, str]] = Counter()
    for path in sorted(places.folder(store.directory.path, recording).glob("*.mcap")):
        with path.open("rb") as stream:
            for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages():
                found[channel.topic, channel.message_encoding] += 1
    return found


def test_what_is_received_is_stored_or_in_the_ledger(store: hl.Store) -> None:
    options = replace(FREE, throttles=[throttle_rule("/scan", "5Hz")])
    robot = Running(store, options)
    chatter, scans = text_channel(), scan_channel()
    for number in range(100):
        robot.speaker.say(chatter, text(str(number)), SECOND + number * SECOND // 20)
        robot.speaker.say(scans, scan(number, 10), SECOND + number * SECOND // 20)
    robot.recorder.lost(Loss(Cause.TRANSPORT, "/chatter", 7, first=SECOND, last=2 * SECOND))
    robot.recorder.lost(Loss(Cause.UNREADABLE, "/tf", 3, SECOND, SECOND, "no type"))
    state = robot.recorder.look()
    assert {t.topic: t.messages for t in state.topics} == {"/chatter": 100, "/scan": 100}
    rows = robot.rows()
    kept = in_segments(store, robot.recorder.name)
    assert rows["/scan", "throttle"] == 100 - kept["/scan", "ros1"]
    assert 23 <= kept["/scan", "ros1"] <= 28
    assert kept["/chatter", "ros1"] == 100
    assert rows["/chatter", "transport"] == 7
    assert rows["/tf", "unreadable"] == 3
    assert robot.speaker.stopped == 1
    assert [m.decode().data for m in store.topic("/chatter")] == [str(n) for n in range(100)]


@pytest.mark.mongo
def test_payloads_step_down_and_fields_stay(store: hl.Store, limit: Limit) -> None:
    filled = [0.0]
    limit(recording_filled=property(lambda _: filled[0]))
    rules = [priority_rule("/lidar", "high"), priority_rule("/cam", "low")]
    options = RecorderOptions(reserve_bytes=0, priorities=rules)
    robot = Running(store, options)
    channels = {name: scan_channel(name) for name in ("/cam", "/scan", "/lidar")}
    small = text_channel("/small")
    number = 0
    for filled[0] in (0.0, 0.6, 0.8, 0.95, 0.0):
        for _ in range(10):
            number += 1
            for channel in channels.values():
                robot.speaker.say(channel, scan(number, 9000), number * SECOND)
            robot.speaker.say(small, text("x"), number * SECOND)
    rows = robot.rows()
    kept = in_segments(store, robot.recorder.name)
    # Five steps of ten messages: whole, or fields only.
    assert kept["/cam", "ros1"] == 10 + 0 + 0 + 0 + 10
    assert kept["/scan", "ros1"] == 10 + 10 + 0 + 0 + 10
    assert kept["/lidar", "ros1"] == 10 + 10 + 10 + 0 + 10
    assert kept["/small", "ros1"] == 50
    for topic in channels:
        reduced = kept[topic, "hybridlog.reduced"]
        assert kept[topic, "ros1"] + reduced == 50
        assert rows[topic, "degrade"] == reduced
    assert any("/cam" in line and "only the fields are stored" in line for line in robot.said)
    # Fields of all messages are in the index, whole or not, and stay there.
    documents = documents_of(store, "/cam")
    assert [d["id"] for d in documents] == list(range(1, 51))
    assert {d["data"]["n"] for d in documents} == {9000}
    assert store.topic("/cam").where("near > 5 and near <= 10").count() == 10
    store.index.rebuild()
    assert documents_of(store, "/cam") == documents
    assert misindexed(store) == {}


def test_a_reduced_message_says_what_it_was(store: hl.Store, limit: Limit, tmp_path: Path) -> None:
    limit(recording_filled=0.99)
    robot = Running(store)
    channel, payload = scan_channel(), scan(5, 9000)
    robot.speaker.say(channel, payload, SECOND)
    robot.speaker.say(channel, payload[:5000], 2 * SECOND)  # does not fit its definition
    limit(recording_filled=0.0)
    robot.speaker.say(channel, payload, 3 * SECOND)
    robot.rows()
    query = store.topic("/scan")
    first, second, third = query
    assert first.is_reduced
    assert not third.is_reduced
    assert first.fields["near"] == 2.5
    assert second.fields == {}
    with pytest.raises(PayloadError, match=hashlib.sha256(payload).hexdigest()):
        first.decode()
    with pytest.raises(PayloadError, match="9012 bytes"):
        _ = first.raw
    assert third.raw == payload
    # Answers that are made of payloads have the others, and say how many they lack.
    batches = [batch for batch, _ in query.batches()]
    assert sum(map(len, batches)) == 1
    assert query.counters.reduced == 2
    # Frames have the fields of all, and say how many lack arrays; one had none.
    query = store.topic("/scan")
    assert query.to_pandas()["id"].tolist() == [5, 5]
    assert (query.counters.unreadable, query.counters.lacking) == (1, 1)
    assert store.topic("/scan").fields("near").to_pandas()["near"].dropna().tolist() == [2.5, 2.5]


def test_a_disk_that_has_room_for_little_more(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was flushed is sealed at once, and what was not is in the ledger."""
    robot = Running(store)
    channel = scan_channel()
    for number in range(5):
        robot.speaker.say(channel, scan(number, 400_000))
    wait_for(lambda: robot.recorder._target.capture.writer.written.total() == 5)  # type: ignore[union-attr]
    pwritev = os.pwritev

    def full(fd: int, pieces: list[memoryview], position: int) -> int:
        # As a disk does that has some blocks left: it takes a part first. What the file of the
        # scans gives back then is enough for the end of the first one.
        if Path(f"/proc/self/fd/{fd}").readlink().name == "000000.mcap.open":
            return pwritev(fd, pieces, position)
        if len(pieces[0]) > 4096:
            return pwritev(fd, [pieces[0][:4096]], position)
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(files.system, "pwritev", full)
    for number in range(200):
        robot.speaker.say(channel, scan(number, 400_000))
        if robot.recorder.wait(0.01):
            break
    robot.speaker.say(channel, scan(1, 100))
    (report,) = robot.recorder.stop()
    assert robot.recorder.stopped_for_disk
    assert "no space" in robot.recorder.reason.lower()
    state = robot.recorder.look()
    assert report.failure is None
    assert report.entry.status == "complete"
    lost = sum(row["count"] for row in report.entry.losses)
    assert {row["cause"] for row in report.entry.losses} == {"disk"}
    assert state.lost == {"disk": lost}
    assert report.entry.messages + lost == state.messages
    assert report.entry.messages >= 5
    assert [m.raw for m in store.topic("/scan")][:5] == [scan(n, 400_000) for n in range(5)]
    assert store.verify().findings == []


@pytest.mark.parametrize("room", [0, 1 << 16], ids=["nothing", "an empty segment"])
def test_a_disk_without_room_for_a_message_leaves_no_recording(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    robot, noise = Running(store), random.Random(1)
    pwritev = os.pwritev

    def full(fd: int, pieces: list[memoryview], position: int) -> int:
        if position + len(pieces[0]) <= room or position < room <= len(pieces[0]):
            return pwritev(fd, [pieces[0][: room - position]], position)
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(files.system, "pwritev", full)
        for number in range(200):
            robot.speaker.say(text_channel(), noise.randbytes(3_000_000), number)
            if robot.recorder.wait(0.01):
                break
        with pytest.raises(DiskFullError):
            robot.recorder.stop()
    assert robot.recorder.stopped_for_disk
    store.refresh()
    assert not store.recordings()
    assert not store.directory.ids()


@pytest.mark.mongo
def test_what_no_follower_derives_is_made_later(store: hl.Store) -> None:
    robot = Running(store)
    robot.speaker.say(text_channel(), text("x"), SECOND)
    (report,) = robot.recorder.stop()
    assert (report.entry.messages, report.indexed, report.failure) == (1, 0, None)
    assert store.shared.repairs.indexed == {}
    store.shared.index.connect()
    assert len(documents_of(store, "/chatter")) == 1
    assert store.shared.repairs.indexed == {robot.recorder.name: 1}
    store.directory.change_settings(retention={"quota": "1GB"})
    with pytest.raises(UsageError, match="leave out --no-derive"):
        Running(store)


def test_bounds_of_time_and_number(store: hl.Store) -> None:
    robot = Running(store, replace(FREE, duration_s=1.0))
    robot.speaker.say(text_channel(), text("x"))
    wait_for(lambda: robot.recorder.look() and robot.recorder.wait(0))
    assert robot.recorder.stop()[0].entry.messages == 1
    robot = Running(store, replace(FREE, max_messages=4))
    for number in range(100):
        robot.speaker.say(scan_channel(), scan(number, 288))
    assert robot.recorder.wait(0)
    assert robot.recorder.stop()[0].entry.messages == 4


def test_a_number_of_more_than_32_bits_is_kept_by_its_lower_ones(store: hl.Store) -> None:
    running = Running(store)
    assert running.speaker.sink is not None
    for number in (7, (1 << 32) + 8, (1 << 40) - 1, None):
        running.speaker.sink.take(
            text_channel(), text("x"), received=time.time_ns(), sequence=number
        )
    (report,) = running.recorder.stop()
    assert report.entry.messages == 4
    assert len(report.entry.channels) == 1  # as of a publisher that connects again
    assert not report.entry.losses
    with places.segment(store.directory.path, report.entry.name).open("rb") as file:
        found = [m.sequence for _, _, m in make_reader(file).iter_messages()]
    assert found == [7, 8, 0xFFFFFFFF, 0]


@pytest.mark.parametrize("place", ["before the chunks", "before the disk"])
def test_a_recorder_that_writes_nothing_is_stalled(
    store: hl.Store, calls: Calls, limit: Limit, place: str
) -> None:
    limit(slow_write_s=0.1)
    robot = Running(store, replace(FREE, flush_interval_s=0.05))
    wait_for(lambda: not robot.recorder.look().stalled_s)
    blocked = threading.Event()
    owner, name = RecordingWriter, "append"
    if place == "before the disk":
        owner, name = append_file.AppendFile, "append"
    calls(owner, name, lambda *_: blocked.wait())
    for number in range(30):
        robot.speaker.say(text_channel(), text(str(number)))
    wait_for(lambda: robot.recorder.look().stalled_s)
    blocked.set()
    wait_for(lambda: not robot.recorder.look().stalled_s)
    robot.recorder.stop()
    assert store.topic("/chatter").count() == 30


def test_a_source_that_cannot_work_leaves_nothing(store: hl.Store) -> None:
    def fail(_: object) -> None:
        raise SourceError("no such robot")

    speaker = Speaker(fail)
    recorder = Recorder(store, [speaker], FREE, print)
    with pytest.raises(SourceError, match="no such robot"):
        recorder.start()
    assert speaker.stopped == 1
    store.refresh()
    assert store.recordings() == []
    assert running(store.directory) == {}


@pytest.mark.parametrize(
    ("is_reached", "is_marked", "recordings"),
    [(False, False, 0), (True, False, 1), (False, True, 1)],
)
def test_a_try_that_reached_nobody_leaves_nothing(
    store: hl.Store, is_reached: bool, is_marked: bool, recordings: int
) -> None:
    running = Running(store)
    running.speaker.was_reached = is_reached
    if is_marked:
        running.mark("here", {})
    assert len(running.recorder.stop()) == recordings
    store.refresh()
    assert len(store.recordings()) == recordings
    assert len(places.folders(store.directory.path)) == recordings


def test_visitors(store: hl.Store) -> None:
    one, other = Running(store), Running(store)
    here = store.directory.path
    for each in (one, other):
        each.recorder.look()
    ids = {name: recorder for recorder, name in running(store.directory).items()}
    assert ids.keys() == {one.recorder.name, other.recorder.name}
    name = ids[one.recorder.name]
    assert choose(store.directory, [one.recorder.name]) == choose(store.directory, [name]) == [name]
    with pytest.raises(UsageError, match="Several recorders"):
        choose(store.directory, [])
    with pytest.raises(UsageError, match="is no running recorder"):
        choose(store.directory, ["nothing"])
    one.speaker.say(text_channel(), text("a"))
    one.recorder.look()
    state = read(here, name)
    assert state.topics[0].messages == 1
    assert state.taken == {"/chatter": 1}
    assert state.hz > 0
    # A recorder that was killed leaves what it said; what is no recorder's is none.
    (here / "recorders" / "20200101-killed-0123456789abcdef.json").write_text("{}")
    (here / "recorders" / f"{other.recorder._target.id}.json").write_text("[" * 100_000)
    with pytest.raises(StoreError, match="has not said"):
        read(here, other.recorder._target.id)
    one.recorder.stop()
    with pytest.raises(StoreError, match="has not said"):
        read(here, name)
    assert [*running(store.directory).values()] == [other.recorder.name]
    other.recorder.look()
    other.recorder.stop()


def test_a_mark_that_is_no_text(store: hl.Store) -> None:
    robot = Running(store)
    robot.mark("bad\udcff\udcfebytes", {"a": "\udc80"})
    robot.rows()
    (message,) = store.topic(MARKS)
    assert json.loads(bytes(message.raw)) == {"text": r"bad\xff\xfebytes", "tags": {"a": r"\x80"}}


def test_the_reserve_holds_for_what_waits_in_memory(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch, limit: Limit
) -> None:
    limit(recording_filled=0.5)
    disk = shutil.disk_usage("/")._replace(free=150 << 20)
    monkeypatch.setattr(recorder_module.shutil, "disk_usage", lambda _: disk)
    robot = Running(store, replace(FREE, reserve_bytes=100 << 20, budget_bytes=64 << 20))
    robot.recorder.look()
    assert not robot.recorder.wait(0)
    robot.rows()
    robot = Running(store, replace(FREE, budget_bytes=512 << 20))
    robot.recorder.look()
    assert "only 157.3 MB left: free some." in robot.recorder.reason
    assert robot.recorder.stop() == []
    robot = Running(store, replace(FREE, reserve_bytes=120 << 20, budget_bytes=64 << 20))
    robot.recorder.look()
    robot.speaker.say(text_channel(), text("a"))
    assert robot.recorder.wait(0)
    assert robot.recorder.look().lost == {"disk": 1}
    assert robot.recorder.stopped_for_disk
    assert "only 157.3 MB left: free some, or lower --reserve." in robot.recorder.reason
    assert robot.recorder.stop() == []


def test_a_standard_type_without_its_definition(store: hl.Store) -> None:
    robot = Running(store)
    bare = Channel("/chatter", "ros1", Schema("std_msgs/String", "", b""))
    odd = Channel("/odd", "ros1", Schema("std_msgs/String", "", b""), {"md5sum": "1" * 32})
    for number in range(3):
        robot.speaker.say(bare, text(str(number)), SECOND + number)
        robot.speaker.say(odd, text(str(number)), SECOND + number)
    robot.recorder.stop()
    assert store.topic("/chatter").to_arrow()["data"].to_pylist() == ["0", "1", "2"]
    channels = {c.topic: c for c in store.entry(robot.recorder.name).channels}
    assert channels["/chatter"].metadata[SUPPLIED] == "noetic, fits the messages"
    reasons = unindexed(store.session.definitions(store.entry(robot.recorder.name)))
    assert "no definition in the source" in reasons[channels["/odd"].id]


def test_fields_land_when_no_payload_finds_room(store: hl.Store, calls: Calls) -> None:
    """Whatever their priority: three large messages are more than the budget.

    What does not land is counted.
    """
    blocked = block_writing(calls)
    rules = [priority_rule(f"/{word}", word) for word in ("low", "normal", "high")]
    options = replace(FREE, budget_bytes=4 << 20, priorities=rules)
    robot = Running(store, options)
    for number in range(10):
        for rule in rules:
            robot.speaker.say(scan_channel(rule.pattern), scan(number, 3_000_000))
    for _ in range(2000):
        robot.speaker.say(text_channel(), text("x" * 4000))
    blocked.set()
    rows = robot.rows()
    lost = rows.pop(("/chatter", "queue"))
    assert {cause for _, cause in rows} == {"degrade"}
    kept = in_segments(store, robot.recorder.name)
    assert 0 < lost == 2000 - kept["/chatter", "ros1"] < 2000
    for rule in rules:
        assert kept[rule.pattern, "ros1"] + rows[rule.pattern, "degrade"] == 10
        assert kept[rule.pattern, "hybridlog.reduced"] == rows[rule.pattern, "degrade"]


@given(
    source_hz=st.floats(1, 2000),
    wanted_hz=st.floats(0.1, 2000),
    seconds=st.integers(2, 10),
    jitter=st.floats(0, 0.2),
    seed=st.integers(0, 1000),
)
def test_a_throttle_gives_the_rate_that_is_wanted(
    source_hz: float, wanted_hz: float, seconds: int, jitter: float, seed: int
) -> None:
    throttle = Throttle(wanted_hz)
    period, shake = SECOND / source_hz, random.Random(seed)
    times = [
        round(SECOND + (n + jitter * (shake.random() - 0.5)) * period)
        for n in range(int(seconds * source_hz))
    ]
    kept = [t for t in times if throttle.lets_through(t)]
    # Never more than wanted, but for what lets jitter pass; never two of them close together.
    assert len(kept) <= wanted_hz * seconds * 1.01 + 2
    interval = SECOND / wanted_hz
    assert all(b - a >= interval / 2 - period for a, b in pairwise(kept))
    # And as many as there can be: the source's own rate, or what an even thinning leaves.
    if source_hz <= wanted_hz * 0.99:
        assert len(kept) == len(times)
    else:
        assert len(kept) >= min(wanted_hz, source_hz) * seconds * 0.49 - 2


def test_a_clock_that_is_set_back_does_not_silence_a_topic() -> None:
    throttle = Throttle(1)
    assert throttle.lets_through(1_000_000 * SECOND)
    assert throttle.lets_through(10 * SECOND)
    assert not throttle.lets_through(10 * SECOND + 1000)
    assert throttle.lets_through(11 * SECOND)


def test_rules() -> None:
    rules = [throttle_rule("/camera/**", "5Hz"), throttle_rule("image_raw", " 0.5 hz")]
    assert first_fit(rules, "/camera/image_raw") == 5
    assert first_fit(rules, "/front/image_raw") == 0.5
    assert first_fit(rules, "/scan") is None
    assert first_fit([priority_rule("scan", "HIGH")], "/base/scan") == WHOLE_BELOW["high"]

    for rate in ("", "-1", "0", "0Hz", "1e400", "nan", "5 kHz"):
        with pytest.raises(UsageError, match="is no rate"):
            throttle_rule("/scan", rate)
    with pytest.raises(TopicError):
        priority_rule("re:(", "low")
