"""Logs are told apart by content; what is none is refused with words that help."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest
import zstandard

from hybridlog.formats.log_set import LogSet, open_source
from hybridlog_storage.errors import SourceError
from tests.data import DATA, needs_data
from tests.other_user import User, needs_root, open_place


@needs_data
@pytest.mark.parametrize(
    ("name", "kind", "profile", "messages"),
    [
        ("odd/example-lz4.bag", "ROS 1 bag", "ros1", 8647),
        ("odd/no-messages.bag", "ROS 1 bag", "ros1", 0),
        ("odd/rosbag2/talker_db3/talker.db3", "ROS 2 bag (sqlite3)", "ros2", 20),
        ("odd/rosbag2/talker.mcap", "ROS 2 bag (mcap)", "ros2", 20),
        ("real/ouster.mcap", "MCAP", "ros1", None),
        ("odd/protobuf.mcap", "MCAP", "", None),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_by_content(
    tmp_path: Path, name: str, kind: str, profile: str, messages: int | None, packed: bool
) -> None:
    file = tmp_path / "log.txt"
    data = (DATA / name).read_bytes()
    file.write_bytes(zstandard.compress(data, 1) if packed else data)
    with open_source(file) as source:
        assert (source.kind, source.profile, source.path) == (kind, profile, file)
        assert source.files == [file]
        assert source.size_bytes == file.stat().st_size
        found = sum(map(len, source.batches()))
        assert source.damage == []
        assert source.bytes_read == source.size_bytes
    assert found == (source.message_count if messages is None else messages)
    assert source.message_count == found


@needs_data
def test_split_ros1_bag(tmp_path: Path) -> None:
    shutil.copy(DATA / "odd/example.bag", tmp_path / "drive_2024-05-06-07-08-09_9.bag")
    shutil.copy(DATA / "odd/example-bz2.bag", tmp_path / "drive_2024-05-06-07-09-09_10.bag")
    with open_source(tmp_path) as source:
        assert [path.name[-6:-4] for path in source.files] == ["_9", "10"]
        assert sum(map(len, source.batches())) == 2 * 8647
        assert LogSet.at(tmp_path).read_time_range() == (1396293887844783943, 1396293909544870200)
        # Both halves define the same connections.
        assert len({channel.topic for channel in source.channels}) == 9
        assert source.damage == []
    shutil.copy(DATA / "odd/example.bag", tmp_path / "other_1.bag")
    with pytest.raises(SourceError, match="3 logs that are not parts of one"):
        open_source(tmp_path)


@needs_data
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("odd/empty-file.bag", "empty"),
        ("damaged/magic_only.bag", "before any message"),
        ("CATALOGUE.md", "not a log of a known kind"),
        ("nothing.bag", "no such file or directory; check"),
        ("CATALOGUE.md/x", "cannot be read"),
        ("odd", "give the path of a log itself"),
        ("mcap-conformance", "without a log"),
    ],
)
def test_refused(name: str, words: str) -> None:
    with pytest.raises(SourceError, match=words) as caught:
        open_source(DATA / name)
    assert str(DATA / name) in str(caught.value)


@needs_root
def test_permission_of_another_user() -> None:
    script = "import sys, pathlib; from hybridlog.formats.log_set import LogSet, open_source\n"
    script += "try: open_source(pathlib.Path(sys.argv[1]))\n"
    script += "except Exception as error: print(type(error).__name__, error)"
    with open_place() as place:
        file = place / "a.bag"
        file.write_bytes(b"#ROSBAG V2.0\n")
        file.chmod(0o600)
        done = User(place).python("-c", script, file)
        assert done.out.startswith("SourceError")
        assert "permission denied; " in done.out
        assert "chmod" in done.out
        file.chmod(0o644)
        assert "permission denied" not in User(place).python("-c", script, file).out


def test_special_files_and_empty_folders(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SourceError, match="neither a file nor a directory"):
        open_source(tmp_path / "pipe")
    with pytest.raises(SourceError, match="without a log"):
        open_source(tmp_path)
