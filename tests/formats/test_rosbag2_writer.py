"""Bags of ROS 2 that are written, read by rosbags."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from msgspec.structs import replace
from rosbags.interfaces import ConnectionExtRosbag2
from rosbags.rosbag2 import Reader
from ruamel.yaml import YAML

import hybridlog as hl
from hybridlog.formats.rosbag2.writer import STORAGES, Rosbag2Writer
from hybridlog.query.query import channels_of
from hybridlog_storage.errors import DiskFullError, UsageError
from tests.cli.running import run
from tests.data import DATA, needs_data
from tests.formats.batches import many, ros1_channels

LOG = DATA / "real/auv_ros2.mcap"
Row = tuple[str, str, int, bytes]


def rows_of(bag: Path) -> list[Row]:
    with Reader(bag) as reader:
        return [(c.topic, c.msgtype, time, bytes(raw)) for c, time, raw in reader.messages()]


@needs_data
@pytest.mark.parametrize("storage", STORAGES)
def test_every_byte_and_profile(storage: str, tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        store.record(LOG, name="auv")
        query = store.all_topics()
        with Rosbag2Writer(tmp_path / "bag", storage=storage) as writer:
            writer.declare([one.channel for one in channels_of(query)])
            for batch, channels in query.batches():
                writer.write(batch, [one.channel for one in channels])
        sent = [(m.topic, m.type, m.log_time_ns, m.raw) for m in query]
        store.record(tmp_path / "bag", name="again")
        again = store.entry("again")
        assert (again.messages, again.status) == (len(sent), "complete")
    assert sorted(rows_of(tmp_path / "bag")) == sorted(sent)
    described = YAML(typ="safe").load((tmp_path / "bag/metadata.yaml").read_text())
    bag = described["rosbag2_bagfile_information"]
    names = [f"bag_{number}{STORAGES[storage]}" for number in range(len(bag["files"]))]
    assert len(names) == 1
    assert bag["storage_identifier"] == storage
    assert [one["path"] for one in bag["files"]] == bag["relative_file_paths"] == names
    assert {one.name for one in (tmp_path / "bag").iterdir()} == {*names, "metadata.yaml"}
    assert sum(one["message_count"] for one in bag["files"]) == bag["message_count"] == len(sent)
    times = [time for _, _, time, _ in sent]
    assert bag["starting_time"]["nanoseconds_since_epoch"] == min(times)
    assert bag["duration"]["nanoseconds"] == max(times) - min(times)
    with Reader(tmp_path / "bag") as reader:
        topics = {one.topic: one for one in reader.connections}
        assert reader.message_count == len(sent)
        assert "/coug2/modem_send" in topics  # it has no messages
        assert topics["/tf_static"].msgtype == "tf2_msgs/msg/TFMessage"
        ext = topics["/tf_static"].ext
        assert isinstance(ext, ConnectionExtRosbag2)
        assert ext.offered_qos_profiles[0].durability.name == "TRANSIENT_LOCAL"


@needs_data
def test_the_command_and_what_fits_into_no_bag(tmp_path: Path) -> None:
    store, bag = tmp_path / "store", tmp_path / "bag"
    run("record", LOG, "--name", "auv", "--mongo", "none", "-q", store=store)
    run("export", bag, "-F", "rosbag2", store=store)
    assert len(rows_of(bag)) == 18558
    run("export", bag, "-F", "rosbag2", store=store, code=2)
    small = ("--storage", "sqlite3")
    shutil.rmtree(bag)
    run("export", bag, "-F", "rosbag2", *small, store=store)
    assert len(rows_of(bag)) == 18558
    assert {one.suffix for one in bag.iterdir()} == {".db3", ".yaml"}
    said = run("export", tmp_path / "x.mcap", "--storage", "mcap", store=store, code=2).err
    assert "--storage is for rosbag2" in said
    some = ("fetch", "-t", "/tf", "-F", "rosbag2", "-o", bag)
    assert "is not empty" in run(*some, "-f", store=store, code=2).err
    shutil.rmtree(bag)
    run(*some, store=store)
    assert {topic for topic, *_ in rows_of(bag)} == {"/tf"}
    run("mark", "here", "-r", "auv", "--at", "+1s", store=store)
    said = run("export", tmp_path / "marked", "-F", "rosbag2", store=store, code=2).err
    assert "/hybridlog/marks has json messages" in said
    assert not (tmp_path / "marked").exists()
    with pytest.raises(UsageError, match="is no stream"), (tmp_path / "x").open("wb") as file:
        Rosbag2Writer(file)


def test_a_full_disk_under_a_database(tmp_path: Path) -> None:
    """SQLite says so itself; nothing stays."""
    channels = [replace(one, message_encoding="cdr") for one in ros1_channels()]
    writer = Rosbag2Writer(tmp_path / "bag", storage="sqlite3")
    writer.write(many(300), channels)
    log = writer._log
    assert log is not None
    log._db.execute("PRAGMA max_page_count = 1")  # type: ignore[union-attr]
    with pytest.raises(DiskFullError):
        writer.write(many(9000), channels)
    writer.abort()
    assert not list(tmp_path.iterdir())


def test_messages_of_ros_1_say_what_to_do(tmp_path: Path) -> None:
    with (
        pytest.raises(UsageError, match="--format bag, and convert that with rosbags-convert"),
        Rosbag2Writer(tmp_path / "bag") as writer,
    ):
        writer.write(many(3), ros1_channels())
