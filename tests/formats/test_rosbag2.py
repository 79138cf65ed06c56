"""ROS 2 bags against an independent reader, whole, compressed and damaged."""

from __future__ import annotations

import shutil
import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionFormat, CompressionMode, Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from hybridlog.formats.log_set import open_source, parse_metadata
from hybridlog.formats.reading import BATCH_MESSAGES, Damage, Source
from hybridlog.formats.rosbag2.sqlite import SqliteSource
from hybridlog.formats.yaml_values import YamlError
from hybridlog_storage.errors import SourceError
from tests.data import DATA, needs_data

Messages = Counter[tuple[str, str, int, bytes]]
"""(topic, type, time, payload)."""


def contents(source: Source) -> Messages:
    found: Messages = Counter()
    for batch in source.batches():
        assert 0 < len(batch) <= BATCH_MESSAGES
        for row in range(len(batch)):
            channel = source.channels[batch.channel[row]]
            assert channel.schema is not None
            time = int(batch.log_time[row])
            found[channel.topic, channel.schema.name, time, bytes(batch.payload(row))] += 1
    return found


def read(path: Path) -> tuple[Messages, list[Damage]]:
    with open_source(path) as source:
        return contents(source), source.damage


def reference(path: Path) -> Messages:
    with Reader(path) as reader:
        return Counter(
            (connection.topic, connection.msgtype, time, bytes(data))
            for connection, time, data in reader.messages()
        )


@needs_data
def test_what_channels_say() -> None:
    with open_source(DATA / "odd/rosbag2/wrong_rmw_test.db3") as source:
        list(source.batches())
        channels = {channel.topic: channel for channel in source.channels}
    array = channels["/array_topic"]
    assert array.message_encoding == "wrong_format"
    assert array.schema is not None
    assert (array.schema.name, array.schema.encoding, array.schema.data) == (
        "test_msgs/StaticArrayPrimitives",
        "",
        b"",
    )
    assert array.metadata == {}
    assert not array.has_publish_time
    clock = channels["/clock"].schema
    assert clock is not None
    assert (clock.name, clock.encoding, clock.data) == ("rosgraph_msgs/Clock", "", b"")


# Bags made here.


def make(
    folder: Path,
    *,
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    mode: CompressionMode = CompressionMode.NONE,
    messages: int = 300,
) -> Path:
    store = get_typestore(Stores.ROS2_HUMBLE)
    writer = Writer(folder, version=9, storage_plugin=storage)
    if mode is not CompressionMode.NONE:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = [
            writer.add_connection(f"/topic{number}", kind, typestore=store)
            for number, kind in enumerate(["std_msgs/msg/String", "std_msgs/msg/Int32"])
        ]
        for number in range(messages):
            payload = number.to_bytes(4, "little") * (number % 90)
            writer.write(connections[number % 2], 10**18 + number * 999_983, payload)
    return folder


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize(
    "mode", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE]
)
def test_written_by_rosbags(tmp_path: Path, storage: StoragePlugin, mode: CompressionMode) -> None:
    folder = make(tmp_path / "bag", storage=storage, mode=mode)
    expected = reference(folder)
    assert expected.total() == 300
    with open_source(folder) as source:
        assert contents(source) == expected
        assert source.damage == []
        assert source.bytes_read == source.size_bytes
        assert source.message_count == 300
        assert source.profile == "ros2"
        assert source.kind == f"ROS 2 bag ({storage.name.lower()})"
        assert source.time_range == (10**18, 10**18 + 299 * 999_983 + 1)
        assert {channel.topic for channel in source.channels} == {"/topic0", "/topic1"}
    # The file alone says enough too: beside its metadata, and a database away from it.
    (file,) = (path for path in folder.iterdir() if path.name != "metadata.yaml")
    assert read(file) == (expected, [])
    (folder / "metadata.yaml").unlink()
    assert file.suffix == ".zstd" or mode is not CompressionMode.FILE
    if storage is StoragePlugin.SQLITE3 or mode is not CompressionMode.MESSAGE:
        assert read(file) == (expected, [])
        assert read(folder) == (expected, [])


def test_no_room_to_unpack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make(tmp_path / "bag", mode=CompressionMode.FILE)
    usage = shutil.disk_usage(tmp_path)._replace(free=(64 << 20) + 1000)
    monkeypatch.setattr("shutil.disk_usage", lambda _: usage)
    with pytest.raises(SourceError, match="TMPDIR"):
        open_source(folder)
    # A frame that does not say its size is stopped when it has filled the room.
    file = next(folder.glob("*.zstd"))
    raw = zstandard.ZstdDecompressor().decompressobj().decompress(file.read_bytes())
    file.write_bytes(zstandard.ZstdCompressor(write_content_size=False).compress(raw))
    with pytest.raises(SourceError, match="TMPDIR"):
        open_source(folder)


@given(st.text(max_size=60) | st.sampled_from(["!!python/object:os.system x", "&a [*a]"]))
def test_metadata_is_untrusted(text: str) -> None:
    with pytest.raises(YamlError):
        parse_metadata(text)
    head = "rosbag2_bagfile_information:\n  version: 4\n  storage_identifier: sqlite3\n  "
    for key in ("relative_file_paths", "message_count", "files", "duration", "compression_mode"):
        with suppress(YamlError):
            assert parse_metadata(f"{head}{key}: {text!r}").files == []


def test_metadata_names_no_other_folder() -> None:
    found = parse_metadata(
        "rosbag2_bagfile_information:\n  relative_file_paths:\n    - ../../etc/passwd\n"
        "    - bag/bag_0.db3\n    - C:\\x\\bag_1.db3\n    - ..\n"
    )
    assert found.files == ["passwd", "bag_0.db3", "bag_1.db3"]


# Databases put together by hand.


def database(path: Path, *script: str, rows: Iterable[tuple[object, ...]] = ()) -> Path:
    db = sqlite3.connect(path)
    for line in script:
        db.execute(line)
    if rows:
        db.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows)
    db.commit()
    db.close()
    return path


TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)"
)
MESSAGES = (
    "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)"
)
TOPIC = "INSERT INTO topics VALUES (1, '/a', 'std_msgs/msg/String', 'cdr')"


def test_publish_time(tmp_path: Path) -> None:
    path = database(
        tmp_path / "a.db3",
        TOPICS,
        TOPIC,
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, recv_timestamp INTEGER,"
        " send_timestamp INTEGER, data BLOB)",
        "INSERT INTO messages VALUES (1, 1, 50, 40, x'00'), (2, 1, 60, NULL, x'01')",
    )
    with SqliteSource(path) as source:
        (batch,) = source.batches()
        assert source.channels[0].has_publish_time
    assert batch.log_time.tolist() == [50, 60]
    assert batch.publish_time.tolist() == [40, 60]


def test_times_before_1970_are_left_out_and_counted(tmp_path: Path) -> None:
    path = database(
        tmp_path / "a.db3",
        TOPICS,
        MESSAGES,
        TOPIC,
        rows=[(1, 1, -1, b"lost"), (2, 1, 0, b"a"), (3, 1, 2**63 - 1, b"b"), (4, 1, -(2**63), b"")],
    )
    with SqliteSource(path) as source:
        (batch,) = source.batches()
    assert batch.log_time.tolist() == [0, 2**63 - 1]
    (damage,) = source.damage
    assert damage.messages_lost == 2
    assert "1970" in damage.reason


@pytest.mark.parametrize(
    "script",
    [
        [],
        [TOPICS],
        ["CREATE TABLE messages(a, b)", TOPICS],
        [
            TOPICS,
            "CREATE VIEW messages AS WITH RECURSIVE n(id) AS (SELECT 1 UNION ALL SELECT id + 1 "
            "FROM n) SELECT id, 1 AS topic_id, 1 AS timestamp, x'00' AS data FROM n",
        ],
        [TOPICS, MESSAGES + " WITHOUT ROWID"],
    ],
)
def test_databases_that_are_no_bag(tmp_path: Path, script: list[str]) -> None:
    path = database(tmp_path / "a.db3", "CREATE TABLE x(y)", *script)
    with pytest.raises(SourceError, match=r"no ROS 2 bag|SQLite cannot") as caught:
        SqliteSource(path)
    assert str(path) in str(caught.value)


def test_write_ahead_log_of_a_crashed_recorder(tmp_path: Path) -> None:
    live = tmp_path / "live.db3"
    db = sqlite3.connect(live)
    db.execute("PRAGMA journal_mode = WAL")
    for line in (TOPICS, MESSAGES, TOPIC, "INSERT INTO messages VALUES (1, 1, 5, x'05')"):
        db.execute(line)
    db.commit()
    crashed = tmp_path / "crashed.db3"
    shutil.copy(live, crashed)
    shutil.copy(f"{live}-wal", f"{crashed}-wal")
    db.close()
    with open_source(crashed) as source:
        (batch,) = source.batches()
    assert batch.log_time.tolist() == [5]


def damaged_database(path: Path, break_page: Callable[[int, int], bool]) -> tuple[int, int]:
    """Writes 2000 rows, then overwrites leaf pages of the messages; (rows, pages)."""
    rows = [(number, 1, 1000 + number, bytes([number % 256]) * 100) for number in range(1, 2001)]
    database(path, TOPICS, MESSAGES, TOPIC, rows=rows)
    data = bytearray(path.read_bytes())
    leaves = [
        page for page in range(4096, len(data), 4096) if data[page] == 0x0D and data[page + 4]
    ]
    leaves = [page for page in leaves if int.from_bytes(data[page + 3 : page + 5], "big") > 20]
    broken = [page for number, page in enumerate(leaves) if break_page(number, len(leaves))]
    lost = 0
    for page in broken:
        lost += int.from_bytes(data[page + 3 : page + 5], "big")
        data[page : page + 200] = b"\xff" * 200
    path.write_bytes(data)
    return 2000 - lost, len(broken)


@pytest.mark.parametrize(
    "which",
    [
        pytest.param(lambda n, _: n == 10, id="one"),
        pytest.param(lambda n, _: n in {3, 20, 21, 22, 40}, id="some"),
        pytest.param(lambda n, _: n == 0, id="first"),
    ],
)
def test_everything_before_the_damage_is_read(
    tmp_path: Path, which: Callable[[int, int], bool]
) -> None:
    kept, broken = damaged_database(tmp_path / "a.db3", which)
    assert broken
    found, damage = read(tmp_path / "a.db3")
    times = sorted(time - 1000 for _, _, time, _ in found)
    assert times == [*range(1, len(times) + 1)]
    assert len(times) <= kept
    assert all(data == bytes([(time - 1000) % 256]) * 100 for _, _, time, data in found)
    assert [each.messages_lost for each in damage] == [None]  # no index counts them
    assert f"rows from id {len(times) + 1} on cannot be read: SQLite says" in damage[0].reason


PAYLOADS = {number: bytes([number]) * (number * 211) for number in range(1, 60)}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = [(number, 1, number, payload) for number, payload in PAYLOADS.items()]
    return database(tmp_path_factory.mktemp("db") / "a.db3", TOPICS, MESSAGES, TOPIC, rows=rows)


@given(st.lists(st.tuples(st.integers(100, 1 << 20), st.integers(0, 255)), max_size=40))
def test_random_damage_is_never_fatal(whole: Path, changes: list[tuple[int, int]]) -> None:
    data = bytearray(whole.read_bytes())
    for place, value in changes:
        data[place % len(data)] = value
    path = whole.with_name("b.db3")
    path.write_bytes(data)
    with suppress(SourceError), open_source(path) as source:
        assert sum(map(len, source.batches())) <= 1000


@given(st.data())
def test_cut_anywhere(whole: Path, data: st.DataObject) -> None:
    path, content = whole.with_name("b.db3"), whole.read_bytes()
    cut = data.draw(st.integers(0, len(content) - 1))
    path.write_bytes(content[:cut])
    try:
        source = open_source(path)
    except SourceError:
        assert cut < 3 * 4096
        return
    with source:
        for batch in source.batches():
            for row in range(len(batch)):
                assert batch.payload(row) == PAYLOADS[int(batch.log_time[row])]
        assert source.damage


@pytest.mark.parametrize("keep", [0.01, 0.3, 0.95])
def test_compressed_file_cut_short(tmp_path: Path, keep: float) -> None:
    folder = make(tmp_path / "bag", mode=CompressionMode.FILE, messages=5000)
    expected = reference(folder)
    file = next(folder.glob("*.zstd"))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * keep)])
    if keep < 0.1:
        # Not even the first block is there.
        with pytest.raises(SourceError, match="zstd -t") as caught:
            read(folder)
        assert str(file) in str(caught.value)
        return
    found, damage = read(folder)
    assert found <= expected
    assert 0 < found.total() < 5000
    assert {each.file for each in damage} <= {file, folder / "metadata.yaml"}
    assert sum(each.messages_lost or 0 for each in damage) == 5000 - found.total()


def test_values_of_odd_types_and_unknown_topics(tmp_path: Path) -> None:
    path = database(
        tmp_path / "a.db3",
        TOPICS,
        MESSAGES,
        TOPIC,
        rows=[(1, 1, 5, "text"), (2, "x", 6, b"lost"), (3, 1, None, None), (9, 1, "7", b"b")],
    )
    with SqliteSource(path) as source:
        (batch,) = source.batches()
    rows = [(int(t), bytes(batch.payload(row))) for row, t in enumerate(batch.log_time)]
    assert rows == [(5, b"text"), (0, b""), (7, b"b")]
    assert [each.messages_lost for each in source.damage] == [1]
