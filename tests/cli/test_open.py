"""`hybridlog open`, with programs that stand in for the viewers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.independent import read_mcap

from .running import run


@pytest.fixture
def bin_(tmp_path: Path) -> Path:
    """A directory for programs, the only one on the PATH."""
    directory = tmp_path / "bin"
    directory.mkdir()
    return directory


def install(directory: Path, name: str, code: int = 0) -> None:
    """A program that writes its arguments to `called`, and ends with a code; 9 without the file."""
    program = directory / name
    called = directory / "called"
    program.write_text(
        f'#!/bin/sh\nprintf "%s\\n" "{name}" "$@" > "{called}"\n'
        f'for last; do :; done; [ -s "$last" ] || exit 9\nexit {code}\n'
    )
    program.chmod(0o755)


def called(directory: Path) -> list[str]:
    return (directory / "called").read_text().splitlines()


def test_a_slice_is_handed_to_rerun(store: Path, bin_: Path) -> None:
    install(bin_, "rerun")
    words = ("open", "rerun", "/base/scan", "-r", "robot", "--between", "+1s", "+2s")
    done = run(*words, store=store, PATH=str(bin_))
    program, *options, path = called(bin_)
    assert (program, options) == ("rerun", ["--bind", "127.0.0.1"])
    assert f"{path}: " in done.err
    assert Path(path).name == "robot.mcap"
    assert not Path(path).parent.exists(), "it goes when the program has ended"


def test_foxglove_is_also_lichtblick(store: Path, tmp_path: Path, bin_: Path) -> None:
    install(bin_, "lichtblick")
    path = tmp_path / "own.mcap"
    words = ("open", "foxglove", "-r", "robot", "-t", "/map", "-o", path)
    run(*words, store=store, PATH=str(bin_))
    assert called(bin_) == ["lichtblick", str(path)]
    assert [m.topic for m in read_mcap(path)] == ["/map"]
    refused = run(*words, store=store, code=2, PATH=str(bin_))
    assert "--force" in refused.err
    install(bin_, "foxglove-studio", code=3)
    failed = run(*words, "--force", store=store, code=1, PATH=str(bin_))
    assert called(bin_) == ["foxglove-studio", str(path)]
    assert failed.err.endswith("foxglove-studio ended with exit code 3.\n")


@pytest.mark.parametrize(
    ("viewer", "cure"),
    [
        ("rerun", "There is no program rerun on the PATH: pip install rerun-sdk."),
        ("foxglove", "There is no program foxglove-studio or lichtblick on the PATH: get it"),
        ("lichtblick", "There is no program lichtblick on the PATH: get it from https://"),
    ],
)
def test_a_missing_one_is_named_with_its_cure(viewer: str, cure: str, bin_: Path) -> None:
    # It is missing whatever the store has, so that is not opened.
    done = run("open", viewer, "--store", bin_ / "none", code=9, PATH=str(bin_))
    assert cure in done.err
