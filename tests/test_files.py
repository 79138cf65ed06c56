"""The files of a recording: small topics in one, large topics in others."""

from __future__ import annotations

import random
import shutil
import struct
from pathlib import Path

import pytest
from msgspec.structs import replace

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_reader import SegmentReader
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.calls import Calls
from tests.cli.within import answer
from tests.waiting import wait_for

SCHEMA = Schema("a/msg/N", "ros2msg", b"uint32 n\nuint8[] data")
LARGE = [Channel(f"/large{n}", "cdr", SCHEMA) for n in range(5)]
SMALL = Channel("/small", "cdr", SCHEMA)
PROFILE = "- durability: transient_local\n  history: keep_last\n  depth: 1\n"
LATCHED = Channel("/map", "cdr", SCHEMA, {"offered_qos_profiles": PROFILE})
BEGIN, MS = 1_700_000_000 * 10**9, 10**6
COUNT = 60
SETTINGS = SegmentSettings(chunk_size=4096, own_payload=1000, segment_size=300_000)


def payload(number: int, size: int) -> bytes:
    return b"\0\1\0\0" + struct.pack("<II", number, size) + random.Random(number).randbytes(size)


def write(recording: hl.LiveRecording) -> list[tuple[str, int]]:
    """Messages that lie at equal times in several files; topics and numbers in total order."""
    written = []
    for number in range(COUNT):
        at = BEGIN + number // 3 * MS
        for channel in (*LARGE, SMALL, LATCHED):
            size = 4 if channel is SMALL else 2000
            recording.write(channel, payload(number, size), log_time=at)
            written.append((channel.topic, number))
    # Of equal times, what came first comes first.
    return sorted(written, key=lambda one: one[1] // 3)


def read(store: hl.Store) -> list[tuple[str, int]]:
    found = []
    for message in store.all_topics():
        number = struct.unpack_from("<I", message.raw, 4)[0]
        size = 4 if message.topic == "/small" else 2000
        assert bytes(message.raw) == payload(number, size)
        found.append((message.topic, number))
    return found


@pytest.fixture
def recorded(tmp_path: Path) -> tuple[Path, list[tuple[str, int]]]:
    with hl.open(tmp_path / "store", mongo="none", create=True) as store:
        recording = store.start("run", settings=SETTINGS)
        written = write(recording)
        recording.close()
    return tmp_path / "store", written


def test_files_are_read_as_one_log(
    recorded: tuple[Path, list[tuple[str, int]]], tmp_path: Path
) -> None:
    path, written = recorded
    manifest = places.read_in(places.folder(path, "run"))
    assert manifest is not None
    assert len({file.group for file in manifest.files}) > 1
    for file in manifest.files:
        topics = {manifest.channels[number].topic for number in file.parts}
        if file.number == file.group:
            assert topics <= {"/small", "/map"}
        else:
            assert topics.isdisjoint({"/small", "/map"})
    with hl.open(path, mongo="none") as store:
        assert read(store) == written
        assert [
            (m.topic, struct.unpack_from("<I", m.raw, 4)[0]) for m in store.all_topics().reverse()
        ] == written[::-1]
        assert store.verify().findings == []
        with hl.open(tmp_path / "again", mongo="none", create=True) as again:
            answer("fetch", "-t", "**", "-o", tmp_path / "all.mcap", store=path)
            again.record(tmp_path / "all.mcap")
            assert read(again) == written


def test_a_topic_costs_its_own_files(
    recorded: tuple[Path, list[tuple[str, int]]], calls: Calls
) -> None:
    path, _ = recorded
    manifest = places.read_in(places.folder(path, "run"))
    assert manifest is not None
    with hl.open(path, mongo="none") as store:  # now the catalog knows them
        assert store.topic("/large3").count() == COUNT
    for topic in ("/large3", "/small"):
        own = {
            file.number
            for file in manifest.files
            if topic in {manifest.channels[number].topic for number in file.parts}
        }
        assert len(own) < len(manifest.files) / 2
        with hl.open(path, mongo="none") as store:
            opened = calls(SegmentReader, "__init__")
            assert sum(1 for _ in store.topic(topic)) == COUNT
            assert {arguments[2] for arguments in opened} == own


def test_a_running_one_has_several_open_files(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", mongo="none", create=True) as store:
        recording = store.start("run", settings=replace(SETTINGS, segment_size=1 << 30))
        folder = places.folder(tmp_path / "store", "run")
        with hl.open(tmp_path / "store", mongo="none") as other:
            following = other.all_topics().follow("**")
            recording.write(SMALL, payload(1000, 4), log_time=BEGIN - MS)
            wait_for(lambda: recording.capture.writer.written.total() == recording.taken.total())
            written = [("/small", 1000), *write(recording)]
            wait_for(lambda: recording.capture.writer.written.total() == recording.taken.total())
            assert len([*folder.glob("*.open")]) > 2
            assert read(other) == written
            shutil.copytree(tmp_path / "store", tmp_path / "killed")
            recording.close()
            assert read(other) == written
            came = [(m.topic, struct.unpack_from("<I", m.raw, 4)[0]) for m in following]
            assert sorted(came) == sorted(written)
    with hl.open(tmp_path / "killed", mongo="none") as killed:
        assert read(killed) == written
        assert killed.edit("run", note="found").status == "recovered"
        assert read(killed) == written
        assert killed.verify().findings == []
    assert not [*places.folder(tmp_path / "killed", "run").glob("*.open")]
