"""How fast `record` is: small messages against the ways into MongoDB, images against a copy."""

from __future__ import annotations

import statistics
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.speed import logs
from benchmarks.speed.bench import discard
from benchmarks.speed.results import figure, ratio, values_of

if TYPE_CHECKING:
    from benchmarks.speed.bench import Bench

OURS = "hybridlog"
HALF = "hybridlog, half the length"


def small(bench: Bench) -> None:
    """Poses, IMU, transforms and joint states."""
    messages = bench.size(1_000_000, 100_000)
    seed = bench.settings.seed
    bag = bench.input(f"small-{messages}.bag", lambda p: logs.write_small(p, messages, seed))
    half = bench.input(
        f"small-{messages // 2}.bag", lambda p: logs.write_small(p, messages // 2, seed)
    )
    documents = bench.place("documents")
    for repetition in bench.repetitions:
        run = partial(bench.run, repetition=repetition)
        store = bench.place("store")
        run(OURS, "ours:record", {"bag": str(bag), "store": str(store)}, warm=[bag])
        if not repetition:
            bench.run(
                "documents",
                "database_sides:dump",
                {"store": str(store), "directory": str(documents)},
            )
        discard(store)
        mongod = bench.place("mongod")
        arguments = {"bag": str(bag), "directory": str(mongod)}
        run("dictionaries", "database_sides:dictionaries", arguments, warm=[bag])
        mongod = bench.place("mongod")
        arguments = {"documents": str(documents), "directory": str(mongod)}
        run("mongod alone", "database_sides:raw_documents", arguments, warm=[documents])
        discard(mongod)
    _record_half(bench, half)
    for sample in bench.samples:
        if sample.side not in {"documents", HALF}:
            bench.agree(sample.values["messages"], messages, "numbers of messages")
    ours, plain, alone = (
        values_of(bench.samples, side, "seconds") for side in (OURS, "dictionaries", "mongod alone")
    )
    bench.find(
        ratio(bench.study, "record over rosbags → dict → insert_many(1000)", plain, ours, target=8)
    )
    bench.find(
        ratio(
            bench.study,
            "record over raw documents into mongod alone",
            alone,
            ours,
            target=0.5,
            aim=True,
        )
    )
    for side, seconds in ((OURS, ours), ("dictionaries", plain), ("mongod alone", alone)):
        rates = [messages / s for s in seconds]
        bench.find(figure(bench.study, f"{side}: messages per second", rates, "/s"))
    bench.find_peak(OURS, "peak memory of record, without mongod")
    bench.find_growth(OURS, HALF, 2)
    peaks = [v / 1e6 for v in values_of(bench.samples, OURS, "mongod_peak_rss")]
    bench.find(figure(bench.study, "peak memory of the embedded mongod", peaks, "MB"))


def images(bench: Bench) -> None:
    """Images of 640 kB."""
    count = bench.size(500, 100)
    seed = bench.settings.seed
    bag = bench.input(f"images-{count}.bag", lambda p: logs.write_images(p, count, seed))
    half = bench.input(f"images-{count // 2}.bag", lambda p: logs.write_images(p, count // 2, seed))
    for repetition in bench.repetitions:
        run = partial(bench.run, repetition=repetition, warm=[bag])
        store, copy = bench.place("store"), bench.place("copy.mcap")
        run(OURS, "ours:record", {"bag": str(bag), "store": str(store)})
        discard(store)
        run("mcap", "file_sides:copy", {"bag": str(bag), "path": str(copy), "sync": False})
        discard(copy)
        run("mcap, fsync", "file_sides:copy", {"bag": str(bag), "path": str(copy), "sync": True})
        discard(copy)
    _record_half(bench, half)
    ours = values_of(bench.samples, OURS, "seconds")
    plain = values_of(bench.samples, "mcap", "seconds")
    synced = values_of(bench.samples, "mcap, fsync", "seconds")
    about = "record over a copy with the mcap writer"
    bench.find(ratio(bench.study, about, plain, ours, target=0.8))
    about = "the same when the copy is forced to the disk too, as record does"
    bench.find(ratio(bench.study, about, synced, ours))
    megabytes = count * logs.IMAGE_SIDE**2 / 1e6
    for side, seconds in ((OURS, ours), ("mcap", plain)):
        rates = [megabytes / s for s in seconds]
        bench.find(figure(bench.study, f"{side}: payload", rates, "MB/s"))
    sizes = [
        statistics.median(values_of(bench.samples, side, "stored_bytes")) for side in (OURS, "mcap")
    ]
    bench.find(
        figure(bench.study, "size of the segments over the copy's", [sizes[0] / sizes[1]], "x")
    )
    bench.find_peak(OURS, "peak memory of record, without mongod")
    bench.find_growth(OURS, HALF, 2)


def _record_half(bench: Bench, bag: Path) -> None:
    store = bench.place("store")
    bench.run(HALF, "ours:record", {"bag": str(bag), "store": str(store)}, warm=[bag])
    discard(store)
