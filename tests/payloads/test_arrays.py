"""Tables with arrays answer as messages do, and other readers find the arrays in them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import duckdb
import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rosbags.typesys import Stores, get_typestore

import hybridlog as hl
from hybridlog.arrays.message_arrays import to_numpy
from hybridlog.columns.fields import PointColumns, as_columns
from hybridlog.query.planner import Planner
from hybridlog.schema.codecs import codec_for
from hybridlog_storage.errors import PayloadError, StoreError, TopicError, UsageError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests import places
from tests.cli.within import answer
from tests.damage import flip
from tests.indexed import batch_of
from tests.payloads.logs import (
    BASE,
    CLOUD,
    COUNT,
    SCAN,
    STEP,
    XYZ,
    cloud,
    points_of,
    ranges_of,
    scan,
    standard_channel,
    write_log,
)
from tests.payloads.test_expiry import expire
from tests.waiting import wait_for

TYPES = get_typestore(Stores.ROS2_HUMBLE)
TOPICS = ("scan", "cloud", "image")


@pytest.fixture(scope="module")
def stores(
    plain: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[hl.Store, hl.Store]]:
    """A store whose tables have no long arrays, and the same with them."""
    path = tmp_path_factory.mktemp("arrays") / "store"
    shutil.copytree(plain, path)
    with hl.open(path, mongo="none") as arrays, hl.open(plain, mongo="none") as store:
        arrays.index.arrays(*TOPICS)
        yield store, arrays


def files_of(store: hl.Store, kind: str) -> list[Path]:
    return sorted((store.directory.path / "tables").glob(f"sensor_msgs_msg_{kind}~*/*.parquet"))


FIELDS = [
    ("scan", ["ranges"], True),
    ("scan", ["ranges", "intensities", "header.stamp", "angle_min"], True),
    ("scan", ["header", "ranges"], True),
    ("scan", None, True),
    ("image", ["data"], False),
    ("cloud", ["fields", "width"], True),
    ("cloud", ["data"], False),
]


@pytest.mark.parametrize(("topic", "fields", "in_tables"), FIELDS)
def test_arrays_come_from_tables(
    stores: tuple[hl.Store, hl.Store], topic: str, fields: list[str] | None, *, in_tables: bool
) -> None:
    answers, read = [], []
    for store in stores:
        query = store.topic(topic)
        query = query if fields is None else query.fields(*fields)
        answers.append(query.to_arrow())
        read.append(query.counters.chunks_read)
    assert answers[0].equals(answers[1])
    assert answers[0].schema == answers[1].schema
    assert answers[0].num_rows in {COUNT, COUNT // 10}
    assert (read[1] == 0) == in_tables


PREDICATES = [
    "ranges < 1.002",
    "ranges.min < 1.0005",
    "ranges[350] < 1.5",
    "ranges[340:380].min < 1.5",
    "ranges[17] > 2.4 and header.stamp > 30",
    "ranges[17] > 2.4 and ranges.min < 1.001",
    "not ranges.max > 2.9",
    "intensities.n == 200",
    "ranges[10:20] > 2.95",
    "not ranges[190:].mean < 2.5 and ranges[5:17].n == 12",
    "ranges[400] exists",
]


@pytest.mark.parametrize("predicate", PREDICATES)
def test_predicates_on_elements(stores: tuple[hl.Store, hl.Store], predicate: str) -> None:
    answers: list[list[Any]] = []
    for store in stores:
        query = store.topic("scan").where(predicate)
        tables = query.fields("ranges").to_arrow()
        times = [m.log_time_ns for m in query]
        spans = [(i.begin_ns, i.end_ns) for i in query.intervals()]
        answers.append([query.count(), times, tables.to_pylist(), spans])
    # Lists, since NaN is in no scan of these.
    assert answers[0] == answers[1]
    store = stores[1]
    query = store.topic("scan").where(predicate)
    planner = Planner(store.session, query.question, query.counters)
    (part,) = planner.parts()
    assert planner.tabled(part) is not None
    assert planner.count_of([part]) == planner.count_in_chunks([part])
    assert query.count() == answers[0][0]
    assert query.counters.chunks_read == 0


@pytest.mark.parametrize(
    ("query", "from_chunks"),
    [
        ("select t, ranges, intensities from scan order by t", False),
        ("select t, ranges[21:40] from scan where angle_min < 0 and seq % 7 = 0 order by t", False),
        ("select t, ranges[350], ranges_summary.min from scan where ranges[351] < 2", False),
        ("select t, ranges_summary from scan order by t", None),
        ("select t, data from image order by t", True),
        ("select t, height, data from cloud order by t", True),
    ],
)
def test_sql(stores: tuple[hl.Store, hl.Store], query: str, *, from_chunks: bool | None) -> None:
    paths = [store.directory.path for store in stores]
    with (
        hl.open(paths[0], mongo="none") as plain,  # which have no chunk in memory
        hl.open(paths[1], mongo="none") as arrays,
    ):
        answers = [store.sql(query) for store in (plain, arrays)]
        expected, found = (one.to_arrow() for one in answers)
    assert found.equals(expected)
    assert found.num_rows > 10
    assert (answers[0].reading.counters.chunks_read > 0) == (from_chunks is not None)
    assert (answers[1].reading.counters.chunks_read > 0) == (from_chunks is True)


def test_other_readers(stores: tuple[hl.Store, hl.Store]) -> None:
    """Each array as rosbags reads it from the payload; points as numpy reads them."""
    store = stores[1]
    (scans,), (clouds,) = files_of(store, "LaserScan"), files_of(store, "PointCloud2")
    rows = duckdb.execute(
        "select ranges, intensities from read_parquet(?) order by t", [str(scans)]
    ).fetchall()
    sent = [TYPES.deserialize_cdr(m.raw, SCAN) for m in store.topic("scan")]
    assert [np.float32(row[0]).tolist() for row in rows] == [s.ranges.tolist() for s in sent]
    assert [np.float32(row[1]).tolist() for row in rows] == [s.intensities.tolist() for s in sent]
    frame = pl.scan_parquet(clouds).sort("t").select(pl.col("points").struct.unnest()).collect()
    assert frame.columns == ["x", "y", "z", "ring"]
    for n in range(COUNT):
        points = points_of(n)
        for place, axis in enumerate("xyz"):
            assert frame[axis][n].to_numpy().tolist() == points["xyz"][:, place].tolist()
        assert frame["ring"][n].to_list() == points["ring"].tolist()


def columns_of(path: Path) -> dict[str, Any]:
    return {
        f"{file.parent.name}/{file.name}": pq.read_table(file)
        for file in sorted((path / "tables").glob("*~*/*.parquet"))
    }


def test_off_gives_the_columns_back(copy: Path) -> None:
    before = {name: one.replace_schema_metadata() for name, one in columns_of(copy).items()}
    with hl.open(copy, mongo="none") as store:
        (made,) = store.index.arrays("scan")
        assert (made.topic, made.recordings, made.left) == ("/scan", ["log"], [])
        assert store.index.arrays("scan")[0].recordings == []
        assert 'arrays = ["/scan"]' in (copy / "hybridlog.toml").read_text()
        (gone,) = store.index.arrays("scan", off=True)
        assert gone.recordings == ["log"]
        assert made.bytes > gone.bytes > 0
        assert "arrays" not in (copy / "hybridlog.toml").read_text()
        assert not store.verify().findings
    after = {name: one.replace_schema_metadata() for name, one in columns_of(copy).items()}
    assert before.keys() == after.keys()
    assert all(before[name].equals(after[name]) for name in before)


@pytest.mark.parametrize("off", [False, True])
def test_a_damaged_chunk_costs_no_table(copy: Path, *, off: bool) -> None:
    with hl.open(copy, mongo="none") as store:
        store.index.arrays("scan", off=not off)
        flip(places.segment(store.directory.path, "log", 1), 2000)
        query = store.topic("scan").where("ranges.min < 1.0005")
        expected, tables = query.count(), columns_of(copy)
        (found,) = store.index.arrays("scan", off=off)
        assert (found.recordings, found.left) == ([], ["log"])
        assert columns_of(copy) == tables
        store.refresh()
        assert query.count() == expected > 0
        assert query.counters.chunks_read == 0
    if off:
        said = answer("index", "arrays", "scan", "--off", store=copy)
        assert "Tables of log stay as they are" in said.err


def test_topics_without_long_arrays_keep_their_columns(
    copy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = columns_of(copy)
    with hl.open(copy, mongo="none") as store:
        found = store.index.arrays("image", "number")
        for one in found:
            assert (one.recordings, one.left) == (["log"], [])
        assert columns_of(copy) == before
        for wrong in ((), (["scan"],), ("scan", 3)):
            with pytest.raises(UsageError, match="Name the topics one by one"):
                store.index.arrays(*wrong)
        monkeypatch.setattr(type(store.directory), "is_writable", False)
        with pytest.raises(StoreError):
            store.index.arrays("scan")


def answers_of(path: Path) -> list[Any]:
    with hl.open(path, mongo="none") as store:
        scans = store.topic("scan")
        found: list[Any] = [scans.where(text).count() for text in PREDICATES]
        found += [scans.fields("ranges").to_arrow().to_pylist()]
        found += [store.sql("select ranges[350], ranges_summary from scan order by t").rows()]
        return found


def test_arrays_expire_with_their_payloads(copy: Path) -> None:
    """What tables had of them is in no answer, and in no table."""
    with hl.open(copy, mongo="none") as store:
        store.index.arrays("scan")
    shutil.copytree(copy, copy.with_name("plain"))
    with hl.open(copy.with_name("plain"), mongo="none") as store:
        store.index.arrays("scan", off=True)
    for path in (copy, copy.with_name("plain")):
        expire(path, [0])
    with hl.open(copy, mongo="none") as store:
        store.verify(repair=True)  # makes tables again
    assert answers_of(copy) == answers_of(copy.with_name("plain"))
    with hl.open(copy, mongo="none") as store:
        assert store.index.arrays("scan")[0].recordings == []
        (file,) = files_of(store, "LaserScan")
    table = pq.read_table(file, columns=["ranges", "ranges_summary", "state"])
    gone = pa.compute.equal(table["state"], "expired")
    assert 0 < pa.compute.sum(gone).as_py() < COUNT
    assert table.filter(gone)["ranges"].null_count == pa.compute.sum(gone).as_py()


def test_new_recordings_follow_the_setting(tmp_path: Path) -> None:
    path, channel = tmp_path / "store", standard_channel(SCAN)
    settings_ = SegmentSettings(chunk_size=8 << 10, segment_size=30 << 10)
    with hl.open(path, mongo="none", create=True) as store:
        (found,) = store.index.arrays("/topic")
        assert (found.recordings, found.bytes) == ([], 0)
        for wrong in ("topic", "/t*"):
            with pytest.raises(TopicError):
                store.index.arrays(wrong)
        recording = store.start("run", settings=settings_, flush_interval_s=0.05)
        for n in range(60):
            recording.write(channel, scan(ranges_of(n), n=n), log_time=BASE + n * STEP)
        wait_for(lambda: (store.refresh(), store.topics())[1])
        wait_for(lambda: (store.refresh(), store.topic("/topic").count())[1] == 60)
        query = store.topic("/topic").where("ranges[350] < 2.5")
        expected = sum(float(ranges_of(n)[350]) < 2.5 for n in range(60))
        assert query.count() == expected
        assert query.counters.bytes_read > 0
        assert store.index.arrays("/topic")[0].left == ["run"]
        recording.close()
        store.refresh()
        assert query.count() == expected
        assert store.index.arrays("/topic")[0].recordings == []
        (file,) = files_of(store, "LaserScan")
    assert pq.read_table(file)["ranges"].null_count == 0


def test_the_command(copy: Path) -> None:
    said = answer("index", "arrays", "scan", "/later", store=copy).out
    assert re.search(r"(?m)^/scan +1 +\S+ \S+$", said)
    assert re.search(r"(?m)^/later +0 ", said)
    again = answer("index", "arrays", "scan", "--json", store=copy).json
    assert [(one["topic"], one["recordings"]) for one in again] == [("/scan", [])]
    assert "Its tables have long arrays" in answer("info", "-t", "scan", store=copy).out
    answer("index", "arrays", "scan", "--off", store=copy)
    answer("index", "arrays", "later", store=copy, code=2)


# Points of clouds.

_FIELD = st.tuples(
    st.sampled_from(["x", "y", "Z", "z", "rgb", "", "a.b", "x"]),
    st.integers(0, 20),  # offset
    st.integers(0, 9),  # type; 0 and 9 are none
    st.integers(0, 3),  # count
)


@given(
    layout=st.lists(_FIELD, max_size=5),
    step=st.integers(0, 40),
    shape=st.tuples(st.integers(1, 3), st.integers(0, 4)),
    pad=st.integers(0, 5),
    big=st.booleans(),
    lost=st.sampled_from([0, 0, 0, 1]),
    seed=st.integers(0, 2**32 - 1),
)
def test_points_are_those_of_the_messages(
    layout: list[tuple[str, int, int, int]],
    step: int,
    shape: tuple[int, int],
    pad: int,
    lost: int,
    seed: int,
    *,
    big: bool,
) -> None:
    """As numpy reads each point; a cloud that contradicts itself is null."""
    rows, width = shape
    row_step = width * step + pad
    data = np.random.default_rng(seed).bytes(max(rows * row_step - lost, 0))
    kinds = TYPES.types
    fields = [kinds["sensor_msgs/msg/PointField"](*one) for one in layout]
    stamp = kinds["builtin_interfaces/msg/Time"](1, 2)
    message = kinds[CLOUD](
        kinds["std_msgs/msg/Header"](stamp, "lidar"), rows, width, fields, big, step, row_step,
        np.frombuffer(data, np.uint8), True,
    )  # fmt: skip
    payload = bytes(TYPES.serialize_cdr(message, CLOUD))
    good = cloud([("w", 0, 8, 1)], 8, np.arange(3.0).tobytes())
    codec = codec_for(standard_channel(CLOUD))
    records = codec.columns_of(batch_of(good, payload)).arrow()
    maker = PointColumns()
    columns = maker.with_points(as_columns(records, arrays=True), records)
    found = columns.field("points")
    assert found[0].as_py()["w"] == [0.0, 1.0, 2.0]
    try:
        points = _loop(layout, step, shape, row_step, data, big=big)
    except ValueError:
        assert not found[1].is_valid
        return
    array = to_numpy(CLOUD, message)
    assert array.shape == (shape if rows > 1 else (width,))
    assert not array.size or np.shares_memory(array, message.data)
    values = [v for name, v in found[1].as_py().items() if name != "w"]
    assert len(values) == len(points)
    for have, want in zip(values, points, strict=True):
        np.testing.assert_array_equal(np.array(have, want.dtype), want)


def _loop(
    layout: list[tuple[str, int, int, int]],
    step: int,
    shape: tuple[int, int],
    row_step: int,
    data: bytes,
    *,
    big: bool,
) -> list[np.ndarray[Any, Any]]:
    """Numbers of each field, a point at a time."""
    rows, width = shape
    if not layout or (rows * width and not step):
        raise ValueError
    row_step = row_step if rows > 1 and row_step else width * step
    names = ["i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"]
    found = []
    for _, offset, kind, count in layout:
        if not 1 <= kind <= 8:
            raise ValueError
        dtype = np.dtype((">" if big else "<") + names[kind - 1])
        if offset + (count or 1) * dtype.itemsize > step:
            raise ValueError
        values = [np.empty(0, dtype)]
        for row in range(rows):
            for column in range(width):
                at = row * row_step + column * step + offset
                values.append(np.frombuffer(data, dtype, count or 1, at))
        found.append(np.concatenate(values).astype(dtype.newbyteorder("=")))
    if width and (rows - 1) * row_step + width * step > len(data):
        raise ValueError
    return found


def test_points_in_sql(copy: Path) -> None:
    """From tables where these have them, and from messages elsewhere."""
    query = "select t, points.x[2] as x, len(points.ring) as n from cloud where seq % 3 = 1"
    with hl.open(copy, mongo="none") as store:
        store.index.arrays("cloud")
        answer_ = store.sql(query + " order by t")
        right = answer_.rows()
        assert answer_.reading.counters.chunks_read == 0
        points = [points_of(n) for n in range(COUNT)]
        want = [(float(one["xyz"][1, 0]), len(one)) for one in points]
        assert {row[1:] for row in right} <= {*want}
        with store.start("now", flush_interval_s=0.05) as recording:
            channel = replace(standard_channel(CLOUD), topic="/cloud")
            late = BASE + 1000 * STEP
            recording.write(channel, cloud(XYZ, 20, points[5].tobytes()), log_time=late)
            recording.write(channel, cloud([("x", 9, 7, 1)], 8, bytes(8)), log_time=late + 1)
            wait_for(lambda: (store.refresh(), store.topic("cloud").count())[1] == COUNT + 2)
            found = store.sql("select points.x[2], points is null from cloud order by t").rows()
            assert found[-2:] == [(want[5][0], False), (None, True)]
        store.remove("now")
    expire(copy, [0])
    with hl.open(copy, mongo="none") as store:
        gone = store.sql("select count(*) from cloud where points is null").rows()
        assert gone[0][0] > 1


# Scans as one array.


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Iterator[hl.Store]:
    """Topics of scans, one of them of one length."""
    path = tmp_path_factory.mktemp("scans")
    said = []
    for n in range(30):
        values = np.sin(np.arange(60) + n).astype(np.float32)
        values[n] = (np.inf, np.nan, -np.inf)[n % 3]
        for topic, size, measured in (
            ("/even", 60, 60),
            ("/some", 60, 60 * (n % 2)),
            ("/longer", 60 - n % 2, 60 - n % 2),
        ):
            payload = scan(values[:size], n=n, big=n % 4 == 0, measured=measured)
            said.append((topic, SCAN, BASE + n * STEP, payload))
    said.append(("/even", SCAN, BASE + 40 * STEP, b"odd"))
    log = write_log(path / "log.mcap", said)
    with hl.open(path / "store", mongo="none", create=True) as store:
        store.record(log, name="log")
        yield store


@pytest.mark.parametrize("topic", ["/even", "/some", "/longer"])
def test_scans_that_are_alike_are_one_array(scans: hl.Store, topic: str) -> None:
    query = scans.topic(topic).between(None, "+1s")
    expected = [message.to_numpy() for message in query]
    found = query.to_numpy()
    assert isinstance(found, np.ndarray) == (topic == "/even")
    for one, other in zip(found, expected, strict=True):
        assert (one.dtype, one.tobytes()) == (other.dtype, other.tobytes())


def test_odd_scans_are_counted(scans: hl.Store) -> None:
    query = scans.topic("/even")
    assert len(query.to_numpy()) == 30
    assert query.counters.unreadable == 1
    assert len(scans.topic("/even").between("+1.9s", None).limit(0).to_numpy()) == 0
    with pytest.raises(PayloadError, match="does not fit"):
        scans.topic("/even").between("+1.9s", None).to_numpy()
