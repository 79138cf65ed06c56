"""Handles that are open for long: of several threads, and beside files that cannot be read."""

from __future__ import annotations

import errno
import json
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.follow.follower import Follower
from hybridlog.live import LiveOptions
from hybridlog.maintenance.keep import expire
from hybridlog.maintenance.opening import StoreFiles
from hybridlog_storage.disk import files
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.calls import Calls
from tests.running.running import NO_MONGODB

SAID = Channel("/said", "json", None)
START = 10**18


def record(store: hl.Store, name: str, time: int) -> None:
    with store.start(name) as recording:
        recording.write(SAID, b'{"n": 1}', log_time=time)


def test_a_recording_that_comes_while_another_thread_looks_is_seen(
    tmp_path: Path, calls: Calls
) -> None:
    with hl.open(tmp_path / "store", create=True) as writer:
        record(writer, "old", START)
        with hl.open(tmp_path / "store", mongo=NO_MONGODB) as store:
            store.refresh()
            has_looked, may_end = threading.Event(), threading.Event()

            def slow(found: object, *_: object, **__: object) -> object:
                if threading.current_thread().name == "slow":
                    has_looked.set()
                    may_end.wait(30)
                return found

            calls.change(StoreFiles, "look", slow)
            first = threading.Thread(target=lambda: store.topic("said").count(), name="slow")
            first.start()
            assert has_looked.wait(30)
            record(writer, "new", START + 1)
            second = threading.Thread(target=lambda: store.topic("said").count())
            second.start()
            may_end.set()
            first.join()
            second.join()
            deadline = time.monotonic() + 20
            while store.topic("said").count() != 2:
                assert time.monotonic() < deadline
                time.sleep(0.05)


def test_a_segment_that_cannot_be_read_any_more_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = LiveOptions(flush_interval_s=0.05)
    with (
        hl.open(tmp_path / "store", create=True) as writer,
        writer.start("live", options) as recording,
    ):
        recording.write(SAID, b'{"n": 1}', log_time=START)
        with hl.open(tmp_path / "store", mongo=NO_MONGODB) as store:
            deadline = time.monotonic() + 30
            while not store.topics() or store.topic("said").count() < 1:
                assert time.monotonic() < deadline
                time.sleep(0.02)
            assert not store.topic("said").completeness().has_losses
            before = recording.stored
            recording.write(SAID, b'{"n": 2}', log_time=START + 1)
            while recording.stored == before:
                time.sleep(0.02)
            time.sleep(0.5)  # until it is flushed

            with monkeypatch.context() as patch:
                Calls(patch).fail(files, "preadv", OSError(errno.EIO, "Input/output error"))
                assert store.topic("said").completeness().has_losses
            assert store.topic("said").count() == 2
            assert not store.topic("said").completeness().has_losses


def test_a_gap_at_the_end_is_longer_than_what_may_not_be_flushed(tmp_path: Path) -> None:
    second = 10**9
    often, once = Channel("/often", "json", None), Channel("/once", "json", None)
    with (
        hl.open(tmp_path / "store", create=True) as store,
        store.start("live", LiveOptions(flush_interval_s=1)) as recording,
    ):
        for number in range(41):
            recording.write(often, b"{}", log_time=START + number * second // 4)
        for number in (0, 1, 2, 37):
            recording.write(once, b"{}", log_time=START + number * second // 4)
        deadline = time.monotonic() + 30
        while not store.topics() or len(list(store.topic("often", "once"))) < 45:
            assert time.monotonic() < deadline
            time.sleep(0.02)

        def gaps() -> list[tuple[int, int]]:
            found = store.topic("once").gaps(longer_than="0.5s")
            return [(one.begin_ns - START, one.end_ns - START) for one in found]

        assert gaps() == [(second // 2, 37 * second // 4)]
        recording.write(often, b"{}", log_time=START + 20 * second)
        while store.topic("often").count() < 42:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert gaps() == [(second // 2, 37 * second // 4), (37 * second // 4, 19 * second + 1)]


def test_chunks_that_are_flushed_while_the_index_is_made_are_not_damaged(
    tmp_path: Path, calls: Calls
) -> None:
    """The index looked at the size of a file, and then took chunks that came behind it."""
    first, second = (
        Channel("/said", "json", Schema("a/Said", "jsonschema", b'{"title": "%d"}' % n))
        for n in (1, 2)
    )
    settings = SegmentSettings(chunk_size=4096, segment_size=40_000, compression="none")

    def slow(_: object, reader: SegmentReader) -> None:
        if threading.current_thread() is following:
            time.sleep(0.05)

    def follow() -> None:
        follower = Follower(writer.directory, writer.shared.catalog, recording.capture.entry)
        while not is_over.is_set():
            follower.follow()
        follower.discard()

    is_over = threading.Event()
    following = threading.Thread(target=follow)
    calls.change(SegmentReader, "grow", slow)
    written, seen = 0, 0
    with (
        hl.open(tmp_path / "store", create=True, mongo="none") as writer,
        hl.open(tmp_path / "store", mongo="none") as store,
    ):
        options = LiveOptions(settings=settings, flush_interval_s=0.01)
        with writer.start("live", options) as recording:
            following.start()
            until = time.monotonic() + 1.5
            while time.monotonic() < until:
                payload = b'{"n": %d, "pad": "%s"}' % (written, b"." * 300)
                channel = (first, second)[written % 2]
                recording.write(channel, payload, log_time=START + written)
                written += 1
                if not written % 10:
                    time.sleep(0.005)
                if not written % 100 and store.topics():
                    found = [json.loads(one.raw)["n"] for one in store.topic("said")]
                    assert found == [*range(len(found))]
                    assert seen <= len(found) <= store.topic("said").count()
                    seen = len(found)
            is_over.set()
            following.join()
        assert [json.loads(one.raw)["n"] for one in store.topic("said")] == [*range(written)]
        assert store.topic("said").count() == written
        assert not store.topic("said").completeness().has_losses


ASKS: dict[str, Callable[[hl.Store], int]] = {
    "rows": lambda s: len([*s.topic("said")]),
    "count": lambda s: s.topic("said").count(),
    "count in time": lambda s: s.topic("said").between("start", "end").count(),
    "count where": lambda s: s.topic("said").where("n >= 0").count(),
    "frame": lambda s: len(s.topic("said").to_arrow()),
    "stats": lambda s: s.topic("said").stats("n")[0].count,
}


@pytest.mark.parametrize("name", ASKS)
@pytest.mark.parametrize("is_snapshot", [False, True], ids=["store", "snapshot"])
def test_files_that_were_replaced_are_looked_for_once_more(
    tmp_path: Path, name: str, is_snapshot: bool
) -> None:
    """Within the answer, also where the payloads of segments have expired."""
    settings = SegmentSettings(chunk_size=4096, segment_size=10_000, compression="none")
    with (
        hl.open(tmp_path / "store", create=True, mongo="none") as writer,
        hl.open(tmp_path / "store", mongo="none") as opened,
    ):
        with writer.start("one", LiveOptions(settings=settings)) as recording:
            for n in range(200):
                payload = b'{"n": %d, "pad": "%s"}' % (n, b"." * 200)
                recording.write(SAID, payload, log_time=START + n)
        store = opened.snapshot() if is_snapshot else opened
        assert store.entry("one").segments > 2
        recording = store.entry("one").id
        with writer.directory.writing(recording):
            expire(writer.directory, recording, [0, 2])
        assert ASKS[name](store) == 200


def test_a_snapshot_only_answers(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        record(store, "one", START)
        with store.snapshot() as then:
            record(store, "two", START + 1)
            assert [one.name for one in then.recordings()] == ["one"]
            assert then.snapshot().topic("said").count() == then.topic("said").count() == 1
            for change in (
                lambda: then.edit("one", note="here"),
                lambda: then.remove("one"),
                lambda: then.start("three"),
                then.refresh,
                lambda: then.pin("one"),
                lambda: then.keep({"max-age": "0s"}),
            ):
                with pytest.raises(UsageError, match="snapshot"):
                    change()
        assert store.topic("said").count() == 2
