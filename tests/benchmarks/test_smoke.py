"""The studies as a user runs them, tiny: they end, all is stored, and the answers agree."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.backends.registry import BACKENDS
from benchmarks.questions.base import QUESTIONS
from benchmarks.samples import Journal, Sample
from hybridlog.demo.write import write_bag
from tests.imports import ROOT

TINY = ["--sizes", "5000", "--rates", "64", "--topics", "3", "--messages", "20"]


def run(out: Path, *arguments: str) -> list[Sample]:
    """Run a study to its end; what it has written down."""
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", *arguments, "--quick", "--out", str(out)],
        cwd=ROOT,
        env={**os.environ, "TERM": "dumb"},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    assert "quick run" in (out / "report.md").read_text("utf-8")
    return list(Journal(out).samples.values())


@pytest.mark.exhaustive
def test_every_backend_stores_what_it_says(tmp_path: Path) -> None:
    samples = run(tmp_path, "throughput", "--only", "throughput", *TINY)
    assert {sample.backend for sample in samples} == set(BACKENDS)
    for sample in samples:
        values = sample.values
        assert sample.status == "ok", (sample.backend, sample.reason)
        assert values["published"] == 60
        assert values["errors"] == values["lost"] == 0, sample.backend
        # A slow machine may drop; what is not dropped must be there.
        assert values["persisted"] + values["dropped"] == 60, sample.backend
        assert values["persisted"] > 0, sample.backend


@pytest.mark.exhaustive
@pytest.mark.timeout(600)
def test_all_three_studies_end_and_the_answers_agree(tmp_path: Path) -> None:
    # The searches, for ceilings and for the speed at which logs drop, have tests of their own.
    # What each backend answers has tests of its own; this one starts at once. A study whose
    # answers are not those of the generator ends with 1.
    parts = ("throughput", "persistence", "queries", "reading")
    only = ["--backends", "sqlite_json1", *(word for part in parts for word in ("--only", part))]
    write_bag(tmp_path / "robot.bag", duration_s=2, topics=["/imu/data", "/base/scan"])
    logs = ["--logs", str(tmp_path / "robot.bag")]
    samples = run(tmp_path / "results", "all", *TINY, *only, *logs)
    assert {sample.study for sample in samples} == set(parts)
    assert {sample.status for sample in samples} == {"ok"}
    asked = {(s.backend, s.case["question"]) for s in samples if s.study == "queries"}
    assert asked == {("sqlite_json1", question) for question in QUESTIONS}
    answers: dict[str, set[str]] = {}
    for sample in samples:
        if sample.study == "queries":
            answers.setdefault(sample.case["question"], set()).add(str(sample.values["answer"]))
    assert {question: len(found) for question, found in answers.items()} == dict.fromkeys(
        QUESTIONS, 1
    )
