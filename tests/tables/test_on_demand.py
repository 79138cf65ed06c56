"""Tables that a question misses are made after it, once, and frames come from tables."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.query.rows import Rows
from hybridlog_storage.messages import Channel, Schema

SECOND = 10**9
MIXED = Channel("/mixed", "json", None)
IMU = Channel(
    "/imu", "ros1", Schema("pkg/Imu", "ros1msg", b"float64 x\nuint64 n\nfloat64[3] a\nstring s")
)


def payload(number: int) -> bytes:
    text = f"m{number}".encode()
    head = np.array([number / 2 if number % 5 else np.nan]).tobytes()
    whole = np.array([2**63 + number], np.uint64).tobytes()
    array = np.arange(3, dtype=np.float64).tobytes()
    return head + whole + array + len(text).to_bytes(4, "little") + text


@pytest.fixture
def store(tmp_path: Path) -> Iterator[hl.Store]:
    with hl.open(tmp_path / "store", create=True) as opened:
        with opened.start("log") as recording:
            for number in range(1500):
                recording.write(IMU, payload(number), log_time=number * SECOND)
                if number < 5:
                    value = [1, "a", None, {"b": 1}, [2]][number]
                    text = json.dumps({"v": value, "n": number}).encode()
                    recording.write(MIXED, text, log_time=number * SECOND)
        yield opened


def test_frames_come_from_tables(store: hl.Store, monkeypatch: pytest.MonkeyPatch) -> None:
    for query in (
        store.topic("/imu"),
        store.topic("/imu").fields("n", "s"),
        store.topic("/imu").where("x > 100").fields("a", "n"),
        store.topic("/imu").between(10 * SECOND, 20 * SECOND).fields("x"),
        store.topic("/imu").where("s ~ '^m1[0-9]$'").reverse(),
    ):
        table, frame = query.to_arrow(), query.to_pandas()
        assert query.counters.chunks_read == 0
        assert query.counters.messages == table.num_rows == len(frame) == query.count()
        streamed = sum(part.num_rows for part in query.to_tables())
        assert streamed == table.num_rows
        with monkeypatch.context() as patch:
            patch.setattr(Rows, "tabled", lambda *_: None)
            decoded = query.to_arrow()
            assert query.counters.chunks_read > 0
        assert table.schema == decoded.schema
        assert repr(table.to_pylist()) == repr(decoded.to_pylist())  # NaN is NaN
