"""Aggregates of what topics say between regular times, against plain loops."""

from __future__ import annotations

import math
import random
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hybridlog as hl
from hybridlog.query.intervals import Intervals
from hybridlog_storage.errors import UsageError
from hybridlog_storage.messages import Channel, Schema

from .conftest import BASE, MS, Logs, Said


def bins(begin: int, end: int, step: int, messages: list[Said]) -> Iterator[tuple[int, list[Said]]]:
    """Times from `begin` on, and the messages from each to the next, or to the end."""
    for time in range(begin, end, step):
        yield time, [m for m in messages if time <= m.time < min(time + step, end)]


def aggregate(how: str, values: list[Any]) -> Any:
    """Of finite values."""
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return None
    if how == "mean":
        return math.fsum(map(float, finite)) / len(finite)
    return min(finite) if how == "min" else max(finite)


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("how", ["min", "max", "mean", "first", "last", "count"])
def test_aggregates_of_a_topic(logs: Logs, how: str) -> None:
    query = logs.store.topic("left/pose")
    found = query.resample("15ms", how=how).to_arrow().to_pylist()
    place = 0
    for label, said in logs.said.items():
        begin, end = said[0].time, said[-1].time + 1
        for time, inside in bins(begin, end, 15 * MS, logs.of(label, "/left/pose")):
            row = found[place]
            place += 1
            assert row["log_time"].value == time
            assert row["recording"] == label
            assert row["count"] == len(inside)
            if how in {"first", "last"}:
                one = inside[0 if how == "first" else -1].fields if inside else None
                for name in ("x", "y", "ticks", "state", "list", "on"):
                    assert repr(row[name]) == repr(None if one is None else one[name])
            elif how != "count":
                for name in ("x", "y", "ticks", "on"):
                    want = aggregate(how, [m.fields[name] for m in inside])  # type: ignore[misc]
                    is_near = how == "mean" and want is not None
                    assert row[name] == (pytest.approx(want, rel=1e-12) if is_near else want)
                    assert isinstance(row[name], type(want))
                assert not {"state", "list", "header.frame_id"} & row.keys()
                assert ("header.stamp" in row) == (how != "mean")
    assert place == len(found)
    assert any(row["count"] == 0 for row in found)


@pytest.mark.usefixtures("blocks")
def test_bins_end_with_their_range(logs: Logs) -> None:
    """Also when the next range begins where the last bin would go on."""
    first = logs.said["b"][0].time
    spans = [(first + 2 * MS, first + 45 * MS), (first + 46 * MS, first + 70 * MS)]
    (entry,) = [one for one in logs.store.recordings() if one.name == "b"]
    rows = [[begin, end, 1] for begin, end in spans]

    asked = logs.store.topic("left/pose").where("x > -3")
    asked = asked.during(Intervals([(entry.id, np.array(rows, np.int64))]))
    for how in ("count", "max"):
        found = asked.fields("x").resample("10ms", how=how).to_arrow().to_pylist()
        messages = [m for m in logs.of("b", "/left/pose") if float(str(m.fields["x"])) > -3]
        want = [
            (time, len(inside), aggregate("max", [m.fields["x"] for m in inside]))
            for begin, end in spans
            for time, inside in bins(begin, end, 10 * MS, messages)
        ]
        assert [(row["log_time"].value, row["count"]) for row in found] == [w[:2] for w in want]
        if how == "max":
            assert [row["x"] for row in found] == [w[2] for w in want]


def test_fields_without_a_definition(logs: Logs) -> None:
    """A field that is text in one recording has no numbers there."""
    found = logs.store.topic("weather").resample("100ms", how="mean").to_arrow()
    for row in found.to_pylist():
        inside = [
            one.number
            for one in logs.of(row["recording"], "/right/pose")
            if row["log_time"].value <= one.time < row["log_time"].value + 100 * MS
        ]
        assert row["count"] == len(inside)
        assert row["n"] == (pytest.approx(sum(inside) / len(inside)) if inside else None)
        half = row["n"] / 2 if inside and row["recording"] == "b" else None
        assert row["v"] == (half if half is None else pytest.approx(half))


def test_integers_are_exact_and_types_stay(tmp_path: Path) -> None:
    rng = random.Random(5)
    values = [2**63 - 1 - rng.randrange(3) for _ in range(20)]
    text = b"int64 big\nuint8 small\nfloat32 part\nduration wait\nint32[] list"
    channel = Channel("/n", "ros1", Schema("demo/Numbers", "ros1msg", text))
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("log") as recording:
            for n, value in enumerate(values):
                data = struct.pack("<qBfiiIi", value, n, math.inf, n, 0, 1, n)
                recording.write(channel, data, log_time=BASE + n * MS)
        query = store.topic("/n")
        least, most = (query.resample("1s", how=how).to_arrow() for how in ("min", "max"))
        assert least["big"].to_pylist() == [min(values)]
        assert most["big"].to_pylist() == [max(values)]
        assert most["wait"].cast("int64").to_pylist() == [19 * 10**9]
        assert [str(kind) for kind in most.schema.types[1:]] == [
            *("int64", "int64", "uint8", "float", "duration[ns]"),
        ]
        assert most["part"].to_pylist() == [None]
        mean = query.resample("10ms", how="mean")
        assert mean.to_arrow()["small"].to_pylist() == [4.5, 14.5]
        assert mean.to_arrow().column_names == ["log_time", "count", "big", "small", "part"]
        assert mean.counters.chunks_read == 0  # the table has the fields
        lists = query.fields("list.max").resample("10ms", how="min").to_arrow()
        assert lists["list.max"].to_pylist() == [0, 10]
        count = query.resample("10ms", how="count")
        assert count.to_arrow()["count"].to_pylist() == [10, 10]
        assert (count.counters.messages, count.counters.chunks_read) == (20, 0)


def test_what_is_refused(logs: Logs) -> None:
    query = logs.store.topic("left/pose")
    with pytest.raises(UsageError, match=r"list of /left/pose is no single number"):
        query.fields("x", "list").resample("1s", how="mean").to_arrow()
    with pytest.raises(UsageError, match="leave out tolerance"):
        query.resample("1s", how="mean", tolerance="1s")
    with pytest.raises(UsageError, match=r"'sum'; choose asof, .*, mean\."):
        query.resample("1s", how="sum")
    with pytest.raises(UsageError, match="choose asof, nearest, interpolate"):
        logs.store.align("base", "left/pose", how="mean")


def test_means_of_large_doubles(tmp_path: Path) -> None:
    values = [1.7e308, 1.7e308, 1.6e308, 1e308, -1e308, 3e300, 1.5, 2.5]
    channel = Channel("/n", "ros1", Schema("demo/Large", "ros1msg", b"float64 v\nfloat64[] a"))
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("log") as recording:
            for n, value in enumerate(values):
                data = struct.pack("<dIdd", value, 2, value, 1.75e308)
                recording.write(channel, data, log_time=BASE + n * MS)
        query = store.topic("/n")
        found = query.resample("3ms", how="mean").to_arrow()["v"].to_pylist()
        assert found == pytest.approx([1.7e308 / 3 * 2 + 1.6e308 / 3, 1e300, 2.0])
        (v,) = query.stats("v")
        assert v.mean == pytest.approx(1.7e308 / 4 + 1.6e308 / 8)
        assert v.std == pytest.approx(float(np.std(np.array(values) / 1e200, ddof=1)) * 1e200)
        means = query.fields("a.mean").to_arrow()["a.mean"].to_pylist()
        assert means == pytest.approx([value / 2 + 1.75e308 / 2 for value in values])
        assert query.where("a.mean > 1.7e308").count() == 2
