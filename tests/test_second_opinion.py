"""Segments as a reader in another language sees them, which shares no line with ours."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.data import DATA

HERE = Path(__file__).parent / "second_opinion"
SMALL = RobotConfig(image_size=(64, 48), cloud_columns=20, scan_beams=180)
REAL = [
    "real/tilt_laser.bag",
    "real/luminar_pointcloud.bag",
    "real/auv_ros2.mcap",
    "real/ouster.mcap",
    "odd/example-unsorted-chunks.bag",
    "odd/empty_msgs.bag",
    "odd/no-messages.bag",
    "odd/protobuf.mcap",
    "odd/rosbag2/split_mcap",
]

pytestmark = [
    pytest.mark.mongo,
    pytest.mark.skipif(
        shutil.which("node") is None or shutil.which("npm") is None,
        reason="node and npm are not installed: no reader in another language has a look",
    ),
]


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the reader with its packages, in the versions that the lock file names."""
    place = tmp_path_factory.mktemp("npm") / "reader"
    shutil.copytree(HERE, place, ignore=shutil.ignore_patterns("node_modules"))
    done = subprocess.run(
        ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund"],
        cwd=place,
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    if done.returncode != 0:
        # Without a registry nothing can be said; with one, a failure is ours.
        offline = ("ENOTFOUND", "ECONNREFUSED", "EAI_AGAIN", "ETIMEDOUT", "ENETUNREACH")
        if any(word in done.stderr for word in offline):
            pytest.skip(f"npm reaches no registry: {done.stderr.strip()[-300:]}")
        pytest.fail(done.stderr[-2000:])
    return place / "read.mjs"


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    base = tmp_path_factory.mktemp("second")
    write_bag(base / "robot.bag", duration_s=3.0, config=SMALL)
    write_bag(base / "robot2", duration_s=3.0, ros=2, config=SMALL)
    with hl.open(base / "store", create=True, require_database=True) as opened:
        opened.record(base / "robot2")
        for compression in ("zstd", "lz4", "none"):
            settings = SegmentSettings(
                compression=compression,
                chunk_size=64 << 10,
                segment_size=300_000,
            )
            opened.record(base / "robot.bag", name=compression, settings=settings, again=True)
        if DATA.is_dir():
            for name in REAL:
                opened.record(DATA / name)
        yield opened


def opinion(reader: Path, segments: list[Path]) -> list[dict[str, Any]]:
    done = subprocess.run(
        ["node", reader, *segments], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stderr == ""
    found: list[dict[str, Any]] = json.loads(done.stdout)
    return found


def digest(lines: list[str]) -> str:
    return hashlib.sha256("".join(sorted(lines)).encode()).hexdigest()


def line(message: hl.Message) -> str:
    sent = message.log_time_ns if message.publish_time_ns is None else message.publish_time_ns
    head = f"{message.topic}\0{message.log_time_ns}\0{sent}\0{message.sequence}\0"
    return hashlib.sha256(head.encode() + message.raw).hexdigest()


def test_another_reader_sees_the_same_messages(store: hl.Store, reader: Path) -> None:
    # Which segment a message lies in, the index says.
    ours: dict[Path, list[hl.Message]] = defaultdict(list)
    for entry in store.recordings():
        paths = dict(places.segments(store.directory.path, entry.id))
        for number, path in paths.items():
            ours[path] = []
            topics = sorted({c.topic for c in entry.channels})
            if topics:
                query = store.query(topics, [entry.id]).where({"_meta.ref.seg": number})
                ours[path].extend(query)
    assert len(ours) > len(store.recordings())
    for seen in opinion(reader, list(ours)):
        messages = ours[Path(seen["path"])]
        want = digest([line(m) for m in messages])
        by_topic = Counter(m.topic for m in messages)
        for way in (seen["stream"], seen["indexed"]):
            assert way["messages"] == len(messages), seen["path"]
            assert way["topics"] == by_topic
            assert way["digest"] == want, seen["path"]
        indexed = seen["indexed"]
        assert indexed["ordered"]
        assert indexed["backwards"] == want
        assert indexed["profile"] == "hybridlog"
        assert "hybridlog.recording" in indexed["metadata"]
        assert indexed["chunks"] == indexed["statistics"]["chunks"]
        assert indexed["statistics"]["messages"] == len(messages)
        times = [m.log_time_ns for m in messages]
        assert indexed["statistics"]["start"] == str(min(times, default=0))
        assert indexed["statistics"]["end"] == str(max(times, default=0))


def test_another_reader_refuses_what_was_altered(
    store: hl.Store, reader: Path, tmp_path: Path
) -> None:
    """The test above can fail: a flipped bit in a chunk is no match."""
    entry = next(r for r in store.recordings() if r.name == "none")
    _, path = places.segments(store.directory.path, entry.id)[0]
    data = bytearray(path.read_bytes())
    data[int(store.catalog.table(entry, 0).chunks["offset"][0]) + 200] ^= 4
    altered = tmp_path / "altered.mcap"
    altered.write_bytes(data)
    done = subprocess.run(
        ["node", reader, altered], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode != 0
    assert "altered.mcap" in done.stderr


def test_the_lock_file_names_versions_and_no_hosts() -> None:
    package = json.loads((HERE / "package.json").read_text())
    assert all(v[0].isdigit() for v in package["dependencies"].values())
    text = (HERE / "package-lock.json").read_text()
    assert "resolved" not in text
    assert "http" not in text
    for name, entry in json.loads(text)["packages"].items():
        assert not name or entry["integrity"].startswith("sha512-"), name
