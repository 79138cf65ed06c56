"""Questions about arrays are answered from columns, as from the messages."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

import hybridlog as hl
from hybridlog.query.engines.base import Need
from hybridlog.query.planner import Planner
from tests.payloads.logs import BASE, COUNT, STEP


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
