"""The study of questions and that of reading: answers against the truth, failures, going on."""

from __future__ import annotations

import os
import random
import signal
from pathlib import Path
from typing import Any

import pytest

from benchmarks.backends.base import Backend, BackendMissingError
from benchmarks.backends.registry import BACKENDS
from benchmarks.loads.truth import Truth
from benchmarks.questions import askers, run, sides, tasks
from benchmarks.questions.base import (
    QUESTIONS,
    true_answers,
)
from benchmarks.questions.sqlite import SqliteAsker
from benchmarks.samples import Journal, Sample
from benchmarks.studies import queries, reading
from benchmarks.studies.runs import Context
from tests.benchmarks.test_harness import Missing
from tests.some import each

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
    return any(run.to_do(where, turn) for turn in study.plan(where))


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("work")


@pytest.fixture(autouse=True)
def two_of_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(queries.SETTINGS, "tiny", queries.Settings(1, 1.5, 2))
    monkeypatch.setitem(reading.SETTINGS, "tiny", reading.Settings(2, 2))


@pytest.mark.parametrize("name", [n for n in askers.ASKERS if n != "bagfile"] + each("bagfile"))
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


RARELY = ("mongo_indexed", "postgres_indexed", "bagfile", "mcap")


@pytest.mark.parametrize("name", [n for n in askers.READERS if n not in RARELY] + each(*RARELY))
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
