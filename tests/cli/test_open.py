"""`hybridlog open`, with programs that stand in for the viewers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.independent import Seen, read_bag, read_mcap

from .running import run


@pytest.fixture
def bin_(tmp_path: Path) -> Path:
    """A directory for programs, the only one on the PATH."""
    directory = tmp_path / "bin"
    directory.mkdir()
    return directory


def install(directory: Path, name: str, code: int = 0) -> None:
    """A program that writes its arguments to `called`, and ends with a code."""
    program = directory / name
    called = directory / "called"
    program.write_text(f'#!/bin/sh\nprintf "%s\\n" "{name}" "$@" > "{called}"\nexit {code}\n')
    program.chmod(0o755)


def called(directory: Path) -> list[str]:
    return (directory / "called").read_text().splitlines()


def scans(logs: Path) -> list[Seen]:
    seen = read_bag(logs / "robot.bag")
    start = min(m.log_time for m in seen) + 10**9
    return [m for m in seen if m.topic == "/base/scan" and start <= m.log_time < start + 10**9]


def test_a_slice_is_handed_to_rerun(logs: Path, store: Path, tmp_path: Path, bin_: Path) -> None:
    install(bin_, "rerun")
    cache = tmp_path / "cache"
    words = ("open", "rerun", "/base/scan", "-r", "robot", "--between", "+1s", "+2s")
    env = {"PATH": str(bin_), "XDG_CACHE_HOME": str(cache)}
    done = run(*words, store=store, **env)
    program, *options, path = called(bin_)
    assert (program, options) == ("rerun", ["--bind", "127.0.0.1"])
    assert f"{path}: " in done.err
    assert Path(path).parent == cache / "hybridlog" / "slices"
    assert Path(path).name.startswith("robot-")
    assert (cache / "hybridlog" / "slices").stat().st_mode & 0o777 == 0o700
    assert read_mcap(Path(path)) == scans(logs)
    # The same slice again is the same file, not written again.
    written = Path(path).stat().st_mtime_ns
    done = run(*words, "-q", store=store, **env)
    assert done.err == ""
    assert called(bin_)[-1] == path
    assert Path(path).stat().st_mtime_ns == written
    assert [*(cache / "hybridlog" / "slices").iterdir()] == [Path(path)]


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
