"""SQL beside DuckDB on the same Parquet files: `python -m benchmarks.sql --rows 1000000`.

One recording has odometry at 100 Hz and a mode at 1 Hz. Each question is asked of an open
store and of DuckDB's `read_parquet` in turns. A figure is the least of several times, in ms:
on the clock, and of the processor, since the clock of a busy machine says little.
"""

from __future__ import annotations

import argparse
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import duckdb
import numpy as np

import hybridlog as hl
from hybridlog_storage.messages import Channel, Schema

ODOM = Channel(
    "/odom",
    "ros1",
    Schema(
        "test/Odom",
        "ros1msg",
        b"Header header\nVector pose\nVector twist\nfloat64[36] covariance\n"
        + b"=" * 80
        + b"\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
        + b"=" * 80
        + b"\nMSG: test/Vector\nfloat64 x\nfloat64 y\nfloat64 z\n",
    ),
)
MODE = Channel("/mode", "ros1", Schema("test/Mode", "ros1msg", b"uint8 mode\n"))
START = 1_700_000_000 * 10**9
STEP = 10_000_000
TIMES = 9
QUESTIONS = {
    "count": "select count(*) from odom",
    "filter": "select count(*), avg(pose.z) from odom where twist.x < 10 and pose.x > 0",
    "time range": f"select avg(pose.x) from odom where t between {START} and {START + 10**11}",
    "group": "select t // 60000000000 as m, avg(pose.x), max(twist.z) from odom group by 1",
    "join": "select m.mode, avg(o.pose.x) from odom o join mode m on o.t = m.t - 1 group by 1",
    "as-of join": "select m.mode, avg(o.twist.x) from odom o asof join mode m on o.t >= m.t "
    "group by 1",
}


def fill(store: hl.Store, rows: int) -> None:
    """Record one log."""
    values = np.cumsum(np.random.default_rng(1).normal(size=(rows, 6)), axis=0)
    covariance = struct.pack("<36d", *range(36))
    with store.start("drive") as recording:
        for n in range(rows):
            log_time = START + n * STEP
            head = struct.pack("<IIII4s", n, *divmod(log_time, 10**9), 4, b"odom")
            recording.write(ODOM, head + values[n].tobytes() + covariance, log_time=log_time)
            if n % 100 == 0:
                recording.write(MODE, bytes([n // 100 % 7]), log_time=log_time + 1)


def least(ask: Callable[[], Any]) -> tuple[float, float]:
    """The least time of a question on the clock and of the processor, ms."""
    found = []
    for _ in range(TIMES):
        clock, work = time.perf_counter(), time.process_time()
        ask()
        found.append((time.perf_counter() - clock, time.process_time() - work))
    return tuple(1000 * min(times) for times in zip(*found, strict=True))  # type: ignore[return-value]


def main() -> None:
    """Ask all questions of both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=1_000_000, help="messages of odometry")
    rows = parser.parse_args().rows
    with (
        tempfile.TemporaryDirectory(prefix="hl-sql-") as folder,
        hl.open(Path(folder, "store"), create=True) as store,
    ):
        fill(store, rows)
        files = duckdb.connect()
        for topic in ("odom", "mode"):
            glob = f"{folder}/store/tables/*/topic={topic}/*.parquet"
            files.execute(f"create view {topic} as select * from read_parquet('{glob}')")
        print(f"{'question':12}{'clock':>9}{'DuckDB':>9}{'work':>9}{'DuckDB':>9}")
        for name, query in QUESTIONS.items():
            ours = least(lambda query=query: store.sql(query).rows())
            theirs = least(lambda query=query: files.sql(query).fetchall())
            cells = (ours[0], theirs[0], ours[1], theirs[1])
            print(f"{name:12}" + "".join(f"{cell:9.1f}" for cell in cells), flush=True)


if __name__ == "__main__":
    main()
