"""Attachments, metadata records and channels without messages: kept, listed and given back."""

from __future__ import annotations

import hashlib
import shutil
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.rosbag1 import Reader as BagReader
from rosbags.rosbag1 import Writer as BagWriter

import hybridlog as hl
from hybridlog.attachments import Extras, StoredAttachment, extras_of
from hybridlog.cli.answers import write_answer
from hybridlog_storage.cells import CATALOG
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.running import run
from tests.copies import bring
from tests.independent import write_mcap

pytestmark = pytest.mark.mongo

SECOND = 10**9
TIMES = [100 * SECOND + n * SECOND for n in range(10)]
ATTACHMENTS: list[tuple[int, str, str, bytes]] = [
    (TIMES[0], "calibration.yaml", "text/yaml", b"focal: 600\n"),
    (0, "../../etc/passwd", "", b"root"),
    (TIMES[3], "calibration.yaml", "text/plain", b"focal: 601\n"),
    (TIMES[5], "", "application/octet-stream", b""),
    (TIMES[9], "späte Karte.png", "image/png", bytes(range(256)) * 300),
]
METADATA = [("robot", {"id": "7"}), ("robot", {}), ("notes", {"a": "b" * 1000, "": "é"})]


def write_log(path: Path) -> Path:
    """A log with all of it, between and behind the messages."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=64)
        writer.start(profile="ros2")
        texts = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        numbers = writer.register_schema("std_msgs/msg/UInt8", "ros2msg", b"uint8 data\n")
        spoken = writer.register_channel("/n", "cdr", numbers, {"offered_qos_profiles": "- x"})
        writer.register_channel("/silent", "cdr", texts, {"offered_qos_profiles": "- y"})
        writer.register_channel("/bare", "json", 0)
        writer.register_channel("/n", "cdr", texts)  # another type, never sent
        for n, time in enumerate(TIMES):
            writer.add_message(spoken, time, b"\x00\x01\x00\x00" + bytes([n]), time)
            if n < len(METADATA):
                writer.add_metadata(*METADATA[n])
            if n < len(ATTACHMENTS):
                log_time, name, media_type, data = ATTACHMENTS[n]
                writer.add_attachment(log_time + 1, log_time, name, media_type, data)
        writer.finish()
    return path


def contents(path: Path) -> dict[str, Any]:
    """The same of an MCAP file, as its own library reads it."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        channels = [
            (c.topic, c.message_encoding, sorted(c.metadata.items()),
             summary.schemas[c.schema_id].name if c.schema_id else None)
            for c in summary.channels.values()
        ]  # fmt: skip
        attachments = [
            (a.log_time, a.create_time, a.name, a.media_type, a.data)
            for a in reader.iter_attachments()
        ]
        assert summary.statistics.attachment_count == len(attachments)
        return {
            "channels": sorted(channels, key=repr),
            "attachments": attachments,
            "metadata": [(m.name, m.metadata) for m in reader.iter_metadata()],
            "messages": [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages()],
        }


def listed(found: list[StoredAttachment]) -> list[tuple[int, str, str, bytes]]:
    return [(a.log_time_ns, a.name, a.media_type, a.read()) for a in found]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("log") / "drive.mcap")


@pytest.fixture(scope="module")
def store(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store with the log, in one segment; the tests do not change it."""
    with hl.open(tmp_path_factory.mktemp("store") / "s", create=True) as store:
        store.record(log)
        yield store


def test_a_channel_without_messages_changes_no_answer(store: hl.Store) -> None:
    assert store.topic("/silent").count() == 0
    assert list(store.topic("/silent")) == []
    assert store.topic("/n").to_arrow().schema.field("data").type == "uint8"
    assert store.topic("/n").where("data >= 4").count() == 6
    assert store.topic("/silent").to_pandas().empty
    assert store.all_topics().where({"_meta.ref.seg": 0}).count() == 10
    assert len(list(store.topic("/silent", "/n").where({"_meta.ref.seg": 0}))) == 10
    assert list(store.topic("/silent").where({"data": {"$gt": "a"}})) == []


def extras_in(query: hl.Query) -> Extras:
    return extras_of(query.source.now(), query.question)


def test_a_whole_recording_comes_back(log: Path, store: hl.Store, tmp_path: Path) -> None:
    write_answer(
        store.all_topics(), "mcap", tmp_path / "out.mcap", extras=extras_in(store.all_topics())
    )
    assert contents(tmp_path / "out.mcap") == contents(log)


def test_a_slice_has_the_attachments_from_before_its_end(store: hl.Store, tmp_path: Path) -> None:
    slice_ = store.topic("/n").between(TIMES[2], TIMES[5])
    extras = extras_in(slice_)
    assert [a.name for a in extras.attachments] == [a[1] for a in ATTACHMENTS[:3]]
    assert (extras.left_out, len(extras.metadata)) == (2, 3)
    assert {c.topic for c in extras.channels} == {"/n"}
    path = store.directory.path
    done = run("export", tmp_path / "a.mcap", "-t", "/n", "--between", "+2s", "+5s", store=path)
    assert "3 messages" in done.err
    assert "2 attachments from behind the time range: left out." in done.err
    found = contents(tmp_path / "a.mcap")
    assert [a[2] for a in found["attachments"]] == [a[1] for a in ATTACHMENTS[:3]]
    assert [m[1] for m in found["messages"]] == TIMES[2:5]
    run("export", tmp_path / "b.mcap", "--no-attachments", store=path)
    assert contents(tmp_path / "b.mcap")["attachments"] == []


def test_commands(store: hl.Store, tmp_path: Path) -> None:
    path = store.directory.path
    rows = run("info", "drive", "--attachments", "--json", store=path).json
    assert [(r["name"], r["bytes"]) for r in rows] == [(a[1], len(a[3])) for a in ATTACHMENTS]
    table = run("info", "drive", "--attachments", store=path).lines
    assert table[1].split() == ["calibration.yaml", "text/yaml", "11", "B", "1970-01-01T00:01:40Z"]
    done = run("info", "drive", "--attachment", "../../etc/passwd", store=path)
    assert done.out == "root"
    out = tmp_path / "map.png"
    run("info", "drive", "--attachment", "späte Karte.png", "-o", out, store=path)
    assert out.read_bytes() == ATTACHMENTS[4][3]
    again = run("info", "drive", "--attachment", "späte Karte.png", "-o", out, store=path, code=2)
    assert "exists" in again.err
    twice = run("info", "drive", "--attachment", "calibration.yaml", store=path, code=2)
    assert "2 attachments have the name" in twice.err
    missing = run("info", "drive", "--attachment", "x", store=path, code=2)
    assert "späte Karte.png" in missing.err


def test_nothing_is_lost_on_the_way(log: Path, tmp_path: Path) -> None:
    """In many segments, packed, with another name, without derived data, in another store."""
    packed = tmp_path / "drive.mcap.zstd"
    packed.write_bytes(zstandard.compress(log.read_bytes()))
    with hl.open(tmp_path / "s", create=True) as store:
        report = store.record(packed, settings=SegmentSettings(segment_size=100))
        assert report.entry.segments > 3
        store.edit("drive", name="other name")
        assert listed(store.attachments("other name")) == ATTACHMENTS
    for derived in (CATALOG, "mongod", "tables"):
        shutil.rmtree(tmp_path / "s" / derived, ignore_errors=True)
        (tmp_path / "s" / derived).unlink(missing_ok=True)
    with hl.open(tmp_path / "s") as store:
        store.index.rebuild()
        assert store.verify().findings == []
        (entry,) = store.recordings()
        assert (entry.attachments, entry.metadata_records) == (5, 3)
    with hl.open(tmp_path / "t", create=True) as other:
        bring(other, tmp_path / "s")
        assert listed(other.attachments("other name")) == ATTACHMENTS
        assert other.metadata("other name") == METADATA
        query = other.all_topics()
        write_answer(query, "mcap", tmp_path / "out.mcap", extras=extras_in(query))
    assert contents(tmp_path / "out.mcap") == contents(log)


def damaged_log(log: Path, path: Path) -> Path:
    data = bytearray(log.read_bytes())
    data[data.index(b"focal: 600")] ^= 1
    path.write_bytes(data)
    return path


def test_a_wrong_checksum_in_the_log_is_told(log: Path, tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True) as store:
        report = store.record(damaged_log(log, tmp_path / "a.mcap"))
        assert [(d.messages_lost, d.reason) for d in report.damage] == [
            (0, "the checksum of the attachment 'calibration.yaml' differs")
        ]
        assert listed(store.attachments("a")) == ATTACHMENTS[1:]


def test_damage_in_the_store(log: Path, tmp_path: Path) -> None:
    with hl.open(tmp_path / "s", create=True) as store:
        store.record(log)
        (segment,) = places.folder(tmp_path / "s", "drive").glob("*.mcap")
        damaged_log(segment, segment)
        data = segment.read_bytes().replace(b"b" * 1000, b"b" * 999 + b"c")
        segment.write_bytes(data)
        first, *others = store.attachments("drive")
        for read in (first.read, first.pieces, lambda: first.save(tmp_path / "x")):
            with pytest.raises(SegmentError, match=r"The attachment 'calibration.yaml' at byte"):
                read()
        assert not (tmp_path / "x").exists()
        assert listed(others) == ATTACHMENTS[1:]
        found = " ".join(problem.problem for problem in store.verify().findings)
        assert "the checksum of the attachment 'calibration.yaml' differs" in found
        assert "a metadata record is damaged" in found
    done = run("export", tmp_path / "out.mcap", store=tmp_path / "s")
    assert "The attachment 'calibration.yaml' is left out" in done.err
    assert "A metadata record is left out" in done.err
    found_there = contents(tmp_path / "out.mcap")
    assert len(found_there["attachments"]) == 4
    assert len(found_there["messages"]) == 10


def test_bags_keep_connections_and_say_what_they_cannot_hold(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag") as bag:
        text = {"msgdef": "string data\n", "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}
        spoken = bag.add_connection("/a", "std_msgs/msg/String", **text)
        bag.add_connection("/silent", "std_msgs/msg/String", **text)
        bag.write(spoken, TIMES[0], b"\x01\0\0\0x")
    store = tmp_path / "s"
    run("record", tmp_path / "a.bag", store=store)
    run("export", tmp_path / "b.bag", store=store)
    with BagReader(tmp_path / "b.bag") as reader:
        assert sorted(reader.topics) == ["/a", "/silent"]
        assert reader.message_count == 1
    channel = Channel("/c", "ros1", Schema("std_msgs/String", "ros1msg", b"string data\n"))
    rows = [(channel, TIMES[0], b"\x01\0\0\0x", 0)]
    write_mcap(tmp_path / "c.mcap", rows, attachments=[(0, 0, "a", "", b"a")])
    run("record", tmp_path / "c.mcap", store=store)
    done = run("export", tmp_path / "c.bag", "-r", "c", store=store)
    assert "A bag has no attachments and metadata records of the log" in done.err


def test_large_attachments_are_never_in_memory(tmp_path: Path) -> None:
    size = 48 << 20
    block = bytes(range(256)) * 4096
    attached = (0, 0, "large", "", block * (size // len(block)))
    rows = [(Channel("/n", "json", None), 1, b"{}")]
    write_mcap(tmp_path / "a.mcap", rows, attachments=[attached])
    want = hashlib.sha256(block * (size // len(block))).hexdigest()
    with hl.open(tmp_path / "s", create=True) as store:
        tracemalloc.start()
        try:
            store.record(tmp_path / "a.mcap")
            (large,) = store.attachments("a")
            large.save(tmp_path / "large")
            query = store.all_topics()
            write_answer(query, "mcap", tmp_path / "out.mcap", extras=extras_in(query))
            _, peak = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert peak < size // 3
    assert hashlib.sha256((tmp_path / "large").read_bytes()).hexdigest() == want
    (found,) = contents(tmp_path / "out.mcap")["attachments"]
    assert hashlib.sha256(found[4]).hexdigest() == want
