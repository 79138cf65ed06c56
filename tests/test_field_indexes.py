"""Indexes on fields: found by MongoDB, the same answers, kept by `index rebuild`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import hybridlog as hl
from benchmarks.simulator.topics import RobotConfig
from benchmarks.simulator.write import write_bag
from hybridlog_storage.errors import DatabaseError, TopicError, UsageError
from tests.cli.running import run
from tests.indexed import misindexed

pytestmark = pytest.mark.mongo


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("indexes")
    config = RobotConfig(image_size=(64, 48), cloud_columns=20, scan_beams=180)
    write_bag(place / "robot.bag", duration_s=5.0, config=config)
    with hl.open(place / "store", create=True, require_database=True) as store:
        store.record(place / "robot.bag")
    return place / "store"


@pytest.fixture
def store(path: Path) -> Iterator[hl.Store]:
    with hl.open(path, require_database=True) as opened:
        for one in opened.index.list():
            opened.index.remove(one.topic, *one.fields)
        yield opened


def stages(plan: dict[str, Any]) -> set[str]:
    found = {str(plan.get("stage"))}
    for part in (plan.get("inputStage"), *plan.get("inputStages", ())):
        found |= stages(part) if part else set()
    return found


def how(store: hl.Store, collection: str, where: dict[str, object]) -> set[str]:
    """The steps by which MongoDB finds documents."""
    import pymongo

    assert store.shared.index.reached() is not None
    with pymongo.MongoClient[dict[str, Any]](store.shared.index.reached().address) as client:
        told = client[store.shared.index.reached().name][collection].find(where).explain()
    return stages(told["queryPlanner"]["winningPlan"])


def test_an_index_is_used_and_changes_no_answer(store: hl.Store) -> None:
    question = store.topic("imu/data").where("angular_velocity.z > 0.05")
    before = [(m.log_time_ns, m.raw) for m in question]
    assert 0 < len(before) < store.topic("imu/data").count()
    where = {"angular_velocity.z": {"$gt": 0.05}}
    assert "IXSCAN" not in how(store, "imu__data", where)
    assert store.index.add("imu/data", "angular_velocity.z") == [
        ("/imu/data", ("angular_velocity.z",))
    ]
    assert "IXSCAN" in how(store, "imu__data", where)
    assert [(m.log_time_ns, m.raw) for m in question] == before
    assert question.count() == len(before)
    # Once more is no error, and makes no second one.
    assert len(store.index.add("imu/data", "angular_velocity.z")) == 1


def test_reindex_makes_indexes_again(store: hl.Store) -> None:
    store.index.add("imu/data", "orientation.x", "_meta.inserted_at")
    store.index.add("/odom", "pose.pose.position.x")
    known = store.index.list()
    assert len(known) == 2
    store.index.rebuild()
    assert store.index.list() == known
    assert "IXSCAN" in how(store, "odom", {"pose.pose.position.x": {"$gt": 0}})
    assert misindexed(store) == {}


def test_what_cannot_be_indexed(store: hl.Store) -> None:
    with pytest.raises(TopicError, match=r"no field 'angular_velocity.q'.*angular_velocity.z"):
        store.index.add("imu/data", "angular_velocity.q")
    with pytest.raises(TopicError, match="no topic 'nothing'"):
        store.index.add("nothing", "x")
    for fields in ((), ("orientation.x",) * 2, tuple(f"a{n}" for n in range(9))):
        with pytest.raises((UsageError, TopicError)):
            store.index.add("imu/data", *fields)
    with pytest.raises(DatabaseError):
        store.index.add("joint_states", "position", "velocity")
    assert store.index.list() == []


def test_an_index_on_elements_of_an_array(store: hl.Store) -> None:
    store.index.add("joint_states", "position")
    assert "IXSCAN" in how(store, "joint_states", {"position": {"$gt": 100}})


def test_as_a_command(store: hl.Store) -> None:
    place = store.directory.path

    def said(*arguments: str, code: int = 0) -> str:
        done = run("index", *arguments, store=place, code=code)
        return done.out if code == 0 else done.err

    made = [{"topic": "/imu/data", "fields": ["angular_velocity.z"]}]
    assert said("list") == ""
    assert said("list", "--quiet") == ""
    assert "angular_velocity.z" in said("add", "imu/data", "angular_velocity.z")
    assert json.loads(said("list", "--json")) == made
    assert json.loads(said("list", "/odom", "--json")) == []
    assert "Its indexes: angular_velocity.z." in said("remove", "imu/data", "x", code=2)
    assert "FIELD..." in said("remove", "imu/data", code=2)
    assert said("remove", "imu/data", "angular_velocity.z") == ""
