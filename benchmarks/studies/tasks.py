"""What a user does with a store: commands, SQL, many recordings.

All of it but `many` is about one recording of the robot's log. Each group runs
in a process of its own; a figure is the median of several times after a first one, on the clock
and of the processor (that of MongoDB is not counted).
"""

from __future__ import annotations

import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.loads import robot
from benchmarks.samples import Sample, Scale
from benchmarks.side import SideError, Values, run_side
from benchmarks.studies.runs import Context, run_directory
from hybridlog_storage.messages import Channel, Schema
from tests.independent import write_mcap

if TYPE_CHECKING:
    pass

STUDY = "tasks"
_TIMEOUT_S = 900.0
_DAY_NS = 86_400 * 10**9
_MANY_MESSAGES = 200


class Settings(NamedTuple):
    """How much there is, and how often each task is done.

    Attributes:
        seconds: Of the robot's log.
        recordings: In the store of many.
        times: Of each task.
    """

    seconds: int
    recordings: int
    times: int


SETTINGS: dict[Scale, Settings] = {
    "full": Settings(600, 1000, 5),
    "tiny": Settings(10, 10, 1),
}
NEAR = "/odom: twist.twist.linear.x > 1.2"
COMMANDS: dict[str, tuple[str, ...]] = {
    "`hybridlog --version`": ("--version",),
    "`info`": ("info",),
    "`fetch` of a second of all topics into MCAP": (
        *("fetch", "-t", "*", "--between", "+5s", "+6s", "-o", "{out}.mcap"),
    ),
    "`fetch --count` with a predicate on `imu/data`": (
        *("fetch", "-t", "imu/data", "--where", "angular_velocity.z > 0.02", "--count"),
    ),
    "`fetch --count` of scans near a fast `odom`": (
        *("fetch", "-t", "scan", "--where", NEAR, "--within", "0.1s", "--count"),
    ),
    "`sql`: mean of a field of `odom` where another is large": (
        "sql",
        "select count(*), avg(twist.twist.linear.x) from odom where twist.twist.linear.x > 0.5",
    ),
    "`align` of `odom` and `scan` to `imu/data`, into Parquet": (
        *("align", "--to", "imu/data", "-t", "odom", "-t", "scan", "-o", "{out}.parquet"),
    ),
    "`fetch` of `imu/data` into Parquet": ("fetch", "-t", "imu/data", "-o", "{out}.parquet"),
    "`export` into a bag": ("export", "{out}.bag"),
    "`verify`": ("verify",),
}
"""Arguments by what they do."""
SQL = {
    "count": "select count(*) from odom",
    "filter of two fields, mean of a third": (
        "select count(*), avg(pose.pose.position.y) from odom "
        "where twist.twist.linear.x > 0.5 and pose.pose.position.x > 0"
    ),
    "group of `imu/data` by minute": (
        "select t // 60000000000 as m, max(linear_acceleration.z) from imu__data group by 1"
    ),
    "as-of join of `imu/data` and `odom`": (
        "select count(*), avg(o.twist.twist.linear.x) from imu__data i "
        "asof join odom o on i.t >= o.t where i.angular_velocity.z > 0"
    ),
}


def run(context: Context, group: str) -> None:
    """Do a group."""
    settings = SETTINGS[context.scale]
    wanted = Sample(STUDY, {"group": group, **settings._asdict()}, "hybridlog", 0)
    with context.step(f"tasks: {group}"), run_directory(context.work) as directory:
        arguments = {"directory": str(directory), "seed": context.seed, **settings._asdict()}
        try:
            if group != "many":
                arguments["store"] = str(robot_store(context, settings))
            side = f"{__name__}:{group}_side"
            values = run_side(side, arguments, directory, _TIMEOUT_S)
            sample = Sample(STUDY, wanted.case, "hybridlog", 0, "ok", values)
        except SideError as error:
            sample = Sample(STUDY, wanted.case, "hybridlog", 0, "failed", {}, str(error))
    context.journal.add(sample)


def robot_store(context: Context, settings: Settings) -> Path:
    """The store with the robot's log, recorded once; the log lies beside it."""
    place = context.work / "loads" / f"store-{settings.seconds}-{context.seed}"
    if not place.exists():
        place.mkdir(parents=True)
        robot.write_log(place / "robot.mcap", seconds=settings.seconds, seed=context.seed)
        _recorded(place / "robot.mcap", place / "store")
    return place / "store"


def _recorded(log: Path, store: Path) -> Values:
    return command(("record", str(log)), store)


# --- timing ---------------------------------------------------------------------------


def timed(work: Callable[[], object], times: int) -> Values:
    """Milliseconds of a function, on the clock and of the processor, after a first time."""
    work()
    clocks, processors = [], []
    for _ in range(times):
        begun, used = time.perf_counter(), time.process_time()
        work()
        clocks.append(1e3 * (time.perf_counter() - begun))
        processors.append(1e3 * (time.process_time() - used))
    return _spread(clocks) | {"cpu_ms": statistics.median(processors)}


def _spread(clocks: Sequence[float]) -> Values:
    found = {"ms": statistics.median(clocks), "low": min(clocks), "high": max(clocks)}
    return {name: round(value, 4) for name, value in found.items()}


def command(arguments: Sequence[str], store: Path) -> Values:
    """Run `hybridlog` in a process: ms on the clock and of the processor, peak memory in MB."""
    environment = os.environ | {"HYBRIDLOG_STORE": str(store)}
    with tempfile.TemporaryFile() as printed:
        begun = time.monotonic()
        process = subprocess.Popen(
            [sys.executable, "-m", "hybridlog", *arguments],
            env=environment,
            stdout=printed,
            stderr=printed,
        )
        _, status, usage = os.wait4(process.pid, 0)
        clock = time.monotonic() - begun
        process.returncode = os.waitstatus_to_exitcode(status)
        printed.seek(0)
        said = printed.read().decode(errors="replace").strip()
    if process.returncode:
        raise SideError(f"hybridlog {arguments[0]}: exit code {process.returncode}: {said[-500:]}")
    return {
        "ms": 1e3 * clock,
        "cpu_ms": 1e3 * (usage.ru_utime + usage.ru_stime),
        "peak_mb": usage.ru_maxrss / 1000,
    }


def _commands(arguments: Sequence[str], store: Path, times: int) -> Values:
    runs = []
    for _ in range(times + 1):
        with tempfile.TemporaryDirectory(dir=store.parent) as folder:
            filled = [part.replace("{out}", f"{folder}/out") for part in arguments]
            runs.append(command(filled, store))
    runs = runs[1:]
    medians = {name: statistics.median(run[name] for run in runs) for name in ("cpu_ms", "peak_mb")}
    return _spread([run["ms"] for run in runs]) | medians


# --- the groups -----------------------------------------------------------------------


def commands_side(*, store: str, directory: str, times: int, **_: Any) -> Values:
    """The command line on the robot's log."""
    place = Path(store)
    log = place.parent / "robot.mcap"
    fresh = Path(directory) / "store"
    rows = {"`record` of the log": _recorded(log, fresh)}
    rows["`index arrays` of the scans"] = command(("index", "arrays", "scan"), fresh)
    for name, arguments in COMMANDS.items():
        rows[name] = _commands(arguments, place, times)
    return {"rows": rows}


def sql_side(*, store: str, times: int, **_: Any) -> Values:
    """SQL in an open store, beside DuckDB alone on the same files."""
    import duckdb

    import hybridlog as hl

    rows: Values = {}
    with hl.open(store) as opened, duckdb.connect() as alone:
        for name, kind in (("odom", "nav_msgs_Odometry"), ("imu__data", "sensor_msgs_Imu")):
            glob = f"{store}/tables/{kind}~*/*.parquet"
            alone.execute(f"create view {name} as select * from read_parquet('{glob}')")
        for name, query in SQL.items():

            def ours(query: str = query) -> Any:
                return opened.sql(query).rows()

            def theirs(query: str = query) -> Any:
                return alone.sql(query).fetchall()

            if len(ours()) != len(theirs()):
                raise SideError(f"{name}: the answers differ")
            rows[name] = timed(ours, times) | {"duckdb_ms": timed(theirs, times)["ms"]}
    return {"rows": rows}


def many_side(*, directory: str, recordings: int, times: int, **_: Any) -> Values:
    """A store with many recordings of 200 messages on four topics, a day apart."""
    import hybridlog as hl

    place, logs = Path(directory) / "many", Path(directory)

    def record(day: int) -> None:
        store.record(_write_day(logs / "day.mcap", day), name=f"day{day:05d}")

    with hl.open(place, create=True) as store:
        for day in range(recordings):
            record(day)
    listing = _commands(("ls",), place, times)
    del listing["peak_mb"]  # that of this process, of which a child is a copy at first
    rows = {
        "`ls`": listing,
        "open the store": timed(lambda: hl.open(place).close(), times),
    }
    begun = robot.START_NS + min(3, recordings - 1) * _DAY_NS
    days = iter(range(recordings, recordings + 100))
    with hl.open(place) as store:
        pose = store.topic("pose")
        of_a_day = pose.between(begun, begun + _DAY_NS)
        rows |= {
            "messages of a day": timed(lambda: sum(1 for _ in of_a_day), times),
            "count of a day by a predicate": timed(of_a_day.where("x > 7").count, times),
            "count of all by a predicate": timed(pose.where("x > 7").count, times),
            "count of the matches in one of all": timed(pose.where("y == 3").count, times),
            "record one more": timed(lambda: record(next(days)), times),
        }
    return {"rows": rows}


def _write_day(path: Path, day: int) -> Path:
    """A log of one day."""
    kind = Schema("geometry_msgs/Vector3", "ros1msg", b"float64 x\nfloat64 y\nfloat64 z\n")
    channels = [Channel(t, "ros1", kind) for t in ("/pose", "/imu", "/tf", "/joint_states")]
    begin = robot.START_NS + day * _DAY_NS
    said = [
        (channels[n % 4], begin + n * 10**7, struct.pack("<3d", n, day, n * 0.01))
        for n in range(_MANY_MESSAGES)
    ]
    return write_mcap(path, said)


GROUPS = ("commands", "sql", "many")
"""In their order; `<name>_side` does each."""
