"""What the studies share: runs that are done once, searches, loads that are made once."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.backends.base import Backend
from benchmarks.backends.nothing import Nothing
from benchmarks.harness.run import Outcome, Setting
from benchmarks.loads.base import Load
from benchmarks.samples import Journal, Sample
from benchmarks.studies import record, runs, search
from benchmarks.studies.runs import Context, run_directory
from tests.benchmarks.test_harness import Dying, make_load

pytestmark = pytest.mark.mongo("embedded")

BOUNDS = search.Bounds(start=64.0, lowest=1.0, highest=16384.0, halvings=2)


def context(directory: Path, **settings: Any) -> Context:
    return Context(
        **{
            "work": directory / "work",
            "backends": {"nothing": Nothing},
            "journal": Journal(directory / "out"),
            "scale": "tiny",
            **settings,
        }
    )


# --- the search -----------------------------------------------------------------------


def tried(truth: float, **bounds: float) -> dict[float, bool]:
    """Trials of a backend that keeps all up to a rate."""
    kept: dict[float, bool] = {}
    while (rate := search.next_rate(kept, replace(BOUNDS, **bounds))) is not None:
        assert rate not in kept
        kept[rate] = rate <= truth
        assert len(kept) < 30
    return kept


def test_the_search_doubles_then_halves_the_gap() -> None:
    assert list(tried(300)) == [64, 128, 256, 512, 384, 320]
    assert list(tried(400)) == [64, 128, 256, 512, 384, 448]
    assert list(tried(10)) == [64, 32, 16, 8, 12, 10]
    assert list(tried(0.5)) == [64, 32, 16, 8, 4, 2, 1]
    assert list(tried(1e9, highest=512)) == [64, 128, 256, 512]


@given(truth=st.floats(1, 16384), start=st.sampled_from([4.0, 50.0, 64.0, 100.0]))
def test_the_search_comes_within_a_quarter(truth: float, start: float) -> None:
    kept = tried(truth, start=start)
    best = max((rate for rate, good in kept.items() if good), default=None)
    lost = min((rate for rate, good in kept.items() if not good), default=None)
    if best is None:
        assert lost is not None
        assert lost / 2 < 1
    elif lost is None:
        assert best * 2 > 16384
    else:
        assert best <= truth < lost <= best * 1.2501


def trial(backend: str, rate: float, repetition: int = 0, **values: float) -> Sample:
    usual = {"published": 100, "persisted": 100, "due_s": 1.0, "publish_s": 1.0}
    return Sample("record", {"rate": rate}, backend, repetition, values={**usual, **values})


def test_ends_of_searches_are_computed_from_samples() -> None:
    lost, late = {"persisted": 99}, {"publish_s": 1.5}
    samples = [
        trial("nothing", 1024),
        trial("nothing", 2048, **late),
        trial("low", 64, **lost),
        trial("middle", 64),
        trial("middle", 96),
        trial("middle", 128, **lost),
        trial("middle", 256),  # luck above a loss does not count
        trial("high", 1024),
        trial("high", 2048, **lost),
        trial("late", 64),
        trial("late", 128, **late),
        trial("open", 64),
        trial("crashed", 64),
        replace(trial("crashed", 128), status="failed", values={}),
        replace(trial("absent", 64), status="missing", values={}),
        trial("middle", 64, 1),
        trial("middle", 128, 1, **lost),
    ]
    found = search.searches(samples, "rate", "nothing")
    assert {n: [(one.rate, one.is_above) for one in ends] for n, ends in found.items()} == {
        "nothing": [(1024, True)],
        "low": [(None, False)],
        "middle": [(96, False), (64, False)],
        "high": [(1024, True)],  # the harness could do no more
        "late": [(64, True)],
        "open": [(64, True)],
        "crashed": [(64, False)],
    }


TRUTH = {"Dying": 100.0, "Nothing": 1e9}
"""Rates up to which the backends of the model keep all."""


def test_a_search_is_done_and_goes_on_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bounds = search.Bounds(40.0, 1.0, 320.0, 2)
    monkeypatch.setitem(record.SETTINGS, "tiny", record.Settings(0.2, 4, bounds))
    done: list[tuple[str, float]] = []
    limit = 3

    def model(load: Load, backend: type[Backend], _: Path, setting: Setting) -> Outcome:
        if len(done) == limit:
            raise KeyboardInterrupt
        rate = float(load.name.split()[2])
        done.append((backend.__name__, rate))
        if rate > TRUTH[backend.__name__]:
            return Outcome("failed", {"published": len(load)}, "it died")
        values = {"published": 9, "persisted": 9, "due_s": 1.0, "publish_s": 1.0}
        return Outcome("ok", {**values, "topics": {}})

    monkeypatch.setattr(runs, "run_load", model)
    backends = {"mongo": Dying, "nothing": Nothing}
    with pytest.raises(KeyboardInterrupt):
        record.run(context(tmp_path, backends=backends), 200, 0)
    assert done == [("Dying", 40), ("Nothing", 40), ("Dying", 80)]
    limit = 1000
    record.run(context(tmp_path, backends=backends), 200, 0)
    assert [rate for name, rate in done if name == "Dying"] == [40, 80, 160, 120, 100]
    assert [rate for name, rate in done if name == "Nothing"] == [40, 80, 160, 320]
    samples = list(Journal(tmp_path / "out").samples.values())
    assert all("topics" not in sample.values for sample in samples)
    found = search.searches(samples, "rate", "nothing")
    assert [one.rate for one in found["mongo"]] == [100]
    # A repetition begins anew.
    done.clear()
    record.run(context(tmp_path, backends=backends), 200, 1)
    assert done[0] == ("Dying", 40)


def test_a_stream_is_recorded_and_nothing_of_its_data_stays(tmp_path: Path) -> None:
    where = context(tmp_path)
    record.run(where, 200, 0)
    (sample,) = Journal(tmp_path / "out").samples.values()
    assert sample.status == "ok"
    assert sample.values["persisted"] == sample.values["published"] == 20 * 7
    assert list((tmp_path / "work" / "runs").iterdir()) == []
    loads = sorted(path.name for path in (tmp_path / "work" / "loads").iterdir())
    assert [name.rsplit("-", 1)[0] for name in loads] == ["pool-200-140", "stream-200-64"]


# --- runs and loads -------------------------------------------------------------------


def test_a_failure_is_noted_and_tried_again(tmp_path: Path) -> None:
    load = make_load(tmp_path / "load", messages=100)
    wanted = Sample("record", {"size": 1}, "it", 0)
    for kind, status in ((Dying, "failed"), (Nothing, "ok")):
        context(tmp_path, backends={"it": kind}).run(wanted, lambda: load)
        (sample,) = Journal(tmp_path / "out").samples.values()
        assert sample.status == status
        assert sample.reason == ("the disk is full" if status == "failed" else "")


def test_a_load_that_was_not_finished_is_made_again(tmp_path: Path) -> None:
    where = context(tmp_path)
    made: list[Path] = []

    def broken(directory: Path) -> Load:
        (directory / "payloads.bin").write_bytes(b"half")
        raise OSError("no space")

    def whole(directory: Path) -> Load:
        made.append(directory)
        shutil.rmtree(directory)
        return make_load(directory, messages=2)

    with pytest.raises(OSError, match="no space"):
        where.load("name", {"seed": 1}, broken)
    assert list((where.work / "loads").iterdir()) == []
    for seed in (1, 1, 2):
        assert len(where.load("name", {"seed": seed}, whole)) == 6
    assert len(made) == 2


def test_directories_of_killed_runs_are_removed_and_others_are_not(tmp_path: Path) -> None:
    left = tmp_path / "runs" / "999999999-abc"
    other = tmp_path / "runs" / f"{os.getppid()}-abc"
    for place in (left, other):
        place.mkdir(parents=True)
        (place / "data").write_bytes(b"data")
    with run_directory(tmp_path) as directory:
        assert directory.is_dir()
        assert not left.exists()
        assert other.is_dir()
    assert not directory.exists()


@pytest.mark.parametrize("scale", ["full", "quick"])
def test_a_disturbed_run_is_repeated_and_the_best_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scale: str
) -> None:
    stolen = iter([1.9, 0.5, 1.0])

    def run(*_: Any) -> Outcome:
        values = {"published": 9, "persisted": 8, "wall_s": 1.0, "steal_s": next(stolen)}
        return Outcome("ok", {**values, "persisted_bytes": 0})

    monkeypatch.setattr(runs, "run_load", run)
    load = make_load(tmp_path / "load")
    where = context(tmp_path, scale=scale)
    found = where.run(Sample("record", {"size": 1}, "nothing", 0), lambda: load)
    assert found.values["steal_s"] == (0.5 if scale == "full" else 1.9)
