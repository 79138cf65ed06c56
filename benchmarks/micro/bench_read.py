"""From a question to an answer: the plan, the payloads, the columns."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from pathlib import Path
from typing import Any

import pytest

from benchmarks.micro.inputs import DRIVE, IMU, read
from benchmarks.micro.isolation import need

PLANS: dict[str, Callable[[Any], Any]] = {
    "slice": lambda store: store.topic("/scan").between("+1s", "+2s"),
    "where": lambda store: store.topic("/imu/data").where("angular_velocity.z > 2.5"),
}


@pytest.mark.parametrize("case", PLANS)
def bench_plan(case: str, store: Any, benchmark: Any) -> None:
    """Which chunks hold the answer, in a store that has been asked before."""
    question = PLANS[case]
    plan = benchmark(lambda: question(store).plan())
    assert plan.lanes


def bench_plan_first(store: Any, benchmark: Any) -> None:
    """The same when nothing is known of the store yet."""
    question = PLANS["slice"]
    plan = benchmark.pedantic(
        lambda: question(store).plan(), setup=store.refresh, rounds=30, warmup_rounds=1
    )
    assert plan.lanes


FETCHES: dict[str, tuple[Callable[[Any], Any], int]] = {
    "scan": (lambda store: store.topic("/scan").between("+1s", "+2s"), 20),
    "image": (lambda store: store.topic("/camera/left/image_raw").between("+1s", "+2s"), 15),
    "imu": (lambda store: store.topic("/imu/data").between("+10s", "+20s"), 2000),
}
"""A question, and how many messages answer it."""


@pytest.mark.parametrize("case", FETCHES)
def bench_fetch(case: str, store: Any, benchmark: Any) -> None:
    """The payloads of a time slice."""
    question, count = FETCHES[case]

    def fetch() -> int:
        return sum(len(batch) for batch, _ in question(store).batches())

    assert benchmark(fetch) == count


@pytest.mark.parametrize("case", ["elsewhere", "near"])
def bench_moment(case: str, store: Any, benchmark: Any) -> None:
    """The scan at a time, decoded: its chunk has to be read, or was for the one before."""
    moments = cycle(["+1.0s", "+1.1s"])

    def forget() -> None:
        kept = getattr(store, "recent_chunks", None)  # older revisions keep none
        if case == "elsewhere" and kept is not None:
            kept.clear()

    def look() -> Any:
        return store.topic("/scan").at(next(moments)).decode()

    look()
    scan = benchmark.pedantic(look, setup=forget, rounds=300, warmup_rounds=3)
    assert len(scan.ranges)


FAST = "angular_velocity.z > 2.5"
AGAIN: dict[str, Callable[[Any], int]] = {
    "count": lambda store: store.topic("/imu/data").where(FAST).count(),
    "states": lambda store: len(store.topic("/imu/data").where(FAST).intervals()),
    "changes": lambda store: len(store.topic("/imu/data").changes("orientation")),
    "frame": lambda store: len(
        store.topic("/imu/data").where(FAST).fields("angular_velocity.z").to_pandas()
    ),
}


@pytest.mark.parametrize("case", AGAIN)
def bench_again(case: str, store: Any, benchmark: Any) -> None:
    """What was asked before about single values of a topic."""
    ask = AGAIN[case]
    answer = ask(store)
    assert benchmark(ask, store) == answer


@pytest.mark.parametrize("case", AGAIN)
def bench_first(case: str, store: Any, benchmark: Any) -> None:
    """The same when only the catalog was read before."""
    ask = AGAIN[case]

    def forget() -> None:
        store.kept.clear()

    answer = ask(store)
    found = benchmark.pedantic(ask, (store,), setup=forget, rounds=30, warmup_rounds=1)
    assert found == answer


DECODED = {
    "imu": (IMU, "/imu/data", 5000),
    "scan": (DRIVE, "/scan", 80),
    "image": (DRIVE, "/camera/left/image_raw", 8),
}


@pytest.mark.parametrize("case", DECODED)
def bench_decode(case: str, bags: Path, benchmark: Any) -> None:
    """Payloads to columns of numpy."""
    name, topic, count = DECODED[case]
    stream = read(bags / name, topic, count)
    codec = need("hybridlog.schema.codec", "codec_for").codec_for(stream.channel())
    batch: Any = stream.batches(count)[0]
    decoded = benchmark(codec.columns, batch.buffer, batch.offset, batch.length, None)
    assert len(decoded.records) == count


TABLES: dict[str, tuple[Callable[[Any], Any], int]] = {
    "pandas": (lambda store: store.topic("/imu/data").to_pandas(), 20_000),
    "arrow": (lambda store: store.topic("/scan").to_arrow(), 80),
    "images": (
        lambda store: store.topic("/camera/left/image_raw").between("+1s", "+2s").to_numpy(),
        15,
    ),
}
"""A question with its answer's form, and the rows of the answer."""


@pytest.mark.parametrize("case", TABLES)
def bench_columns(case: str, store: Any, benchmark: Any) -> None:
    """A topic of a store as a table or an array."""
    ask, rows = TABLES[case]
    assert len(benchmark(ask, store)) == rows
