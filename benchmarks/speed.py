"""hybridlog beside the other ways to do the same: `pytest benchmarks/speed.py [--quick]`.

A group of benchmarks has the same input; all of a group must give the same answer. The
targets are in docs/benchmarks.md.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymongo
import pytest
from bson import decode_all
from bson.raw_bson import DEFAULT_RAW_BSON_OPTIONS as RAW_BSON
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

import hybridlog as hl
from benchmarks.backends.conversion import message_plan
from benchmarks.conftest import Inputs
from benchmarks.loads import bags
from benchmarks.side import run_side
from hybridlog_storage.mongo.collection_names import collection_of
from hybridlog_storage.mongo.database import Database
from hybridlog_storage.mongo.mongod import EmbeddedMongod

Size = Callable[[int, int], int]
ROUNDS = 3
SEED = 1
TIMEOUT_S = 600.0
PEAK_LIMIT = 400_000_000
GROWTH_LIMIT = 1.15
"""A longer log may add a sixth to the peak: buffers that happen to be full at once."""

_SECOND_NS = 1_000_000_000
_BLOCK = 1000


def _record(bag: Path, store: Path) -> int:
    with hl.open(store, create=True, require_database=True) as opened:
        report = opened.record(bag)
    assert report.failure is None
    assert report.indexed == report.entry.messages
    return report.entry.messages


def record_side(bag: str, store: str) -> dict[str, int]:
    """Record in a process of its own, whose peak memory counts."""
    return {"messages": _record(Path(bag), Path(store))}


def slice_side(store: str, start: int) -> dict[str, int]:
    """Read a slice in a process of its own."""
    with hl.open(store) as opened:
        return {"messages": len(_slice(opened, start))}


def _slice(store: Any, start: int) -> list[bytes]:
    query = store.topic(bags.SCAN_TOPIC).between(start, start + _SECOND_NS)
    return [message.raw for message in query]


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Callable[[], tuple[tuple[Path], dict[str, Any]]]]:
    """Setup of a round: a path on which nothing is."""

    def setup() -> tuple[tuple[Path], dict[str, Any]]:
        shutil.rmtree(tmp_path, ignore_errors=True)
        tmp_path.mkdir()
        return (tmp_path / "fresh",), {}

    yield setup
    shutil.rmtree(tmp_path, ignore_errors=True)


# --- small messages -------------------------------------------------------------------


@pytest.fixture
def small(inputs: Inputs, size: Size) -> tuple[Path, int]:
    """Poses, IMU, transforms and joint states, a quarter each."""
    count = size(1_000_000, 4_000)
    return inputs(f"small-{count}.bag", lambda p: bags.write_small(p, count, SEED)), count


@pytest.mark.benchmark(group="record_small")
def bench_small_hybridlog(small: tuple[Path, int], fresh: Any, benchmark: Any) -> None:
    bag, count = small
    found = benchmark.pedantic(lambda p: _record(bag, p), setup=fresh, rounds=ROUNDS)
    assert found == count


@pytest.mark.benchmark(group="record_small")
def bench_small_dictionaries(small: tuple[Path, int], tmp_path: Path, benchmark: Any) -> None:
    """Decode every message with rosbags, make it a dictionary, `insert_many` of 1 000."""
    bag, count = small

    def insert() -> int:
        client.drop_database("plain")
        waiting: dict[str, list[Any]] = defaultdict(list)
        plans: dict[str, Any] = {}
        database, messages = client["plain"], 0
        with AnyReader([bag]) as reader:
            for connection, log_time, payload in reader.messages():
                kind, name = connection.msgtype, collection_of(connection.topic)
                plan = plans.setdefault(kind, None) or message_plan(reader.typestore, kind)
                plans[kind] = plan
                document = plan(reader.deserialize(payload, kind)) | {"log_time": log_time}
                waiting[name].append(document)
                messages += 1
                if len(waiting[name]) == _BLOCK:
                    database[name].insert_many(waiting.pop(name))
        for name, rows in waiting.items():
            database[name].insert_many(rows)
        return messages

    with EmbeddedMongod(tmp_path) as mongod:
        client: Any = pymongo.MongoClient(mongod.start())
        with client:
            assert benchmark.pedantic(insert, rounds=ROUNDS) == count


@pytest.mark.benchmark(group="record_small")
def bench_small_raw_documents(small: tuple[Path, int], tmp_path: Path, benchmark: Any) -> None:
    """Insert hybridlog's own documents, made before, by two threads: mongod alone."""
    bag, count = small
    _record(bag, tmp_path / "store")
    with hl.open(tmp_path / "store") as store:
        database = store.database_for("the benchmark")
        blocks = [
            (name, raw, np.array([len(each.raw) for each in decode_all(raw, RAW_BSON)]))
            for name in database.list_collections()
            if not name.startswith("hybridlog.")
            for raw in (bytes(part) for part in database.find_raw(name))
        ]
    with (
        EmbeddedMongod(tmp_path / "alone") as mongod,
        Database.connect(mongod.start()) as alone,
        ThreadPoolExecutor(2) as pool,
    ):
        names = {name for name, _, _ in blocks}

        def empty() -> None:
            for name in names:
                alone.drop(name)
                alone.ensure_collection(name)

        def insert() -> int:
            return sum(
                pool.map(lambda b: alone.insert_raw(b[0], b[1], len(b[2]), lengths=b[2]), blocks)
            )

        assert benchmark.pedantic(insert, setup=empty, rounds=ROUNDS) == count


# --- images ---------------------------------------------------------------------------


@pytest.fixture
def images(inputs: Inputs, size: Size) -> tuple[Path, int]:
    """Images of 640 kB: half of each is noise, half is smooth."""
    count = size(500, 10)
    return inputs(f"images-{count}.bag", lambda p: bags.write_images(p, count, SEED)), count


@pytest.mark.benchmark(group="record_images")
def bench_images_hybridlog(images: tuple[Path, int], fresh: Any, benchmark: Any) -> None:
    bag, count = images
    found = benchmark.pedantic(lambda p: _record(bag, p), setup=fresh, rounds=ROUNDS)
    assert found == count


@pytest.mark.benchmark(group="record_images")
@pytest.mark.parametrize("sync", [False, True], ids=["mcap", "mcap_fsync"])
def bench_images_copy(images: tuple[Path, int], fresh: Any, benchmark: Any, *, sync: bool) -> None:
    """A copy by the `mcap` package's writer."""
    bag, count = images

    def copy(path: Path) -> Path:
        bags.bag_to_mcap(bag, path)
        if sync:
            with path.open("rb") as stream:
                os.fsync(stream.fileno())
        return path

    path = benchmark.pedantic(copy, setup=fresh, rounds=ROUNDS)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == count


# --- a slice out of a drive -----------------------------------------------------------


class Drive:
    """Two cameras and a scanner: as a bag, as an MCAP file, in an open store."""

    def __init__(self, directory: Path, inputs: Inputs, seconds: int) -> None:
        self.bag = inputs(f"drive-{seconds}.bag", lambda p: bags.write_drive(p, seconds, SEED))
        self.file = inputs(f"drive-{seconds}.mcap", lambda p: bags.bag_to_mcap(self.bag, p))
        _record(self.bag, directory / "store")
        self.store = hl.open(directory / "store")
        random = np.random.default_rng(SEED)
        starts = random.uniform(0.5, seconds - 1.0, 12) * _SECOND_NS
        self.starts = [bags.START_NS + int(start) for start in starts]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory, inputs: Inputs, size: Size) -> Iterator[Drive]:
    made = Drive(tmp_path_factory.mktemp("drive"), inputs, size(600, 4))
    with made.store:
        yield made


def _mcap_slice(drive: Drive, start: int) -> list[bytes]:
    with drive.file.open("rb") as stream:
        messages = make_reader(stream).iter_messages([bags.SCAN_TOPIC], start, start + _SECOND_NS)
        return [message.data for _, _, message in messages]


@pytest.mark.benchmark(group="slice")
def bench_slice_hybridlog(drive: Drive, benchmark: Any) -> None:
    """A second of /scan, in an open store; no second twice in a round."""

    def read() -> list[list[bytes]]:
        return [_slice(drive.store, start) for start in drive.starts]

    found = benchmark.pedantic(read, setup=drive.store.refresh, rounds=ROUNDS)
    assert found == [_mcap_slice(drive, start) for start in drive.starts]
    query = drive.store.topic(bags.SCAN_TOPIC).between(drive.starts[0], drive.starts[-1])
    sum(1 for _ in query)
    benchmark.extra_info["bytes_read"] = query.counters.bytes_read


@pytest.mark.benchmark(group="slice")
def bench_slice_mcap(drive: Drive, benchmark: Any) -> None:
    """The same by the `mcap` reader, its summary read before."""
    with drive.file.open("rb") as stream:
        reader = make_reader(stream)
        reader.get_summary()

        def read() -> list[list[bytes]]:
            return [
                [m.data for _, _, m in reader.iter_messages([bags.SCAN_TOPIC], s, s + _SECOND_NS)]
                for s in drive.starts
            ]

        found = benchmark.pedantic(read, rounds=ROUNDS)
    assert [len(payloads) for payloads in found] == [20] * len(found)


# --- a topic as a frame ---------------------------------------------------------------


class Imu:
    """IMU messages: as a bag, as an MCAP file, in an open store."""

    def __init__(self, directory: Path, inputs: Inputs, count: int) -> None:
        self.count = count
        self.bag = inputs(f"imu-{count}.bag", lambda p: bags.write_imu(p, count, SEED))
        self.file = inputs(f"imu-{count}.mcap", lambda p: bags.bag_to_mcap(self.bag, p))
        _record(self.bag, directory / "store")
        self.store = hl.open(directory / "store")


@pytest.fixture(scope="module")
def imu(tmp_path_factory: pytest.TempPathFactory, inputs: Inputs, size: Size) -> Iterator[Imu]:
    made = Imu(tmp_path_factory.mktemp("imu"), inputs, size(1_000_000, 4_000))
    with made.store:
        yield made


def _from_bag(imu: Imu) -> Iterator[tuple[int, Any]]:
    with AnyReader([imu.bag]) as reader:
        for connection, log_time, payload in reader.messages():
            yield log_time, reader.deserialize(payload, connection.msgtype)


def _from_mcap(imu: Imu) -> Iterator[tuple[int, Any]]:
    types = get_typestore(Stores.ROS1_NOETIC)
    with imu.file.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages():
            yield message.log_time, types.deserialize_ros1(message.data, "sensor_msgs/msg/Imu")


def _frame(messages: Iterable[tuple[int, Any]]) -> pd.DataFrame:
    """The same columns as hybridlog's frame."""
    vectors = {"orientation": "xyzw", "angular_velocity": "xyz", "linear_acceleration": "xyz"}
    times, rows = [], []
    for log_time, m in messages:
        stamp = m.header.stamp
        row = [m.header.seq, stamp.sec * _SECOND_NS + stamp.nanosec, m.header.frame_id]
        for name, axes in vectors.items():
            vector = getattr(m, name)
            row += [getattr(vector, axis) for axis in axes]
        times.append(log_time)
        rows.append([*row, *(getattr(m, f"{name}_covariance") for name in vectors)])
    columns = ["header.seq", "header.stamp", "header.frame_id"]
    columns += [f"{name}.{axis}" for name, axes in vectors.items() for axis in axes]
    columns += [f"{name}_covariance" for name in vectors]
    index = pd.to_datetime(np.array(times), unit="ns", utc=True)
    return pd.DataFrame(rows, columns=columns, index=index)


FRAMES: dict[str, Callable[[Imu], pd.DataFrame]] = {
    "hybridlog": lambda imu: imu.store.topic(bags.IMU_TOPIC).to_pandas(),
    "rosbags": lambda imu: _frame(_from_bag(imu)),
    "mcap": lambda imu: _frame(_from_mcap(imu)),
}


@pytest.mark.benchmark(group="to_pandas")
@pytest.mark.parametrize("way", FRAMES)
def bench_frame(way: str, imu: Imu, benchmark: Any) -> None:
    found = benchmark.pedantic(FRAMES[way], (imu,), rounds=ROUNDS)
    expected = FRAMES["mcap" if way == "hybridlog" else "hybridlog"](imu)
    assert len(found) == imu.count
    assert (found.index == expected.index).all()
    for name in ("header.seq", "orientation.w", "angular_velocity.x", "linear_acceleration.z"):
        assert np.array_equal(found[name], expected[name]), name
    for name in (column for column in expected if column.endswith("_covariance")):
        assert np.array_equal(found[name].iloc[-1], expected[name].iloc[-1]), name


# --- what a command costs, and memory -------------------------------------------------


@pytest.mark.benchmark(group="start")
def bench_start(benchmark: Any) -> None:
    """`hybridlog --help`: what every command costs before it does anything."""
    command = [sys.executable, "-m", "hybridlog", "--help"]
    done = benchmark.pedantic(
        subprocess.run, (command,), {"capture_output": True}, rounds=10, warmup_rounds=1
    )
    assert done.returncode == 0


@pytest.mark.parametrize("kind", ["small", "images"])
def bench_memory_of_record(
    kind: str, inputs: Inputs, size: Size, tmp_path: Path, benchmark: Any
) -> None:
    """Peak memory of `record`: within the limit, and the same for a log twice as long."""
    write, peaks = getattr(bags, f"write_{kind}"), []
    for times in (1, 2):
        count = times * (size(500_000, 4_000) if kind == "small" else size(250, 10))
        bag = inputs(f"{kind}-{count}.bag", lambda p, n=count: write(p, n, SEED))
        arguments = {"bag": str(bag), "store": str(tmp_path / str(times))}
        side = "benchmarks.speed:record_side"
        job = (side, arguments, tmp_path, TIMEOUT_S)
        found = benchmark.pedantic(run_side, job, rounds=1) if times == 2 else run_side(*job)
        assert found["messages"] == count
        peaks.append(found["peak_rss"])
    benchmark.extra_info["peak_rss"] = peaks
    _see_that_it_fits(peaks)


def bench_memory_of_slices(drive: Drive, tmp_path: Path, benchmark: Any) -> None:
    """Peak memory of a process that reads a slice."""
    path = str(drive.store.directory.path)
    peaks = []
    for start in drive.starts[:ROUNDS]:
        side, arguments = "benchmarks.speed:slice_side", {"store": path, "start": start}
        found = run_side(side, arguments, tmp_path, TIMEOUT_S)
        assert found["messages"] == 20
        peaks.append(found["peak_rss"])
    benchmark.extra_info["peak_rss"] = peaks
    benchmark.pedantic(statistics.median, (peaks,), rounds=1)
    _see_that_it_fits(peaks)


def _see_that_it_fits(peaks: list[int]) -> None:
    assert max(peaks) < PEAK_LIMIT, json.dumps(peaks)
    assert peaks[-1] / peaks[0] <= GROWTH_LIMIT, json.dumps(peaks)
