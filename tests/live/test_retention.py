"""A recorder keeps its store within the rules, loses nothing for it, and leaves pins alone."""

from __future__ import annotations

import random
import struct
import time
from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog.live.recorder import RecorderOptions
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.mongo.index_documents import RECORDINGS
from hybridlog_storage.segments.segment_writer import SegmentSettings
from hybridlog_storage.settings import write_settings
from tests import places
from tests.indexed import documents_of, misindexed
from tests.live.speaker import Recorded
from tests.test_faults import kill_mongod
from tests.waiting import wait_for

CAMERA = Channel("/camera", "ros1", Schema("a/Image", "ros1msg", b"uint32 n\nuint8[] data\n"), {})
NOISE = random.Random(5).randbytes(1 << 20)
SIZE = 50_000


def image(number: int) -> bytes:
    first = number * 7919 % (len(NOISE) - SIZE)
    return struct.pack("<II", number, SIZE) + NOISE[first : first + SIZE]


def store_with(path: Path, **rules: str) -> hl.Store:
    """A new store with rules of retention, without MongoDB."""
    with hl.open(path, mongo="none", create=True) as store:
        settings = store.directory.settings
    write_settings(path, replace(settings, retention=rules))
    return hl.open(path, mongo="none")


def has_expired(folder: Path) -> bool:
    """True once a segment of a recording has gone."""
    manifest = places.read_in(folder)
    return manifest is not None and any(not log.is_here for log in manifest.logs.values())


def test_rules_that_are_written_while_it_runs_hold(tmp_path: Path) -> None:
    with store_with(tmp_path / "store") as store:
        robot = Recorded(store, RecorderOptions(reserve_bytes=0))
        robot.speaker.say(CAMERA, image(0))
        with store_with(tmp_path / "store", **{"min-free": "1000TB"}):
            pass
        wait_for(lambda: robot.recorder.look() and robot.said)
        robot.recorder.stop()
    assert "all that is left must stay" in robot.said[0]
    with hl.open(tmp_path / "store", mongo="none") as store:
        assert store.topic("/camera").count() == 1


@pytest.mark.mongo("embedded")
def test_documents_that_mongodb_loses_after_their_messages_expired_are_made_again(
    tmp_path: Path,
) -> None:
    path = tmp_path / "store"
    with hl.open(path, create=True) as store:
        store.directory.change_settings(retention={"max-age": "0s"})
        settings = SegmentSettings(segment_size=4 << 20)
        robot = Recorded(store, RecorderOptions(reserve_bytes=0, settings=settings))
        recorder = robot.recorder
        (folder,) = places.folders(path)
        sent = 0

        def say(count: int) -> None:
            nonlocal sent
            for _ in range(count):
                robot.speaker.say(CAMERA, image(sent), sent * 10**9)
                sent += 1
            time.sleep(0.1)
            recorder.look()

        wait_for(lambda: say(10) or has_expired(folder))
        database = store.shared.index.connect()
        # Or what is sent now would say anew what is there.
        wait_for(lambda: not recorder.look().lag)
        nothing = {"$set": {"segments": {}}}
        database.update(RECORDINGS, {"_id": folder.name[-16:]}, nothing)
        database._client.admin.command("fsync")
        kill_mongod(path)
        wait_for(lambda: say(1) or recorder.look().index_failure)
        (report,) = recorder.stop()
        assert report.entry.losses == []
    with hl.open(path) as store:
        assert store.topic("/camera").count() == sent
        assert len(documents_of(store, "/camera")) == sent
        assert store.verify().findings == []
        assert misindexed(store) == {}
