"""A full chunk to what is written: compression, checksum, message indexes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.micro.inputs import DRIVE, IMU, read
from benchmarks.micro.isolation import need

CASES = {
    "imu": (IMU, "/imu/data", 6000),
    "scan": (DRIVE, "/scan", 80),
    "images": (DRIVE, "/camera/left/image_raw", 6),
}


@pytest.mark.parametrize("case", CASES)
def bench_pack(case: str, bags: Path, benchmark: Any) -> None:
    """Chunks of about 2 MB, or all that there is."""
    name, topic, count = CASES[case]
    batch: Any = read(bags / name, topic, count).batches(count)[0]
    compressor = need("hybridlog_storage.compression", "Compressor").Compressor()
    pack = need("hybridlog_storage.chunk", "pack").pack
    builder = need("hybridlog_storage.chunk_builder", "ChunkBuilder").ChunkBuilder(2 << 20)
    builder.append(batch, np.arange(count))
    content, seq, size = builder.take()
    packed = benchmark(pack, compressor, content, seq, size)
    assert packed.uncompressed_size == size
