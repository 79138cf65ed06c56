"""Questions about arrays are answered from columns, as from the messages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

import hybridlog as hl
from hybridlog.columns import payload_writer as writer
from hybridlog.query.engines import Need
from hybridlog.query.planner import Planner
from hybridlog_storage.errors import PayloadError
from hybridlog_storage.segments.segment_writer import SegmentSettings
from tests.payloads.logs import BASE, COUNT, SCAN, STEP, scan, write_log


@pytest.fixture(scope="module")
def stores(
    plain: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[hl.Store, hl.Store]]:
    """A store without columns, and the same with columns."""
    path = tmp_path_factory.mktemp("answers") / "store"
    shutil.copytree(plain, path)
    with hl.open(path) as columns, hl.open(plain) as store:
        columns.compact(topics=["scan", "cloud", "image"])
        yield store, columns


FIELDS = [
    ("scan", ["ranges"]),
    ("scan", ["ranges", "intensities", "header.stamp", "angle_min"]),
    ("scan", ["header", "ranges"]),
    ("scan", None),
    ("image", ["data"]),
    ("image", ["data", "height"]),
    ("cloud", ["fields", "width"]),
]


@pytest.mark.parametrize(("topic", "fields"), FIELDS)
def test_arrays_come_from_columns(
    stores: tuple[hl.Store, hl.Store], topic: str, fields: list[str] | None
) -> None:
    answers, read = [], []
    for store in stores:
        query = store.topic(topic)
        query = query if fields is None else query.fields(*fields)
        answers.append(query.to_arrow())
        read.append(query.counters.chunks_read)
    assert answers[0].equals(answers[1])
    assert answers[0].num_rows in {COUNT, COUNT // 10}
    assert read[0] > 0
    assert read[1] == 0


def test_the_data_of_unpacked_clouds_come_from_messages(
    stores: tuple[hl.Store, hl.Store],
) -> None:
    answers = [store.topic("cloud").fields("data").to_arrow() for store in stores]
    assert answers[0].equals(answers[1])


def test_a_range_reads_only_its_row_groups(stores: tuple[hl.Store, hl.Store]) -> None:
    begin, end = BASE + 10 * STEP, BASE + 20 * STEP
    found = [
        store.topic("scan").between(begin, end).fields("ranges").to_arrow() for store in stores
    ]
    assert found[0].equals(found[1])
    assert found[1].num_rows == 10


PREDICATES = [
    "ranges < 1.002",
    "ranges.min < 1.0005",
    "ranges[17] > 2.4 and header.stamp > 30",
    "not ranges.max > 2.9",
    "intensities.n == 200",
    "ranges[10:20] > 2.95",
    "not ranges[190:].mean < 2.5 and ranges[5:17].n == 12",
]


@pytest.mark.parametrize("predicate", PREDICATES)
def test_predicates_on_arrays(stores: tuple[hl.Store, hl.Store], predicate: str) -> None:
    expected, found = [], []
    for store, into in zip(stores, (expected, found), strict=True):
        query = store.topic("scan").where(predicate)
        into += [
            query.count(),
            [m.log_time_ns for m in query],
            query.fields("ranges").to_arrow(),
            [(i.begin_ns, i.end_ns) for i in query.intervals()],
        ]
    assert found[:2] == expected[:2]
    assert found[2].equals(expected[2])
    assert found[3] == expected[3]


@pytest.mark.parametrize("predicate", PREDICATES)
def test_the_engine_agrees_with_the_messages(
    stores: tuple[hl.Store, hl.Store], predicate: str
) -> None:
    query = stores[1].topic("scan").where(predicate)
    planner = Planner(stores[1].session, query.question, query.counters)
    (part,) = planner.parts()
    columns, scan = planner._columns, planner._scan
    assert columns.cost(part, Need.COUNT) is not None
    assert columns.count([part]) == scan.count([part])
    for mine, other in zip(columns.outcomes(part), scan.outcomes(part), strict=False):
        size = min(len(mine.holds), len(other.holds))
        np.testing.assert_array_equal(mine.holds[:size], other.holds[:size])
    tasks = scan.plan([part]).tasks()
    chosen = columns.select([part], tasks).offsets
    total = sum(map(len, chosen.values()))
    assert total == scan.count([part])


def test_what_columns_cannot_tell_they_leave(stores: tuple[hl.Store, hl.Store]) -> None:
    query = stores[1].topic("scan").where("_meta.seq > 5")
    planner = Planner(stores[1].session, query.question, query.counters)
    (part,) = planner.parts()
    assert planner._columns.cost(part, Need.COUNT) is None
    (plain,) = Planner(stores[1].session, stores[1].topic("scan").question, query.counters).parts()
    assert planner._columns.cost(plain, Need.COUNT) is None  # the catalog knows
    assert planner._columns.cost(plain, Need.VALUES, ["nothing"]) is None
    (number,) = Planner(
        stores[1].session, stores[1].topic("number").question, query.counters
    ).parts()
    assert planner._columns.cost(number, Need.VALUES, None) is None


def test_types_are_those_of_the_messages(stores: tuple[hl.Store, hl.Store]) -> None:
    table = stores[1].topic("image").fields("data").to_arrow()
    assert table.schema.field("data").type == pa.list_(pa.uint8())


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
            ("/without", 60, 0),
            ("/some", 60, 60 * (n % 2)),
            ("/fewer", 60, 59),
            ("/longer", 60 - n % 2, 60 - n % 2),
            ("/none", 0, 0),
        ):
            payload = scan(values[:size], n=n, big=n % 4 == 0, measured=measured)
            said.append((topic, SCAN, BASE + n * STEP, payload))
    said.append(("/even", SCAN, BASE + 40 * STEP, b"odd"))
    log = write_log(path / "log.mcap", said)
    with hl.open(path / "store", create=True) as store:
        store.record(log, name="log")
        yield store


@pytest.mark.parametrize("topic", ["/even", "/without", "/some", "/fewer", "/longer", "/none"])
def test_scans_as_one_array(scans: hl.Store, topic: str) -> None:
    """From columns where scans are alike, and as from the messages one by one."""
    whole = scans.topic(topic).between(None, "+1s")
    questions = [
        whole,
        whole.reverse(),
        whole.every(3),
        whole.limit(4),
        whole.where("ranges > 0.9"),
    ]
    for query in questions:
        expected = [message.to_numpy() for message in query]
        found = query.to_numpy()
        is_stack = len({(one.shape, one.dtype) for one in expected}) == 1
        assert isinstance(found, np.ndarray) == is_stack
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert (one.dtype, one.shape) == (other.dtype, other.shape)
            assert one.tobytes() == other.tobytes()


def test_scans_of_compacted_recordings_come_from_columns(scans: hl.Store) -> None:
    query = scans.topic("/without").between("+0.3s", "+1.2s")
    expected = query.to_numpy()
    assert query.counters.chunks_read > 0
    scans.compact(topics=["without"])
    assert query.to_numpy().tobytes() == expected.tobytes()  # type: ignore[union-attr]
    assert query.counters.chunks_read == 0
    assert query.counters.messages == len(expected) == 18


def test_odd_scans_are_counted(scans: hl.Store) -> None:
    query = scans.topic("/even")
    assert len(query.to_numpy()) == 30
    assert query.counters.unreadable == 1
    assert scans.topic("/even").between("+1.9s", None).limit(0).to_numpy() == []
    with pytest.raises(PayloadError, match="does not fit"):
        scans.topic("/even").between("+1.9s", None).to_numpy()


@pytest.mark.parametrize(
    ("query", "from_chunks"),
    [
        ("select t, ranges, intensities from scan order by t", False),
        ("select t, ranges[21:40] from scan where angle_min < 0 and seq % 7 = 0 order by t", False),
        ("select t, data from image order by t", False),
        ("select t, height, data from cloud order by t", True),  # the points are columns
    ],
)
def test_sql_reads_arrays_from_columns(
    stores: tuple[hl.Store, hl.Store], query: str, *, from_chunks: bool
) -> None:
    paths = [store.directory.path for store in stores]
    with hl.open(paths[0]) as plain, hl.open(paths[1]) as columns:  # which have no chunk in memory
        answers = [store.sql(query) for store in (plain, columns)]
        expected, found = (answer.to_arrow() for answer in answers)
    assert found.equals(expected)
    assert found.num_rows > 10
    assert answers[0].counts.chunks > 0
    assert (answers[1].counts.chunks > 0) == from_chunks


@pytest.mark.parametrize("size", ["GROUP_BYTES", "FILE_BYTES"])
def test_late_messages_in_row_groups_and_files_of_their_own(
    size: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each is in order of time, and each begins before the one in front of it has ended."""
    order = [n for late in range(3) for n in range(late, 60, 3)]
    said = [scan(np.full(400, (n * n) % 7, np.float32)) for n in range(60)]
    rows = [("/scan", SCAN, BASE + n * STEP, said[n]) for n in order]
    log = write_log(tmp_path / "log.mcap", rows)
    settings = SegmentSettings(chunk_size=20 * len(said[0]) + len(said[0]) // 2)
    with hl.open(tmp_path / "store", create=True) as store:
        store.record(log, name="log", settings=settings)
        (entry,) = store.recordings()
        assert entry.chunks == 3
        scans = store.topic("/scan")

        def answers() -> list[Any]:
            return [
                [(i.begin_ns, i.end_ns) for i in scans.where(f"ranges.max {text}").intervals()]
                for text in ("> 2.5", "== 2", "< 1", "== 4")
            ] + [[m.log_time_ns for m in scans.where("ranges.max == 2")]]

        before = answers()
        assert all(before)
        monkeypatch.setattr(writer, size, 1)
        store.compact(topics=["scan"])
        assert answers() == before
    with hl.open(tmp_path / "store") as store:
        scans = store.topic("/scan")
        assert answers() == before
        # Rows of one file are read one after the other, files are merged.
        arrays = store.session.arrays(store.recordings()[0], "/scan")
        assert (arrays is None) == (size == "GROUP_BYTES")
