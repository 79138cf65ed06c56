"""The tour as data, and its behaviour when a command fails or answers wrongly."""

from __future__ import annotations

import errno
import shlex
import sys
from pathlib import Path

import pytest

from hybridlog.demo import tour
from hybridlog_storage.errors import DiskFullError, UsageError

# Stands in for each command: answers as told, so that the tour alone is under test.
FAKE = """\
import pathlib, sys
verb = sys.argv[1]
if verb == FAIL:
    sys.exit(6)
elif '--count' in sys.argv:
    print(GRIPPER if 'position == 0' in sys.argv else 297)
elif 'jsonl' in sys.argv:
    print('{}'); print('{}'); print('{}')
elif '-o' in sys.argv:
    pathlib.Path('scan.npz').write_bytes(b'x')
elif verb == 'record':
    pathlib.Path('robot-logs').mkdir()
    print('recorded')
"""


def fake(code: str, command: str) -> list[str]:
    words = shlex.split(command)
    skipped = 1 if words[0] == "hybridlog" else 3 if words[1] == "-m" else 2
    return [sys.executable, "-c", code, *words[skipped:]]


def pretend(monkeypatch: pytest.MonkeyPatch, *, fail: str = "", gripper: str = "3") -> None:
    code = FAKE.replace("FAIL", repr(fail)).replace("GRIPPER", repr(gripper))
    monkeypatch.setattr(tour.Step, "argv", property(lambda step: fake(code, step.command)))


def test_every_command_is_whole() -> None:
    programs = [shlex.split(step.command) for step in tour.steps()]
    for step, words in zip(tour.steps(), programs, strict=True):
        assert step.argv[:2] == [sys.executable, "-P"]
        assert step.argv[-len(words) + 1 :] == words[1:]
        assert words[0] in {"hybridlog", "python"}
        assert (step.argv[2:4] == ["-m", "hybridlog"]) == (words[0] == "hybridlog")
    compile(programs[-1][2], "<snippet>", "exec")
    verbs = [words[1] for words in programs if words[0] == "hybridlog"]
    assert verbs[:3] == ["record", "ls", "info"]
    assert sum(bool(step.fact) for step in tour.steps()) == 3


def test_a_good_tour_confirms_each_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pretend(monkeypatch)
    assert tour.run(tmp_path / "new") == 0
    out, err = capfd.readouterr()
    assert err == ""
    for step in tour.steps():
        assert f"$ {step.command}" in out
    assert out.count("(as the simulation counted") == 3
    assert "gripper closings: 3" in out
    # What a command prints stands below the command.
    assert out.index("$ hybridlog record") < out.index("recorded") < out.index("$ hybridlog ls")
    assert (tmp_path / "new" / "robot.bag").stat().st_size < 8_000_000
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["robot-logs", "robot.bag", "scan.npz"]
    with pytest.raises(UsageError, match="exists already"):
        tour.run(tmp_path / "new")


@pytest.mark.parametrize(
    ("started", "on_path", "typed"),
    [
        (".venv/bin/hybridlog", False, ".venv/bin/hybridlog"),
        ("/x/hybridlog/__main__.py", False, "python -m hybridlog"),
        (".venv/bin/hybridlog", True, "hybridlog"),
    ],
)
def test_the_last_line_can_be_typed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    started: str,
    on_path: bool,
    typed: str,
) -> None:
    pretend(monkeypatch)
    monkeypatch.setattr("sys.argv", [started])
    monkeypatch.setattr("shutil.which", lambda name: f"/usr/bin/{name}" if on_path else None)
    assert tour.run(tmp_path) == 0
    place = shlex.quote(str(tmp_path / tour.STORE))
    assert capfd.readouterr().out.endswith(f"look at them: {typed} view --store {place}\n")


def test_a_failing_command_ends_the_tour_with_its_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    pretend(monkeypatch, fail="ls")
    assert tour.run(tmp_path) == 6
    out, err = capfd.readouterr()
    assert "hybridlog ls --store robot-logs` failed with exit code 6" in err
    assert "hybridlog info" not in out
    assert (tmp_path / "robot.bag").exists()


@pytest.mark.parametrize("answer", ["4", "", "three", "-3", "3 messages"])
def test_a_wrong_answer_is_an_error(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    answer: str,
) -> None:
    pretend(monkeypatch, gripper=answer)
    assert tour.run(tmp_path) == 1
    _, err = capfd.readouterr()
    assert "wrong answer" in err
    assert "gripper closings: 3" in err


def test_an_unusable_directory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(UsageError, match="cannot write to"):
        tour.run(tmp_path / "file" / "below")


def test_a_full_disk_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("shutil.copyfile", full)
    with pytest.raises(DiskFullError, match="no space left in"):
        tour.run(tmp_path)


def test_the_real_tour(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code = tour.run(tmp_path / "real")
    out, err = capfd.readouterr()
    assert code == 0, err
    assert out.count("(as the simulation counted") == 3
    assert "gripper closings: 3" in out
    assert "(6000, " in out
