"""Rates, gaps and statistics against loops over what was written."""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Callable
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.drawing.series import series
from hybridlog.drawing.times import lane_of
from hybridlog.query import intervals
from hybridlog.query.answers.statistics import _Running
from hybridlog_storage.errors import HybridlogError, UsageError
from hybridlog_storage.messages import Channel
from tests.calls import Calls
from tests.limits import Limit

from .conftest import BASE, MS, Logs


def ends(logs: Logs, label: str) -> tuple[int, int]:
    times = [m.time for m in logs.said[label]]
    return min(times), max(times) + 1


@pytest.mark.parametrize(
    ("longer", "periods"), [("12ms", None), (None, 2.5), (None, None), ("9ms", 2.0), ("0s", None)]
)
@pytest.mark.parametrize("between", [None, ("+100ms", "+700ms")])
def test_gaps(
    logs: Logs, longer: str | None, periods: float | None, between: tuple[str, str] | None
) -> None:
    query = logs.store.topic("right/pose")
    query = query if between is None else query.between(*between)
    found = query.gaps(longer, periods)
    want = []
    for label in ("b",):  # the other one does not have the topic
        low, high = ends(logs, label)
        if between is not None:
            low, high = low + 100 * MS, low + 700 * MS
        times = [m.time for m in logs.of(label, "/right/pose") if low <= m.time < high]
        limit = 0.0 if longer is None else float(longer.rstrip("ms")) * MS
        if periods is not None or longer is None:
            if len(times) < 2:
                continue
            usual = sorted(b - a for a, b in pairwise(times))[(len(times) - 2) * 9 // 10]
            limit = max(limit, (periods or 5.0) * usual)
        want += [(a, b) for a, b in pairwise([low, *times, high]) if b - a > limit]
    assert [(gap.begin_ns, gap.end_ns) for gap in found] == sorted(want)
    assert query.counters.chunks_read == 0


def test_of_very_many_steps_the_first_tell_the_usual_one(calls: Calls, limit: Limit) -> None:
    sizes: list[int] = []
    calls(intervals, "usual_period", lambda steps: sizes.append(len(steps)))
    limit(sampled_periods=20)
    steps = intervals.Steps()
    for begin in range(0, 600, 3):
        steps.add(np.arange(begin, begin + 3, dtype=np.int64))
        assert steps.usual_period() == 1
    assert max(sizes) <= 40
    assert min(sizes[-50:]) > 5


def test_bursts_are_no_gaps(tmp_path: Path) -> None:
    """A topic that comes four messages at once, every 100 ms, and is silent once for 2 s."""
    begins = [BASE + n * 100 * MS for n in (*range(60), *range(80, 150))]
    times = [begin + n * MS for begin in begins for n in range(4)]
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("a") as recording:
            for time in times:
                recording.write(Channel("/burst", "json", None), b'{"v": 1}', log_time=time)
        silence = times[239], times[240]
        query = store.topic("burst")
        assert [(gap.begin_ns, gap.end_ns) for gap in query.gaps()] == [silence]
        span = times[0], times[-1] + 1
        for pixels in (5000, 250, 50):
            (line,) = series(query, ["v"], pixels=pixels)
            assert int(np.isnan(line.least).sum()) == 1, pixels
        lane = lane_of(store.session, store.entry("a"), "/burst")
        assert lane.period() == 97 * MS
        edges = np.linspace(span[0], span[1], 1250).astype(np.int64)
        found = lane.gaps(edges, span, lane.period())
        assert len(found) == 1
        assert silence[0] <= edges[found[0, 0]] < edges[found[0, 1]] <= silence[1]


def test_a_topic_that_fell_silent(tmp_path: Path) -> None:
    """A recording without any message of a topic is one gap, and so is its silent end."""
    loud, shy = (Channel(name, "json", None) for name in ("/loud", "/shy"))
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("a") as recording:
            for n in range(100):
                time = BASE + n * 10 * MS
                recording.write(loud, b'{"n": 1}', log_time=time)
                if n in {30, 32, 34, 36}:
                    recording.write(shy, b'{"v": 1e300, "w": [1, 2]}', log_time=time)
        gaps = [
            ((g.begin_ns - BASE) // MS, (g.end_ns - BASE) // MS) for g in store.topic("shy").gaps()
        ]
        assert gaps == [(0, 300), (360, 990)]
        none = store.topic("shy").where("v == 0")
        assert len(none.gaps("100ms")) == 1
        assert len(none.gaps()) == 0
        (v,) = store.topic("shy").stats("v")
        assert (v.count, v.min, v.std) == (4, 1e300, 0.0)
        (w,) = store.topic("shy").stats("w")
        assert (w.count, w.min, w.max, w.mean) == (8, 1, 2, 1.5)


def test_statistics_are_those_of_pandas(logs: Logs) -> None:
    for label, query in (
        (None, logs.store.topic("left/pose", "base")),
        ("b", logs.store.topic("base").in_recording("b")),
    ):
        found = {(row.topic, row.field): row for row in query.stats()}
        assert query.counters.bytes_read > 0
        for topic in query.topics:
            said = [m for name in logs.said if label in {None, name} for m in logs.of(name, topic)]
            for field in ("x", "y", "ticks", "distance"):
                values = pd.Series([float(m.fields[field]) for m in said])  # type: ignore[arg-type]
                row = found[topic, field]
                assert row.count == values.count()
                assert row.nan == values.isna().sum()
                assert (row.min, row.max) == (values.min(), values.max())
                assert row.mean == pytest.approx(values.mean())
                assert row.std == pytest.approx(values.std())
        assert ("/base", "list") not in found
        assert ("/base", "on") not in found
    with_arrays = {row.field: row for row in logs.store.topic("base").stats("list", "list.n", "x")}
    lists: list[Any] = [m.fields["list"] for name in logs.said for m in logs.of(name, "/base")]
    assert with_arrays["list.n"].max == 40
    assert with_arrays["list"].count == sum(map(len, lists))
    assert with_arrays["list"].mean == pytest.approx(
        statistics.fmean(v for one in lists for v in one)
    )


def test_numbers_of_statistics_are_exact(tmp_path: Path) -> None:
    values = ["9007199254740993", "9007199254740995", "-9007199254740993"]
    floats = ["1e400", "2.5", "1e400"]
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("a") as recording:
            for n, (value, other) in enumerate(zip(values, floats, strict=True)):
                text = f'{{"v": {value}, "f": {other}}}'
                recording.write(Channel("/n", "json", None), text.encode(), log_time=BASE + n)
        rows = {row.field: row for row in store.topic("n").stats()}
        assert (rows["v"].min, rows["v"].max) == (-9007199254740993, 9007199254740995)
        assert (rows["f"].count, rows["f"].infinite, rows["f"].nan) == (1, 2, 0)
        assert (rows["f"].mean, rows["f"].std) == (2.5, None)
        assert not math.isinf(rows["f"].max or 0)


def test_what_is_refused(logs: Logs) -> None:
    base = logs.store.topic("base")
    for query in (base.limit(3), base.every(2), base.reverse()):
        for ask in (query.gaps, query.stats, query.check):
            with pytest.raises(UsageError, match="limit, every"):
                ask()
    refused: list[tuple[Callable[[], object], str]] = [
        (logs.store.topic("**/pose").gaps, "one topic's"),
        (lambda: base.gaps(periods=0), "more than 0"),
        (base.between("+1ms", None).clock("header").gaps, "log time"),
        (lambda: base.stats("nothing"), "no field"),
        (lambda: base.stats("state"), "no field with numbers"),
        (base.between("2001-01-01", "2001-01-02").stats, "Nothing was recorded"),
    ]
    for ask, said in refused:
        with pytest.raises(HybridlogError, match=said):
            ask()


@given(
    st.lists(
        st.lists(
            st.floats(allow_nan=False, allow_infinity=False)
            | st.sampled_from([1.7e308, -1.7e308, 1e300, 5e-324, 0.0]),
            min_size=1,
            max_size=4,
        ),
        min_size=1,
        max_size=4,
    )
)
def test_means_and_deviations_do_not_overflow(blocks: list[list[float]]) -> None:
    running = _Running()
    for block in blocks:
        running.add(pa.chunked_array([pa.array(block)]))
    found = running.result("/n", "v")
    exact = [Fraction(value) for block in blocks for value in block]
    mean = sum(exact) / len(exact)
    near = max(map(abs, exact)) / 10**12 + Fraction(5e-323)
    assert found.mean is not None
    assert abs(Fraction(found.mean) - mean) <= near
    if len(exact) > 1:
        squares = sum((value - mean) ** 2 for value in exact) / (len(exact) - 1)
        assert found.std is not None
        if squares < Fraction(sys.float_info.max) ** 2:
            assert math.isfinite(found.std)
            assert abs(Fraction(found.std) ** 2 - squares) <= near * max(map(abs, exact)) * 10**4
        else:
            assert math.isinf(found.std)
