"""The study of questions and that of reading: answers against the truth, failures, going on."""

from __future__ import annotations

import json
import os
import random
import signal
import sqlite3
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.backends.base import Backend, BackendMissingError
from benchmarks.backends.registry import BACKENDS
from benchmarks.loads.truth import Truth
from benchmarks.questions import askers, run, sides, sql, tasks
from benchmarks.questions.base import (
    GRIPPER,
    MINUTE_NS,
    QUESTIONS,
    VIEWPOINT,
    Answer,
    Asker,
    checked,
    true_answers,
    whole_minutes,
    windows_before,
)
from benchmarks.questions.files import _FileAsker
from benchmarks.questions.mongo import MongoAsker
from benchmarks.questions.sqlite import SqliteAsker
from benchmarks.samples import Journal, Sample
from benchmarks.studies import logs, queries, reading
from benchmarks.studies.runs import Context
from hybridlog_storage.mongo.collection_names import collection_of
from tests.benchmarks.test_harness import Missing

pytestmark = pytest.mark.mongo("embedded")


def context(directory: Path, work: Path, *names: str, **backends: type[Backend]) -> Context:
    chosen = {**{name: able(name) for name in names}, **backends}
    return Context(work, chosen, Journal(directory / "out"), "tiny")


def able(name: str) -> type[Backend]:
    kind = BACKENDS[name]
    try:
        kind.check()
    except BackendMissingError as error:
        pytest.skip(f"{name} was NOT asked: {error}")
    return kind


def is_left(study: Any, where: Context) -> bool:
    """Whether there is something to do."""
    return any(run.to_do(where, turn) for turn in study.plan(where))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the loads lie: they are made once."""
    return tmp_path_factory.mktemp("work")


@pytest.fixture(autouse=True)
def two_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(queries.SETTINGS, "tiny", queries.Settings(1, 1.5, 2))
    monkeypatch.setitem(reading.SETTINGS, "tiny", reading.Settings(2, 2))


def each(names: Iterable[str], *rarely: str) -> list[Any]:
    """Names for a test, of which some are tried before figures are published."""
    exhaustive = pytest.mark.exhaustive
    return [pytest.param(n, marks=exhaustive) if n in rarely else n for n in names]


# --- every backend --------------------------------------------------------------------


@pytest.mark.parametrize("name", each(askers.ASKERS, "bagfile"))
def test_all_answers_are_true(name: str, work: Path, tmp_path: Path) -> None:
    asked = context(tmp_path, work, name)
    queries.run(asked)
    (place,) = (work / "loads").glob("questions-*")
    truth = true_answers(Truth.open(place))
    assert truth["Q1"] != truth["Q4"] != truth["Q4 ±0.1 s"]
    found = list(asked.journal.samples.values())
    assert [s.reason for s in found if s.status != "ok"] == []
    assert len(found) == len(QUESTIONS) * 2
    for sample in found:
        assert sample.values["answer"] == truth[sample.case["question"]]
        assert sample.values["ms"] > 0
        assert sample.values["cold_ms"] > 0
        assert sample.values["disk_bytes"] > 10_000
    # Each repetition is of an opening of its own; two times may be equal, all of them not.
    first_times = [
        tuple(s.values["cold_ms"] for s in found if s.repetition == number) for number in (0, 1)
    ]
    assert first_times[0] != first_times[1]
    assert list((work / "runs").iterdir()) == []
    # What is done is not done again, and no load is wanted for it.
    again = Context(tmp_path / "nowhere", asked.backends, Journal(tmp_path / "out"), "tiny")
    assert not is_left(queries, again)
    queries.run(again)
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize(
    "name", each(askers.READERS, "mongo_indexed", "postgres_indexed", "bagfile", "mcap")
)
def test_what_is_read_is_what_was_published(name: str, work: Path, tmp_path: Path) -> None:
    asked = context(tmp_path, work, name)
    reading.run(asked)
    found = list(asked.journal.samples.values())
    assert [s.reason for s in found if s.status != "ok"] == []
    assert len(found) == len(tasks.TASKS) * 2
    by_task = {(s.case["task"], s.repetition): s.values for s in found}
    assert by_task["1 s of scans", 0]["answer"] != by_task["1 s of scans", 1]["answer"]
    assert by_task["IMU to pandas", 0]["answer"][2] == 400
    assert by_task["scan at a time", 0]["answer"][0] == tasks.MOMENTS
    assert all(v["total_ms"] >= v["ms"] > 0 and v["first_ms"] > 0 for v in by_task.values())
    assert not is_left(reading, asked)


# --- what goes wrong ------------------------------------------------------------------


class Wrong(SqliteAsker):
    """Miscounts, breaks, and changes its mind."""

    def closings(self) -> int:
        return super().closings() + 1

    def behind(self) -> int:
        return self.number("SELECT count(*) FROM nowhere")

    def in_region(self) -> int:
        return random.SystemRandom().getrandbits(62)


class Dying(SqliteAsker):
    """Is killed by the third question."""

    def in_region(self) -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        return 0


def _asked_by(
    monkeypatch: pytest.MonkeyPatch, name: str, work: Path, tmp_path: Path
) -> dict[str, Sample]:
    asker = f"tests.benchmarks.test_queries:{name}"
    monkeypatch.setattr(queries, "ASKERS", {"sqlite_indexed": asker})
    asked = context(tmp_path, work, "sqlite_indexed")
    queries.run(asked)
    assert is_left(queries, asked)
    assert list((work / "runs").iterdir()) == []
    found = asked.journal.samples.values()
    return {sample.case["question"]: sample for sample in found if sample.repetition == 0}


def test_a_wrong_answer_fails(monkeypatch: pytest.MonkeyPatch, work: Path, tmp_path: Path) -> None:
    found = _asked_by(monkeypatch, "Wrong", work, tmp_path)
    assert found["Q1"].status == "failed"
    truth = found["Q1"].values["answer"] - 1
    assert found["Q1"].reason == f"it answered {truth + 1}, and {truth} is right"
    assert "no such table" in found["Q2"].reason
    assert " then " in found["Q3"].reason
    assert found["Q4"].status == "ok"


def test_what_was_told_before_the_end_is_kept(
    monkeypatch: pytest.MonkeyPatch, work: Path, tmp_path: Path
) -> None:
    found = _asked_by(monkeypatch, "Dying", work, tmp_path)
    assert found["Q1"].status == found["Q2"].status == "ok"
    assert found["Q3"].status == found["Q4"].status == "failed"
    assert "SIGKILL" in found["Q4"].reason


def test_what_is_missing_is_said(work: Path, tmp_path: Path) -> None:
    asked = context(tmp_path, work, mongo_indexed=Missing)
    queries.run(asked)
    assert {(s.status, s.reason) for s in asked.journal.samples.values()} == {
        ("missing", "no such system; install it")
    }


def test_what_is_slow_is_asked_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []

    def question() -> int:
        calls.append(0)
        return 7

    found = sides._timed(question, 3)
    assert (len(calls), len(found["ms"]), found["answer"]) == (4, 3, 7)
    monkeypatch.setattr(sides, "SLOW_S", 0.0)
    calls.clear()
    slow = sides._timed(question, 3)
    assert (len(calls), slow["ms"]) == (1, [])
    assert not sides._has_enough(slow)
    slow |= sides._first_again(question, slow)
    assert (len(calls), sides._has_enough(slow), slow["ms"]) == (2, True, [])


def test_first_times_are_of_one_answer() -> None:
    known: dict[str, Any] = {"answer": [7], "cold_ms": [1.0], "ms": [0.5]}
    found = sides._first_again(lambda: [7], known)
    assert found.keys() == {"cold_ms"}
    assert found["cold_ms"][0] == 1.0
    assert len(found["cold_ms"]) == 2
    assert sides._first_again(lambda: [8], known) == {"error": "it answered [7], then [8]"}
    assert sides._first_again(lambda: 1 // 0, known)["error"].startswith("ZeroDivisionError")


def test_a_repetition_may_have_no_first_time() -> None:
    """A side that is ended has told what it knew until then."""
    outcome = SimpleNamespace(values={})
    truth: dict[str, Any] = dict.fromkeys(QUESTIONS, 7)
    result = {"row": "mine", "question": "Q1", "answer": 7}
    told = {**result, "cold_ms": [3.0], "ms": [1.0, 2.0]}
    samples = list(queries._samples(outcome, told, truth, queries.SETTINGS["tiny"]))  # type: ignore[arg-type]
    assert [s.values["ms"] for s in samples] == [1.0, 2.0]
    assert [s.values.get("cold_ms") for s in samples] == [3.0, None]


# --- the questions themselves ---------------------------------------------------------


class Loop(_FileAsker):
    """The loops over messages of a model."""

    def __init__(self, told: list[tuple[str, int, Any]]) -> None:
        self.told = told

    def opened(self) -> Any:
        raise AssertionError

    def messages(self, topics: Sequence[str], *_: Any) -> Any:
        return (row for row in self.told if row[0] in topics)

    def times(self) -> Any:
        return (time for _, time, _ in self.told)

    def last_before(self, topic: str, time: int) -> Any:
        raise AssertionError


def asked_of(asker: type[Asker], messages: dict[str, list[dict[str, Any]]]) -> Asker:
    """SQLite's way, on a table in memory."""
    connection = sqlite3.connect(":memory:")
    for topic, rows in messages.items():
        table = collection_of(topic)
        connection.execute(f'CREATE TABLE "{table}" (id INTEGER PRIMARY KEY, msg TEXT)')
        values = [(json.dumps(row),) for row in rows]
        connection.executemany(f'INSERT INTO "{table}" (msg) VALUES (?)', values)
    found = object.__new__(asker)
    found.connection = connection  # type: ignore[attr-defined]
    backend = SimpleNamespace(connection=connection)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.backends.sqlite.Sqlite", SimpleNamespace)
        found.start(backend)  # type: ignore[arg-type]
    found.topics = list(messages)
    return found


@given(st.lists(st.tuples(st.booleans(), st.integers(1, 100)), max_size=12))
def test_minutes_are_the_same_in_words_and_in_a_loop(steps: list[tuple[bool, int]]) -> None:
    time = 1_400_000_000 * 10**9
    told, rows = [], []
    for is_closed, seconds in steps:
        position = 0.0 if is_closed else 0.08
        told.append((GRIPPER, time, SimpleNamespace(position=position)))
        rows.append({"position": position, "_meta": {"t": time}})
        time += seconds * 10**9
    asker = asked_of(SqliteAsker, {GRIPPER: rows})
    assert asker.closed_minutes() == Loop(told).closed_minutes()


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(0, 1)), max_size=12))
def test_changes_are_the_same_in_words_and_in_a_loop(poses: list[tuple[int, int]]) -> None:
    rows = [
        {"position": {"x": x}, "orientation": {"w": w}, "_meta": {"t": 10**18 + n}}
        for n, (x, w) in enumerate(poses)
    ]
    told = [
        (VIEWPOINT, n, SimpleNamespace(position=x, orientation=w)) for n, (x, w) in enumerate(poses)
    ]
    asker = asked_of(SqliteAsker, {VIEWPOINT: rows})
    want, was_moving = 0, False
    for one, other in zip(poses[1:], poses, strict=False):
        want += one != other and not was_moving
        was_moving = one != other
    assert asker.changes() == Loop(told).changes() == want


def test_the_small_parts() -> None:
    assert whole_minutes([(0, 3 * MINUTE_NS - 1), (10**12, 10**12 + 5)]) == [0, MINUTE_NS]
    five = 5 * MINUTE_NS
    assert windows_before([]) == []
    assert windows_before([2 * five, five // 2 * 3, 10 * five]) == [
        (five // 2, 2 * five),
        (9 * five, 10 * five),
    ]
    assert checked([1, 2]) == [2, 3]
    assert checked([10**18]) != checked([10**18 + 1])
    assert sql.sums([]) == [0.0, 0.0, 0.0, 0.0]
    with np.errstate(all="raise"):
        odd = np.array([1, np.nan, np.inf], np.float32)
        assert tasks.checksum(odd) == tasks.checksum(np.array([1, 0, 0], np.float32))


def test_slices_begin_and_end_between_scans(work: Path, tmp_path: Path) -> None:
    load = logs.make_load(context(tmp_path, work), 2)
    scans = np.sort(load.log_time[tasks._rows(load, tasks.SCAN)])
    for repetition in range(3):
        times = tasks.moment_times(load, repetition)
        times += [edge for span in tasks.slice_spans(load, repetition) for edge in span]
        nearest = np.abs(scans[:, None] - np.array(times)).min(axis=0)
        assert nearest.min() > 1_000_000
        assert all(begin < end for begin, end in tasks.slice_spans(load, repetition))


def test_the_appendix_asks_for_what_the_paper_says() -> None:
    """Word for word, against a collection that writes down what it is asked."""
    asked: list[Any] = []

    class Collection:
        def __init__(self, name: str) -> None:
            self.name = name

        def count_documents(self, question: Any) -> int:
            asked.append((self.name, question))
            return 0

        def find(self, question: Any, *_: Any) -> list[Any]:
            asked.append((self.name, question))
            return []

    asker = object.__new__(MongoAsker)
    asker._database = type("Database", (), {"__getitem__": lambda _, n: Collection(n)})()  # type: ignore[assignment]
    answers: list[Answer] = [QUESTIONS[name](asker) for name in ("Q1", "Q2", "Q3", "Q4")]
    assert answers == [0, 0, 0, 0]
    assert asked == [
        ("r_gripper_controller__command", {"position": 0.0}),
        ("rviz_camera_publisher__camera_pose", {"position.x": {"$lte": 0}}),
        (
            "r_cart__command_pose",
            {
                "pose.position.z": {"$gt": 1},
                "pose.position.y": {"$gt": -0.5, "$lt": 0.5},
                "pose.position.x": {"$gt": 0.5, "$lt": 1},
            },
        ),
        ("r_gripper_controller__command", {"position": 0.0}),
    ]
