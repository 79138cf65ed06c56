"""A condition on one topic, asked of many: worked out once, and each chunk is read once."""

from __future__ import annotations

import shutil
import struct
from collections import Counter
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.query.answers import statistics
from hybridlog.query.rows import Rows
from hybridlog_storage.messages import Channel
from tests import places
from tests.calls import Calls
from tests.independent import write_mcap
from tests.many_topics import FLOAT
from tests.scale.cost import cost_of

START = 1_577_836_800 * 10**9
FEW, MANY = 10, 200
MESSAGES = 8


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """A store of a recording with few topics, and one with many; as many messages a second."""
    found = {}
    for count in (FEW, MANY):
        log = tmp_path_factory.mktemp("topics") / "log.mcap"
        topics = [Channel(f"/s{n}", "ros1", FLOAT) for n in range(count)]
        said = [
            (topics[n % count], START + n * 10**6, struct.pack("<f", n // count))
            for n in range(MESSAGES * count)
        ]
        write_mcap(log, said)
        found[count] = log.parent / "store"
        with hl.open(found[count], create=True) as store:
            store.record(log, name="log")
    return found


def near(count: int) -> int:
    """Messages within 3 ms of one on /s1 with data > 3, which come one a round."""
    times = [(turn * count + 1) for turn in range(4, MESSAGES)]
    return sum(any(abs(n - t) <= 3 for t in times) for n in range(MESSAGES * count))


def test_a_condition_on_another_topic_reads_each_chunk_once(stores: dict[int, Path]) -> None:
    costs = {}
    for count, path in stores.items():
        with hl.open(path) as store:
            query = store.all_topics().where("s1: data > 3", within="3ms")
            assert query.count() == near(count)
            size = sum(one.stat().st_size for one in places.files(path))
            costs[count] = cost_of(store, store.all_topics().during(query.question.during).count)
            assert costs[count].bytes_read <= size
    assert costs[MANY].counts == costs[FEW].counts


def test_statistics_of_many_topics_are_planned_together(
    stores: dict[int, Path], calls: Calls
) -> None:
    planners, planned = calls(statistics, "Planner"), []
    looked = calls(Rows, "_find")
    for count, path in stores.items():
        planners.clear()
        looked.clear()
        with hl.open(path) as store:
            found = store.all_topics().stats()
            assert len(looked) == count  # once a topic
            store.refresh()
            for work in (store.all_topics().stats, store.sql("show tables").rows):
                opened = Counter(cost_of(store, work).opened)
                # For what it says of itself, and for its columns.
                assert not [n for file, n in opened.items() if ".parquet" in file and n > 2]
        assert [(one.topic, one.field) for one in found] == [
            (topic, "data") for topic in sorted(f"/s{n}" for n in range(count))
        ]
        assert {(one.count, one.min, one.max) for one in found} == {(MESSAGES, 0, MESSAGES - 1)}
        planned.append(len(planners))
    assert planned[0] == planned[1]


def test_missing_tables_are_made_together(stores: dict[int, Path], tmp_path: Path) -> None:
    costs = {}
    for count, path in stores.items():
        copy = shutil.copytree(path, tmp_path / str(count), ignore=shutil.ignore_patterns("mongod"))
        shutil.rmtree(copy / "tables")
        with hl.open(copy) as store:
            query = store.all_topics().where("data > 3")
            assert query.count() == count * (MESSAGES - 4)
            assert not (copy / "tables").exists()
            costs[count] = cost_of(store, lambda: store.verify(repair=True))
            assert (copy / "tables").exists()
            assert query.count() == count * (MESSAGES - 4)
    few, many = costs[FEW], costs[MANY]
    assert len(many.commands) == len(few.commands)
