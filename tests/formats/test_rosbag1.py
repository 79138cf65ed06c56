"""ROS 1 bags against an independent reader, whole, cut and damaged."""

from __future__ import annotations

import bz2
import re
import struct
import tempfile
import tracemalloc
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import lz4.frame
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rosbags.rosbag1 import Writer

from hybridlog.formats.reading import Damage, Source
from hybridlog.formats.rosbag1.reader import Rosbag1Source, walk
from hybridlog_storage.errors import SourceError
from hybridlog_storage.messages import Channel, Schema
from tests.data import DATA, needs_data
from tests.formats.batches import STRING_MD5
from tests.limits import Limit

Messages = dict[tuple[str, str], list[tuple[int, bytes]]]


def contents(source: Source) -> Messages:
    """(time, payload) of each message, by topic and callerid, in the order of reading."""
    found: Messages = defaultdict(list)
    for batch in source.batches():
        for row in range(len(batch)):
            channel = source.channels[batch.channel[row]]
            key = (channel.topic, channel.metadata.get("callerid", ""))
            found[key].append((int(batch.log_time[row]), bytes(batch.payload(row))))
    return dict(found)


def read(path: Path) -> tuple[Messages, list[Damage]]:
    with Rosbag1Source(path) as source:
        return contents(source), source.damage


def total(messages: Messages) -> int:
    return sum(map(len, messages.values()))


@needs_data
def test_arrival_order_is_file_order() -> None:
    with Rosbag1Source(DATA / "odd/example-unsorted-chunks.bag") as source:
        times = [int(time) for batch in source.batches() for time in batch.log_time]
    assert times == [2_000_000_000, 3_000_000_000, 1_000_000_000]


# Bags made here.


def make(path: Path, compression: str, *, chunk: int, messages: int, size: int = 40) -> Messages:
    writer = Writer(path)
    if compression != "none":
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
    writer.chunk_threshold = chunk
    rows: Messages = defaultdict(list)
    with writer:
        connections = [
            writer.add_connection(
                f"/topic_{number}",
                "std_msgs/msg/String",
                msgdef="string data\n",
                md5sum=STRING_MD5,
                callerid=f"/node_{number}",
                latching=1,
            )
            for number in range(3)
        ]
        for number in range(messages):
            connection = connections[number % 3]
            payload = number.to_bytes(4, "little") * (number % size)
            time = 10**18 + number * 1_000_003
            writer.write(connection, time, payload)
            rows[(connection.topic, f"/node_{number % 3}")].append((time, payload))
    return dict(rows)


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@pytest.mark.parametrize(
    ("chunk", "messages", "size", "window"),
    [(200, 400, 40, 64), (5000, 400, 40, 0), (4 << 20, 40_000, 3, 0)],
)
def test_written_by_rosbags(
    tmp_path: Path,
    limit: Limit,
    compression: str,
    chunk: int,
    messages: int,
    size: int,
    window: int,
) -> None:
    if window:  # smaller than a message
        limit(bag_window_bytes=window)
    expected = make(tmp_path / "a.bag", compression, chunk=chunk, messages=messages, size=size)
    with Rosbag1Source(tmp_path / "a.bag") as source:
        assert contents(source) == expected
        assert source.damage == []
        assert source.bytes_read == source.size_bytes == (tmp_path / "a.bag").stat().st_size
        assert source.message_count == messages
        assert source.time_range == (10**18, 10**18 + (messages - 1) * 1_000_003 + 1)
    assert len(source.channels) == 3
    for channel in source.channels:
        number = channel.topic[-1]
        schema = Schema("std_msgs/String", "ros1msg", b"string data\n")
        said = {"md5sum": STRING_MD5, "callerid": f"/node_{number}", "latching": "1"}
        wanted = Channel(f"/topic_{number}", "ros1", schema, said, has_publish_time=False)
        assert str(channel) == str(wanted)


def _cases() -> dict[str, tuple[bytes, Messages]]:
    cases = {}
    with tempfile.TemporaryDirectory() as folder:
        for compression in ("none", "bz2", "lz4"):
            path = Path(folder) / f"{compression}.bag"
            expected = make(path, compression, chunk=700, messages=60)
            cases[compression] = path.read_bytes(), expected
    return cases


CASES = _cases()


def read_bytes(data: bytes) -> tuple[Messages, list[Damage]]:
    with tempfile.NamedTemporaryFile(suffix=".bag") as file:
        file.write(data)
        file.flush()
        return read(Path(file.name))


def payload_ends(data: bytes, messages: Messages) -> list[tuple[int, int]]:
    """(time, byte after its payload) of each message of an uncompressed bag."""
    ends = []
    for rows in messages.values():
        for time, payload in rows:
            stamp = b"time=" + struct.pack("<II", time // 10**9, time % 10**9)
            start = data.index(stamp) + len(stamp) + 4
            assert data[start : start + len(payload)] == payload
            ends.append((time, start + len(payload)))
    return ends


ENDS = payload_ends(*CASES["none"])


@given(compression=st.sampled_from(sorted(CASES)), data=st.data())
def test_cut_anywhere(compression: str, data: st.DataObject) -> None:
    whole, expected = CASES[compression]
    cut = data.draw(st.integers(0, len(whole) - 1))
    try:
        found, damage = read_bytes(whole[:cut])
    except SourceError:
        assert cut < 4200
        return
    for key, rows in found.items():
        assert rows == expected[key][: len(rows)]
    assert damage, "a cut file is damaged"
    if compression == "none":
        times = {time for rows in found.values() for time, _ in rows}
        assert times == {time for time, end in ENDS if end <= cut}
    lost = [each.messages_lost for each in damage]
    if None not in lost:
        assert total(found) + sum(filter(None, lost)) == total(expected)


@given(
    compression=st.sampled_from(sorted(CASES)),
    place=st.integers(0, 1 << 20),
    value=st.integers(1, 255),
)
@example(compression="none", place=4117, value=1)
def test_one_flipped_byte(compression: str, place: int, value: int) -> None:
    whole, expected = CASES[compression]
    place %= len(whole)
    broken = bytearray(whole)
    broken[place] ^= value
    try:
        found, _ = read_bytes(bytes(broken))
    except SourceError:
        assert place < 4117
        return
    all_times = {time for rows in expected.values() for time, _ in rows}
    times = [time for rows in found.values() for time, _ in rows]
    known = all_times & set(times)
    # One byte costs one chunk at most, and an uncompressed chunk a few messages at most.
    assert len(known) >= total(expected) - (30 if compression != "none" else 3)
    assert len(times) <= total(expected)


@given(st.binary(max_size=400))
def test_any_bytes(data: bytes) -> None:
    head = CASES["none"][0][:4117]
    found, _ = read_bytes(head + data)
    assert total(found) == 0


# Records put together by hand.


def record(fields: dict[str, bytes], data: bytes) -> bytes:
    header = b"".join(
        struct.pack("<I", len(name) + 1 + len(value)) + name.encode() + b"=" + value
        for name, value in fields.items()
    )
    return struct.pack("<I", len(header)) + header + struct.pack("<I", len(data)) + data


def connection(conn: int, kind: str = "std_msgs/String", topic: str = "/a") -> bytes:
    inner = record({"topic": topic.encode(), "type": kind.encode(), "message_definition": b""}, b"")
    size = struct.unpack("<I", inner[:4])[0]
    fields = {"op": b"\x07", "conn": struct.pack("<I", conn), "topic": topic.encode()}
    return record(fields, inner[4 : 4 + size])


def message(conn: int, time: int, data: bytes, *, order: str = "oct", **extra: bytes) -> bytes:
    values = {
        "o": ("op", b"\x02"),
        "c": ("conn", struct.pack("<I", conn)),
        "t": ("time", struct.pack("<II", time // 10**9, time % 10**9)),
    }
    return record(dict(values[letter] for letter in order) | extra, data)


def chunk(data: bytes, compression: str = "none", *, size: int | None = None) -> bytes:
    packed = {"none": bytes, "bz2": bz2.compress, "lz4": lz4.frame.compress}.get(
        compression, bytes
    )(data)
    return packed_chunk(packed, compression, len(data) if size is None else size)


def packed_chunk(packed: bytes, compression: str, size: int) -> bytes:
    fields = {
        "op": b"\x05",
        "compression": compression.encode(),
        "size": struct.pack("<I", size),
    }
    return record(fields, packed)


def index(conn: int, count: int) -> bytes:
    fields = {
        "op": b"\x04",
        "ver": struct.pack("<I", 1),
        "conn": struct.pack("<I", conn),
        "count": struct.pack("<I", count),
    }
    return record(fields, bytes(12 * count))


def bag(*records: bytes, encryptor: bytes = b"") -> bytes:
    fields = {
        "op": b"\x03",
        "index_pos": bytes(8),
        "conn_count": bytes(4),
        "chunk_count": bytes(4),
    }
    if encryptor:
        fields["encryptor"] = encryptor
    return b"#ROSBAG V2.0\n" + record(fields, b" " * 4027) + b"".join(records)


def values(found: Messages) -> list[bytes]:
    return [payload for rows in found.values() for _, payload in rows]


def test_messages_outside_of_chunks() -> None:
    found, damage = read_bytes(
        bag(connection(3), *(message(3, time, bytes([time])) for time in range(5)))
    )
    assert values(found) == [bytes([time]) for time in range(5)]
    assert damage == []


def with_index_lengths(data: bytes, change: Callable[[int, int], int]) -> bytes:
    """A bag whose index records state other lengths: `change(length, number)`."""
    out = bytearray(data)
    at, number = 13, 0
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        place = at + 4 + size
        (length,) = struct.unpack_from("<I", data, place)
        if re.search(rb"op=[\x04\x06]", data[at + 4 : place]):
            struct.pack_into("<I", out, place, max(change(length, number), 0))
            number += 1
        at = place + 4 + length
    return bytes(out)


@pytest.mark.parametrize("compression", ["none", "lz4"])
@pytest.mark.parametrize(
    "change",
    [
        lambda length, _: length + 1,
        lambda length, _: length - 1,
        lambda length, _: length * 20 // 12,
        lambda length, number: length + 7 * (number % 3) - 5 * (number % 2),
        lambda _length, _: 0,
        lambda _length, _: 2**32 - 1,
    ],
)
def test_index_records_that_state_a_wrong_length(
    tmp_path: Path, compression: str, change: Callable[[int, int], int]
) -> None:
    path = tmp_path / "a.bag"
    expected = make(path, compression, chunk=2000, messages=400)
    path.write_bytes(with_index_lengths(path.read_bytes(), change))
    found, damage = read(path)
    assert found == expected
    assert damage == []
    with Rosbag1Source(path) as source:
        assert source.message_count == 400
        assert source.time_range == (10**18, 10**18 + 399 * 1_000_003 + 1)


def test_connections_without_messages_are_channels(tmp_path: Path) -> None:
    path = tmp_path / "a.bag"
    make(path, "none", chunk=2000, messages=2)  # of three topics
    with Rosbag1Source(path) as source:
        assert total(contents(source)) == 2
        assert sorted(c.topic for c in source.channels) == ["/topic_0", "/topic_1", "/topic_2"]


def test_undefined_connection_is_counted() -> None:
    body = connection(0) + message(0, 1, b"a") + message(9, 2, b"b") + message(0, 3, b"c")
    found, damage = read_bytes(bag(chunk(body, "lz4")))
    assert values(found) == [b"a", b"c"]
    assert [each.messages_lost for each in damage] == [1]
    assert "id 9" in damage[0].reason


def test_a_connection_id_that_changes_its_meaning(tmp_path: Path) -> None:
    body = (
        connection(0, "a/A")
        + message(0, 1, b"a")
        + connection(0, "b/B")
        + message(0, 2, b"b")
        + connection(0, "b/B")
        + message(0, 3, b"b")
    )
    (tmp_path / "a.bag").write_bytes(bag(chunk(body)))
    with Rosbag1Source(tmp_path / "a.bag") as source:
        batches = [*source.batches()]
        types = [source.channels[number].schema for batch in batches for number in batch.channel]
    assert [schema.name for schema in types if schema is not None] == ["a/A", "b/B", "b/B"]
    assert len(source.channels) == 2


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
@pytest.mark.parametrize("lie", [5, 999, 1 << 30])
def test_chunk_length_that_lies(compression: str, lie: int) -> None:
    """What unpacks from there on is the chunk; a plain one needs no length."""
    rows = [message(0, time, bytes([time, time])) for time in range(20)]
    one = bytearray(chunk(connection(0) + b"".join(rows), compression))
    head = struct.unpack_from("<I", one)[0] + 4
    length = struct.unpack_from("<I", one, head)[0]
    struct.pack_into("<I", one, head, max(0, length + lie))
    two = chunk(message(0, 100, b"z"), compression)
    found, damage = read_bytes(bag(bytes(one), index(0, 20), two, index(0, 1)))
    assert values(found) == [bytes([time, time]) for time in range(20)] + [b"z"]
    assert len(damage) == (compression == "none" and lie > 5)  # then it ends behind the file


def test_encrypted_and_old() -> None:
    with pytest.raises(SourceError, match="encrypted"):
        read_bytes(bag(encryptor=b"rosbag/AesCbcEncryptor"))
    with pytest.raises(SourceError, match=r"version 1\.2"):
        read_bytes(b"#ROSBAG V1.2\n" + bytes(100))


def test_the_definition_is_found_in_the_index_when_its_chunk_is_lost(tmp_path: Path) -> None:
    expected = make(tmp_path / "a.bag", "lz4", chunk=700, messages=60)
    data = bytearray((tmp_path / "a.bag").read_bytes())
    data[4117 + 60 : 4117 + 80] = bytes(20)
    found, damage = read_bytes(bytes(data))
    assert 0 < total(found) < total(expected)
    assert [each.messages_lost for each in damage] == [total(expected) - total(found)]


def with_zeros(data: bytes) -> bytes:
    """A bag with zeros behind each of its index records, which states them in its chunk list."""
    parts, moved, at = [data[:13]], {}, 13
    while at < len(data):
        (size,) = struct.unpack_from("<I", data, at)
        (length,) = struct.unpack_from("<I", data, at + 4 + size)
        end = at + 8 + size + length
        moved[at] = sum(map(len, parts))
        record = bytearray(data[at:end])
        if (place := record.find(b"chunk_pos=", 0, size)) > 0:
            struct.pack_into(
                "<Q", record, place + 10, moved[struct.unpack_from("<Q", record, place + 10)[0]]
            )
        parts.append(bytes(record))
        if b"op=\x04" in record[: 4 + size] or b"op=\x06" in record[: 4 + size]:
            parts.append(bytes(20))
        at = end
    whole = bytearray(b"".join(parts))
    place = whole.index(b"index_pos=") + 10
    struct.pack_into("<Q", whole, place, moved[struct.unpack_from("<Q", whole, place)[0]])
    return bytes(whole)


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_zeros_behind_index_records_are_no_damage(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.bag"
    expected = make(path, compression, chunk=2000, messages=400)
    path.write_bytes(with_zeros(path.read_bytes()))
    with Rosbag1Source(path) as source:
        assert source.message_count == 400
        assert contents(source) == expected
        assert source.damage == []
        assert len(source.remarks) == 1


@pytest.mark.parametrize("size", [0, 12, 40])
def test_zeros_in_place_of_a_chunk_are_damage(tmp_path: Path, size: int) -> None:
    """From the head of the second chunk, or from somewhat before it, to its end."""
    path = tmp_path / "a.bag"
    expected = make(path, "lz4", chunk=2000, messages=400)
    data = bytearray(path.read_bytes())
    first = data.index(b"compression=lz4")
    start = data.index(b"compression=lz4", first + 1) - 8
    end = data.index(b"op=\x04", start) - 8
    data[start - size : end] = bytes(end - start + size)
    path.write_bytes(data)
    found, damage = read(path)
    lost = total(expected) - total(found)
    assert sum(each.messages_lost or 0 for each in damage) == lost > 0


@pytest.mark.parametrize("compression", ["none", "lz4"])
def test_message_length_that_lies(compression: str) -> None:
    rows = [message(0, time, bytes(30)) for time in range(20)]
    broken = bytearray(rows[7])
    struct.pack_into("<I", broken, len(broken) - 34, 77)
    rows[7] = bytes(broken)
    found, damage = read_bytes(
        bag(chunk(connection(0) + b"".join(rows), compression), index(0, 20))
    )
    left = range(8, 20) if compression == "none" else ()  # damage costs the rest of the chunk
    assert [time for time, _ in found[("/a", "")]] == [*range(7), *left]
    assert set(values(found)) == {bytes(30)}
    assert [each.messages_lost for each in damage] == [None]


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_a_cut_chunk_gives_what_unpacks(compression: str) -> None:
    rows = [message(0, time, bytes([time, time + 1]) * 30_000) for time in range(40)]
    one = chunk(connection(0) + b"".join(rows), compression)
    found, damage = read_bytes(bag(one)[: -len(one) // 4])
    times = [time for time, _ in found[("/a", "")]]
    assert times == list(range(len(times)))
    assert 5 < len(times) < 40
    assert [each.messages_lost for each in damage] == [None]


def test_zeros_are_no_records() -> None:
    """A small chunk may unpack to very many of them."""
    sound = connection(0) + message(0, 1, b"a")
    data = sound + bytes(16 << 20)
    tracemalloc.start()
    try:
        found = walk(data, len(sound))
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
    assert found == ([], len(sound))
    messages, damage = read_bytes(bag(chunk(sound + bytes(1 << 20), "bz2")))
    assert values(messages) == [b"a"]
    assert damage
