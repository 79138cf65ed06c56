"""Hostile logs end within 5 s of processor time and 500 MB, or are refused with the reason."""

from __future__ import annotations

import bz2
import json
import os
import resource
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

from hybridlog.formats.yaml_values import YamlError, parse_yaml
from hybridlog_storage.errors import SegmentError
from hybridlog_storage.mcap.mcap_content import Compressor, decompress
from tests.formats import test_rosbag1 as bags
from tests.formats.test_rosbag2 import make

CPU_S = 5
MEMORY = 500 << 20

READ = """
import json, sys
from pathlib import Path
from hybridlog.formats.log_set import open_source

with open_source(Path(sys.argv[1])) as source:
    messages = sum(len(batch) for batch in source.batches())
    damage = [[each.reason, each.messages_lost] for each in source.damage]
    print(json.dumps([messages, len(source.channels), damage]))
"""


def bounded(*command: str, memory: int = MEMORY) -> subprocess.CompletedProcess[str]:
    """Run a Python command with limits of processor time and memory."""

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))

    environment = {
        **os.environ,
        "OPENBLAS_NUM_THREADS": "1",
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    return subprocess.run(
        [sys.executable, *command],
        preexec_fn=limit,
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )


def read(path: Path) -> tuple[int, int, list[Any]]:
    """Number of messages and channels of a log, and its damage, read within the limits."""
    done = bounded("-c", READ, str(path))
    assert done.returncode == 0, (done.returncode, done.stderr[-2000:])
    messages, channels, damage = json.loads(done.stdout)
    return messages, channels, damage


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
def test_metadata_of_any_kind_is_bounded(tmp_path: Path, text: str, reason: str | None) -> None:
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


def test_missing_files_of_the_metadata_are_told(tmp_path: Path) -> None:
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

GIB = 1 << 30
PIECE = 1 << 20


def zeros(size: int) -> Iterator[bytes]:
    yield from (bytes(PIECE) for _ in range(size >> 20))


def private(size: int, opcode: int = 0x90) -> Iterator[bytes]:
    """A record whose content is zeros."""
    yield struct.pack("<BQ", opcode, size)
    yield from zeros(size)


def noisy(size: int) -> Iterator[bytes]:
    yield record(0x90, os.urandom(1 << 16))
    yield from private(size)


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


def record(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def text(value: str | bytes) -> bytes:
    value = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(value)) + value


def schema(number: int, name: str = "a/T", data: str = "uint8 n") -> bytes:
    return record(3, struct.pack("<H", number) + text(name) + text("ros1msg") + text(data))


def channel(number: int, topic: str = "/a", schema_id: int = 1) -> bytes:
    fields = struct.pack("<HH", number, schema_id) + text(topic) + text("ros1")
    return record(4, fields + struct.pack("<I", 0))


def message(number: int = 1, payload: bytes = b"\1", time: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", number, 0, time, time) + payload)


def chunk(codec: str, data: bytes, size: int, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 1, 1, size, crc) + text(codec)
    return record(6, head + struct.pack("<Q", len(data)) + data)


def write(path: Path, *parts: bytes) -> Path:
    magic = b"\x89MCAP0\r\n"
    start = record(1, text("ros1") + text("")) + schema(1) + channel(1)
    end = record(15, bytes(4)) + record(2, bytes(20))
    path.write_bytes(magic + start + b"".join(parts) + end + magic)
    return path


GOOD = chunk("", message(), len(message()))
Data = Callable[[], tuple[bytes, int]]
"""Makes compressed data and the number of bytes that it stands for."""


@pytest.mark.parametrize(
    ("codec", "made", "claim", "reason"),
    [
        ("zstd", lambda: zstd(zeros(PIECE)), None, "the record at byte 0 of its content has no"),
        ("zstd", lambda: zstd(zeros(GIB)), None, "which is not believed of its"),
        ("lz4", lambda: lz4_(zeros(GIB)), None, "which is not believed of its"),
        ("zstd", lambda: zstd(zeros(PIECE)), 100, "zstd data is damaged"),
        ("lz4", lambda: lz4_(zeros(GIB)), 100, "to 100 bytes as it claims"),
        ("zstd", lambda: zstd(zeros(PIECE)), 8 << 30, "more than the limit of"),
        ("lz4", lambda: lz4_(zeros(PIECE)), 1 << 29, "which is not believed of its"),
        ("zstd", lambda: zstd(private(3 * GIB)), 2 * GIB, "more than the limit of"),
        ("zstd", lambda: zstd(repeat(record(0x90, b""))), None, "too many records for its size"),
        ("zstd", lambda: zstd(repeat(schema(2))), None, "too many records for its size"),
        ("zstd", lambda: zstd(repeat(message())), None, "too many records for its size"),
        ("zstd", lambda: zstd(repeat(message(), 5 << 19)), None, "too many records for its size"),
        ("zstd", lambda: zstd(noisy(99 << 20)), 100 << 20, "to 104857600 bytes as it claims"),
    ],
)
def test_chunks_of_any_kind_are_bounded(
    tmp_path: Path, codec: str, made: Data, claim: int | None, reason: str
) -> None:
    good = chunk("", message() * 10, len(message() * 10))
    data, size = made()
    path = write(tmp_path / "a.mcap", good, chunk(codec, data, claim or size), good)
    messages, _, damage = read(path)
    assert 20 <= messages <= 20 + (1 << 18)
    assert [row[0].startswith("a chunk is damaged") for row in damage] == [True]
    assert reason in damage[0][0]


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_large_chunks_are_read_in_little_memory(tmp_path: Path, codec: str) -> None:
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


def test_chunks_of_bags_are_bounded(tmp_path: Path) -> None:
    good = bags.chunk(bags.connection(0) + bags.message(0, 1, b"a"), "none")
    small = bags.message(0, 2, b"a")
    packed = {
        "bz2": bz2.compress(bytes(300 << 20)),
        "lz4": lz4_(zeros(80 << 20))[0],
    }
    cases = [
        ("lz4", packed["lz4"], 100, "says 100 bytes, it has more than 16777216"),
        ("lz4", packed["lz4"], 2**32 - 1, "says 4294967295 bytes, there are 83886080"),
        ("bz2", packed["bz2"], 100, "says 100 bytes, it has more than 16777216"),
        ("bz2", packed["bz2"], 2**32 - 1, "bytes become more than"),
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


def test_large_chunks_of_bags_are_read_in_little_memory(tmp_path: Path) -> None:
    rows = [bags.connection(0)] + [bags.message(0, 1, os.urandom(PIECE))] * 200
    data, size = lz4_(iter(rows))
    path = tmp_path / "a.bag"
    path.write_bytes(bags.bag(bags.packed_chunk(data, "lz4", size)))
    assert read(path)[::2] == (200, [])


# Channels

FULL = 65535


def test_a_log_of_too_many_channels_is_refused(tmp_path: Path) -> None:
    many = [channel(1 + k % FULL, f"/t{k}") + message(1 + k % FULL) for k in range(FULL + 1)]
    rows = [bags.connection(k, topic=f"/t{k}") + bags.message(k, 1, b"") for k in range(FULL + 1)]
    bag = tmp_path / "a.bag"
    bag.write_bytes(bags.bag(*rows))
    for path in (write(tmp_path / "a.mcap", *many), bag):
        done = bounded("-c", READ, str(path))
        assert f"it has more than {FULL} channels" in done.stderr


def test_definitions_without_messages(tmp_path: Path) -> None:
    # The last definition of each id is a channel.
    path = write(tmp_path / "a.mcap", *(channel(9, f"/t{k}") for k in range(70_000)), message())
    assert read(path) == (1, 2, [])
    flips = [channel(k, f"/t{k}") for k in range(1, FULL)] + [
        schema(1, f"a/T{k % 2}") for k in range(10_000)
    ]
    assert read(write(tmp_path / "b.mcap", *flips, message())) == (1, FULL - 1, [])


def test_very_many_damaged_places_are_counted_together(tmp_path: Path) -> None:
    bad = chunk("", message(9) * 2, 2 * len(message(9)))
    good = chunk("", message(), len(message()))
    messages, _, damage = read(write(tmp_path / "a.mcap", bad * 10_300, good))
    assert messages == 1
    assert len(damage) == 10_001
    assert damage[9_999][1] == 2
    assert damage[10_000] == ["more places could not be read", 600]
    unknown = chunk("zstd", b"bad", 100)
    damage = read(write(tmp_path / "b.mcap", bad * 10_300, unknown, good))[2]
    assert damage[10_000] == ["more places could not be read", None]
