"""Requests and bytes of copies and of a store in a bucket.

Records a scan and numbers of an arm in a directory, and copies them to a directory and
to a bucket of moto, behind the proxy of the tests, which counts. Then the bucket is asked. What
is counted does not depend on how busy the machine is; a request costs some 50 ms elsewhere.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import hybridlog as hl
from hybridlog_storage.disk import files
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.remote.server import Moto, Proxy, make_bucket

SECOND = 10**9
BEGIN = 1_700_000_000 * SECOND
RECORDINGS, SECONDS, RATE = 20, 60, 20
ARM = Channel("/arm", "ros1", Schema("a/Arm", "ros1msg", b"uint32 n\nfloat64 x\n"), {})
SCAN = Channel("/scan", "ros1", Schema("a/Scan", "ros1msg", b"uint32 n\nfloat32[] ranges\n"), {})


@dataclass(frozen=True)
class Cost:
    """What a step has asked of the bucket.

    Attributes:
        step: What was done.
        requests: Number of requests.
        received: Bytes that came.
        sent: Bytes that went.
    """

    step: str
    requests: int
    received: int
    sent: int


def record(path: Path) -> int:
    """Make the store; returns the bytes of its segments."""
    noise = np.random.default_rng(1)
    with hl.open(path, mongo="none", create=True) as store:
        for place in range(RECORDINGS):
            begin = BEGIN + place * 2 * SECONDS * SECOND
            settings = SegmentSettings(segment_size=8 << 20)
            with store.start(f"run-{place:02}", settings=settings) as recording:
                for number in range(SECONDS * RATE):
                    at = begin + number * SECOND // RATE
                    ranges = noise.random(720, np.float32).tobytes()
                    recording.write(SCAN, struct.pack("<II", number, 720) + ranges, log_time=at)
                    arm = struct.pack("<Id", number, place + number / 1000)
                    recording.write(ARM, arm, log_time=at + 1)
        return sum(one.stored_bytes for one in store.summaries())


def measure(place: Path) -> list[Cost]:
    """The steps and what they cost, in the order in which they were done."""
    moto = Moto(place / "moto.log")
    proxy = Proxy(moto.port)
    names = {"ACCESS_KEY_ID": "x", "SECRET_ACCESS_KEY": "x", "REGION": "us-east-1"}
    os.environ |= {f"AWS_{name}": value for name, value in names.items()}
    os.environ |= {"AWS_ALLOW_HTTP": "true", "AWS_ENDPOINT_URL": proxy.url}
    os.environ["XDG_CACHE_HOME"] = str(place / "cache")
    costs: list[Cost] = []

    def step(what: str, work: Callable[[], object]) -> None:
        proxy.reset()
        work()
        costs.append(Cost(what, len(proxy.requests), proxy.received, proxy.sent))

    try:
        size = record(place / "store")
        make_bucket(proxy.url, "lab")
        address = "s3://lab/store"
        with hl.open(place / "store", mongo="none") as store:
            copied = store.copy(place / "disk").bytes_copied
            costs.append(Cost(f"copy of {size:,} bytes to a directory", 0, 0, copied))
            step("copy to a bucket", lambda: store.copy(address))
            step("copy again", lambda: store.copy(address))
        files.mounted.clear()  # as another process, without a cache
        os.environ["XDG_CACHE_HOME"] = str(place / "empty")
        opened: list[hl.Store] = []
        step("open", lambda: opened.append(hl.open(address)))
        with opened[0] as store:
            entry = store.entry("run-05")
            begin = BEGIN + 5 * 2 * SECONDS * SECOND + 30 * SECOND
            second = store.topic("/scan").between(begin, begin + SECOND)
            where = store.topic("/arm").where("x > 7.2 and x < 7.9")
            step("a recording", lambda: store.catalog.table(entry, entry.spans[0][0]))
            step("a second of scan", lambda: list(second))
            step("the same again", lambda: list(second))
            step("count by predicate", where.count)
            step("the same again", where.count)
    finally:
        proxy.close()
        moto.close()
    return costs
