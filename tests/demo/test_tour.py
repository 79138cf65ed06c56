"""The tour as data, its behaviour when a command fails, and its answers."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path

import pytest

from hybridlog import demo
from hybridlog.cli.commands import demo as tour
from hybridlog_storage.errors import UsageError

# Stands in for each command, so that the tour alone is under test.
FAKE = """\
import pathlib, sys
if sys.argv[1] == FAIL:
    sys.exit(6)
elif sys.argv[1] == 'record':
    pathlib.Path('robot-logs').mkdir()
    print('recorded')
"""


def fake(code: str, command: str) -> list[str]:
    words = shlex.split(command)
    return [sys.executable, "-c", code, *words[1 if words[0] == "hybridlog" else 2 :]]


def pretend(monkeypatch: pytest.MonkeyPatch, *, fail: str = "") -> None:
    code = FAKE.replace("FAIL", repr(fail))
    monkeypatch.setattr(tour, "program", lambda typed: fake(code, typed))


def test_every_command_is_whole() -> None:
    programs = [shlex.split(typed) for typed in tour.STEPS.values()]
    for typed, words in zip(tour.STEPS.values(), programs, strict=True):
        argv = tour.program(typed)
        assert argv[:2] == [sys.executable, "-P"]
        assert argv[-len(words) + 1 :] == words[1:]
        assert words[0] in {"hybridlog", "python"}
        assert (argv[2:4] == ["-m", "hybridlog"]) == (words[0] == "hybridlog")
    compile(programs[-1][2], "<snippet>", "exec")
    verbs = [words[1] for words in programs if words[0] == "hybridlog"]
    assert verbs[:3] == ["record", "ls", "info"]


def test_a_good_tour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pretend(monkeypatch)
    assert tour.run(tmp_path / "new") == 0
    out, err = capfd.readouterr()
    assert err == ""
    for typed in tour.STEPS.values():
        assert f"$ {typed}" in out
    # What a command prints stands below the command.
    assert out.index("$ hybridlog record") < out.index("recorded") < out.index("$ hybridlog ls")
    assert (tmp_path / "new" / "robot.bag").stat().st_size < 8_000_000
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["robot-logs", "robot.bag"]
    with pytest.raises(UsageError, match="exists already"):
        tour.run(tmp_path / "new")


@pytest.mark.parametrize("on_path", [False, True])
def test_the_last_line_can_be_typed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    on_path: bool,
) -> None:
    pretend(monkeypatch)
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}" if on_path else None)
    assert tour.run(tmp_path) == 0
    typed = "hybridlog" if on_path else f"{sys.executable} -m hybridlog"
    place = shlex.quote(str(tmp_path / tour.STORE))
    assert capfd.readouterr().out.endswith(f"look at them: {typed} view --store {place}\n")


def test_the_real_tour_answers_as_the_simulation_counted(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code = tour.run(tmp_path / "real")
    out, err = capfd.readouterr()
    assert code == 0, err
    counted = json.loads(Path(demo.__file__).with_name("robot.json").read_text("utf-8"))
    shown = [part.partition("\n$ ")[2].splitlines()[1:] for part in out.split("\n# ")[1:]]
    closings, near, errors = ([line for line in part if line] for part in shown[3:6])
    assert closings == [str(counted["gripper_closings"])]
    assert near == [str(counted["near_scans"])]
    assert len(errors) == counted["errors"]
    assert (tmp_path / "real" / tour.SLICE).stat().st_size > 0
    assert "(6000, " in out
