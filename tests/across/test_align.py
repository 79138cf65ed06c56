"""Topics side by side against pandas, DuckDB and plain loops."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hybridlog as hl
from hybridlog.across.match import UNKNOWN, interpolated, match
from hybridlog_storage.errors import TimeError, TopicError, UsageError
from hybridlog_storage.messages import Channel
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer as run
from tests.limits import Limit

from .conftest import BASE, MS, Logs, Said

TOLERANCE_MS = 7


def naive(
    time: int, rows: list[int], how: str, tolerance: int | None
) -> tuple[int, int, int] | None:
    """Row before, row after and distance, by looking at every message."""
    before = [n for n, row in enumerate(rows) if row <= time]
    after = [n for n, row in enumerate(rows) if row > time]
    if how == "asof":
        pair = [before[-1]] if before else []
    elif how == "nearest":
        near = sorted(
            ([before[-1]] if before else []) + after[:1], key=lambda n: abs(rows[n] - time)
        )
        pair = near[:1]
    else:
        is_exact = bool(before) and rows[before[-1]] == time
        pair = [before[-1]] if is_exact else before[-1:] + after[:1]
        pair = pair if is_exact or (len(pair) == 2 and before) else []
    if not pair or (tolerance is not None and any(abs(rows[n] - time) > tolerance for n in pair)):
        return None
    far = max(pair, key=lambda n: abs(rows[n] - time))
    return pair[0], pair[-1], rows[far] - time


@given(
    st.lists(st.integers(0, 40), max_size=15),
    st.lists(st.integers(0, 40), max_size=15).map(sorted),
    st.sampled_from(["asof", "nearest", "interpolate"]),
    st.none() | st.integers(0, 10),
)
def test_matches_are_those_of_a_loop(
    times: list[int], rows: list[int], how: str, tolerance: int | None
) -> None:
    found = match(np.array([*times, UNKNOWN]), np.array(rows, np.int64), how, tolerance)  # type: ignore[arg-type]
    assert found.before[-1] == -1
    for time, before, after, distance in zip(times, *found, strict=False):
        want = naive(time, rows, how, tolerance)
        if want is None:
            assert (before, after, distance) == (-1, -1, 0)
            continue
        # Of two that are equally far, either distance is right but for its sign.
        assert (before, after, abs(distance)) == (want[0], want[1], abs(want[2]))


def frame_of(said: list[Said], clock: Callable[[Said], int], prefix: str) -> pd.DataFrame:
    frame = pd.DataFrame(
        {
            "time": pd.to_datetime([clock(one) for one in said], utc=True),
            f"{prefix}x": [one.fields["x"] for one in said],
            f"{prefix}number": [one.number for one in said],
        }
    )
    return frame.sort_values("time", kind="stable")


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("clock", ["log", "publish", "header"])
@pytest.mark.parametrize(("how", "direction"), [("asof", "backward"), ("nearest", "nearest")])
def test_joins_are_those_of_pandas(logs: Logs, how: str, direction: str, clock: str) -> None:
    found = logs.store.align(
        "base",
        ["left/pose", "right/pose"],
        how=how,
        tolerance=f"{TOLERANCE_MS}ms",
        fields={name: ["x", "header.seq"] for name in ("base", "left/pose", "/right/pose")},
        clock=clock,
    ).to_pandas()
    time: Callable[[Said], int] = (lambda m: m.time) if clock == "log" else (lambda m: m.stamp)
    for label in logs.said:
        mine = found[found["recording"] == label]
        base = frame_of(logs.of(label, "/base"), time, "")
        assert mine["base.header.seq"].tolist() == [m.number for m in logs.of(label, "/base")]
        for topic in ("left/pose", "right/pose"):
            others = frame_of(logs.of(label, f"/{topic}"), time, "their_")
            if others.empty:
                assert mine[f"{topic}.header.seq"].isna().all()
                continue
            want = pd.merge_asof(
                base,
                others.assign(their_time=others["time"]),
                on="time",
                direction=direction,  # type: ignore[arg-type]
                tolerance=pd.Timedelta(TOLERANCE_MS, "ms"),
            ).sort_values("number", kind="stable")
            mine = mine.sort_values("base.header.seq", kind="stable")
            assert mine[f"{topic}.header.seq"].astype("Float64").tolist() == (
                want["their_number"].astype("Float64").tolist()
            )
            distance = (want["their_time"] - want["time"]).to_numpy()
            np.testing.assert_array_equal(mine[f"{topic}.distance"].to_numpy(), distance)


def on_the_sphere(low: np.ndarray, high: np.ndarray, part: float) -> np.ndarray:
    """Turning by a share of the angle between two rotations, by axis and angle."""
    x, y, z, w = low
    inverse = np.array([-x, -y, -z, w])

    def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        vector = a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])
        return np.append(vector, a[3] * b[3] - a[:3] @ b[:3])

    turn = product(inverse, high)
    turn = -turn if turn[3] < 0 else turn
    angle = 2 * np.arctan2(np.linalg.norm(turn[:3]), turn[3])
    axis = turn[:3] / max(np.linalg.norm(turn[:3]), 1e-300)
    share = np.append(axis * np.sin(part * angle / 2), np.cos(part * angle / 2))
    return product(low, share)


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("tolerance", [None, 20])
def test_interpolation_is_that_of_a_loop(logs: Logs, tolerance: int | None) -> None:
    found = logs.store.align(
        "base",
        "left/pose",
        how="interpolate",
        tolerance=None if tolerance is None else f"{tolerance}ms",
    ).to_arrow()
    rows = found.to_pylist()
    name = "left/pose"
    assert found[f"{name}.y"].type == pa.float32()
    assert found[f"{name}.ticks"].type == pa.float64()
    place = nulls = 0
    for label in logs.said:
        others = logs.of(label, f"/{name}")
        times = [m.time for m in others]
        for base in logs.of(label, "/base"):
            row = {k.removeprefix(f"{name}."): v for k, v in rows[place].items()}
            place += 1
            assert (row["recording"], row["base.header.seq"]) == (label, base.number)
            limit = None if tolerance is None else tolerance * MS
            want = naive(base.time, times, "interpolate", limit)
            if want is None:
                nulls += 1
                assert row["distance"] is row["x"] is row["state"] is row["header.stamp"] is None
                assert row["orientation.w"] is None
                continue
            low, high = others[want[0]], others[want[1]]
            length = high.time - low.time
            part = (base.time - low.time) / length if length else 0.0
            for field in ("x", "y", "ticks"):
                a, b = float(low.fields[field]), float(high.fields[field])  # type: ignore[arg-type]
                exact = a if not part else a + (b - a) * part
                np.testing.assert_allclose(row[field], exact, rtol=1e-6 if field == "y" else 1e-12)
            for field in ("state", "list", "on"):
                assert row[field] == low.fields[field]
            assert row["header.stamp"].value == low.stamp
            q = np.array([row[f"orientation.{axis}"] for axis in "xyzw"])
            a, b = low.fields["q"], high.fields["q"]
            assert isinstance(a, np.ndarray)
            assert isinstance(b, np.ndarray)
            if not a.any() or not b.any() or not part:
                np.testing.assert_allclose(q, a, atol=1e-15)
            else:
                np.testing.assert_allclose(q, on_the_sphere(a, b, part), atol=1e-9)
    assert place == len(rows)
    assert 0 < nulls < len(rows)


def test_values_that_have_no_middle() -> None:
    low = pa.table({"f": [np.inf, 1.0, 1.0, None], "n": pa.array([2**63, 1, 2, 3], pa.uint64())})
    high = pa.table({"f": [2.0, np.nan, None, 1.0], "n": pa.array([2**63, 3, 2, 3], pa.uint64())})
    found = interpolated(low, high, np.array([0.0, 0.5, 0.5, 0.5]), [])
    assert str(found["f"].to_pylist()) == "[inf, nan, None, None]"
    assert found["n"].to_pylist() == [2.0**63, 2.0, 2.0, 3.0]


@pytest.mark.usefixtures("blocks")
def test_regular_times(logs: Logs) -> None:
    poses = logs.store.topic("left/pose").fields("x")
    found = poses.resample("5ms", tolerance="4ms").to_pandas()
    place = 0
    for label in logs.said:
        everything = [m.time for m in logs.said[label]]
        others = logs.of(label, "/left/pose")
        for time in range(min(everything), max(everything) + 1, 5 * MS):
            row = found.iloc[place]
            place += 1
            assert found.index[place - 1].value == time
            want = naive(time, [m.time for m in others], "asof", 4 * MS)
            assert pd.isna(row["distance"]) == (want is None)
            if want is not None:
                np.testing.assert_equal(float(row["x"]), others[want[0]].fields["x"])
    assert place == len(found)
    near = poses.between("+50ms", "+80ms").in_recording("b").resample("10ms").to_pandas()
    assert [t.value - logs.said["b"][0].time for t in near.index] == [50 * MS, 60 * MS, 70 * MS]
    both = logs.store.topic("**/pose").in_recording("b").resample("1s", how="nearest").to_arrow()
    assert {"left/pose.x", "right/pose.x", "right/pose.distance"} <= set(both.column_names)


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
    kinds = {field.name: field.type for field in later.schema() or ()}
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
    for how in ("asof", "nearest", "interpolate"):
        for tolerance in ("10ms", None):
            found = logs.store.align(base, poses, how=how, tolerance=tolerance)
            table = found.to_arrow()
            full = logs.store.align(base.between(None, None), poses, how=how, tolerance=tolerance)
            part = full.to_arrow().filter(
                pa.compute.is_in(full.to_arrow()["log_time"], table["log_time"])
            )
            assert table.num_rows > 5
            assert str(table.to_pylist()) == str(part.to_pylist())
            assert found.counters.bytes_read < whole.counters.bytes_read / 2


def test_rows_with_large_messages_are_made_a_few_at_a_time(logs: Logs, limit: Limit) -> None:
    """A message that is in many rows is copied into each of them."""
    aligned = logs.store.align(logs.store.topic("left/pose").in_recording("b"), ["right/pose"])
    whole, tables = aligned.to_arrow(), list(aligned.to_tables())
    limit(align_piece_bytes=1000)
    pieces = list(aligned.to_tables())
    found = pa.concat_tables(pieces, promote_options="default")
    pd.testing.assert_frame_equal(found.to_pandas(), whole.to_pandas())
    assert len(pieces) > len(tables)
    beside = [n for n in whole.column_names if n.startswith("right/pose.")]
    assert max(piece.select(beside).nbytes for piece in pieces) < 2000


def test_batches_and_other_frames(logs: Logs) -> None:
    aligned = logs.store.align("base", "left/pose", fields={"base": ["x"], "left/pose": ["y"]})
    table = aligned.to_arrow()
    assert str(pa.Table.from_batches(list(aligned.batches())).to_pylist()) == str(table.to_pylist())
    polars = pytest.importorskip("polars")
    assert aligned.to_polars().equals(polars.from_arrow(table))
    assert str(aligned.to_pandas().index.dtype) == "datetime64[ns, UTC]"


def test_what_is_refused(logs: Logs) -> None:
    store = logs.store
    with pytest.raises(UsageError, match="choose asof"):
        store.align("base", "left/pose", how="linear")
    with pytest.raises(UsageError, match="choose log"):
        store.align("base", "left/pose", clock="wall")
    with pytest.raises(UsageError, match="limit, every"):
        store.align(store.topic("base").limit(3), "left/pose").to_arrow()
    with pytest.raises(UsageError, match="one topic"):
        store.align("**/pose", "base")
    with pytest.raises(TopicError, match=r"weather has no header\.stamp"):
        store.align("base", "weather", clock="header").to_arrow()
    with pytest.raises(TopicError, match="no topic of this alignment"):
        store.align("base", "left/pose", fields={"weather": ["n"]})
    with pytest.raises(TopicError, match="no field 'z'"):
        store.align("base", "left/pose", fields={"base": ["z"]})
    with pytest.raises(TopicError, match="a part of an array"):
        store.align("base", "left/pose", fields={"base": ["list[0]"]})
    with pytest.raises(TimeError, match="not a duration"):
        store.align("base", "left/pose", tolerance="soon")
    with pytest.raises(UsageError, match="given by topic"):
        store.align("base", "left/pose", fields=["x"])  # type: ignore[arg-type]
    with hl.open(store.directory.path) as other:
        for call in (store.align, lambda *queries: store.sync(queries)):
            with pytest.raises(UsageError, match="another store"):
                call(store.topic("base"), other.topic("left/pose"))
    with pytest.raises(UsageError, match="step of 0"):
        store.topic("base").resample(0)
    with pytest.raises(UsageError, match="longer step"):
        store.topic("base").resample("1ns")


@pytest.mark.parametrize("how", ["asof", "nearest", "interpolate"])
@pytest.mark.parametrize("tolerance", [None, 7 * MS])
def test_empty_cells_are_explained(logs: Logs, how: str, tolerance: int | None) -> None:
    topics = ["left/pose", "right/pose"]
    near = None if tolerance is None else f"{tolerance}ns"
    aligned = logs.store.align("base", topics, how=how, tolerance=near)
    found = aligned.to_pandas()
    assert aligned.rows == len(found)
    for topic in topics:
        reasons = dict(aligned.empty.get(f"/{topic}", {}))
        assert sum(reasons.values()) == found[f"{topic}.distance"].isna().sum()
        elsewhere = 0
        for label in logs.said:
            rows = [one.time for one in logs.of(label, f"/{topic}")]
            times = [one.time for one in logs.of(label, "/base")]
            empty = sum(naive(time, rows, how, tolerance) is None for time in times)
            elsewhere += 0 if rows else empty
        apart = [number for why, number in reasons.items() if "other recordings (b), " in why]
        assert apart == ([elsewhere] if elsewhere else [])
        others = {why for why in reasons if "other recordings" not in why}
        assert all(why.startswith("no message") for why in others)
        assert all(("7ms" in why) == (tolerance is not None) for why in others)
    said = [line.partition(": ")[0] for line in aligned.remarks()]
    assert said == [name for name, reasons in aligned.empty.items() for _ in reasons]


def test_cells_without_a_value_are_counted_by_column(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("now") as recording:
            for n in range(6):
                fields = {"n": n} | ({"x": n} if n % 3 else {})
                for topic in ("/a", "/b"):
                    payload = json.dumps(fields).encode()
                    recording.write(Channel(topic, "json", None, {}), payload, log_time=BASE + n)
        aligned = store.align("/a", store.topic("/b").between(BASE + 1, None))
        aligned.to_arrow()
        assert aligned.empty == {
            "a.x": {"the message has no such value": 2},
            "/b": {"no message came before": 1},
            "b.x": {"the message has no such value": 1},
        }
        assert aligned.remarks() == [
            "a.x: 2 of 6 rows are empty: the message has no such value.",
            "/b: 1 of 6 rows is empty: no message came before.",
            "b.x: 1 of 6 rows is empty: the message has no such value.",
        ]


@pytest.mark.usefixtures("blocks")
@pytest.mark.parametrize("clock", ["log", "header"])
@pytest.mark.parametrize(("how", "direction"), [("asof", "backward"), ("nearest", "nearest")])
@pytest.mark.parametrize("labels", [["c"], ["b", "c"]])
def test_messages_of_another_recording(
    logs: Logs, how: str, direction: str, clock: str, labels: list[str]
) -> None:
    base = logs.store.topic("base").in_recording("b").fields("header.seq")
    other = logs.store.topic("left/pose").in_recording(*labels).fields("header.seq", "x")
    found = logs.store.align(
        base, [other], how=how, tolerance="7ms", clock=clock, across_recordings=True
    ).to_pandas()
    time: Callable[[Said], int] = (lambda m: m.time) if clock == "log" else (lambda m: m.stamp)
    theirs = [one for label in labels for one in logs.of(label, "/left/pose")]
    label_of = {id(one): label for label in labels for one in logs.of(label, "/left/pose")}
    theirs.sort(key=lambda one: one.time)
    others = frame_of(theirs, time, "their_")
    want = pd.merge_asof(
        frame_of(logs.of("b", "/base"), time, ""),
        others.assign(their_time=others["time"]),
        on="time",
        direction=direction,  # type: ignore[arg-type]
        tolerance=pd.Timedelta(7, "ms"),
    ).sort_values("number", kind="stable")
    found = found.sort_values("base.header.seq", kind="stable")
    distance = (want["their_time"] - want["time"]).to_numpy()
    np.testing.assert_array_equal(found["left/pose.distance"].to_numpy(), distance)
    assert found["left/pose.distance"].notna().sum() > 20
    numbers = {(label_of[id(one)], one.number): time(one) for one in theirs}
    for row in found.dropna(subset=["left/pose.distance"]).itertuples(index=False):
        label, number = row[2], int(row[3])
        assert (label, number) in numbers
    assert set(found["left/pose.recording"].dropna()) <= set(labels)


def test_lost_messages_explain_empty_cells(tmp_path: Path) -> None:
    settings = SegmentSettings(chunk_size=1 << 10, segment_size=1)
    a, b = (Channel(topic, "json", None, {}) for topic in ("/a", "/b"))
    path = tmp_path / "store"
    with hl.open(path, create=True) as store:
        with store.start("now", settings=settings) as recording:
            for second in range(6):
                payload = json.dumps({"n": second, "pad": "-" * 2000}).encode()
                for channel in (a, b):
                    recording.write(channel, payload, log_time=BASE + second * 10**9)
    for segment, file in places.logs_of(path, "now", "/b"):
        if file.first is not None and (file.first - BASE) // 10**9 in {2, 3, 5}:
            segment.unlink()
    with hl.open(path) as store:
        for how, want in (("asof", 3), ("nearest", 3), ("interpolate", 3)):
            aligned = store.align("/a", "/b", how=how, tolerance="0.5s")
            aligned.to_arrow()
            assert aligned.empty == {"/b": {"messages of that time are lost": want}}
            assert "3 messages lost in" in aligned.remarks()[-1]
        whole = store.align("/a", store.topic("/b").between("+0.5s", None), tolerance="0.2s")
        whole.to_arrow()
        assert whole.empty == {
            "/b": {
                "messages of that time are lost": 3,
                "no message within 200ms before": 1,
            }
        }


def test_losses_of_an_unknown_time_explain_no_row(tmp_path: Path) -> None:
    with hl.open(tmp_path / "store", create=True) as store:
        with store.start("now") as recording:
            for n, topic in enumerate(("/a", "/b")):
                recording.write(Channel(topic, "json", None, {}), b"{}", log_time=BASE + n)
    (places.manifest_of(places.folder(tmp_path / "store", "now"))).unlink()
    with hl.open(tmp_path / "store") as store:
        store.verify(repair=True)
        aligned = store.align("/a", "/b")
        aligned.to_arrow()
        assert store.topic("/b").completeness().has_losses
        assert aligned.remarks() == [
            "/b: 1 of 1 row is empty: no message came before.",
            "now has lost its manifest once, so this answer may not be complete.",
        ]


def test_the_command_takes_messages_of_another_recording(logs: Logs) -> None:
    store = logs.store.directory.path
    asked = ("align", "--to", "base", "-t", "left/pose", "-r", "b", "--fields", "base: x")
    done = run(*asked, "--fields", "left/pose: x", "--beside", "c", store=store)
    base, other = (logs.store.topic(name).fields("x") for name in ("base", "left/pose"))
    want = logs.store.align(
        base.in_recording("b"), [other.in_recording("c")], across_recordings=True
    ).to_arrow()
    lines = [json.loads(line) for line in done.lines]
    distances = want["left/pose.distance"].cast(pa.int64()).to_pylist()
    assert [row["left/pose.distance"] for row in lines] == distances
    assert {row["left/pose.recording"] for row in lines} <= {"c", None}
    assert "no message came before." in done.err


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
    done = run(*asked, "-o", path, "-v", store=store)
    assert str(pq.read_table(path).to_pylist()) == str(want.to_pylist())
    cost, *why = done.err.splitlines()
    assert cost.endswith(" s")
    assert "/left/pose: 87 of 260 rows are empty: no message within 5ms." in why
    first = run(*asked, "-n", "30", store=store)
    lines = [json.loads(line) for line in first.lines]
    assert len(lines) == 30
    empty = want["left/pose.state"].to_pylist()[:30].count(None)
    assert f"/left/pose: {empty} of 30 rows are empty: no message within 5ms." in first.err
    assert lines[0]["log_time_ns"] == want["log_time"][0].value
    assert [row["left/pose.state"] for row in lines] == want["left/pose.state"].to_pylist()[:30]
    shown = run(
        "align", "-t", "base", "--step", "100ms", "--fields", "x", "-F", "table", store=store
    )
    assert shown.lines[0].split() == ["log_time", "recording", "distance", "x"]
    assert "The first 20 rows." in shown.err
    run(*asked, "-o", path, store=store, code=2)
    run("align", "--to", "base", "-t", "left/pose", "--where", "x > 0", store=store, code=2)
    assert want["log_time"][0].value > BASE
