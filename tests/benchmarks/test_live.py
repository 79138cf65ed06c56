"""The benchmark of live recording: its load is what it says, its judgement can fail."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.live import cases
from benchmarks.live.cases import CASES, Case, Row, _recorded
from benchmarks.live.recorders import Kept
from benchmarks.live.talker import Load
from benchmarks.samples import Journal
from benchmarks.studies.runs import Context

pytestmark = pytest.mark.mongo("embedded")


def test_a_load_is_counted_to_the_last_message(tmp_path: Path) -> None:
    row = _recorded("tiny", Load(3, 700, 200, 1.0, burst=2), tmp_path / "work", "hybridlog")
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
    recorded = cases._Recorded(Load(1, 500, 100, 1.0), did, kept, 0.0)
    row = cases._row("x", "hybridlog", recorded)
    assert row.holds is holds
    assert row.values["missing"] == 100 - stored - told
    assert row.values["dropped_by_talker"] == 3
    assert row.text.startswith(f"{stored - 7} of 100 stored whole")


def test_messages_are_counted_in_whole_bursts() -> None:
    assert Load(2, 500, 100, 1.05, burst=10).messages == 2 * 110
    assert Load(20, 640_000, 64, 30).megabytes_per_s == pytest.approx(819.2)


def test_every_case_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What does not hold is a failure, and its row is kept."""
    row = Row("small", "hybridlog", {"missing": 1}, "one is missing", holds=False)
    monkeypatch.setitem(CASES, "small", Case("one topic", lambda work, quick: iter([row])))
    context = Context(tmp_path, {}, Journal(tmp_path / "out"))
    cases.run(context, "small")
    (sample,) = context.journal.samples.values()
    assert (sample.status, sample.reason) == ("failed", "one is missing")
    assert sample.values["rows"] == [row._asdict()]
