"""`hybridlog bench`: finds the benchmarks, hands everything over, or says what to do."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest
from hybridlog.cli.bench import find

from hybridlog_storage.errors import MissingDependencyError
from tests.imports import ROOT

from .running import COMMAND, environment, run


def in_directory(place: Path, *arguments: str, source: Path) -> subprocess.CompletedProcess[str]:
    """The command line of the packages below `source`, started in a directory."""
    roots = os.pathsep.join([str(source), str(source / "storage")])
    return subprocess.run(
        [COMMAND[0], "-P", *COMMAND[1:], "bench", *arguments],
        cwd=place,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        env=environment(PYTHONPATH=roots),
        check=False,
    )


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The packages without the source tree around them, as a wheel installs them."""
    place = tmp_path_factory.mktemp("wheel")
    for package in (ROOT / "hybridlog", ROOT / "storage" / "hybridlog_storage"):
        shutil.copytree(package, place / package.name, ignore=shutil.ignore_patterns("__pycache__"))
    return place


def test_arguments_output_and_exit_code_are_those_of_the_benchmarks(tmp_path: Path) -> None:
    listed = run("bench")
    assert listed.out.startswith("Usage: hybridlog bench ")
    assert "persistence" in listed.out
    assert run("bench", "report", "--help").out.startswith("Usage: hybridlog bench report ")
    assert run("bench", "--list-backends").out.splitlines()[0].startswith("name ")
    wrong = run("bench", "throughput", "-b", "nosuch", "--out", tmp_path / "out", code=2)
    assert "no backend 'nosuch'" in wrong.err
    run("bench", "report", "--out", tmp_path, code=2)


def test_the_messages_name_the_command_that_was_given(tmp_path: Path) -> None:
    assert "Try 'hybridlog bench all --help'" in run("bench", "all", "--nosuch", code=2).err


def test_a_directory_of_that_name_is_no_benchmark_of_ours(tmp_path: Path) -> None:
    stranger = tmp_path / "benchmarks"
    stranger.mkdir()
    (stranger / "__init__.py").write_text("raise SystemExit('a stranger')")
    (stranger / "__main__.py").write_text("raise SystemExit('a stranger')")
    (tmp_path / "typer.py").write_text("raise SystemExit('a stranger')")
    done = in_directory(tmp_path, source=ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Usage: hybridlog bench ")


def test_without_the_source_tree_it_says_what_to_do(wheel: Path, tmp_path: Path) -> None:
    done = in_directory(tmp_path, "all", "--quick", source=wheel)
    assert done.returncode == MissingDependencyError.exit_code == 9
    assert done.stdout == ""
    assert "Clone the repository" in done.stderr
    assert "pip install -e '.[bench]'" in done.stderr
    assert "Traceback" not in done.stderr
    # The help is there all the same.
    assert in_directory(tmp_path, "--help", source=wheel).stdout.startswith("Usage: ")


def test_in_a_source_tree_its_own_code_is_measured(wheel: Path) -> None:
    done = in_directory(ROOT, "--list-backends", source=wheel)
    assert (done.returncode, done.stderr) == (0, "")
    assert "hybridlog " in done.stdout


def test_the_first_tree_is_taken(tmp_path: Path) -> None:
    assert find(tmp_path, ROOT) == ROOT
    with pytest.raises(MissingDependencyError, match="Clone"):
        find(tmp_path)
