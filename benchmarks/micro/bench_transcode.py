"""Serialised messages to index documents, a chunk's worth at a time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.micro.inputs import DRIVE, IMU, SMALL, read
from benchmarks.micro.isolation import need

CASES = {
    "pose": (SMALL, "/pose", 1000),
    "imu": (SMALL, "/imu/data", 1000),
    "tf": (SMALL, "/tf", 1000),
    "scan": (DRIVE, "/scan", 80),
    "image": (DRIVE, "/camera/left/image_raw", 8),
}


@pytest.mark.parametrize("case", CASES)
def bench_transcode(case: str, bags: Path, benchmark: Any) -> None:
    """Bodies of the documents, and what stands around them."""
    name, topic, count = CASES[case]
    stream = read(bags / name, topic, count)
    codec_for = need("hybridlog.schema.codec", "codec_for").codec_for
    found = need("hybridlog_storage.index_documents", "DocumentAssembler", "Origin", "Placed")
    batch: Any = stream.batches(count)[0]
    placed = found.Placed.of([_chunk(batch)])
    codec = codec_for(stream.channel())
    assembler = found.DocumentAssembler(found.Origin("0123456789abcdef", topic, False))

    def transcode() -> int:
        documents = 0
        for group in codec.bodies(batch.buffer, batch.offset, batch.length):
            table = assembler.assemble(placed, group.rows, group.body, group.error)
            assert group.error is None
            documents += len(table)
        return documents

    assert benchmark(transcode) == count


def bench_few(bags: Path, benchmark: Any) -> None:
    """Documents of chunks of four messages each, of twenty topics, all at once."""
    stream = read(bags / IMU, "/imu/data", 320)
    need("hybridlog.index_writer", "IndexWriter")  # before, each chunk was by itself
    indexer = need("hybridlog.indexing", "ChunkIndexer").ChunkIndexer("0123456789abcdef" * 2)
    channels = {number: stream.channel() for number in range(20)}
    chunks = []
    for number, batch in enumerate(stream.batches(4)):
        own: Any = batch
        own.channel[:] = number % len(channels)
        chunks.append(_chunk(own))

    _, entries = benchmark(indexer.documents_of, chunks, channels)
    assert [entry.messages for entry in entries] == [4] * 80


def bench_table(bags: Path, tmp_path: Path, benchmark: Any) -> None:
    """Fields of small messages to rows of a table."""
    stream = read(bags / IMU, "/imu/data", 5000)
    found = need("hybridlog.tables.writer", "TableWriter")
    batch: Any = stream.batches(5000)[0]
    writer = found.TableWriter(tmp_path, "0" * 32)
    channels = dict.fromkeys(batch.channel.tolist(), stream.channel())
    benchmark.pedantic(writer.add, (_chunk(batch), channels), rounds=50, warmup_rounds=1)
    assert writer.rows_in_memory or list(tmp_path.rglob("*.parquet"))
    writer.discard()


def _chunk(batch: Any) -> Any:
    """A chunk of these messages."""
    need("hybridlog_storage.chunk_table")  # before, chunks had no numbers
    return need("hybridlog_storage.chunk", "StoredChunk").StoredChunk(
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
