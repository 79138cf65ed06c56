"""Logs of several files: the files are read, whatever the metadata or the names say."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
import zstandard

from hybridlog.formats.log_set import LogSet, open_source
from hybridlog_storage.errors import SourceError
from hybridlog_storage.messages import Channel, Schema
from tests.formats.test_rosbag2 import MESSAGES, TOPICS, database
from tests.independent import write_mcap

BEGIN = 1_700_000_000_000_000_000
SECOND = 10**9

TOPIC = "INSERT INTO topics VALUES (1, '/n', 'std_msgs/msg/UInt32', 'cdr')"
INDEX = "CREATE INDEX timestamp_idx ON messages (timestamp ASC)"


def payload(number: int) -> bytes:
    return b"\x00\x01\x00\x00" + number.to_bytes(4, "little")


def put_db3(path: Path, numbers: Sequence[int], change: Callable[[bytes], bytes] = bytes) -> Path:
    """A database with a message a second, numbered by their seconds."""
    path.parent.mkdir(exist_ok=True, parents=True)
    rows = [(n + 1, 1, BEGIN + n * SECOND, change(payload(n))) for n in numbers]
    return database(path, TOPICS, MESSAGES, INDEX, TOPIC, rows=rows)


def put_metadata(folder: Path, files: Sequence[str], messages: int, *more: str) -> None:
    """Metadata with wrong times, as after a crash."""
    lines = [
        "rosbag2_bagfile_information:",
        "  version: 5",
        "  storage_identifier: sqlite3",
        f"  relative_file_paths: [{', '.join(files)}]",
        "  duration: {nanoseconds: 5000000000}",
        f"  starting_time: {{nanoseconds_since_epoch: {BEGIN + 1}}}",
        f"  message_count: {messages}",
        *more,
    ]
    (folder / "metadata.yaml").write_text("\n".join(lines) + "\n")


class Found:
    """What a log gives: numbers of its messages, time range, and damage by file name."""

    def __init__(self, path: Path) -> None:
        self.time_range = LogSet.at(path).read_time_range()
        with open_source(path) as source:
            self.numbers = [
                int.from_bytes(bytes(batch.payload(row))[4:8], "little")
                for batch in source.batches()
                for row in range(len(batch))
            ]
            self.damage = [(d.file.name, d.messages_lost) for d in source.damage]
            self.reasons = [d.reason for d in source.damage]


FIFTEEN = list(range(15))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """A bag of three files with five messages each, without metadata."""
    for part in range(3):
        put_db3(tmp_path / "bag" / f"bag_{part}.db3", range(part * 5, part * 5 + 5))
    return tmp_path / "bag"


@pytest.mark.parametrize(
    "files",
    [
        ["bag_0.db3", "bag_1.db3", "bag_2.db3"],
        ["bag_0.db3"],
        ["bag_2.db3", "bag_0.db3"],
        ["bag/bag_0.db3", "bag_1.db3", "bag/bag_1.db3", "bag_0.db3"],
    ],
)
@pytest.mark.parametrize("count", [0, 5, 15])
def test_files_are_asked_before_the_metadata(bag: Path, files: list[str], count: int) -> None:
    put_metadata(bag, files, count)
    found = Found(bag)
    assert found.damage == []
    assert sorted(found.numbers) == FIFTEEN
    assert found.time_range == (BEGIN, BEGIN + 14 * SECOND + 1)
    assert Found(bag / "bag_1.db3").numbers == FIFTEEN[5:10]


@pytest.mark.parametrize(
    ("count", "damage"),
    [(10, []), (15, [("metadata.yaml", 5)]), (None, [("bag_0.db3", None)])],
)
def test_part_that_nothing_lists_is_missing(
    bag: Path, count: int | None, damage: list[tuple[str, int | None]]
) -> None:
    (bag / "bag_1.db3").unlink()
    if count is not None:
        put_metadata(bag, ["bag_0.db3", "bag_2.db3"], count)
    found = Found(bag)
    assert found.numbers == [*FIFTEEN[:5], *FIFTEEN[10:]]
    assert found.damage == damage


@pytest.mark.parametrize(
    ("listed", "count", "damage"),
    [
        (["x_0.db3", "x_1.db3"], 15, []),
        (["x_0.db3"], 20, [("metadata.yaml", 5)]),
        ([], 15, []),
        ([], 16, [("metadata.yaml", 1)]),
    ],
)
def test_files_that_got_other_names(
    bag: Path, listed: list[str], count: int, damage: list[tuple[str, int]]
) -> None:
    put_metadata(bag, listed, count)
    found = Found(bag)
    assert (found.numbers, found.damage) == (FIFTEEN, damage)
    found = Found(bag / "bag_1.db3")
    assert (found.numbers, found.damage) == (FIFTEEN[5:10], [])
    put_db3(bag / "other.db3", [99])
    with pytest.raises(SourceError, match="4 logs that are not parts of one"):
        open_source(bag)


@pytest.mark.parametrize(
    ("names", "listed", "damage"),
    [
        (["0", "9", "10"], None, {"0.db3": None}),
        (["d_008", "d_010", "d_100"], None, {"d_008.db3": None, "d_010.db3": None}),
        (["bag_1"], ["bag_1.db3"], {"metadata.yaml": 2}),
        (["x_0", "x_1"], ["data/x_0.db3", "x_1.db3", "data/x_2.db3"], {"x_2.db3": 1}),
    ],
)
def test_names_tell_the_order_and_what_is_missing(
    tmp_path: Path, names: list[str], listed: list[str] | None, damage: dict[str, int | None]
) -> None:
    for n, name in enumerate(names):
        put_db3(tmp_path / f"{name}.db3", [n])
    if listed is not None:
        put_metadata(tmp_path, listed, 3)
    found = Found(tmp_path)
    assert found.numbers == [*range(len(names))]
    assert dict(found.damage) == damage


def test_a_part_that_cannot_be_read_costs_no_other(bag: Path) -> None:
    (bag / "bag_1.db3").write_bytes(b"SQLite format 3\0" + bytes(5000))
    found = Found(bag)
    assert found.numbers == [*FIFTEEN[:5], *FIFTEEN[10:]]
    assert [name for name, _ in found.damage] == ["bag_1.db3"]
    for part in (0, 2):
        (bag / f"bag_{part}.db3").unlink()
    with pytest.raises(SourceError, match="SQLite"):
        open_source(bag).batches().__next__()


def put_mcap(path: Path, numbers: Sequence[int]) -> Path:
    channel = Channel("/n", "cdr", Schema("std_msgs/msg/UInt32", "ros2msg", b"uint32 data\n"))
    return write_mcap(path, [(channel, BEGIN + n * SECOND, payload(n)) for n in numbers])


def test_empty_parts_are_told(bag: Path) -> None:
    (bag / "bag_1.db3").write_bytes(b"")
    (bag / "notes.txt").touch()
    found = Found(bag)
    assert found.numbers == [*FIFTEEN[:5], *FIFTEEN[10:]]
    assert found.damage == [("bag_1.db3", None)]
    assert "empty" in found.reasons[0]
    put_metadata(bag, ["bag_0.db3", "bag_1.db3"], 15)
    assert Found(bag).damage == [("bag_1.db3", 5)]
    put_metadata(bag, ["bag_0.db3"], 15)
    assert Found(bag).damage == [("bag_1.db3", 5)]


def test_files_that_are_no_parts_are_told(bag: Path) -> None:
    put_metadata(bag, ["bag_0.db3", "bag_1.db3"], 15)
    put_db3(bag / "other.db3", range(100, 103))
    put_mcap(bag / "bag_3.mcap", range(7))
    data = (bag / "bag_0.db3").read_bytes()
    (bag / "bag_0.db3.zstd").write_bytes(zstandard.compress(data))
    (bag / "other_2.db3.zstd").write_bytes(zstandard.compress(data))
    found = Found(bag)
    assert found.numbers == FIFTEEN
    assert sorted(found.damage) == [
        ("bag_0.db3.zstd", 0),
        ("bag_3.mcap", 0),
        ("other.db3", 0),
        ("other_2.db3.zstd", 0),
    ]


def test_wrong_statistics_of_a_split_mcap(tmp_path: Path) -> None:
    put_mcap(tmp_path / "a_0.mcap", range(5))
    path = put_mcap(tmp_path / "a_1.mcap", range(5, 10))
    data = path.read_bytes()
    # Another last time in the statistics; the checksum of the summary is switched off.
    times = (BEGIN + 9 * SECOND).to_bytes(8, "little")
    times = (BEGIN + 5 * SECOND).to_bytes(8, "little") + times
    at = data.index(times, data.index(times) + 1)  # behind the chunk
    data = data[: at + 8] + (BEGIN + 7 * SECOND).to_bytes(8, "little") + data[at + 16 :]
    path.write_bytes(data[:-12] + bytes(4) + data[-8:])
    found = Found(tmp_path)
    assert (found.numbers, found.time_range) == (FIFTEEN[:10], (BEGIN, BEGIN + 9 * SECOND + 1))
    shutil.rmtree(tmp_path)
