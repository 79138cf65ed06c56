"""Recordings that messages are written to as they come."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections import Counter
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import hybridlog as hl
from hybridlog.live import LiveRecording
from hybridlog_storage.disk.files import System
from hybridlog_storage.errors import DatabaseError, DiskFullError, UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.index_documents import collection_of
from hybridlog_storage.segments.segment_file import SegmentFile
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings
from tests import places
from tests.calls import Calls
from tests.indexed import misindexed
from tests.live.sources.heard import must_return
from tests.live.speaker import TEXT, text, wait_until_flushed
from tests.test_faults import kill_mongod
from tests.waiting import at_once, wait_for

Seen = tuple[str, int, int, bytes]


def channel(topic: str) -> Channel:
    return Channel(topic, "ros1", TEXT)


def in_segments(store: hl.Store, recording: str) -> list[Seen]:
    """What the official reader finds, in file order."""
    found = []
    for path in sorted(places.folder(store.directory.path, recording).glob("*.mcap")):
        with path.open("rb") as stream:
            for _, about, message in make_reader(stream, validate_crcs=True).iter_messages(
                log_time_order=False
            ):
                found.append((about.topic, message.log_time, message.sequence, message.data))
    return found


@pytest.mark.mongo
def test_many_threads_one_recording(store: hl.Store) -> None:
    sizes = [0, 10, 3000, 200_000, 1 << 20]
    written: list[list[Seen]] = [[] for _ in range(6)]

    def speak(number: int, recording: LiveRecording) -> None:
        own = channel(f"/topic{number}")
        for i in range(30):
            payload = text(bytes([i]) * sizes[(i + number) % len(sizes)])
            recording.write(own, payload, log_time=10**18, sequence=i)
            written[number].append((own.topic, 10**18, i, payload))

    # The budget is far below what is written, so writers have to wait.
    with store.start("talk", budget_bytes=2 << 20, tags={"who": "six"}) as recording:
        at_once(*(partial(speak, n, recording) for n in range(6)))
    report = recording.close()
    assert (report.indexed, report.missed, report.failure) == (180, 0, None)
    assert report.entry.status == "complete"
    assert report.entry.tags == {"who": "six"}
    assert Counter(in_segments(store, recording.name)) == Counter(m for one in written for m in one)
    for number in range(6):
        found = [m for m in in_segments(store, recording.name) if m[0] == f"/topic{number}"]
        assert found == written[number]
        assert [m.raw for m in store.topic(f"/topic{number}")] == [one[-1] for one in found]
    assert store.verify().findings == []
    assert misindexed(store) == {}


@pytest.mark.parametrize("size", [100_000, 10_000])
def test_while_the_disk_stands_still_the_budget_is_still_taken(
    store: hl.Store, calls: Calls, size: int
) -> None:
    go_on = threading.Event()
    calls(SegmentFile, "append_chunk", lambda *_: go_on.wait(60) or pytest.fail("waited in vain"))
    budget, settings = 8 << 20, SegmentSettings(chunk_size=1 << 19)
    written: list[list[bytes]] = [[] for _ in range(5)]
    refused = [0] * 5

    def speak(number: int, recording: LiveRecording) -> None:
        own = channel(f"/topic{number}")
        for i in range(budget // size // 2):
            payload = text(bytes([i % 251]) * size)
            if recording.write(own, payload, sequence=i, wait=False):
                written[number].append(payload)
            else:
                refused[number] += 1

    with store.start("talk", budget_bytes=budget, settings=settings) as recording:
        at_once(*(partial(speak, n, recording) for n in range(5)))
        filled = recording.filled
        go_on.set()
        wait_for(lambda: recording.filled == 0)
    recording.close()
    assert 0.95 < filled <= 1
    taken = sum(len(payload) for one in written for payload in one)
    assert budget * 0.9 < taken <= budget
    assert any(refused)
    for number in range(5):
        if written[number]:  # one may have come when others had taken all the room
            assert [m.raw for m in store.topic(f"/topic{number}")] == written[number]
    assert store.verify().findings == []


INTERRUPTED = """
import signal, sys
import hybridlog as hl
from hybridlog_storage.messages import Batch, Channel, Schema

own = Channel("/talk", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\\n"))
sizes = [10, 140_000, 10, 100, 3000]
payloads = [
    (size := sizes[n % 5]).to_bytes(4, "little") + bytes([n % 251]) * size for n in range(1255)
]
written = interrupted = 0
writing = False

def interrupt(*_):
    if writing:
        raise KeyboardInterrupt
    signal.setitimer(signal.ITIMER_REAL, 0.0005)  # it came too early, and none would follow

signal.signal(signal.SIGALRM, interrupt)
with hl.open(sys.argv[1], create=True) as store:
    with store.start("talk") as recording:
        while interrupted < 4:
            signal.setitimer(signal.ITIMER_REAL, 0.0005 + interrupted * 0.00002)
            try:
                writing = True
                while True:
                    recording.write(own, payloads[written % 1255], sequence=written)
                    written += 1
            except KeyboardInterrupt:
                writing = False
                interrupted += 1
    found = list(store.topic("/talk"))
    numbers = [message.sequence for message in found]
    assert numbers == sorted(numbers)
    # One whose writing was interrupted may be in it, and once more when it was tried again.
    assert set(range(written)) <= set(numbers) <= set(range(written + 1))
    assert len(numbers) <= written + interrupted
    assert all(message.raw == payloads[message.sequence % 1255] for message in found)
    assert store.verify().findings == []
print("whole after", interrupted)
"""


def test_an_interruption_leaves_no_half_message(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, str(tmp_path / "store")],
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert (done.stdout, done.stderr) == ("whole after 4\n", "")


def test_a_full_disk(store: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    own = channel("/talk")
    recording = store.start("talk", flush_interval_s=0.1)
    recording.write(own, text(b"kept"))
    wait_until_flushed(store, 1)

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(System, "pwritev", full)
        patch.setattr(System, "writev", full)

        def until_refused() -> None:
            while True:
                recording.write(own, text(b"lost" * 10_000))

        taken = 1
        with pytest.raises(DiskFullError, match="Free some space"):
            until_refused()
        with pytest.raises(DiskFullError):
            recording.close()
    with pytest.raises(DiskFullError):
        recording.write(own, b"")
    with hl.open(store.directory.path) as again:
        assert [m.raw for m in again.topic("/talk")] == [text(b"kept")]
        again.shared.recover()
        (entry,) = again.recordings()
        assert entry.status == "recovered"
        assert sum(row["count"] for row in entry.losses) == taken - 1


def test_misuse(store: hl.Store) -> None:
    own = channel("/talk")
    recording = store.start("talk")
    for wrong in ({"log_time": -1}, {"publish_time": 1 << 63}, {"sequence": 1 << 32}):
        with pytest.raises(UsageError, match="out of range"):
            recording.write(own, b"", **wrong)
    recording.close()
    with pytest.raises(UsageError, match="was closed"):
        recording.write(own, b"")
    with pytest.raises(UsageError, match="memory budget"):
        store.start("talk", budget_bytes=10)
    with pytest.raises(UsageError, match="flush interval"):
        store.start("talk", flush_interval_s=0)


def test_what_is_no_message_is_refused_at_once_and_costs_nothing(store: hl.Store) -> None:
    own, large = channel("/talk"), b"x" * (1 << 17)
    recording: Any = store.start("talk")
    with closing(recording):
        recording.write(own, text(b"before"), log_time=1)
        wide = memoryview(bytes(8)).cast("H")
        table = memoryview(bytes(8)).cast("B", (2, 4))
        for wrong in ("text", None, 5, [1, 2], wide, table, memoryview(large)[::2]):
            with pytest.raises(UsageError, match="payload of a message"):
                recording.write(own, wrong, log_time=2)
        for numbers in ({"log_time": 1.5e9}, {"publish_time": "1"}, {"sequence": None}):
            for payload in (b"", large):
                with pytest.raises(UsageError, match="must be integers"):
                    recording.write(own, payload, **numbers)
        with pytest.raises(UsageError, match="'/talk' is not a Channel"):
            recording.write("/talk", b"")
        for number, memory in enumerate((bytearray, memoryview, bytes)):
            recording.write(own, memory(text(b"after")), log_time=np.int64(3 + number))
    assert [s[1] for s in in_segments(store, recording.name)] == [1, 3, 4, 5]
    assert store.topic("/talk").where("data == 'after'").count() == 3


@pytest.mark.parametrize(
    "bad",
    [
        Channel("/a\udc80", "ros1", TEXT),
        Channel(None, "ros1", TEXT),  # type: ignore[arg-type]
        Channel("/a", "ros1", TEXT, {"callerid": "\udc80"}),
        Channel("/a", "ros1", TEXT, {"latching": 5}),  # type: ignore[dict-item]
        Channel("/a", "ros1", TEXT, None),  # type: ignore[arg-type]
        Channel("/a", "ros1", "std_msgs/String"),  # type: ignore[arg-type]
        Channel("/a", "ros1", Schema("\udc80", "ros1msg", b"")),
        Channel("/a", "ros1", Schema("a/B", "ros1msg", "string data")),  # type: ignore[arg-type]
        Channel("/a", "ros1", Schema("a/B", "ros1msg", bytearray(b""))),  # type: ignore[arg-type]
        ["/a"],
    ],
)
def test_a_channel_that_cannot_be_stored_does_no_harm(store: hl.Store, bad: Any) -> None:
    with store.start("talk") as recording:
        recording.write(channel("/talk"), text(b"before"))
        with pytest.raises(UsageError, match=r"/a|None") as caught:
            recording.write(bad, text(b"bad"))
        str(caught.value).encode()
        recording.write(channel("/talk"), text(b"after"))
    assert [m.raw for m in store.topic("/talk")] == [text(b"before"), text(b"after")]


def test_memory_that_a_message_lies_in_is_held_until_it_is_laid_down(store: hl.Store) -> None:
    reused = bytearray(text(b"one"))
    released = memoryview(text(b"two"))
    with store.start("talk", budget_bytes=2 << 20) as recording:
        recording.write(channel("/talk"), reused)
        recording.write(channel("/talk"), released)
        released.release()
        with pytest.raises(BufferError):
            reused.clear()
        wait_for(lambda: recording.stored[0] == 2)
        wait_for(lambda: not recording._inbox)
    assert [m.raw for m in store.topic("/talk")] == [text(b"one"), text(b"two")]


def test_it_is_closed_once_whoever_else_closes_it(store: hl.Store) -> None:
    recording = store.start("talk")
    for i in range(40):
        recording.write(channel("/talk"), text(b"x" * 300_000), log_time=i)
    reports: list[Any] = []
    at_once(*[lambda: reports.append(recording.close())] * 4)
    assert reports == [recording.close()] * 4
    assert store.topic("/talk").count() == 40


def test_who_closes_it_while_the_same_thread_does_is_told(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the handler of a signal may; what comes of it is left to whoever opens the store."""
    recording = store.start("talk")
    recording.write(channel("/talk"), text(b"kept"))
    wait_until_flushed(store, 1)
    monkeypatch.setattr(recording.capture, "close", recording.close)
    with recording:
        for _ in range(2):
            with pytest.raises(UsageError, match="is being closed, or closing it was interrupted"):
                recording.close()
    with pytest.raises(UsageError, match="interrupted"):
        recording.abort()
    with hl.open(store.directory.path) as again:
        assert [m.raw for m in again.topic("/talk")] == [text(b"kept")]
        again.verify(repair=True)
        assert again.verify().findings == []


def test_a_store_that_is_closed_ends_its_recordings(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        store.start("talk").write(channel("/talk"), text(b"kept"))
    with hl.open(tmp_path / "store", mongo="none") as store:
        assert store.entry("talk").status == "complete"
        assert [m.raw for m in store.topic("/talk")] == [text(b"kept")]


@pytest.mark.mongo
def test_a_database_that_refuses_to_the_end_leaves_what_segments_know(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = channel("/talk")
    recording = store.start("talk")
    with monkeypatch.context() as broken:
        Calls(broken).fail(Database, "insert_raw", DatabaseError("MongoDB refuses it."))
        for number in range(5):
            recording.write(own, text(b"kept"), log_time=number)
        recording.write(channel("/more"), text(b"kept"), log_time=9)
        report = recording.close()
        assert (report.indexed, report.missed) == (0, 6)
        assert isinstance(report.failure, DatabaseError)
        query = store.topic("/talk").where({"data": "kept"})
        assert (query.count(), query.counters.unindexed) == (0, 5)
    assert [m.raw for m in store.topic("/talk")] == [text(b"kept")] * 5
    assert store.topic("/talk").where("data == 'kept'").count() == 5  # the segments know
    with hl.open(store.directory.path) as again:
        assert again.topic("/talk").where("data == 'kept'").count() == 5
        again.shared.index.connect()
        assert misindexed(again) == {}


@pytest.mark.mongo("embedded")
def test_a_mongod_that_stands_still_or_dies_costs_nothing(store: hl.Store) -> None:
    speech = channel("/speech")
    pid = int((store.directory.mongod / "data/mongod.lock").read_text())

    def write() -> None:
        for number in range(2, 100):
            assert recording.write(speech, text(b"x"), log_time=number, wait=False)

    with store.start("talk", flush_interval_s=0.2) as recording:
        recording.write(speech, text(b"lost"), log_time=1)
        wait_for(lambda: recording.lag == 0 and recording.stored[0] == 1)
        os.kill(pid, signal.SIGSTOP)
        try:
            must_return(write)
            wait_for(lambda: recording.stored[0] == 99)
            assert recording.lag > 0
        finally:
            os.kill(pid, signal.SIGCONT)
        wait_for(lambda: recording.lag == 0)
        # What it had lost when it died is indexed again, and counted once.
        database, key = store.shared.index.database_for("This"), recording.id[-16:]
        database.delete(collection_of("/speech"), {"_meta.rec": key})
        kill_mongod(store.directory.path)
        recording.write(speech, text(b"after"), log_time=100)
        wait_for(lambda: recording.index_failure is not None)
        wait_for(lambda: recording.index_failure is None and recording.lag == 0)
        report = recording.close()
    (found,) = report.entry.channels
    assert found.stats.messages == store.topic("/speech").count() == 100
    assert (report.indexed, report.missed) == (100, 0)
    assert store.topic("/speech").where("data == 'lost'").count() == 1
    assert misindexed(store) == {}


def test_no_mistake_of_ours_is_silent(store: hl.Store, calls: Calls) -> None:
    recording = store.start("talk", budget_bytes=1 << 20)
    calls.fail(RecordingWriter, "append", ZeroDivisionError)
    own = channel("/talk")

    def until_refused() -> None:
        while True:
            recording.write(own, text(b"x" * 100_000))

    with pytest.raises(ZeroDivisionError):
        until_refused()
    with pytest.raises(ZeroDivisionError):
        recording.close()
