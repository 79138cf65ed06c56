"""Logs below a directory, found once and as they become complete."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hybridlog.formats import find
from hybridlog.formats.find import Found, Watch, find_logs
from hybridlog.formats.log_set import grouped_parts
from hybridlog_storage.errors import SourceError
from hybridlog_storage.messages import Channel
from tests import places
from tests.calls import Calls
from tests.independent import write_mcap

METADATA = """rosbag2_bagfile_information:
  relative_file_paths: [{files}]
"""
LONG_AGO = 10**9


def mcap(path: Path, count: int = 1, *, whole: bool = True) -> Path:
    """An MCAP file of a few messages; without its end if it is not whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    channel = Channel("/n", "json", None)
    write_mcap(path, [(channel, number, b"{}") for number in range(count)])
    if not whole:
        path.write_bytes(path.read_bytes()[:-10])
    return path


def bag(path: Path, index: int) -> Path:
    """The beginning of a ROS 1 bag that says where its index begins."""
    head = b"op=\x03index_pos=" + index.to_bytes(8, "little")
    path.write_bytes(b"#ROSBAG V2.0\n" + head + b" " * 100)
    return path


def database(path: Path) -> Path:
    path.write_bytes(b"SQLite format 3\0" + bytes(84))
    return path


def paths(found: Found, top: Path) -> list[str]:
    return [str(log.path.relative_to(top)) for log in found.logs]


def age(*files: Path) -> None:
    for path in files:
        os.utime(path, ns=(LONG_AGO, LONG_AGO))


def test_all_logs_below_a_directory(tmp_path: Path) -> None:
    top = tmp_path / "top"
    mcap(top / "b" / "run.mcap")
    mcap(top / "a" / "drive_0.mcap")
    mcap(top / "a" / "drive_1.mcap", 2)
    mcap(top / "a" / "drive_10.mcap")
    mcap(top / "a" / "other.mcap")
    mcap(top / "called_otherwise")
    mcap(top / ".hidden" / "x.mcap")
    mcap(top / "bag" / "bag_0.mcap")
    mcap(top / "bag" / "beside.mcap")
    (top / "bag" / "metadata.yaml").write_text(METADATA.format(files="bag_0.mcap"))
    mcap(top / "no_bag" / "x.mcap")
    (top / "no_bag" / "metadata.yaml").write_text("about: something else\n")
    (top / "readme.txt").write_text("text")
    (top / "wrong.bag").write_text("text")
    (top / "empty.db3").touch()
    database(top / "history.sqlite")
    database(top / "rosbag.db3")
    mcap(places.new_folder(top / "inner", "r") / "000000.mcap")
    (top / "inner" / "hybridlog.toml").touch()
    found = find_logs(top)
    assert sorted(paths(found, top)) == sorted([
        "a/drive_0.mcap", "a/other.mcap", "b/run.mcap", "bag", "bag/beside.mcap",
        "called_otherwise", "empty.db3", "no_bag/x.mcap", "rosbag.db3", "wrong.bag",
    ])  # fmt: skip
    drive = next(log for log in found.logs if log.path.name == "drive_0.mcap")
    assert [path.name for path in drive.files] == ["drive_0.mcap", "drive_1.mcap", "drive_10.mcap"]
    assert drive.size == sum(path.stat().st_size for path in drive.files)
    assert drive.name == "drive"
    assert {log.name for log in found.logs if log is not drive} == {None}
    assert found.problems == []
    with drive.open() as source:
        assert sum(len(batch) for batch in source.batches()) == 4


def test_what_cannot_be_read_is_told(tmp_path: Path, calls: Calls) -> None:
    mcap(tmp_path / "a" / "one.mcap")
    mcap(tmp_path / "b" / "two.mcap")

    def refuse(path: Path) -> None:
        if Path(path).name == "a":
            raise PermissionError(13, "Permission denied", str(path))

    calls(find.os, "scandir", refuse)
    found = find_logs(tmp_path)
    assert paths(found, tmp_path) == ["b/two.mcap"]
    (problem,) = found.problems
    assert f"{tmp_path / 'a'}" in str(problem)
    with pytest.raises(SourceError):
        find_logs(tmp_path / "a")
    with pytest.raises(SourceError):
        find_logs(tmp_path / "gone")


@pytest.mark.parametrize(
    ("names", "groups"),
    [
        (["x_0.bag", "x_1.bag", "x_2.bag"], [["x_0.bag", "x_1.bag", "x_2.bag"]]),
        (["x_1.bag", "x_2.bag"], [["x_1.bag"], ["x_2.bag"]]),
        (["x_0.bag", "x_2.bag", "x_1.mcap"], [["x_0.bag", "x_2.bag"], ["x_1.mcap"]]),
        (["x_0.db3.zstd", "x_1.db3"], [["x_0.db3.zstd", "x_1.db3"]]),
        (["a_0.bag", "b_1.bag"], [["a_0.bag"], ["b_1.bag"]]),
        (["plain.bag", "other.bag"], [["other.bag"], ["plain.bag"]]),
        (
            [f"r_2024-05-06-07-0{n}-00_{part}.bag" for n, part in ((1, 0), (2, 1), (3, 0), (4, 1))],
            [
                ["r_2024-05-06-07-01-00_0.bag", "r_2024-05-06-07-02-00_1.bag"],
                ["r_2024-05-06-07-03-00_0.bag", "r_2024-05-06-07-04-00_1.bag"],
            ],
        ),
    ],
)
def test_parts_of_one_log_belong_together(names: list[str], groups: list[list[str]]) -> None:
    found = grouped_parts([Path(name) for name in names])
    assert sorted([path.name for path in group] for group in found) == groups


def test_a_log_is_taken_when_it_says_that_it_ends(tmp_path: Path) -> None:
    watch = Watch(tmp_path)
    torn = mcap(tmp_path / "torn.mcap", whole=False)
    mcap(tmp_path / "whole.mcap")
    bag(tmp_path / "open.bag", 0)
    bag(tmp_path / "copied.bag", 5000)
    bag(tmp_path / "whole.bag", 60)
    (tmp_path / "notes.txt").write_text("text")
    (tmp_path / "new.bag").touch()
    assert paths(watch.look(), tmp_path) == []  # they may still be written
    assert paths(watch.look(), tmp_path) == ["whole.bag", "whole.mcap"]
    assert paths(watch.look(), tmp_path) == []
    assert [path.name for path in watch.unfinished] == ["copied.bag", "open.bag", "torn.mcap"]
    mcap(torn, 5)
    assert paths(watch.look(), tmp_path) == []
    assert paths(watch.look(), tmp_path) == ["torn.mcap"]
    # A log that is written again is another one.
    mcap(tmp_path / "whole.mcap", 7)
    watch.look()
    assert paths(watch.look(), tmp_path) == ["whole.mcap"]


def test_a_part_is_taken_when_metadata_lists_it(tmp_path: Path) -> None:
    watch = Watch(tmp_path)
    database(tmp_path / "x_0.db3")
    watch.look()
    assert paths(watch.look(), tmp_path) == []
    (tmp_path / "metadata.yaml").write_text(METADATA.format(files="x_0.db3, x_1.db3"))
    assert paths(watch.look(), tmp_path) == ["x_0.db3"]
    assert paths(watch.look(), tmp_path) == []
    assert watch.unfinished == []


def test_a_file_without_an_end_is_complete_when_it_has_settled(tmp_path: Path) -> None:
    old = [database(tmp_path / name) for name in ("a.db3", "b.db3", "c.db3")]
    packed = tmp_path / "d.mcap.zstd"
    packed.write_bytes(_zstd(mcap(tmp_path / "d.mcap").read_bytes()))
    (tmp_path / "b.db3-wal").write_bytes(b"x")
    torn = mcap(tmp_path / "e.mcap", whole=False)
    age(*old[:2], packed, torn)
    watch = Watch(tmp_path, settle_s=60)
    # Never an MCAP file without its end: its writer may just have nothing to write.
    assert paths(watch.look(), tmp_path) == ["a.db3", "d.mcap.zstd"]
    assert paths(watch.look(), tmp_path) == ["d.mcap"]
    age(old[2])
    assert paths(watch.look(), tmp_path) == ["c.db3"]
    (tmp_path / "b.db3-wal").unlink()
    assert paths(watch.look(), tmp_path) == ["b.db3"]


def _zstd(data: bytes) -> bytes:
    import zstandard

    return zstandard.compress(data)
