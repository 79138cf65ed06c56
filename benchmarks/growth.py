"""What a store costs as it fills: `python -m benchmarks.growth --recordings 10 1000 10000`.

Each store gets recordings of 200 messages on four topics, a day apart. Then the same work is
done in each, twice, and the second time is measured: processor time of this process and of
the MongoDB server, in ms.
"""

from __future__ import annotations

import argparse
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil
from mcap.writer import Writer

import hybridlog as hl

DAY = 86_400 * 10**9
START = 18_262 * DAY
MESSAGES = 200
MAX_AT_ONCE = 1_000
"""Work on all recordings is done in stores of at most so many."""
TOPICS = ("/pose", "/imu", "/tf", "/joint_states")


def write_day(path: Path, day: int) -> Path:
    """A log of one day."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros1")
        kind = writer.register_schema(
            "geometry_msgs/Vector3", "ros1msg", b"float64 x\nfloat64 y\nfloat64 z\n"
        )
        channels = [writer.register_channel(topic, "ros1", kind) for topic in TOPICS]
        for number in range(MESSAGES):
            log_time = START + day * DAY + number * 10**7
            payload = struct.pack("<3d", number, day, number * 0.01)
            writer.add_message(channels[number % len(channels)], log_time, payload, log_time)
        writer.finish()
    return path


def fill(store: hl.Store, count: int, logs: Path) -> None:
    """Record until there are so many recordings."""
    for day in range(len(store.summaries()), count):
        store.record(write_day(logs / "day.mcap", day), name=f"day{day:05d}")
        if day % 500 == 499:
            print(f"  {day + 1} recordings", file=sys.stderr, flush=True)


def server_of(store: hl.Store) -> psutil.Process:
    """The process of the embedded MongoDB."""
    folder = str(store.directory.mongod)
    for process in psutil.process_iter(["name", "cmdline"]):
        if process.info["name"] == "mongod" and folder in " ".join(process.info["cmdline"]):
            return process
    raise RuntimeError("the store's mongod is not running")


def spent(server: psutil.Process) -> float:
    """Processor time of both so far, s."""
    times = server.cpu_times()
    return time.process_time() + float(times.user + times.system)


def measure(path: Path, count: int, logs: Path) -> dict[str, float]:
    """Processor time of each piece of work at its second time, ms."""
    more = iter(range(60_000, 60_100))

    def work_of(store: hl.Store) -> dict[str, Callable[[], object]]:
        day = START + 3 * DAY, START + 4 * DAY
        pose = store.topic("pose")
        near = iter(range(5, 100))
        return {
            "open": lambda: hl.open(path, require_database=True).close(),
            "message at a time": lambda: pose.at(day[0] + next(near) * 10**8),
            "fetch of a day": lambda: sum(1 for _ in pose.between(*day)),
            "count of a day": lambda: pose.between(*day).count(),
            "count of a day, predicate": lambda: (
                pose.where(f"x > {next(near)}").between(*day).count()
            ),
            "first of all": pose.first,
            "record one more": lambda: store.record(
                write_day(logs / "more.mcap", number := next(more)), name=f"more{number}"
            ),
            "rm of one": lambda: store.remove(store.summaries()[-1].id),
            "verify of one": lambda: store.verify(["day00003"]),
            "index rebuild of one": lambda: store.rebuild_index(["day00003"]),
        }

    with hl.open(path, create=True) as store:
        fill(store, count, logs)
    found = {}
    with hl.open(path, require_database=True) as store:
        server = server_of(store)

        def least(work: Callable[[], object]) -> float:
            work()
            best = float("inf")
            for _ in range(3):
                before = spent(server)
                work()
                best = min(best, spent(server) - before)
            return best * 1000

        few = store.topic("pose").where("y == 3")
        found["count of one in all, columns"] = least(few.count)
        store.add_index("pose", "y")
        found["count of one in all, index"] = least(few.count)
        store.remove_index("pose", "y")
        found |= {name: least(work) for name, work in work_of(store).items()}
        for name, once in {
            "count of all, predicate": lambda: store.topic("pose").where("x > 7").count(),
            "verify of all": store.verify,
            "index rebuild of all": store.rebuild_index,
        }.items():
            if count > MAX_AT_ONCE:
                continue
            before = spent(server)
            once()
            found[name] = (spent(server) - before) * 1000
    listing = [sys.executable, "-m", "hybridlog", "ls", "--store", str(path)]
    before = time.monotonic()
    subprocess.run(listing, check=True, capture_output=True)
    found["ls, wall"] = (time.monotonic() - before) * 1000
    return found


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=int, nargs="+", default=[10, 100, 1000])
    parser.add_argument("--folder", type=Path, help="where the stores are made, and stay")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        top = chosen.folder or Path(temporary)
        top.mkdir(exist_ok=True)
        columns = {n: measure(top / str(n), n, Path(temporary)) for n in chosen.recordings}
    print("| ms | " + " | ".join(f"{n:,}" for n in columns) + " |")
    print("|---|" + "---:|" * len(columns))
    for name in next(iter(columns.values())):
        cells = " | ".join(
            f"{column[name]:,.1f}" if name in column else "-" for column in columns.values()
        )
        print(f"| {name} | {cells} |")


if __name__ == "__main__":
    main()
