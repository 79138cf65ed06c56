"""The entry of a recording that goes on: what is sealed, and what is flushed besides."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.entries import put_entry
from hybridlog.maintenance.verify import verify
from hybridlog.record.losses import Cause
from hybridlog.record.running import RunningRecording
from hybridlog_storage.catalog import RecordingEntry
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.damage import flip
from tests.running.running import NO_MONGODB

CHANNELS = [Channel("/a", "json", None), Channel("/b", "json", None)]
SETTINGS = SegmentSettings(chunk_size=2048, segment_size=10_000, compression="none", sync="never")
COUNT = 300


def time_of(n: int) -> int:
    """Each seventh message is late."""
    return 10**18 + 1000 * n - (5500 if n % 7 == 0 else 0)


@dataclass
class Running:
    """A recording that goes on.

    Attributes:
        path: A copy of its store as of one moment, without locks.
        sealed: Its entry with the sealed segments alone.
        entry: Its entry with everything.
    """

    path: Path
    sealed: RecordingEntry
    entry: RecordingEntry

    def follow(self, directory: StoreDirectory) -> RecordingEntry:
        running = RunningRecording(directory, self.sealed.id, lambda: self.sealed)
        running.follow()
        assert running.entry is not None
        return running.entry


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    base = tmp_path_factory.mktemp("entries")
    with (
        hl.open(base / "store", create=True) as store,
        store.start("live", settings=SETTINGS, flush_interval_s=0.05) as recording,
        hl.open(base / "store", mongo=NO_MONGODB) as reader,
    ):
        for n in range(COUNT):
            payload = b'{"pad": "%b"}' % (b"." * (n % 90))
            recording.write(CHANNELS[n % 2], payload, log_time=time_of(n))
        until = time.monotonic() + 60
        while (entry := reader.entry("live")).messages < COUNT or not entry.flushed:
            assert time.monotonic() < until
            time.sleep(0.02)
        (summary,) = reader.session.snapshot().summaries
        sealed = reader.shared.entry(summary)
        assert sealed is not None
        assert 0 < sealed.messages < COUNT
        shutil.copytree(base / "store", base / "copy", ignore=shutil.ignore_patterns("mongod*"))
        yield Running(base / "copy", sealed, entry)


def check(found: RecordingEntry) -> None:
    assert found.messages == COUNT
    assert found.messages_by_topic() == {"/a": COUNT // 2, "/b": COUNT // 2}
    times = [time_of(n) for n in range(COUNT)]
    assert found.span == (min(times), max(times))
    numbers = [number for number, _, _ in found.spans]
    assert numbers == sorted({*map(int, found.digests), *found.flushed})
    assert not found.losses


def test_what_is_sealed_while_it_is_listed_counts_once(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A segment may be listed as open, and be sealed when the catalog is read."""
    directory = StoreDirectory(running.path)
    listing = directory.listing(running.sealed.id)
    late = replace(listing, open={**listing.sealed, **listing.open})
    monkeypatch.setattr(directory, "listing", lambda _: late)
    check(running.follow(directory))


@pytest.mark.parametrize("age_s", [0, 1])
def test_a_segment_that_begins_in_the_tick_of_a_look_is_found(
    running: Running, monkeypatch: pytest.MonkeyPatch, age_s: int
) -> None:
    """The directory looks the same then; after a while it does not."""
    directory = StoreDirectory(running.path)
    listing = directory.listing(running.sealed.id)
    changed = time.time_ns() - age_s * 10**9
    look = f"1 {changed} {changed} 2 3 {changed} {changed}"
    monkeypatch.setattr(directory, "looks", lambda _: {running.sealed.id: look})
    monkeypatch.setattr(directory, "listing", lambda _: replace(listing, open={}))
    follower = RunningRecording(directory, running.sealed.id, lambda: running.sealed)
    follower.follow()
    monkeypatch.setattr(directory, "listing", lambda _: listing)
    assert follower.follow() == (age_s == 0)
    assert follower.entry is not None
    assert (follower.entry.messages == COUNT) == (age_s == 0)


def test_a_segment_that_is_about_to_be_noted_is_no_problem(running: Running) -> None:
    """A recorder seals a segment first, and then tells the catalog."""
    with hl.open(running.path.parent / "store", mongo=NO_MONGODB) as reader:
        catalog, directory = reader.shared.catalog, reader.directory
        catalog.remove(running.entry.id)
        assert not verify(reader.shared, {running.entry.id: "live"}).findings
        put_entry(directory, catalog, running.entry.id)


@pytest.mark.parametrize("is_file", [True, False])
def test_what_cannot_be_read_is_a_loss(running: Running, tmp_path: Path, *, is_file: bool) -> None:
    shutil.copytree(running.path, tmp_path / "store")
    (path,) = places.folder(tmp_path / "store", "live").glob("*.mcap.open")
    place = running.entry.flushed[int(path.name[:6])].table.chunks[0]
    begin = int(place["offset"])
    if is_file:
        flip(path, begin + 20)
    else:
        path.unlink()
        path.mkdir()
    found = running.follow(StoreDirectory(tmp_path / "store"))
    (loss,) = found.losses
    assert (loss["cause"], loss["file"], loss["count"]) == (Cause.SEGMENT, path.name, None)
    assert loss["offset"] == (begin if is_file else None)
    assert running.sealed.messages <= found.messages < COUNT
