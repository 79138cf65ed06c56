"""Topics side by side: columns, reasons, cost, refusals, commands."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pytransform3d.rotations import quaternion_slerp

import hybridlog as hl
from hybridlog.across.match import interpolated
from hybridlog_storage.errors import HybridlogError, UsageError
from hybridlog_storage.messages import Channel, Schema
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer as run
from tests.limits import Limit

from .conftest import BASE, MS, Logs
from .test_joins import naive


def test_what_is_between_two_messages(logs: Logs) -> None:
    """Quaternions go the shorter way on the sphere; what is no number is of the one before."""
    name = "left/pose"
    found = logs.store.align("base", name, how="interpolate", tolerance="20ms").to_arrow()
    assert found[f"{name}.y"].type == pa.float32()
    assert found[f"{name}.ticks"].type == pa.float64()
    rows = iter(found.to_pylist())
    for label in logs.said:
        others = logs.of(label, f"/{name}")
        times = [m.time for m in others]
        for base in logs.of(label, "/base"):
            row = {k.removeprefix(f"{name}."): v for k, v in next(rows).items()}
            want = naive(base.time, times, "interpolate", 20 * MS)
            if want is None:
                assert row["orientation.w"] is row["state"] is row["header.stamp"] is None
                continue
            low, high = others[want[0]], others[want[1]]
            for field in ("state", "list", "on"):
                assert row[field] == low.fields[field]
            assert row["header.stamp"].value == low.stamp
            q = np.array([row[f"orientation.{axis}"] for axis in "wxyz"])
            a, b = (np.roll(np.array(one.fields["q"]), 1) for one in (low, high))
            if low is high or not a.any() or not b.any():
                np.testing.assert_allclose(q, a, atol=1e-15)
            else:
                part = (base.time - low.time) / (high.time - low.time)
                turned = quaternion_slerp(a, b, part, shortest_path=True)
                assert abs(q @ turned) == pytest.approx(1, abs=1e-12)
    assert next(rows, None) is None


def test_values_that_have_no_middle() -> None:
    low = pa.table({"f": [np.inf, 1.0, 1.0, None], "n": pa.array([2**63, 1, 2, 3], pa.uint64())})
    high = pa.table({"f": [2.0, np.nan, None, 1.0], "n": pa.array([2**63, 3, 2, 3], pa.uint64())})
    found = interpolated(low, high, np.array([0.0, 0.5, 0.5, 0.5]), [])
    assert str(found["f"].to_pylist()) == "[inf, nan, None, None]"
    assert found["n"].to_pylist() == [2.0**63, 2.0, 2.0, 3.0]


def test_columns_never_replace_each_other(logs: Logs) -> None:
    base = logs.store.topic("base").in_recording("b").where("header.seq > 3")
    found = logs.store.align(base, ["/base", "left/pose"], how="nearest").to_arrow()
    names = found.column_names
    assert len(names) == len(set(names))
    # A field with the name of our column has an underscore more, as in all tables.
    assert {"base.distance", "base_2.distance", "base_2.distance_", "left/pose.distance_"} <= {
        *names
    }
    assert found["left/pose.distance"].type == pa.duration("ns")
    assert "recording" not in names
    assert found["base_2.distance"].cast(pa.int64()).to_pylist() == [0] * found.num_rows
    by_time = {m.time: float(m.number) for m in logs.of("b", "/base")}
    times = found["log_time"].cast(pa.int64()).to_pylist()
    assert found["base_2.distance_"].to_pylist() == [by_time[time] for time in times]


def test_fields_that_no_definition_fixes(logs: Logs) -> None:
    aligned = logs.store.align("right/pose", "weather", fields={"right/pose": ["header.seq"]})
    found = aligned.to_arrow()
    latest = {
        m.time: m.number for m in [*logs.of("b", "/right/pose"), *logs.of("c", "/right/pose")]
    }
    times = found["log_time"].cast(pa.int64()).to_pylist()
    assert found["weather.n"].to_pylist() == [latest[time] for time in times]
    later = logs.store.align(logs.store.topic("base").fields("x"), "weather", how="interpolate")
    kinds = {field.name: field.type for field in later.to_arrow().schema}
    assert kinds["weather.n"] == pa.float64()
    assert kinds["base.x"] == pa.float64()
    # One recording has no weather.
    table = later.to_arrow()
    assert table["weather.n"].null_count >= len(logs.of("c", "/base"))


def test_only_what_belongs_to_the_range_is_read(logs: Logs) -> None:
    base = logs.store.topic("base").in_recording("b").between("+100ms", "+200ms").fields("list")
    poses = logs.store.topic("left/pose").fields("list")
    whole = poses.in_recording("b")
    whole.to_arrow()
    for how, tolerance in (("asof", None), ("nearest", "10ms"), ("interpolate", None)):
        found = logs.store.align(base, poses, how=how, tolerance=tolerance)
        table = found.to_arrow()
        full = logs.store.align(base.between(None, None), poses, how=how, tolerance=tolerance)
        every = full.to_arrow()
        part = every.filter(pa.compute.is_in(every["log_time"], table["log_time"]))
        assert table.num_rows > 5
        assert str(table.to_pylist()) == str(part.to_pylist())
        assert found.counters.bytes_read < whole.counters.bytes_read / 2


def test_rows_with_large_messages_are_made_a_few_at_a_time(logs: Logs, limit: Limit) -> None:
    """A message that is in many rows is copied into each of them; some are ten times the mean."""
    aligned = logs.store.align(logs.store.topic("left/pose").in_recording("b"), ["right/pose"])
    whole, tables = aligned.to_arrow(), list(aligned.to_tables())
    limit(align_piece_bytes=1000)
    pieces = list(aligned.to_tables())
    found = pa.concat_tables(pieces, promote_options="default")
    pd.testing.assert_frame_equal(found.to_pandas(), whole.to_pandas())
    assert len(pieces) > len(tables)
    beside = [n for n in whole.column_names if n.startswith("right/pose.")]
    assert max(piece.select(beside).nbytes for piece in pieces) < 5000 < whole.nbytes / 10


def test_batches_and_other_frames(logs: Logs) -> None:
    aligned = logs.store.align("base", "left/pose", fields={"base": ["x"], "left/pose": ["y"]})
    table = aligned.to_arrow()
    assert str(pa.Table.from_batches(list(aligned.batches())).to_pylist()) == str(table.to_pylist())
    polars = pytest.importorskip("polars")
    assert aligned.to_polars().equals(polars.from_arrow(table))
    assert str(aligned.to_pandas().index.dtype) == "datetime64[ns, UTC]"


REFUSED: list[tuple[Callable[[hl.Store], object], str]] = [
    (lambda s: s.align("base", "left/pose", how="linear"), "choose asof"),
    (lambda s: s.align("base", "left/pose", clock="wall"), "choose log"),
    (lambda s: s.align(s.topic("base").limit(3), "left/pose").to_arrow(), "limit, every"),
    (lambda s: s.align("**/pose", "base"), "one topic"),
    (lambda s: s.align("base", "weather", clock="header"), r"weather has no header\.stamp"),
    (lambda s: s.align("base", "left/pose", fields={"weather": ["n"]}), "no topic of this"),
    (lambda s: s.align("base", "left/pose", fields={"base": ["z"]}), "no field 'z'"),
    (lambda s: s.align("base", "left/pose", fields={"base": ["list[0]"]}), "a part of an array"),
    (lambda s: s.align("base", "left/pose", fields=["x"]), "given by topic"),  # type: ignore[arg-type]
    (lambda s: s.align("base", "left/pose", tolerance="soon"), "not a duration"),
    (lambda s: s.topic("base").resample(0), "step of 0"),
    (lambda s: s.topic("base").resample("1ns"), "longer step"),
]


def test_what_is_refused(logs: Logs) -> None:
    store = logs.store
    for ask, said in REFUSED:
        with pytest.raises(HybridlogError, match=said):
            ask(store)
    with hl.open(store.directory.path) as other:
        for call in (store.align, lambda *queries: store.sync(queries)):
            with pytest.raises(UsageError, match="another store"):
                call(store.topic("base"), other.topic("left/pose"))


def test_cells_without_a_value_are_counted_by_column(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("now") as recording:
            for n in range(6):
                payload = json.dumps({"n": n} | ({"x": n} if n % 3 else {})).encode()
                for topic in ("/a", "/b"):
                    recording.write(Channel(topic, "json", None, {}), payload, log_time=BASE + n)
        aligned = store.align("/a", store.topic("/b").between(BASE + 1, None))
        aligned.to_arrow()
        assert aligned.remarks() == [
            "a.x: 2 of 6 rows are empty: the message has no such value.",
            "/b: 1 of 6 rows is empty: no message came before.",
            "b.x: 1 of 6 rows is empty: the message has no such value.",
        ]


def test_a_message_that_cannot_be_read_is_no_other(tmp_path: Path) -> None:
    """Not the one before it, and none of its log time."""
    schema = Schema("p/N", "ros1msg", b"float64 x")
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("now") as recording:
            for n in range(5):
                for topic, times in (("/a", 1), ("/b", 2 if n == 3 else 1)):
                    for _ in range(times):
                        payload = b"" if topic == "/b" and n in {1, 3} else struct.pack("<d", n)
                        recording.write(Channel(topic, "ros1", schema), payload, log_time=BASE + n)
        aligned = store.align("/a", "/b")
        assert aligned.to_arrow()["b.x"].to_pylist() == [0, None, 2, None, 4]
        assert "3 messages do not fit" in " ".join(aligned.remarks())


def test_lost_messages_explain_empty_cells(tmp_path: Path) -> None:
    settings = SegmentSettings(chunk_size=1 << 10, segment_size=1)
    path = tmp_path / "store"
    with hl.open(path, create=True) as store:
        with store.start("now", settings=settings) as recording:
            for second in range(6):
                payload = json.dumps({"n": second, "pad": "-" * 2000}).encode()
                for topic in ("/a", "/b"):
                    channel = Channel(topic, "json", None, {})
                    recording.write(channel, payload, log_time=BASE + second * 10**9)
    for segment, file in places.logs_of(path, "now", "/b"):
        if file.first is not None and (file.first - BASE) // 10**9 in {2, 3, 5}:
            segment.unlink()
    with hl.open(path) as store:
        for how in ("asof", "nearest", "interpolate"):
            aligned = store.align("/a", store.topic("/b"), how=how, tolerance="0.5s")
            aligned.to_arrow()
            assert aligned.empty == {"/b": {"messages of that time are lost": 3}}
            assert "3 messages lost in" in aligned.remarks()[-1]


def test_the_commands(logs: Logs, tmp_path: Path) -> None:
    store = logs.store.directory.path
    asked = (
        *("align", "--to", "base", "-t", "*/pose", "--how", "nearest", "--tolerance", "5ms"),
        *("--fields", "base: x", "--fields", "*/pose: state,y", "--where", "left/pose: on == true"),
    )
    want = logs.store.align(
        "base",
        [logs.store.topic("left/pose").where("on == true"), "right/pose"],
        how="nearest",
        tolerance="5ms",
        fields={"base": ["x"], "left/pose": ["state", "y"], "right/pose": ["state", "y"]},
    ).to_arrow()
    path = tmp_path / "x.parquet"
    done = run(*asked, "-o", path, store=store)
    assert str(pq.read_table(path).to_pylist()) == str(want.to_pylist())
    why = done.err.splitlines()
    assert "/left/pose: 87 of 260 rows are empty: no message within 5ms." in why
    first = run(*asked, "-n", "30", store=store)
    lines = [json.loads(line) for line in first.lines]
    assert len(lines) == 30
    empty = want["left/pose.state"].to_pylist()[:30].count(None)
    assert f"/left/pose: {empty} of 30 rows are empty: no message within 5ms." in first.err
    assert lines[0]["log_time_ns"] == want["log_time"][0].value
    assert [row["left/pose.state"] for row in lines] == want["left/pose.state"].to_pylist()[:30]
    other = ("align", "--to", "base", "-t", "left/pose", "-r", "b", "--beside", "c", "-n", "99")
    found = [json.loads(line)["left/pose.recording"] for line in run(*other, store=store).lines]
    assert {*found} == {"c", None}
    run(*asked, "-o", path, store=store, code=2)
    run("align", "--to", "base", "-t", "left/pose", "--where", "x > 0", store=store, code=2)
    assert want["log_time"][0].value > BASE
