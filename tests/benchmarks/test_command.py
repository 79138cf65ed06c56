"""Tiny runs of the benchmarks, and what their figures rest on: true answers, a sound search."""

from __future__ import annotations

import random
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.__main__ import PARTS
from benchmarks.backends.registry import BACKENDS
from benchmarks.backends.sql import SqliteIndexed
from benchmarks.samples import Journal
from benchmarks.studies import answers, record
from benchmarks.studies.runs import Context
from tests.imports import ROOT

pytestmark = pytest.mark.mongo("embedded")


def run(out: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start a tiny run; what it says goes into a file."""
    out.mkdir()
    with (out / "said").open("wb") as stream:
        return subprocess.Popen(
            [sys.executable, "-m", "benchmarks", "--tiny", "--out", str(out), *arguments],
            cwd=ROOT,
            stdout=stream,
            stderr=subprocess.STDOUT,
        )


@pytest.mark.parametrize(
    ("parts", "backends"),
    [
        (["record", "logs", "queries", "reading"], "hybridlog,sqlite_indexed"),
        pytest.param(
            [part for part in PARTS if part != "live"],
            ",".join(BACKENDS),
            marks=pytest.mark.exhaustive,
        ),
    ],
    ids=["some", "all"],
)
def test_a_tiny_run(tmp_path: Path, parts: list[str], backends: str) -> None:
    """Real processes: streams, the log of a robot, questions, reading."""
    only = [word for part in parts for word in ("--only", part)]
    with run(tmp_path / "out", *only, "-b", backends) as process:
        assert process.wait(600) == 0, (tmp_path / "out" / "said").read_text()
    samples = Journal(tmp_path / "out").samples
    assert {sample.study for sample in samples} == set(parts)
    assert {(sample.status, sample.reason) for sample in samples} == {("ok", "")}
    assert {sample.backend for sample in samples} == set(backends.split(","))
    assert {s.case["size"] for s in samples if s.study == "record"} == {5000, 40_000, 640_000}
    text = (tmp_path / "out" / "benchmarks.md").read_text("utf-8")
    assert "\n| poses within a region, counted for the first time, in ms | " in text
    assert "\n| a second of scans, in ms | " in text


class Wrong(SqliteIndexed):
    """Miscounts, breaks, and changes its mind."""

    def closings(self) -> int:
        return super().closings() + 1

    def behind(self) -> int:
        return len(self.rows("SELECT * FROM nowhere"))

    def in_region(self) -> int:
        return random.SystemRandom().getrandbits(62)


def test_a_wrong_answer_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setitem(answers.QUERIES, "tiny", (1, 1.5, 2))
    journal = Journal(tmp_path / "out", {})
    answers.queries(Context(tmp_path / "work", {"sqlite_indexed": Wrong}, journal, "tiny"))
    found = {s.case["question"]: s for s in journal.samples if s.repetition == 0}
    truth = found["Q1"].values["answers"][0] - 1
    assert found["Q1"].reason == f"it answered {truth + 1}, and {truth} is right"
    assert "no such table" in found["Q2"].reason
    assert " is right" in found["Q3"].reason
    assert [found[f"Q{n}"].status for n in (1, 2, 3, 4)] == [*["failed"] * 3, "ok"]


@given(truth=st.floats(1, 16384), start=st.sampled_from([4.0, 50.0, 64.0, 100.0]))
def test_the_search_comes_within_a_half(truth: float, start: float) -> None:
    kept: dict[float, bool] = {}
    bounds = record.Bounds(start, lowest=1.0, highest=16384.0)
    while (rate := record.next_rate(kept, bounds)) is not None:
        assert rate not in kept
        kept[rate] = rate <= truth
        assert len(kept) < 30
    best, lost = record.bracket(kept)
    if best is None:
        assert lost is not None
        assert lost / 2 < 1
    elif lost is None:
        assert best * 2 > 16384
    else:
        assert best <= truth < lost <= best * 1.5
