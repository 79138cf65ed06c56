"""Study 3 and the study of reading: answers against the truth, failures, going on."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import sqlite3
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymongo.database import Database

from benchmarks.backends.base import Backend, BackendMissingError
from benchmarks.backends.hybridlog_store import Hybridlog
from benchmarks.backends.mongo_json import MongoJsonIndexed
from benchmarks.backends.registry import BACKENDS
from benchmarks.loads.hcr_like import hcr_like
from benchmarks.loads.truth import Truth
from benchmarks.questions import askers, run, sides, sql, tasks
from benchmarks.questions.base import (
    ARM,
    GRIPPER,
    MINUTE_NS,
    QUESTIONS,
    ROSOUT,
    VIEWPOINT,
    Answer,
    Asker,
    checked,
    true_answers,
    whole_minutes,
    windows_before,
)
from benchmarks.questions.files import _FileAsker
from benchmarks.questions.mongo import HybridlogIndexedAsker, MongoAsker
from benchmarks.questions.sqlite import SqliteUdfAsker, _time_diff, get_val
from benchmarks.samples import Journal, Sample
from benchmarks.studies import queries, reading
from benchmarks.studies.runs import Context
from hybridlog_storage.mongo.collection_names import collection_of

SMALL = queries.Settings(sessions=1, minutes=1.5, repetitions=2)
SHORT = reading.Settings(seconds=2.0, repetitions=2)


def context(directory: Path, work: Path | None = None, **settings: Any) -> Context:
    return Context(
        **{
            "work": work or directory / "work",
            "backends": {},
            "journal": Journal(directory / "out"),
            "quick": True,
            **settings,
        }
    )


def is_left(study: Any, where: Context, settings: Any) -> bool:
    """Whether there is something to do."""
    return any(run.to_do(where, turn) for turn in study.plan(where, settings))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the loads lie: they are made once."""
    return tmp_path_factory.mktemp("work")


def able(name: str) -> type[Backend]:
    kind = BACKENDS[name]
    try:
        kind.check()
    except BackendMissingError as error:
        pytest.skip(f"{name} was NOT asked: {error}")
    return kind


def samples_of(journal: Journal, backend: str) -> list[Sample]:
    return [sample for sample in journal.samples.values() if sample.backend == backend]


# --- every backend --------------------------------------------------------------------


def test_every_backend_that_keeps_something_is_asked_and_read() -> None:
    kept = {name for name, kind in BACKENDS.items() if kind.kind != "none"}
    kept -= set(askers.SAME)
    assert set(askers.SAME.values()) <= kept
    assert set(askers.ASKERS) == kept == set(askers.READERS)
    rows = ["hybridlog", "hybridlog_api", "hybridlog_indexed", "hybridlog_api_indexed"]
    assert list(askers.ASKERS["hybridlog"]) == rows


ALWAYS = frozenset(("sqlite_json1", "mongo_json_indexed", "postgres_tuned_indexed", "hybridlog"))
"""Of each kind of store one; the others are asked before figures are published."""


def each(names: Iterable[str]) -> list[Any]:
    exhaustive = pytest.mark.exhaustive
    return [n if n in ALWAYS else pytest.param(n, marks=exhaustive) for n in names]


@pytest.mark.parametrize("name", each(askers.ASKERS))
def test_all_answers_are_true(name: str, work: Path, tmp_path: Path) -> None:
    kind = able(name)
    asked = context(tmp_path, work, backends={name: kind})
    queries.run(asked, SMALL)
    (place,) = (work / "loads").glob("questions-*")
    truth = true_answers(Truth.open(place))
    assert truth["Q1"] != truth["Q4"] != truth["Q4 ±0.1 s"]
    for row in askers.ASKERS[name]:
        found = samples_of(asked.journal, row)
        assert [s.reason for s in found if s.status != "ok"] == []
        assert len(found) == len(QUESTIONS) * SMALL.repetitions
        for sample in found:
            assert sample.values["answer"] == truth[sample.case["question"]]
            assert sample.values["ms"] > 0
            assert sample.values["cold_ms"] > 0
            assert sample.values["load_s"] > 0
            assert sample.values["disk_bytes"] > 10_000
        # Each repetition is of an opening of its own; two times may be equal, all of them not.
        first_times = {
            tuple(s.values["cold_ms"] for s in found if s.repetition == repetition)
            for repetition in range(SMALL.repetitions)
        }
        assert len(first_times) == SMALL.repetitions
        sized = {s.values["index_bytes"] for s in found if "index_bytes" in s.values}
        assert all(size > 1000 for size in sized)
    assert not is_left(queries, asked, SMALL)
    assert list((work / "runs").iterdir()) == []


def test_mongodb_and_hybridlog_are_asked_with_the_same_indexes(tmp_path: Path) -> None:
    load = hcr_like(tmp_path / "load", sessions=1, minutes=1.0, seed=1)

    def keys(database: Database[Any]) -> dict[str, set[tuple[str, ...]]]:
        return {
            topic: {tuple(index["key"]) for index in database[collection_of(topic)].list_indexes()}
            for topic in (GRIPPER, VIEWPOINT, ARM, ROSOUT)
        }

    found = []
    for kind, asker in ((MongoJsonIndexed, MongoAsker), (Hybridlog, HybridlogIndexedAsker)):
        able(kind.name)
        place = tmp_path / kind.name
        place.mkdir()
        with closing(kind(place)) as system:
            system.open(load.channels)
            sides.fill(system, load)
            with closing(asker(system, load.channels)) as asked:
                found.append(keys(asked._database))
    assert found[0] == found[1]
    assert ("_meta.inserted_at",) in found[0][ROSOUT]
    assert ("position.x", "_meta.inserted_at") in found[0][VIEWPOINT]


@pytest.mark.parametrize(
    "name",
    each(
        (
            *("mcap", "bagfile", "mongo_json", "postgres_tuned"),
            *("sqlite_udf", "sqlite_json1", "hybridlog"),
        )
    ),
)
def test_what_is_read_is_what_was_published(name: str, work: Path, tmp_path: Path) -> None:
    kind = able(name)
    asked = context(tmp_path, work, backends={name: kind})
    reading.run(asked, SHORT)
    found = samples_of(asked.journal, name)
    assert [s.reason for s in found if s.status != "ok"] == []
    assert len(found) == len(tasks.TASKS) * SHORT.repetitions
    by_task = {(s.case["task"], s.repetition): s.values for s in found}
    assert by_task["1 s of scans", 0]["answer"] != by_task["1 s of scans", 1]["answer"]
    assert by_task["IMU to pandas", 0]["answer"][2] == 200
    assert by_task["scan at a time", 0]["answer"][0] == tasks.MOMENTS
    assert all(v["total_ms"] >= v["ms"] > 0 and v["first_ms"] > 0 for v in by_task.values())


def test_a_run_that_is_done_is_not_done_again(work: Path, tmp_path: Path) -> None:
    asked = context(tmp_path, work, backends={"sqlite_json1": able("sqlite_json1")})
    queries.run(asked, SMALL)
    before = (tmp_path / "out" / "samples.jsonl").read_bytes()
    # Without a place for loads: nothing may be wanted of it.
    again = context(tmp_path, tmp_path / "nowhere", backends=asked.backends)
    assert not is_left(queries, again, SMALL)
    queries.run(again, SMALL)
    assert (tmp_path / "out" / "samples.jsonl").read_bytes() == before
    assert not (tmp_path / "nowhere").exists()


# --- what goes wrong ------------------------------------------------------------------


class Wrong(SqliteUdfAsker):
    """Miscounts, breaks, and changes its mind."""

    def closings(self) -> int:
        return super().closings() + 1

    def behind(self) -> int:
        return self.number("SELECT count(*) FROM nowhere")

    def in_region(self) -> int:
        return random.SystemRandom().getrandbits(62)


class Dying(SqliteUdfAsker):
    """Is killed by the third question."""

    def in_region(self) -> int:
        os.kill(os.getpid(), signal.SIGKILL)
        return 0


def _asked_by(
    monkeypatch: pytest.MonkeyPatch, name: str, work: Path, tmp_path: Path
) -> dict[str, Sample]:
    rows = {"sqlite_udf": {"sqlite_udf": f"tests.benchmarks.test_queries:{name}"}}
    monkeypatch.setattr(queries, "ASKERS", rows)
    asked = context(tmp_path, work, backends={"sqlite_udf": able("sqlite_udf")})
    queries.run(asked, SMALL)
    found = samples_of(asked.journal, "sqlite_udf")
    assert is_left(queries, asked, SMALL)
    assert list((work / "runs").iterdir()) == []
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


class Absent(Backend):
    """Cannot be used here."""

    name = "mongo_json"
    about = "absent"
    kind = "database"

    @classmethod
    def check(cls) -> None:
        raise BackendMissingError("install it")

    def open(self, channels: Sequence[Any]) -> None:
        raise AssertionError

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        raise AssertionError

    def finish(self) -> None:
        raise AssertionError

    def counts(self) -> dict[str, int]:
        raise AssertionError

    def close(self) -> None:
        """Nothing was started."""


def test_what_is_missing_is_said(work: Path, tmp_path: Path) -> None:
    asked = context(tmp_path, work, backends={"mongo_json": Absent, "mine": Absent})
    queries.run(asked, SMALL)
    assert {(s.status, s.reason) for s in samples_of(asked.journal, "mongo_json")} == {
        ("missing", "install it")
    }
    (mine,) = {s.reason for s in samples_of(asked.journal, "mine")}
    assert "benchmarks/questions/askers.py" in mine
    with pytest.raises(ValueError, match="no backend 'nobody'"):
        queries.plan(asked, queries.Settings(backends=["nobody"]))
    nothing = context(tmp_path, work, backends={"nothing": BACKENDS["nothing"]})
    assert queries.plan(nothing) == reading.plan(nothing) == []
    again = {name: BACKENDS[name] for name in askers.SAME if name in BACKENDS}
    assert queries.plan(context(tmp_path, work, backends=again)) == []


def test_what_is_slow_is_asked_twice(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
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

    asked = context(tmp_path, backends={"sqlite_udf": able("sqlite_udf")})
    settings = replace(SMALL, repetitions=3)
    (turn,) = queries.plan(asked, settings)
    truth: dict[str, Any] = dict.fromkeys(QUESTIONS, 7)
    for name in QUESTIONS:
        result = {"row": "sqlite_udf", "question": name, "index_bytes": None, **slow}
        outcome = SimpleNamespace(values={})
        samples = list(queries._samples(outcome, result, truth, settings))  # type: ignore[arg-type]
        assert [s.values["ms"] for s in samples] == slow["cold_ms"]
        assert [s.values["cold_ms"] for s in samples] == slow["cold_ms"]
        for sample in samples:
            assert is_left(queries, asked, settings)
            asked.journal.add(sample)
    # Two samples stand for all repetitions.
    assert not is_left(queries, asked, settings)
    assert len(turn.samples) == 3 * len(QUESTIONS)


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
    result = {"row": "mine", "question": "Q1", "index_bytes": None, "answer": 7}
    told = {**result, "cold_ms": [3.0], "ms": [1.0, 2.0]}
    samples = list(queries._samples(outcome, told, truth, SMALL))  # type: ignore[arg-type]
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
        patch.setattr("benchmarks.backends.sqlite.SqliteUdf", SimpleNamespace)
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
    asker = asked_of(SqliteUdfAsker, {GRIPPER: rows})
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
    asker = asked_of(SqliteUdfAsker, {VIEWPOINT: rows})
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
    message = json.dumps({"a": {"b": 1}, "t": "2015-07-14T09:26:53.589Z"})
    assert get_val(message, "a.b") == 1
    assert get_val(message, "a.c.d") is None
    later = json.dumps({"t": "2015-07-14T09:26:54.089Z"})
    assert _time_diff(message, "t", later, "t") == _time_diff(later, "t", message, "t") == 500.0
    assert sql.sums([]) == [0.0, 0.0, 0.0, 0.0]
    with np.errstate(all="raise"):
        odd = np.array([1, np.nan, np.inf], np.float32)
        assert tasks.checksum(odd) == tasks.checksum(np.array([1, 0, 0], np.float32))


def test_a_task_that_is_slow_is_done_twice(
    monkeypatch: pytest.MonkeyPatch, work: Path, tmp_path: Path
) -> None:
    asked = context(tmp_path, work, backends={"sqlite_json1": able("sqlite_json1")})
    load = reading.make_load(asked, SHORT)
    results = tmp_path / "results"
    (tmp_path / "data").mkdir()
    monkeypatch.setattr(sides, "SLOW_S", 0.0)
    monkeypatch.setattr(reading, "SLOW_S", 0.0)
    values = sides.read(
        load=str(load.payloads.parent),
        backend="benchmarks.backends.sqlite:SqliteJson1",
        directory=str(tmp_path / "data"),
        rows=askers.READERS["sqlite_json1"],
        repetitions=3,
        results=str(results),
    )
    assert (values["status"], values["reason"]) == ("ok", "")
    told = [json.loads(line) for line in results.read_text().splitlines()]
    assert [(t["task"], t["repetition"]) for t in told] == [
        (name, repetition) for name in tasks.TASKS for repetition in range(2)
    ]
    truth = tasks.true_answers(load, 2)
    settings = replace(SHORT, repetitions=3)
    for result in told:
        assert is_left(reading, asked, settings)
        outcome = SimpleNamespace(values=values)
        sample = reading._sample(outcome, result, truth, settings)  # type: ignore[arg-type]
        asked.journal.add(sample)
    assert {s.status for s in asked.journal.samples.values()} == {"ok"}
    assert not is_left(reading, asked, settings)


def test_slices_begin_and_end_between_scans(work: Path, tmp_path: Path) -> None:
    load = reading.make_load(context(tmp_path, work), SHORT)
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


def test_nothing_is_left_of_a_load_that_cannot_be_made(tmp_path: Path) -> None:
    asked = context(tmp_path, backends={"sqlite_udf": able("sqlite_udf")})
    with pytest.raises(Exception, match="at least 1 minute"):
        queries.run(asked, queries.Settings(sessions=1, minutes=0.5))
    assert list((tmp_path / "work" / "loads").iterdir()) == []
    shutil.rmtree(tmp_path / "work")
