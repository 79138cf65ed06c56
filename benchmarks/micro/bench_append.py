"""Messages into chunks, and chunks into segments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.micro.inputs import DRIVE, SMALL, read
from benchmarks.micro.isolation import need

CASES = {
    "one": (SMALL, "/imu/data", 1000, 1),
    "batches": (SMALL, "/imu/data", 1000, 100),
    "images": (DRIVE, "/camera/left/image_raw", 24, 1),
}
"""Bag, topic, messages, messages to a batch."""


@pytest.mark.parametrize("case", CASES)
def bench_append(case: str, bags: Path, benchmark: Any) -> None:
    """Lay messages down in the open chunk, and take it."""
    name, topic, count, size = CASES[case]
    batches: list[Any] = read(bags / name, topic, count).batches(size)
    chunk_builder = need("hybridlog_storage.chunk_builder", "ChunkBuilder").ChunkBuilder
    arrivals = [np.arange(n * size, n * size + len(b)) for n, b in enumerate(batches)]

    def append() -> int:
        builder = chunk_builder(2 << 20)
        for batch, seq in zip(batches, arrivals, strict=True):
            builder.append(batch, seq)
        return len(builder.take()[0])

    assert benchmark(append) == count


@pytest.mark.parametrize("case", CASES)
def bench_write(case: str, bags: Path, tmp_path: Path, benchmark: Any) -> None:
    """Append to a recording, and close it: chunks are packed and written, nothing synced."""
    name, topic, count, size = CASES[case]
    stream = read(bags / name, topic, count)
    batches, channels = stream.batches(size), [stream.channel()]
    found = need("hybridlog_storage.segment_writer", "RecordingWriter", "SegmentSettings")
    settings = found.SegmentSettings(sync="never")
    made = 0

    def fresh() -> tuple[tuple[Path], dict[str, Any]]:
        nonlocal made
        made += 1
        directory = tmp_path / str(made)
        directory.mkdir()
        return (directory,), {}

    def write(directory: Path) -> int:
        writer = found.RecordingWriter(directory, {"_id": "x"}, lambda *_: None, settings)
        for batch in batches:
            writer.append(batch, channels)
        writer.close()
        return int(writer.totals.messages)

    assert benchmark.pedantic(write, setup=fresh, rounds=20, warmup_rounds=1) == count
