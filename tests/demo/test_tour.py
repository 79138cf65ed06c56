"""The tour as it runs, its answers, and where it stops."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import pytest

from hybridlog import demo
from hybridlog.cli.commands import demo as tour
from hybridlog_storage.errors import UsageError


def test_the_tour_answers_as_the_simulation_counted(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "real"
    code = tour.run(place)
    out, err = capfd.readouterr()
    assert code == 0, err
    counted = json.loads(Path(demo.__file__).with_name("robot.json").read_text("utf-8"))
    shown = [part.partition("\n$ ")[2].splitlines()[1:] for part in out.split("\n# ")[1:]]
    closings, near, errors = ([line for line in part if line] for part in shown[3:6])
    assert closings == [str(counted["gripper_closings"])]
    assert near == [str(counted["near_scans"])]
    assert len(errors) == counted["errors"]
    assert (place / tour.SLICE).stat().st_size > 0
    assert "(6000, " in out
    for typed in tour.STEPS.values():
        assert f"$ {typed}" in out
        assert tour.program(typed)[:2] == [sys.executable, "-P"]
    assert (place / "robot.bag").stat().st_size < 8_000_000
    assert {path.name for path in place.iterdir()} == {tour.BAG, tour.STORE, tour.SLICE}
    with pytest.raises(UsageError, match="exists already"):
        tour.run(place)


@pytest.mark.parametrize("step", ["", "python -c 'raise SystemExit(6)'"])
def test_the_last_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], step: str
) -> None:
    monkeypatch.setattr(tour, "STEPS", {"Fail": step} if step else {})
    assert tour.run(tmp_path) == (6 if step else 0)
    told = f"look at them: hybridlog view --store {shlex.quote(str(tmp_path / tour.STORE))}\n"
    out = capfd.readouterr().out
    assert out.endswith("its files remain in " + f"{tmp_path}\n" if step else told)
