"""Hostile logs end within 5 s of processor time and 500 MB, or are refused with the reason."""

from __future__ import annotations

import bz2
import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk, DataEnd, Footer, Header, Schema

from hybridlog.formats.log_set import open_source
from hybridlog.formats.reading import Damage
from hybridlog.formats.yaml_values import YamlError, parse_yaml
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import MAGIC, Compressor, decompress
from tests.formats import test_rosbag1 as bags
from tests.formats.test_rosbag2 import make

CPU_S = 5
MEMORY = 500 << 20

READ = """
import json, os, resource, sys
from pathlib import Path
from hybridlog.formats.log_set import open_source

def read(path):
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    with open_source(Path(path)) as source:
        messages = sum(len(batch) for batch in source.batches())
        damage = [[each.reason, each.messages_lost] for each in source.damage]
        return messages, len(source.channels), damage

for line in sys.stdin:
    if not os.fork():
        try:
            found = read(line.strip())
        except Exception as error:
            found = str(error)
        print(json.dumps(found), flush=True)
        os._exit(0)
    if code := os.wait()[1]:
        print(json.dumps(code), flush=True)
"""
Read = Callable[[Path], tuple[int, int, list[Any]]]
"""Gives number of messages and channels of a log, and its damage, read within the limits."""


@pytest.fixture(scope="module")
def read() -> Iterator[Read]:
    limits = f"CPU_S, MEMORY = {CPU_S}, {MEMORY}"
    with subprocess.Popen(
        [sys.executable, "-c", limits + READ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as process:

        def found(path: Path) -> Any:
            assert process.stdin is not None
            assert process.stdout is not None
            print(path, file=process.stdin, flush=True)
            answer = json.loads(process.stdout.readline())
            assert isinstance(answer, list), answer
            return tuple(answer)

        yield found


# YAML

BAG = (
    "rosbag2_bagfile_information:\n  storage_identifier: sqlite3\n"
    "  relative_file_paths: [bag.db3]\n"
)
LAUGHS = "a0: &a0 [x]\n" + "".join(
    f"a{k}: &a{k} [{','.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)
MERGES = "a0: &a0 {k: 1}\n" + "".join(
    f"a{k}: &a{k} {{<<: [{','.join([f'*a{k - 1}'] * 9)}]}}\n" for k in range(1, 12)
)
LARGE = 6_000_000


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (LAUGHS + BAG, None),
        (MERGES + BAG, None),
        (BAG + "  files: &a [*a, *a]\n  message_count: *none\n", "does not describe a bag"),
        (BAG + "".join(f"  k{k}: 1\n" for k in range(LARGE // 30)), None),
        (BAG + "  junk: " + "word " * (LARGE // 5), None),
        (BAG + "  junk: &" + "a" * LARGE + " x\n", None),
        (BAG + "  junk: " + "[" * (LARGE // 2) + "]" * (LARGE // 2), "nesting depth"),
        ("? " * (LARGE // 2), "a key is a list"),
        (BAG + "  junk: [" + "," * LARGE, "cannot be used"),
        (BAG + "  junk: [" + "a," * LARGE, "more than 1000000 keys and values"),
        (BAG + "  junk: " + "9" * (1 << 26), "more than 64 MiB"),
    ],
    ids=lambda value: str(value)[:20] if value else "read",
)
def test_metadata_of_any_kind_is_bounded(
    read: Read, tmp_path: Path, text: str, reason: str | None
) -> None:
    folder = make(tmp_path / "bag")
    (folder / "metadata.yaml").write_text(text)
    messages, _, damage = read(folder)
    assert messages == 300
    if reason is None:
        assert damage == []
    else:
        assert len(damage) == 1
        assert reason in damage[0][0]
        assert "the files beside it are read without it" in damage[0][0]


def test_missing_files_of_the_metadata_are_told(read: Read, tmp_path: Path) -> None:
    folder = make(tmp_path / "bag")
    files = "".join(f"    - {{path: f{k}.db3, message_count: 2}}\n" for k in range(1000))
    (folder / "metadata.yaml").write_text(f"{BAG}  files:\n{files}")
    assert read(folder)[2] == []
    text = BAG.replace(
        "[bag.db3]", "[bag.db3, " + ", ".join(f"f{k}.db3" for k in range(1000)) + "]"
    )
    (folder / "metadata.yaml").write_text(f"{text}  files:\n{files}")
    assert read(folder)[2] == [["the file is missing; metadata.yaml lists it", None]] * 1000


def test_yaml_values() -> None:
    text = "{a: 1, b: '1', c: ~, d: True, e: 1.5, f: &x [-2, null], g: *x, <<: {h: 1}, i: !!str 3}"
    found = parse_yaml(text)
    assert found == {
        "a": 1,
        "b": "1",
        "c": None,
        "d": True,
        "e": "1.5",
        "f": [-2, None],
        "g": [-2, None],
        "<<": {"h": 1},
        "i": "3",
    }
    assert parse_yaml("a: 1\n---\n}") == {"a": 1}
    assert parse_yaml("") is None
    for wrong in ("{a: 1, a: 2}", "[", "{[a]: 1}", "\x00", "\ud800"):
        with pytest.raises(YamlError):
            parse_yaml(wrong)


# Chunks of MCAP files

PIECE = 1 << 20
EMPTY = struct.pack("<BQ", 0x90, 0)


def zeros(size: int) -> Iterator[bytes]:
    yield from (bytes(PIECE) for _ in range(size >> 20))


def noisy(size: int) -> Iterator[bytes]:
    """Two private records."""
    yield struct.pack("<BQ", 0x90, 1 << 16) + os.urandom(1 << 16) + struct.pack("<BQ", 0x90, size)
    yield from zeros(size)


def repeat(data: bytes, times: int = 1 << 20) -> Iterator[bytes]:
    yield data * times


def zstd(parts: Iterable[bytes]) -> tuple[bytes, int]:
    return _packed(zstandard.ZstdCompressor(level=1).compressobj(), parts)


def lz4_(parts: Iterable[bytes]) -> tuple[bytes, int]:
    packer = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    start = packer.begin()
    data, size = _packed(packer, parts)
    return start + data, size


def _packed(packer: Any, parts: Iterable[bytes]) -> tuple[bytes, int]:
    found, size = [], 0
    for part in parts:
        found.append(packer.compress(part))
        size += len(part)
    return b"".join([*found, packer.flush()]), size


def records(*found: Any) -> bytes:
    builder = RecordBuilder()
    for one in found:
        one.write(builder)
    return builder.end()


def schema(number: int, name: str = "a/T") -> bytes:
    return records(Schema(number, b"uint8 n", "ros1msg", name))


def channel(number: int, topic: str = "/a") -> bytes:
    fields = struct.pack("<HHI", number, 1, len(topic)) + topic.encode() + b"\4\0\0\0ros1\0\0\0\0"
    return struct.pack("<BQ", 4, len(fields)) + fields


def message(number: int = 1, payload: bytes = b"\1") -> bytes:
    return struct.pack("<BQHIQQ", 5, 22 + len(payload), number, 0, 1, 1) + payload


def chunk(codec: str, data: bytes, size: int, crc: int = 0) -> bytes:
    return records(Chunk(codec, data, 1, 1, crc, size))


def write(path: Path, *parts: bytes) -> Path:
    start = records(Header("ros1", "")) + schema(1) + channel(1)
    end = records(DataEnd(0), Footer(0, 0, 0))
    path.write_bytes(b"".join([MAGIC, start, *parts, end, MAGIC]))
    return path


GOOD = chunk("", message(), len(message()))
Data = Callable[[], tuple[bytes, int]]
"""Makes compressed data and the number of bytes that it stands for."""


@pytest.mark.parametrize(
    ("codec", "made", "claim", "reason"),
    [
        ("zstd", lambda: zstd(zeros(PIECE)), None, "the record at byte 0 of its content has no"),
        ("zstd", lambda: zstd(zeros(PIECE)), 1 << 30, "which is not believed of its"),
        ("zstd", lambda: zstd(zeros(PIECE)), 100, "zstd data is damaged"),
        ("lz4", lambda: lz4_(zeros(MEMORY)), 100, "to 100 bytes as it claims"),
        ("zstd", lambda: zstd(zeros(PIECE)), 8 << 30, "more than the limit of"),
        ("lz4", lambda: lz4_(zeros(PIECE)), 1 << 29, "which is not believed of its"),
        ("zstd", lambda: zstd(repeat(EMPTY)), None, "too many records for its size"),
        ("zstd", lambda: zstd(repeat(schema(2))), None, "too many records for its size"),
        ("zstd", lambda: zstd(repeat(message())), None, "too many records for its size"),
        ("zstd", lambda: zstd(repeat(message(), 5 << 19)), None, "too many records for its size"),
        ("zstd", lambda: zstd(noisy(99 << 20)), 100 << 20, "to 104857600 bytes as it claims"),
    ],
)
def test_chunks_of_any_kind_are_bounded(
    read: Read, tmp_path: Path, codec: str, made: Data, claim: int | None, reason: str
) -> None:
    good = chunk("", message() * 10, len(message() * 10))
    data, size = made()
    path = write(tmp_path / "a.mcap", good, chunk(codec, data, claim or size), good)
    messages, _, damage = read(path)
    assert 20 <= messages <= 20 + (1 << 18)
    assert [row[0].startswith("a chunk is damaged") for row in damage] == [True]
    assert reason in damage[0][0]


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_large_chunks_are_read_in_little_memory(read: Read, tmp_path: Path, codec: str) -> None:
    parts = [message(payload=os.urandom(PIECE))] * 100
    data, size = zstd(iter(parts)) if codec == "zstd" else lz4_(iter(parts))
    crc = 0
    for part in parts:
        crc = zlib.crc32(part, crc)
    path = write(tmp_path / "a.mcap", chunk(codec, data, size, crc))
    assert read(path)[::2] == (len(parts), [])
    path = write(tmp_path / "b.mcap", chunk(codec, data, size, crc ^ 1), GOOD)
    messages, _, damage = read(path)
    assert messages == 1
    assert damage == [["a chunk is damaged: its checksum differs", None]]


def test_segments_keep_to_the_ratio_that_readers_believe() -> None:
    large = bytes(300 << 20)
    assert Compressor("zstd").compress(large) == ("", large)
    assert Compressor("zstd").compress(large[: 100 << 20])[0] == "zstd"
    with pytest.raises(SegmentError, match="is not believed of its"):
        decompress("zstd", zstandard.compress(large), len(large))


# Chunks of ROS 1 bags


def test_chunks_of_bags_are_bounded(read: Read, tmp_path: Path) -> None:
    good = bags.chunk(bags.connection(0) + bags.message(0, 1, b"a"), "none")
    small = bags.message(0, 2, b"a")
    cases = [
        ("lz4", lz4_(zeros(80 << 20))[0], 2**32 - 1, "says 4294967295 bytes, there are 83886080"),
        ("lz4", lz4_(zeros(300 << 20))[0], 2**32 - 1, "bytes become more than"),
        ("bz2", bz2.compress(bytes(20 << 20)), 100, "says 100 bytes, it has more than 16777216"),
        ("lz4", lz4.frame.compress(small), 100, f"says 100 bytes, there are {len(small)}"),
        ("bz2", bz2.compress(small), 2**32 - 1, f"there are {len(small)}"),
    ]
    bad = [bags.packed_chunk(data, codec, size) for codec, data, size, _ in cases]
    path = tmp_path / "a.bag"
    path.write_bytes(bags.bag(good, *bad, good))
    messages, _, damage = read(path)
    assert messages == 4
    assert len(damage) == len(cases)
    for (reason, _), (*_, wanted) in zip(damage, cases, strict=True):
        assert wanted in reason


def test_large_chunks_of_bags_are_read_in_little_memory(read: Read, tmp_path: Path) -> None:
    rows = [bags.connection(0)] + [bags.message(0, 1, os.urandom(PIECE))] * 200
    data, size = lz4_(iter(rows))
    path = tmp_path / "a.bag"
    path.write_bytes(bags.bag(bags.packed_chunk(data, "lz4", size)))
    assert read(path)[::2] == (200, [])


# Channels

FULL = 65535


def test_a_log_of_too_many_channels_is_refused(read: Read, tmp_path: Path) -> None:
    many = [channel(1 + k % FULL, f"/t{k}") + message(1 + k % FULL) for k in range(FULL + 1)]
    with pytest.raises(AssertionError, match=f"it has more than {FULL} channels"):
        read(write(tmp_path / "a.mcap", *many))


def test_definitions_without_messages(read: Read, tmp_path: Path) -> None:
    # The last definition of each id is a channel.
    path = write(tmp_path / "a.mcap", *(channel(9, f"/t{k}") for k in range(70_000)), message())
    assert read(path) == (1, 2, [])
    flips = [channel(k, f"/t{k}") for k in range(1, FULL)] + [
        schema(1, f"a/T{k % 2}") for k in range(10_000)
    ]
    assert read(write(tmp_path / "b.mcap", *flips, message())) == (1, FULL - 1, [])


def test_very_many_damaged_places_are_counted_together(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", GOOD)
    with open_source(path) as source:
        for place in range(10_300):
            source.note(Damage(path, place, 1, "bad", 2))
        assert [one.offset for one in source.damage] == [*range(10_000), None]
        assert source.damage[-1].messages_lost == 600
        source.note(Damage(path, 0, 1, "bad", None))
        assert source.damage[-1].messages_lost is None
