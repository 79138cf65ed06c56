"""Ready documents into a collection of an embedded MongoDB."""

from __future__ import annotations

import struct
from typing import Any

import bson
import numpy as np

COUNT = 5000


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
        for row in range(COUNT)
    ]
    documents = b"".join(rows)
    lengths = np.array([len(row) for row in rows], np.int64)
    database = store.database

    def empty() -> None:
        database.drop("micro")
        database.ensure_collection("micro")

    def insert() -> int:
        return int(database.insert_raw("micro", documents, COUNT, lengths=lengths))

    try:
        inserted = benchmark.pedantic(insert, setup=empty, rounds=10, warmup_rounds=1)
    finally:
        database.drop("micro")
    assert inserted == COUNT
