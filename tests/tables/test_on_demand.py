"""Tables that a question misses are made after it, once, and frames come from tables."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.follow import follower
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


def test_a_topic_without_a_table_is_tried_once(
    store: hl.Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[set[str]] = []
    monkeypatch.setattr(follower, "make_tables", lambda *_, topics, until: made.append(topics))
    shutil.rmtree(store.directory.path / "tables")
    store.refresh()
    for _ in range(2):
        assert store.topic("/imu").where("x > 1").count() > 0
        store.mend()
    assert made == [{"/imu", "/mixed"}]  # which share their chunks
