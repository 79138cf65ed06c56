"""A store of several recordings for SQL."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.columns import column_file
from hybridlog.columns import table_writer as writer
from hybridlog.sql.engine import SqlAnswer
from hybridlog_storage.messages import Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.tables.logs import BASE, SECOND, payload, varied, write_log

CHUNKS = SegmentSettings(chunk_size=32 << 10)
SCAN = Schema(
    "test/Scan",
    "ros1msg",
    b"float32 angle\nfloat32[] ranges\nEcho echo\n"
    + b"=" * 80
    + b"""
MSG: test/Echo
uint8 kind
uint8[] data
float32[40] far
""",
)
TEXT = Schema("test/Text", "ros1msg", b"string name\nstring f64\nfloat32 i8\n")
SCANS, LARGE = 300, 1200


def scan(n: int) -> bytes:
    """A scan whose ranges are n, n + 1, … n + 99."""
    ranges = struct.pack("<fI100f", n / 2, 100, *range(n, n + 100))
    return ranges + struct.pack("<BI50B40f", n % 7, 50, *([n % 256] * 50), *([n / 4] * 40))


def text(n: int) -> bytes:
    name, f64 = f"text {n}".encode(), f"{n}.5".encode()
    return b"".join(
        (struct.pack("<I", len(name)), name, struct.pack("<I", len(f64)), f64, struct.pack("<f", n))
    )


def files_read(answer: SqlAnswer) -> int:
    return len({path for path, _ in answer.reading.groups})


def first_log(path: Path) -> Path:
    """A log of fields of all kinds, and of scans."""
    said = [(BASE + n * 1_000_001, "/large", varied(n)) for n in range(LARGE)]
    said += [(BASE + n * 2_000_000 + 5, "/base/scan", scan(n)) for n in range(SCANS)]
    said += [(BASE + n, topic, varied(n)) for n in range(9) for topic in ("/mixed", "/order")]
    said += [(BASE + n, "/recordings", varied(n)) for n in range(3)]
    return write_log(path, sorted(said), {"/base/scan": ("ros1", SCAN)})


def second_log(path: Path) -> Path:
    """A later log: topics of the first one, one with another type, and odd names."""
    later = BASE + 3600 * SECOND
    said = [(later + n * SECOND, "/large", payload(n, i8=5, f64=n / 3)) for n in range(40)]
    said += [(later + n * SECOND, "/mixed", text(n)) for n in range(4)]
    said += [(later + n * SECOND, name, text(n)) for n in range(3) for name in ("/Large", "/a b")]
    kinds = dict.fromkeys(("/mixed", "/Large", "/a b"), ("ros1", TEXT))
    return write_log(path, said, kinds)


@pytest.fixture(scope="session")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store of two recordings, whose tables have row groups of 300 rows."""
    folder = tmp_path_factory.mktemp("sql")
    logs = first_log(folder / "first.mcap"), second_log(folder / "second.mcap")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(column_file, "_GROUP_ROWS", 300)
        patch.setattr(writer, "LONG_ROWS", 1000)
        with hl.open(folder / "store", create=True, mongo="none") as opened:
            opened.record(logs[0], name="first", tags={"site": "hall"}, settings=CHUNKS)
            opened.record(logs[1], name="second", settings=CHUNKS)
    return folder / "store"


@pytest.fixture(scope="session")
def store(root: Path) -> Iterator[hl.Store]:
    """The store; MongoDB cannot be reached from it."""
    with hl.open(root, mongo="mongodb://127.0.0.1:1/?serverSelectionTimeoutMS=1") as opened:
        yield opened
