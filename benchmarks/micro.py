"""The hot paths of hybridlog, one at a time: `pytest benchmarks/micro.py`.

`--benchmark-autosave` keeps the figures, and `--benchmark-compare` shows them beside those of
the run before, such as one of another revision.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import cycle
from pathlib import Path
from typing import Any

import bson
import numpy as np
import pyarrow as pa
import pytest
from rosbags.rosbag1 import Reader

import hybridlog as hl
from benchmarks.conftest import Inputs
from benchmarks.loads import bags as logs
from hybridlog.across.match import HOWS, How, match
from hybridlog.columns.table_writer import TableWriter
from hybridlog.index.indexing import ChunkIndexer
from hybridlog.query.counters import Counters
from hybridlog.query.planner import Planner
from hybridlog.schema.codecs import codec_for
from hybridlog.schema.index_bodies import index_bodies
from hybridlog_storage.messages import Batch, Channel, Schema
from hybridlog_storage.mongo.index_documents import DocumentAssembler, Origin, Placed
from hybridlog_storage.segments.chunk import StoredChunk, pack
from hybridlog_storage.segments.chunk_builder import ChunkBuilder
from hybridlog_storage.segments.compression import Compressor
from hybridlog_storage.segments.segment_writer import RecordingWriter, SegmentSettings

SMALL, IMU, DRIVE = "small.bag", "imu.bag", "drive.bag"
_MAKE: dict[str, Callable[[Path], None]] = {
    SMALL: lambda path: logs.write_small(path, 4000, 1),
    IMU: lambda path: logs.write_imu(path, 20_000, 1),
    DRIVE: lambda path: logs.write_drive(path, 4.0, 1),
}


@pytest.fixture(scope="session")
def bags(inputs: Inputs) -> Path:
    """The directory with the bags."""
    return [inputs(name, make).parent for name, make in _MAKE.items()][-1]


@pytest.fixture(scope="session")
def store(bags: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """A store with the IMU messages and the drive in it."""
    path = tmp_path_factory.mktemp("store") / "store"
    with hl.open(path, create=True, require_database=True) as opened:
        for name in (IMU, DRIVE):
            opened.record(bags / name)
        yield opened


@dataclass(frozen=True, eq=False, slots=True)
class Stream:
    """The messages of one topic.

    Attributes:
        topic: Name.
        msgtype: As ROS 1 spells it.
        definition: Text of the definition.
        payloads: In order of log time.
        log_times: ns.
    """

    topic: str
    msgtype: str
    definition: bytes
    payloads: list[bytes]
    log_times: list[int]

    def channel(self) -> Channel:
        """Its channel."""
        schema = Schema(self.msgtype, "ros1msg", self.definition)
        return Channel(self.topic, "ros1", schema, {}, has_publish_time=False)

    def batches(self, size: int) -> list[Batch]:
        """All messages, `size` to a batch."""
        made = []
        for first in range(0, len(self.payloads), size):
            payloads = self.payloads[first : first + size]
            length = np.array([len(payload) for payload in payloads], np.int64)
            log_time = np.array(self.log_times[first : first + size], np.int64)
            made.append(
                Batch(
                    b"".join(payloads),
                    np.cumsum(length) - length,
                    length,
                    np.zeros(len(payloads), np.int32),
                    log_time,
                    log_time,
                    np.zeros(len(payloads), np.uint32),
                )
            )
        return made


@lru_cache(maxsize=8)
def read(bag: Path, topic: str, limit: int) -> Stream:
    """The first messages of a topic.

    Args:
        bag: One of the bags.
        topic: One of its topics.
        limit: Most messages.
    """
    with Reader(bag) as reader:
        connection = next(c for c in reader.connections if c.topic == topic)
        stream = Stream(
            topic,
            connection.msgtype.replace("/msg/", "/"),
            connection.msgdef.data.encode(),
            [],
            [],
        )
        for _, log_time, payload in reader.messages([connection]):
            if len(stream.payloads) == limit:
                break
            stream.payloads.append(bytes(payload))
            stream.log_times.append(log_time)
    return stream


PACK_CASES = {
    "imu": (IMU, "/imu/data", 6000),
    "scan": (DRIVE, "/scan", 80),
    "images": (DRIVE, "/camera/left/image_raw", 6),
}


@pytest.mark.parametrize("case", PACK_CASES)
def bench_pack(case: str, bags: Path, benchmark: Any) -> None:
    """Chunks of about 2 MB, or all that there is."""
    name, topic, count = PACK_CASES[case]
    batch: Any = read(bags / name, topic, count).batches(count)[0]
    compressor = Compressor()
    builder = ChunkBuilder(2 << 20)
    builder.append(batch, np.arange(count))
    content, seq, size = builder.take()
    packed = benchmark(pack, compressor, content, seq, size)
    assert packed.uncompressed_size == size


INSERT_COUNT = 5000


def bench_insert(store: Any, benchmark: Any) -> None:
    """Documents of some 350 bytes with keys in order, into an empty collection."""
    rows = [
        bson.encode(
            {
                "_id": struct.pack(">QIQ", 10**18 + row, 1, row),
                "values": {f"v{n}": row / (n + 1) for n in range(16)},
                "_meta": {"t": 10**18 + row, "topic": "/imu/data", "seq": row},
            }
        )
        for row in range(INSERT_COUNT)
    ]
    documents = b"".join(rows)
    lengths = np.array([len(row) for row in rows], np.int64)
    database = store.database

    def empty() -> None:
        database.drop("micro")
        database.ensure_collection("micro")

    def insert() -> int:
        return int(database.insert_raw("micro", documents, INSERT_COUNT, lengths=lengths))

    try:
        inserted = benchmark.pedantic(insert, setup=empty, rounds=10, warmup_rounds=1)
    finally:
        database.drop("micro")
    assert inserted == INSERT_COUNT


APPEND_CASES = {
    "one": (SMALL, "/imu/data", 1000, 1),
    "batches": (SMALL, "/imu/data", 1000, 100),
    "images": (DRIVE, "/camera/left/image_raw", 24, 1),
}
"""Bag, topic, messages, messages to a batch."""


@pytest.mark.parametrize("case", APPEND_CASES)
def bench_append(case: str, bags: Path, benchmark: Any) -> None:
    """Lay messages down in the open chunk, and take it."""
    name, topic, count, size = APPEND_CASES[case]
    batches: list[Any] = read(bags / name, topic, count).batches(size)
    arrivals = [np.arange(n * size, n * size + len(b)) for n, b in enumerate(batches)]

    def append() -> int:
        builder = ChunkBuilder(2 << 20)
        for batch, seq in zip(batches, arrivals, strict=True):
            builder.append(batch, seq)
        return len(builder.take()[0])

    assert benchmark(append) == count


@pytest.mark.parametrize("case", APPEND_CASES)
def bench_write(case: str, bags: Path, tmp_path: Path, benchmark: Any) -> None:
    """Append to a recording, and close it: chunks are packed and written, nothing synced."""
    name, topic, count, size = APPEND_CASES[case]
    stream = read(bags / name, topic, count)
    batches, channels = stream.batches(size), [stream.channel()]
    settings = SegmentSettings(sync="never")
    made = 0

    def fresh() -> tuple[tuple[Path], dict[str, Any]]:
        nonlocal made
        made += 1
        directory = tmp_path / str(made)
        directory.mkdir()
        return (directory,), {}

    def write(directory: Path) -> int:
        writer = RecordingWriter(directory, {"_id": "x"}, lambda *_: None, settings)
        for batch in batches:
            writer.append(batch, channels)
        writer.close()
        return int(writer.totals.messages)

    assert benchmark.pedantic(write, setup=fresh, rounds=20, warmup_rounds=1) == count


TRANSCODE_CASES = {
    "pose": (SMALL, "/pose", 1000),
    "imu": (SMALL, "/imu/data", 1000),
    "tf": (SMALL, "/tf", 1000),
    "scan": (DRIVE, "/scan", 80),
    "image": (DRIVE, "/camera/left/image_raw", 8),
}


@pytest.mark.parametrize("case", TRANSCODE_CASES)
def bench_transcode(case: str, bags: Path, benchmark: Any) -> None:
    """Bodies of the documents, and what stands around them."""
    name, topic, count = TRANSCODE_CASES[case]
    stream = read(bags / name, topic, count)
    batch: Any = stream.batches(count)[0]
    placed = Placed.of([_chunk(batch)])
    codec = codec_for(stream.channel())
    assembler = DocumentAssembler(Origin("0123456789abcdef", topic, False))

    def transcode() -> int:
        documents = 0
        for group in index_bodies(codec, batch.buffer, batch.offset, batch.length):
            table = assembler.assemble(placed, group.rows, group.body, group.error)
            assert group.error is None
            documents += len(table)
        return documents

    assert benchmark(transcode) == count


def bench_few(bags: Path, benchmark: Any) -> None:
    """Documents of chunks of four messages each, of twenty topics, all at once."""
    stream = read(bags / IMU, "/imu/data", 320)
    indexer = ChunkIndexer("0123456789abcdef" * 2)
    channels = {number: stream.channel() for number in range(20)}
    chunks = []
    for number, batch in enumerate(stream.batches(4)):
        own: Any = batch
        own.channel[:] = number % len(channels)
        chunks.append(_chunk(own))

    _, entries = benchmark(indexer.documents_of, chunks, channels)
    assert [entry.messages for entry in entries] == [4] * 80


def bench_gather(bags: Path, tmp_path: Path, benchmark: Any) -> None:
    """Fields of small messages to the tables."""
    stream = read(bags / IMU, "/imu/data", 5000)
    batch: Any = stream.batches(5000)[0]
    writer = TableWriter(tmp_path, "0" * 32)
    channels = dict.fromkeys(batch.channel.tolist(), stream.channel())
    benchmark.pedantic(writer.add, (_chunk(batch), channels), rounds=50, warmup_rounds=1)
    writer.discard()


def _chunk(batch: Any) -> Any:
    """A chunk of these messages."""
    return StoredChunk(
        segment=1,
        number=0,
        offset=4096,
        length=len(batch.buffer),
        trailer=0,
        crc=0,
        trailer_crc=0,
        batch=batch,
        seq=np.arange(len(batch)),
        compressed_size=len(batch.buffer),
    )


PLANS: dict[str, Callable[[Any], Any]] = {
    "slice": lambda store: store.topic("/scan").between("+1s", "+2s"),
    "where": lambda store: store.topic("/imu/data").where("angular_velocity.z > 2.5"),
}


@pytest.mark.parametrize("case", PLANS)
def bench_plan(case: str, store: Any, benchmark: Any) -> None:
    """Which chunks hold the answer, in a store that has been asked before."""
    question = PLANS[case]
    plan = benchmark(lambda: _plan(store, question))
    assert plan.channels


def bench_plan_first(store: Any, benchmark: Any) -> None:
    """The same when nothing is known of the store yet."""
    question = PLANS["slice"]
    plan = benchmark.pedantic(
        lambda: _plan(store, question), setup=store.refresh, rounds=30, warmup_rounds=1
    )
    assert plan.channels


def _plan(store: Any, question: Callable[[Any], Any]) -> Any:
    planner = Planner(store.session, question(store).question, Counters())
    return planner.plan(planner.parts())


FETCHES: dict[str, tuple[Callable[[Any], Any], int]] = {
    "scan": (lambda store: store.topic("/scan").between("+1s", "+2s"), 20),
    "image": (lambda store: store.topic("/camera/left/image_raw").between("+1s", "+2s"), 15),
    "imu": (lambda store: store.topic("/imu/data").between("+10s", "+20s"), 2000),
}
"""A question, and how many messages answer it."""


@pytest.mark.parametrize("case", FETCHES)
def bench_fetch(case: str, store: Any, benchmark: Any) -> None:
    """The payloads of a time slice."""
    question, count = FETCHES[case]

    def fetch() -> int:
        return sum(len(batch) for batch, _ in question(store).batches())

    assert benchmark(fetch) == count


@pytest.mark.parametrize("case", ["elsewhere", "near"])
def bench_moment(case: str, store: Any, benchmark: Any) -> None:
    """The scan at a time, decoded: its chunk has to be read, or was for the one before."""
    moments = cycle(["+1.0s", "+1.1s"])

    def forget() -> None:
        if case == "elsewhere":
            store.session.cache.drop("chunk")

    def look() -> Any:
        return store.topic("/scan").at(next(moments)).decode()

    look()
    scan = benchmark.pedantic(look, setup=forget, rounds=300, warmup_rounds=3)
    assert len(scan.ranges)


FAST = "angular_velocity.z > 2.5"
AGAIN: dict[str, Callable[[Any], int]] = {
    "count": lambda store: store.topic("/imu/data").where(FAST).count(),
    "states": lambda store: len(store.topic("/imu/data").where(FAST).intervals()),
    "changes": lambda store: len(store.topic("/imu/data").changes("orientation")),
    "frame": lambda store: len(
        store.topic("/imu/data").where(FAST).fields("angular_velocity.z").to_pandas()
    ),
}


@pytest.mark.parametrize("case", AGAIN)
def bench_again(case: str, store: Any, benchmark: Any) -> None:
    """What was asked before about single values of a topic."""
    ask = AGAIN[case]
    answer = ask(store)
    assert benchmark(ask, store) == answer


@pytest.mark.parametrize("case", AGAIN)
def bench_first(case: str, store: Any, benchmark: Any) -> None:
    """The same when only the catalog was read before."""
    ask = AGAIN[case]

    def forget() -> None:
        store.session.tables.invalidate()

    answer = ask(store)
    found = benchmark.pedantic(ask, (store,), setup=forget, rounds=30, warmup_rounds=1)
    assert found == answer


@pytest.mark.parametrize("how", HOWS)
def bench_join(how: How, benchmark: Any) -> None:
    """Of a million rows, those that belong to 20,000 times: a column of doubles is taken."""
    rng = np.random.default_rng(1)
    rows = np.cumsum(rng.integers(500_000, 1_500_000, 1_000_000))
    times = np.sort(rng.integers(rows[0], rows[-1], 20_000))
    table = pa.table({"x": rng.normal(size=len(rows))})

    def join() -> int:
        found = match(times, rows, how, 20_000_000)
        return table.take(pa.array(found.before)).num_rows

    assert benchmark(join) == len(times)


def bench_align(store: Any, benchmark: Any) -> None:
    """Scans with the messages of an IMU that were current, from the tables of an open store."""
    aligned = store.align(
        "/scan", "/imu/data", fields={"/scan": ["range_max"], "/imu/data": ["angular_velocity.z"]}
    )
    rows = store.topic("/scan").count()
    assert benchmark(aligned.to_arrow).num_rows == rows


DECODED = {
    "imu": (IMU, "/imu/data", 5000),
    "scan": (DRIVE, "/scan", 80),
    "image": (DRIVE, "/camera/left/image_raw", 8),
}


@pytest.mark.parametrize("case", DECODED)
def bench_decode(case: str, bags: Path, benchmark: Any) -> None:
    """Payloads to columns of numpy."""
    name, topic, count = DECODED[case]
    stream = read(bags / name, topic, count)
    codec = codec_for(stream.channel())
    batch: Any = stream.batches(count)[0]
    decoded = benchmark(codec.columns, batch.buffer, batch.offset, batch.length)
    assert len(decoded.records) == count


TABLES: dict[str, tuple[Callable[[Any], Any], int]] = {
    "pandas": (lambda store: store.topic("/imu/data").to_pandas(), 20_000),
    "arrow": (lambda store: store.topic("/scan").to_arrow(), 80),
    "images": (
        lambda store: store.topic("/camera/left/image_raw").between("+1s", "+2s").to_numpy(),
        15,
    ),
}
"""A question with its answer's form, and the rows of the answer."""


@pytest.mark.parametrize("case", TABLES)
def bench_columns(case: str, store: Any, benchmark: Any) -> None:
    """A topic of a store as a table or an array."""
    ask, rows = TABLES[case]
    assert len(benchmark(ask, store)) == rows
