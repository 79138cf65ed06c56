"""Logs played as if the robot ran, compared with other people's readers."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from functools import cache
from pathlib import Path

import pytest

from hybridlog.live.sources import replay
from hybridlog.live.sources.base import Cause
from hybridlog.live.sources.replay import ReplaySource
from hybridlog_storage.messages import Channel, Schema
from tests import independent
from tests.calls import Calls
from tests.data import DATA, needs_data
from tests.live.sources.heard import Heard

BEGIN = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
FAST = 1e9


@pytest.fixture(autouse=True)
def _nothing_is_left() -> Iterator[None]:
    yield
    assert [t.name for t in threading.enumerate() if t.name.startswith("hybridlog-replay")] == []


def write(path: Path, messages: Iterable[tuple[str, int, bytes]], sequence: int = 0) -> Path:
    schema = Schema("T", "jsonschema", b"{}")
    channel = cache(lambda topic: Channel(topic, "json", schema))
    rows = [
        (channel(topic), time, payload, time - 5, sequence and sequence + at)
        for at, (topic, time, payload) in enumerate(messages)
    ]
    notes = (0, 0, "notes.txt", "text/plain", b"hello")
    return independent.write_mcap(path, rows, attachments=[notes], chunk_size=1000)


def play(path: Path, heard: Heard, *, speed: float = FAST) -> None:
    with ReplaySource(path, speed=speed) as source:
        source.start(heard)
        heard.until(lambda h: h.ends)


def assert_same(heard: Heard, expected: Sequence[independent.Seen]) -> None:
    """All messages came, byte for byte."""
    got = Counter((taken.channel.topic, taken.payload) for taken in heard.taken)
    assert got == Counter((seen.topic, seen.payload) for seen in expected)


@needs_data
@pytest.mark.parametrize(
    "name",
    [
        "real/tilt_laser.bag",
        "real/ouster.mcap",
        "real/auv_ros2_db3",
        "odd/example-unsorted-chunks.bag",
        "odd/no-messages.bag",
        "odd/rosbag2/split_mcap",
    ],
)
def test_real_logs_come_as_other_readers_see_them(name: str) -> None:
    heard = Heard()
    play(DATA / name, heard)
    expected = independent.read(DATA / name)
    assert_same(heard, expected)
    assert heard.losses == []
    assert heard.ends == [""]
    came = {topic for topic, _ in heard.came}
    gone = {*heard.gone}
    assert came == gone >= {seen.topic for seen in expected}


@needs_data
@pytest.mark.parametrize(
    ("name", "messages"),
    [("tilt_trunc60.bag", 2469), ("ouster_zstd_bitflip.mcap", 100), ("lidar_trunc50.db3", 217)],
)
def test_what_cannot_be_read_is_a_row(name: str, messages: int) -> None:
    heard = Heard()
    play(DATA / "damaged" / name, heard)
    assert len(heard.taken) == messages
    assert heard.ends == [""]
    told = [lost.reason for lost in heard.losses] + heard.said
    assert any(name in line for line in told)
    for lost in heard.losses:
        assert (lost.topic, lost.cause) == ("", Cause.UNREADABLE)
        assert lost.count != 0
    if name == "tilt_trunc60.bag":
        assert heard.losses
        assert any(", byte " in lost.reason for lost in heard.losses)


def test_times_and_numbers_are_those_of_the_log(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [("/a", BEGIN + at, b"%d" % at) for at in range(5)], 7)
    heard = Heard()
    before = time.time_ns()
    play(path, heard)
    after = time.time_ns()
    assert heard.payloads() == [b"0", b"1", b"2", b"3", b"4"]
    assert [taken.sent for taken in heard.taken] == [BEGIN + at - 5 for at in range(5)]
    assert [taken.sequence for taken in heard.taken] == [7, 8, 9, 10, 11]
    assert all(before <= taken.received <= after for taken in heard.taken)
    assert len({id(taken.channel) for taken in heard.taken}) == 1
    assert heard.topics == [("/a", "T"), ("/a",)]
    unnumbered = Heard()
    play(write(tmp_path / "b.mcap", [("/a", BEGIN, b"x")]), unnumbered)
    assert unnumbered.taken[0].sequence is None


class Clock(threading.Event):
    """A clock that advances only while the player waits for it."""

    now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def time_ns(self) -> int:
        return int(self.now * SECOND)

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        self.now += timeout
        return self.is_set()


def play_by(
    clock: Clock, path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch, speed: float
) -> None:
    with monkeypatch.context() as patch, ReplaySource(path, speed=speed) as source:
        patch.setattr(replay, "time", clock)
        source._stopping = clock
        source.start(heard)
        heard.until(lambda h: h.ends)


@pytest.mark.parametrize("speed", [1.0, 2.5])
def test_nothing_comes_before_its_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, speed: float
) -> None:
    offsets = [0.0, 0.0, 0.05, 0.1, 0.1004, 0.1007, 0.3, 5000.0]
    log = [("/a", BEGIN + int(offset * SECOND), b"x") for offset in offsets]
    path = write(tmp_path / "a.mcap", log)
    clock, heard = Clock(), Heard()
    began = clock.now
    play_by(clock, path, heard, monkeypatch, speed)
    assert len(heard.taken) == len(offsets)
    for taken, offset in zip(heard.taken, offsets, strict=True):
        late = taken.received / SECOND - (began + offset / speed)
        assert -1e-6 <= late <= replay._MIN_PAUSE_S + 1e-6


def test_what_is_late_in_the_log_is_no_lateness_of_ours(tmp_path: Path) -> None:
    hour = 3600 * SECOND
    times = [BEGIN + hour, BEGIN + hour + 1, BEGIN, BEGIN + hour + 2]
    path = write(tmp_path / "a.mcap", [("/a", at, bytes(1000)) for at in times])
    heard = Heard()
    play(path, heard, speed=1.0)
    assert [taken.sent for taken in heard.taken] == [at - 5 for at in times]
    assert heard.said == []


def test_only_what_is_wanted_is_played(tmp_path: Path) -> None:
    log = [(topic, BEGIN + at, b"x") for at in range(10) for topic in ("/a", "/b")]
    path = write(tmp_path / "a.mcap", log)
    asked: list[tuple[str, str]] = []
    heard = Heard(lambda topic, kind: bool(asked.append((topic, kind))) or topic == "/b")
    play(path, heard)
    assert {taken.channel.topic for taken in heard.taken} == {"/b"}
    assert len(heard.taken) == 10
    assert asked == [("/a", "T"), ("/b", "T")]
    assert heard.topics == [("/b", "T"), ("/b",)]


def test_what_is_not_wanted_takes_its_time_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = [("/a", BEGIN, b"x"), ("/b", BEGIN + SECOND // 5, b"y")]
    path = write(tmp_path / "a.mcap", log)
    for topic in ("/a", "/c"):
        heard = Heard(lambda name, _, topic=topic: name == topic)  # type: ignore[misc]
        clock = Clock()
        began = clock.now
        play_by(clock, path, heard, monkeypatch, speed=1.0)
        assert clock.now == pytest.approx(began + 0.2, abs=replay._MIN_PAUSE_S)
        assert heard.ends == [""]


def test_a_sink_that_fails_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, calls: Calls
) -> None:
    seen: list[object] = []
    monkeypatch.setattr(threading, "excepthook", lambda given: seen.append(given.exc_value))
    path = write(tmp_path / "a.mcap", [("/a", BEGIN, b"x")])

    heard = Heard()
    calls.fail(heard, "take", RuntimeError("no more"))
    with ReplaySource(path) as source:
        source.start(heard)
        heard.until(lambda h: h.ends)
    assert "no more" in heard.ends[0]
    assert len(seen) == 1
