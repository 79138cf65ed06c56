"""How fast reading is: a second out of ten minutes, and a million messages as a frame."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.side import Values
from benchmarks.speed import logs
from benchmarks.speed.bench import discard
from benchmarks.speed.results import figure, ratio, values_of

if TYPE_CHECKING:
    from benchmarks.speed.bench import Bench

OURS = "hybridlog"
SHORT = "hybridlog, a tenth of the length"
_SECOND_NS = 1_000_000_000
_SLICES = 12
_SHORTER = 10


def slices(bench: Bench) -> None:
    """One second of `/scan` out of a drive with two cameras."""
    seconds = bench.size(600, 60)
    seed = bench.settings.seed
    bag = bench.input(f"drive-{seconds}s.bag", lambda p: logs.write_drive(p, seconds, seed))
    short = bench.input(
        f"drive-{seconds // _SHORTER}s.bag",
        lambda p: logs.write_drive(p, seconds // _SHORTER, seed),
    )
    file = bench.input(f"drive-{seconds}s.mcap", lambda p: logs.bag_to_mcap(bag, p))
    store = _recorded(bench, "store", bag)
    arguments = {"topic": logs.SCAN_TOPIC, "length_ns": _SECOND_NS}
    ours: Values = {"store": str(store), "starts": _starts(seed, seconds), **arguments}
    others = {"path": str(file), "starts": _starts(seed, seconds), **arguments}
    bench.run("hybridlog, no mongod up", "ours:slices", ours, warm=[store / "recordings"])
    with bench.mongod_up(store):
        for repetition in bench.repetitions:
            run = partial(bench.run, repetition=repetition)
            mine = run(OURS, "ours:slices", ours, warm=[store / "recordings"])
            theirs = run("mcap", "file_sides:slices", others, warm=[file])
            bench.agree(mine["answers"], theirs["answers"], "the payloads of a slice")
    discard(store)
    store = _recorded(bench, "short", short)
    ours = {"store": str(store), "starts": _starts(seed, seconds // _SHORTER), **arguments}
    bench.run(SHORT, "ours:slices", ours, warm=[store / "recordings"])
    discard(store)
    _find_slices(bench)


def _find_slices(bench: Bench) -> None:
    mine = [s.values for s in bench.samples if s.side == OURS]
    theirs = [s.values for s in bench.samples if s.side == "mcap"]
    warm = [float(np.median(v["seconds"][1:])) for v in mine]
    usual = [float(np.median(v["seconds"][1:])) for v in theirs]
    about = "a 1 s slice of /scan over the mcap reader, both open"
    bench.find(ratio(bench.study, about, usual, warm, target=20))
    about = "the same, first slice of the process"
    first = [v["seconds"][0] for v in mine]
    bench.find(ratio(bench.study, about, [v["seconds"][0] for v in theirs], first))
    about = "the same, opening included, mongod up"
    bench.find(
        ratio(
            bench.study,
            about,
            [v["open_s"] + v["seconds"][0] for v in theirs],
            [v["open_s"] + v["seconds"][0] for v in mine],
        )
    )
    for side, name, values in (
        ("hybridlog", "a slice", warm),
        ("mcap", "a slice", usual),
        ("hybridlog", "the first slice", first),
        ("hybridlog", "opening, mongod up", [v["open_s"] for v in mine]),
        ("hybridlog", "opening, mongod to be started", _open_alone(bench)),
        ("mcap", "opening", [v["open_s"] for v in theirs]),
    ):
        found = figure(bench.study, f"{side}: {name}", [v * 1e3 for v in values], "ms")
        bench.find(found)
    shares = [sum(v["bytes_read"]) / sum(v["compressed"]) for v in mine]
    about = "bytes read over the compressed payload"
    bench.find(figure(bench.study, about, shares, "x", target=1.3, relation="<="))
    bench.find_peak(OURS, "peak memory of the reader, without mongod")
    bench.find_growth(OURS, SHORT, _SHORTER)


def frames(bench: Bench) -> None:
    """IMU messages as a pandas frame."""
    messages = bench.size(1_000_000, 100_000)
    seed = bench.settings.seed
    bag = bench.input(f"imu-{messages}.bag", lambda p: logs.write_imu(p, messages, seed))
    file = bench.input(f"imu-{messages}.mcap", lambda p: logs.bag_to_mcap(bag, p))
    store = _recorded(bench, "store", bag)
    topic = {"topic": logs.IMU_TOPIC}
    with bench.mongod_up(store):
        for repetition in bench.repetitions:
            run = partial(bench.run, repetition=repetition)
            segments = [store / "recordings"]
            mine = run(OURS, "ours:frame", {"store": str(store), **topic}, warm=segments)
            looped = run(
                "rosbags", "file_sides:rosbags_frame", {"bag": str(bag), **topic}, warm=[bag]
            )
            decoded = run(
                "mcap + decode", "file_sides:mcap_frame", {"path": str(file), **topic}, warm=[file]
            )
            for other in (looped, decoded):
                for part in ("rows", "last_covariance"):
                    bench.agree(mine[part], other[part], f"the frames' {part}")
                if not np.isclose(mine["sum"], other["sum"], rtol=1e-9):
                    bench.agree(mine["sum"], other["sum"], "the frames' sums")
    discard(store)
    fast = values_of(bench.samples, OURS, "seconds")
    for side in ("rosbags", "mcap + decode"):
        slow = values_of(bench.samples, side, "seconds")
        about = f"to_pandas of {messages:,} IMU messages over a loop with {side}"
        bench.find(ratio(bench.study, about, slow, fast, target=20))
    for side in (OURS, "rosbags", "mcap + decode"):
        found = values_of(bench.samples, side, "seconds")
        bench.find(figure(bench.study, f"{side}: the whole frame", found, "s"))
    bench.find_peak(OURS, "peak memory of to_pandas, the frame included, without mongod")


def _starts(seed: int, seconds: int) -> list[int]:
    """Where the slices start, log time in ns; not at whole seconds."""
    random = np.random.default_rng(seed)
    starts = random.uniform(1.0, seconds - 2.0, _SLICES) * _SECOND_NS
    return [logs.START_NS + int(start) for start in starts]


def _recorded(bench: Bench, name: str, bag: Path) -> Path:
    store = bench.place(name)
    bench.run("recording", "ours:record", {"bag": str(bag), "store": str(store)}, warm=[bag])
    return store


def _open_alone(bench: Bench) -> list[float]:
    return [s.values["open_s"] for s in bench.samples if s.side == "hybridlog, no mongod up"]
