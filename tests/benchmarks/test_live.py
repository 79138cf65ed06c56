"""The benchmark of live recording: its load is what it says, its judgement can fail."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.live import cases
from benchmarks.live.cases import CASES, Row, _recorded
from benchmarks.live.command import main, markdown
from benchmarks.live.recorders import Kept
from benchmarks.live.talker import Load


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


def test_the_table_names_its_conditions() -> None:
    header = {
        "cpu": "a cpu",
        "cores": 2,
        "memory_gib": 8,
        "disk": "ext4 on vda",
        "system": "Linux",
        "python": "3.11",
        "mongod": "6.0",
        "revision": "abc",
        "started": "today",
        "quick": True,
    }
    text = markdown(header, [Row("paper", "hybridlog", {"stolen_s": 2.5}, "all", holds=True)])
    assert f"| {CASES['paper'].about} | hybridlog | all |" in text
    assert "took 2.5 s of processor time away" in text
    assert "Quick run" in text


def test_help_names_every_case(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as leaving:
        main(["--help"])
    assert leaving.value.code == 0
    said = capsys.readouterr().out
    assert all(name in said for name in CASES)
