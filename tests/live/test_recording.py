"""Recordings that messages are written to as they come."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

import hybridlog as hl
from hybridlog.live import LiveRecording
from hybridlog_storage import append_file
from hybridlog_storage.errors import DiskFullError, UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segment_writer import RecordingWriter, SegmentSettings
from tests.test_faults import kill_mongod, wait_for

TEXT = Schema("std_msgs/String", "ros1msg", b"string data\n")
Seen = tuple[str, int, int, bytes]


def channel(topic: str) -> Channel:
    return Channel(topic, "ros1", TEXT)


def text(content: bytes) -> bytes:
    return len(content).to_bytes(4, "little") + content


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True, require_database=True) as opened:
        yield opened


def in_segments(store: hl.Store, recording: str) -> list[Seen]:
    """What the official reader finds, in file order."""
    found = []
    for path in sorted(store.directory.recording(recording).glob("*.mcap")):
        with path.open("rb") as stream:
            for _, about, message in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            ):
                found.append((about.topic, message.log_time, message.sequence, message.data))
    return found


def test_many_threads_one_recording(store: hl.Store) -> None:
    sizes = [0, 10, 3000, 200_000, 1_000_000]
    written: list[list[Seen]] = [[] for _ in range(6)]

    def speak(number: int, recording: LiveRecording) -> None:
        own = channel(f"/topic{number}")
        for i in range(30):
            payload = text(bytes([i]) * sizes[(i + number) % len(sizes)])
            recording.write(own, payload, log_time=10**18 + i, sequence=i)
            written[number].append((own.topic, 10**18 + i, i, payload))

    # The budget is far below what is written, so writers have to wait.
    with store.start("talk", budget_bytes=2 << 20, tags={"who": "six"}) as recording:
        threads = [threading.Thread(target=speak, args=(n, recording)) for n in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    report = recording.close()
    assert (report.indexed, report.missed, report.failure) == (180, 0, None)
    assert report.entry.status == "complete"
    assert report.entry.tags == {"who": "six"}
    assert Counter(in_segments(store, recording.id)) == Counter(m for one in written for m in one)
    for number in range(6):
        fetched = store.topic(f"/topic{number}")
        assert [(m.log_time_ns, m.raw) for m in fetched] == [
            (when, payload) for _, when, _, payload in written[number]
        ]
    assert store.verify().findings == []


def test_while_nothing_is_laid_down_the_budget_is_still_taken(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    go_on = threading.Event()
    append_one = RecordingWriter.append_one

    def wait(writer: RecordingWriter, *arguments: Any) -> None:
        assert go_on.wait(60)
        append_one(writer, *arguments)

    monkeypatch.setattr(RecordingWriter, "append_one", wait)
    refused = [0] * 5
    payload = text(bytes(100_000))

    def speak(number: int, recording: LiveRecording) -> None:
        own = channel(f"/topic{number}")
        for i in range(20):
            refused[number] += not recording.write(own, payload, sequence=i, wait=False)

    # A disk that stands still. From half of the budget on writers give way to the thread
    # that waits for it, but not for long, and nothing is refused before the budget is spent.
    with store.start("talk", budget_bytes=8 << 20) as recording:
        threads = [threading.Thread(target=speak, args=(n, recording)) for n in range(5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert 0.98 < recording.filled <= 1
        assert sum(refused) == 100 - (8 << 20) // len(payload)
        go_on.set()
        wait_for(lambda: recording.filled == 0)
    report = recording.close()
    assert (report.indexed, report.missed, report.failure) == (100 - sum(refused), 0, None)


def test_what_is_written_can_be_asked_for_while_it_goes_on(store: hl.Store) -> None:
    own = channel("/talk")
    with store.start("talk", flush_interval_s=0.2) as recording:
        recording.write(own, text(b"first"))
        assert store.database is not None
        wait_for(lambda: store.database and store.database.count("talk", {"data": "first"}))
        recording.write(own, text(b"second"))
        wait_for(lambda: store.database and store.database.count("talk", {}) == 2)


def test_the_index_falls_behind_and_catches_up(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy = True
    monkeypatch.setattr(LiveRecording, "_is_under", lambda *_: busy)
    own = channel("/talk")
    payloads = [text(os.urandom(50_000)) for _ in range(40)]
    settings = SegmentSettings(chunk_size=100_000, segment_size=1_000_000)
    with store.start("talk", settings=settings, flush_interval_s=0.2) as recording:
        for number, payload in enumerate(payloads):
            recording.write(own, payload, log_time=number)
        wait_for(lambda: len(in_segments_so_far(store, recording.id)) >= 2)
        assert store.database is not None
        assert store.database.count("talk", {}) == 0
        # Chunks of segments that were sealed meanwhile are read back as well.
        busy = False
    assert recording.close().indexed == 40
    assert [m.raw for m in store.topic("/talk")] == payloads
    assert store.verify().findings == []


def in_segments_so_far(store: hl.Store, recording: str) -> list[Path]:
    return list(store.directory.recording(recording).glob("*.mcap"))


def test_mongod_killed_while_messages_come(store: hl.Store) -> None:
    own = channel("/talk")
    with store.start("talk", flush_interval_s=0.1) as recording:
        for number in range(2000):
            recording.write(own, text(b"%d" % number))
            if number == 500:
                time.sleep(0.5)
                kill_mongod(store.directory.path)
    report = recording.close()
    assert (report.failure, report.missed, report.indexed) == (None, 0, 2000)
    assert store.topic("/talk").where("data == '1999'").count() == 1
    assert store.verify().findings == []


def test_a_full_disk(store: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    own = channel("/talk")
    recording = store.start("talk", flush_interval_s=0.1)
    recording.write(own, text(b"kept"))
    wait_for(lambda: store.database and store.database.count("talk", {}) == 1)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(append_file.os, "pwritev", full)
        patch.setattr("hybridlog_storage.durability.os.writev", full)

        def until_refused() -> None:
            while True:
                recording.write(own, text(b"lost" * 10_000))

        with pytest.raises(DiskFullError, match="Free some space"):
            until_refused()
        with pytest.raises(DiskFullError):
            recording.close()
    with pytest.raises(DiskFullError):
        recording.write(own, b"")
    with hl.open(store.directory.path) as again:
        assert [m.raw for m in again.topic("/talk")] == [text(b"kept")]
        assert again.recordings()[0].status == "recovered"


def test_no_mistake_of_ours_is_silent(store: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    recording = store.start("talk", budget_bytes=1 << 20)
    monkeypatch.setattr("hybridlog_storage.segment_writer.RecordingWriter.append_one", broken)
    own = channel("/talk")

    def until_refused() -> None:
        while True:
            recording.write(own, text(b"x" * 100_000))

    with pytest.raises(ZeroDivisionError):
        until_refused()
    with pytest.raises(ZeroDivisionError):
        recording.close()


KILLED = """
import sys, time
import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema

own = Channel("/talk", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\\n"))
with hl.open(sys.argv[1], create=True) as store:
    recording = store.start("talk", flush_interval_s=0.2)
    for number in range(10**9):
        recording.write(own, (8).to_bytes(4, "little") + b"%8d" % number, log_time=time.time_ns())
        if number % 100 == 0:
            print(number, time.time_ns(), flush=True)
        time.sleep(0.0001)
"""


def test_kill_costs_no_more_than_the_flush_interval(tmp_path: Path) -> None:
    place = tmp_path / "store"
    process = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(place)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        said = [process.stdout.readline().split() for _ in range(60)]
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert process.stdout is not None
        process.stdout.close()
    last_ns = int(said[-1][1])
    with hl.open(place, require_database=True) as store:
        found = [m.log_time_ns for m in store.topic("/talk")]
        numbers = [int(m.raw[4:]) for m in store.topic("/talk")]
        assert numbers == list(range(len(numbers)))
        # On a busy machine threads wait, too; what matters is that it is not all.
        assert last_ns - found[-1] < 2_000_000_000
        assert store.verify().findings == []


def test_misuse(store: hl.Store) -> None:
    own = channel("/talk")
    recording = store.start("talk")
    for wrong in ({"log_time": -1}, {"publish_time": 1 << 63}, {"sequence": 1 << 32}):
        with pytest.raises(UsageError, match="out of its range"):
            recording.write(own, b"", **wrong)
    recording.close()
    assert recording.close() is recording.close()
    with pytest.raises(UsageError, match="was closed"):
        recording.write(own, b"")
    with pytest.raises(UsageError, match="memory budget"):
        store.start("talk", budget_bytes=10)
    with pytest.raises(UsageError, match="flush interval"):
        store.start("talk", flush_interval_s=0)


def test_abort_leaves_nothing(store: hl.Store) -> None:
    recording = store.start("talk")
    recording.write(channel("/talk"), text(b"gone"))
    recording.abort()
    assert store.directory.recording_ids() == []
    store.refresh()
    assert store.recordings() == []


def test_an_error_in_the_block_keeps_what_came(store: hl.Store) -> None:
    def speak() -> None:
        with store.start("talk") as recording:
            recording.write(channel("/talk"), text(b"kept"))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        speak()
    assert store.topic("/talk").count() == 1


def test_a_mongod_that_dies_is_started_again_and_the_index_catches_up(store: hl.Store) -> None:
    """Not at the end only: a recording may go on for hours."""
    speech = channel("/speech")
    with store.start("talk") as recording:
        recording.write(speech, text(b"before"), log_time=1)
        wait_for(lambda: recording.lag == 0 and recording.stored[0] == 1)
        kill_mongod(store.directory.path)
        recording.write(speech, text(b"while"), log_time=2)
        wait_for(lambda: recording.index_failure is not None)
        assert recording.lag == 1
        wait_for(lambda: recording.index_failure is None and recording.lag == 0)
        recording.write(speech, text(b"after"), log_time=3)
        report = recording.close()
    assert report.failure is None
    assert (report.indexed, report.missed) == (3, 0)
    assert store.topic("/speech").where("data == 'while'").count() == 1
    assert not store.verify().findings


def test_a_mongod_that_stands_still_costs_nothing(store: hl.Store) -> None:
    speech = channel("/speech")
    pid = int(json.loads((store.directory.mongod / "mongod.json").read_text())["mongod"])
    with store.start("talk") as recording:
        recording.write(speech, text(b"0"), log_time=1)
        wait_for(lambda: recording.lag == 0 and recording.stored[0] == 1)
        os.kill(pid, signal.SIGSTOP)
        try:
            started = time.monotonic()
            for number in range(2, 200):
                assert recording.write(speech, text(b"x"), log_time=number, wait=False)
                time.sleep(0.01)
            assert time.monotonic() - started < 20
            wait_for(lambda: recording.stored[0] == 199)
            assert recording.lag > 0
        finally:
            os.kill(pid, signal.SIGCONT)
        wait_for(lambda: recording.lag == 0)
    assert store.topic("/speech").count() == 199


def test_a_recording_of_more_chunks_than_are_kept_is_counted_whole(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hybridlog.indexing._MOST_LATEST", 2)
    settings = SegmentSettings(chunk_size=1 << 12)
    recording = store.start("many", settings=settings)
    own = channel("/talk")
    for number in range(100):
        recording.write(own, text(b"x" * 2000), log_time=10**18 + number)
    report = recording.close()
    (found,) = report.entry.channels
    assert report.entry.chunks > 20
    assert (found.stats.messages, found.stats.first, found.stats.last) == (100, 10**18, 10**18 + 99)
    assert store.recordings()[0].channels == report.entry.channels
    assert store.verify().findings == []
