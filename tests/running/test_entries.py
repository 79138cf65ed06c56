"""The entry of a recording that goes on: what is sealed, and what is flushed besides."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.record.running import RunningRecording
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.running.running import NO_MONGODB
from tests.waiting import wait_for

CHANNELS = [Channel("/a", "json", None), Channel("/b", "json", None)]
SETTINGS = SegmentSettings(chunk_size=2048, segment_size=10_000, compression="none", sync="never")
COUNT = 300
Follow = Callable[[StoreDirectory], RunningRecording]


def time_of(n: int) -> int:
    """Each seventh message is late."""
    return 10**18 + 1000 * n - (5500 if n % 7 == 0 else 0)


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Follow]:
    """A copy of a store in which a recording goes on, without locks; and who follows that."""
    base = tmp_path_factory.mktemp("entries")
    with (
        hl.open(base / "store", create=True, mongo="none") as store,
        store.start("live", settings=SETTINGS, flush_interval_s=0.05) as recording,
        hl.open(base / "store", mongo=NO_MONGODB) as reader,
    ):
        for n in range(COUNT):
            payload = b'{"pad": "%b"}' % (b"." * (n % 90))
            recording.write(CHANNELS[n % 2], payload, log_time=time_of(n))
        wait_for(lambda: reader.entry("live").messages == COUNT and reader.entry("live").flushed)
        sealed = reader.shared.entry(reader.session.snapshot().summaries[0])
        assert sealed is not None
        assert 0 < sealed.messages < COUNT
        shutil.copytree(base / "store", base / "copy")
    return base / "copy", lambda one: RunningRecording(one, sealed.id, lambda: sealed)


def test_what_is_sealed_while_it_is_listed_counts_once(
    running: tuple[Path, Follow], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A segment may be listed as open, and be sealed when the catalog is read."""
    path, follow = running
    directory = StoreDirectory(path)
    (recording,) = directory.ids()
    listing = directory.listing(recording)
    late = replace(listing, open={**listing.sealed, **listing.open})
    monkeypatch.setattr(directory, "listing", lambda _: late)
    found = follow(directory).follow()
    assert found is not None
    assert found.messages_by_topic() == {"/a": COUNT // 2, "/b": COUNT // 2}
    times = [time_of(n) for n in range(COUNT)]
    assert found.span == (min(times), max(times))
    assert [n for n, _, _ in found.spans] == sorted({*map(int, found.digests), *found.flushed})
    assert not found.losses


@pytest.mark.parametrize("age_s", [0, 1])
def test_a_segment_that_begins_in_the_tick_of_a_look_is_found(
    running: tuple[Path, Follow], monkeypatch: pytest.MonkeyPatch, age_s: int
) -> None:
    """The directory looks the same then; after a while it does not."""
    path, follow = running
    directory = StoreDirectory(path)
    (recording,) = directory.ids()
    listing, changed = directory.listing(recording), time.time_ns() - age_s * 10**9
    look = f"1 {changed} {changed} 2 3 {changed} {changed}"
    monkeypatch.setattr(directory, "looks", lambda _: {recording: look})
    monkeypatch.setattr(directory, "listing", lambda _: replace(listing, open={}))
    follower = follow(directory)
    follower.follow()
    monkeypatch.setattr(directory, "listing", lambda _: listing)
    found = follower.follow()
    assert found is not None
    assert (found.messages == COUNT) == (age_s == 0)
