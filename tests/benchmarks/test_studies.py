"""What the studies share: runs that are done once, searches, loads that are made once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.backends.base import Backend
from benchmarks.backends.nothing import Nothing
from benchmarks.harness.run import Outcome, Setting
from benchmarks.live import cases
from benchmarks.live.cases import CASES, Case, Row, _recorded
from benchmarks.live.recorders import Kept
from benchmarks.live.talker import Load as Talk
from benchmarks.loads.base import Load
from benchmarks.samples import Journal, Sample
from benchmarks.studies import record, runs, search
from benchmarks.studies.runs import Context
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


def tried(truth: float, **bounds: float) -> dict[float, bool]:
    """Trials of a backend that keeps all up to a rate."""
    kept: dict[float, bool] = {}
    while (rate := search.next_rate(kept, replace(BOUNDS, **bounds))) is not None:
        assert rate not in kept
        kept[rate] = rate <= truth
        assert len(kept) < 30
    return kept


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


def test_a_failure_is_noted_and_tried_again(tmp_path: Path) -> None:
    load = make_load(tmp_path / "load", messages=100)
    wanted = Sample("record", {"size": 1}, "it", 0)
    for kind, status in ((Dying, "failed"), (Nothing, "ok")):
        context(tmp_path, backends={"it": kind}).run(wanted, lambda: load)
        (sample,) = Journal(tmp_path / "out").samples.values()
        assert sample.status == status
        assert sample.reason == ("the disk is full" if status == "failed" else "")


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


def test_a_load_is_counted_to_the_last_message(tmp_path: Path) -> None:
    row = _recorded("tiny", Talk(3, 700, 200, 1.0, burst=2), tmp_path / "work", "hybridlog")
    assert row.values["sent"] == row.values["stored"] == 600
    assert row.holds
    assert "600 of 600 stored whole (100 %), nothing in the ledger, 0 missing" in row.text
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize(
    ("stored", "told", "indexed", "holds"),
    [(90, 10, 90, True), (90, 9, 90, False), (100, 0, 99, False), (100, 0, 100, True)],
)
def test_what_is_missing_without_a_word_is_found(
    stored: int, told: int, indexed: int, *, holds: bool
) -> None:
    kept = Kept(stored, told, 7, indexed, {"transport": told, "degrade": 7}, 1.0)
    did = {"sent": 100, "dropped": 3, "late_ms": 0.1, "seconds": 1.0}
    recorded = cases._Recorded(Talk(1, 500, 100, 1.0), did, kept, 0.0)
    row = cases._row("x", "hybridlog", recorded)
    assert row.holds is holds
    assert row.values["missing"] == 100 - stored - told
    assert row.values["dropped_by_talker"] == 3
    assert row.text.startswith(f"{stored - 7} of 100 stored whole")


def test_messages_are_counted_in_whole_bursts() -> None:
    assert Talk(2, 500, 100, 1.05, burst=10).messages == 2 * 110
    assert Talk(20, 640_000, 64, 30).megabytes_per_s == pytest.approx(819.2)


def test_every_case_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not hold is a failure, and its row is kept."""
    row = Row("small", "hybridlog", {"missing": 1}, "one is missing", holds=False)
    monkeypatch.setitem(CASES, "small", Case("one topic", lambda work, quick: iter([row])))
    told = context(tmp_path)
    cases.run(told, "small")
    (sample,) = told.journal.samples.values()
    assert (sample.status, sample.reason) == ("failed", "one is missing")
    assert sample.values["rows"] == [row._asdict()]
