"""The hot paths: each runs, two revisions are told apart, and nothing is left behind."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable
from fnmatch import fnmatch
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.micro import command, inputs, revisions, running
from benchmarks.micro.compare import HotPath, compare, comparison_table, duration, run_table
from benchmarks.micro.revisions import RevisionError
from benchmarks.micro.running import Run, RunError, Settings, Timed
from tests.imports import ROOT

# So little that every path has its least number of rounds.
NO_TIME = 1e-6
SECONDS = st.floats(1e-7, 10)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Benchmarks, inputs, and the source, away from the checkout."""
    place = tmp_path_factory.mktemp("micro")
    running.copy_benchmarks(ROOT, place / "benchmarks")
    running.copy_source(ROOT, place / "now")
    (place / "inputs").mkdir()
    inputs.make(place / "inputs")
    return place


def run(prepared: Path, source: Path, only: str = "") -> Run:
    return running.run(
        prepared / "benchmarks",
        source,
        prepared / "inputs",
        prepared / "run",
        Settings(NO_TIME, only),
    )


def test_every_path_runs(prepared: Path) -> None:
    found = run(prepared, prepared / "now")
    assert (found.skipped, found.failed) == ({}, {})
    kinds = {name.partition("[")[0] for name in found.timed}
    assert kinds == {
        *("transcode", "few", "table", "append", "write", "pack", "insert"),
        *("plan", "plan_first", "fetch", "moment", "again", "first", "decode", "columns"),
    }
    assert {f"transcode[{kind}]" for kind in ("pose", "imu", "scan", "image", "tf")} <= set(
        found.timed
    )
    assert all(0 < timed.least <= timed.median for timed in found.timed.values())
    assert not (prepared / "run").exists()
    table = run_table(found)
    assert all(name in table for name in found.timed)


def test_what_a_source_lacks_is_skipped_and_never_taken_from_elsewhere(
    prepared: Path, tmp_path: Path
) -> None:
    old = tmp_path / "old"
    shutil.copytree(prepared / "now", old)
    compression = old / "storage" / "hybridlog_storage" / "compression.py"
    text = compression.read_text(encoding="utf-8")
    compression.write_text(text.replace("class Compressor:", "class Packer:"), encoding="utf-8")
    (old / "storage" / "hybridlog_storage" / "chunk_builder.py").unlink()
    codec = old / "hybridlog" / "schema" / "codec.py"
    codec.write_text(codec.read_text(encoding="utf-8") + "\nraise KeyError('broken')\n")
    found = run(prepared, old, "append or pack or decode")
    assert found.timed == {}
    assert found.skipped["append[one]"] == "there is no module hybridlog_storage.chunk_builder"
    assert found.skipped["pack[imu]"] == "hybridlog_storage.compression has no Compressor"
    assert found.failed["decode[imu]"] == "KeyError: 'broken'"

    # A whole package that is missing is on the path of every editable install.
    shutil.rmtree(old / "storage")
    found = run(prepared, old, "append")
    assert set(found.skipped.values()) == {"there is no module hybridlog_storage"}
    shutil.rmtree(old / "hybridlog")
    with pytest.raises(RunError, match="there is no hybridlog in it"):
        run(prepared, old, "append")


def test_modules_of_another_source_are_refused(prepared: Path, tmp_path: Path) -> None:
    """A source that reaches for another one."""
    mixed = tmp_path / "mixed"
    shutil.copytree(prepared / "now", mixed)
    builder = mixed / "storage" / "hybridlog_storage" / "chunk_builder.py"
    builder.unlink()
    builder.symlink_to(ROOT / "storage" / "hybridlog_storage" / "chunk_builder.py")
    with pytest.raises(RunError, match=r"not what was measured: hybridlog_storage\.chunk_builder"):
        run(prepared, mixed, "append and one")


def test_no_path_and_no_end(prepared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RunError, match="No path fits --only 'nosuch'"):
        run(prepared, prepared / "now", "nosuch")
    monkeypatch.setattr(running, "INPUTS", "SOMETHING_ELSE")
    monkeypatch.setattr(running, "OUTCOME", "SOMETHING_ELSE_2")
    with pytest.raises(RunError, match="failed:"):
        run(prepared, prepared / "now", "append and one")
    assert not (prepared / "run").exists()


# --- comparing --------------------------------------------------------------------------


def timed(**seconds: float) -> Run:
    return Run({name: Timed(value, value * 2, 5) for name, value in seconds.items()})


@given(st.lists(st.tuples(SECONDS, SECONDS), min_size=1, max_size=6))
def test_ratio_and_spread(pairs: list[tuple[float, float]]) -> None:
    before = [timed(x=old) for old, _ in pairs]
    now = [timed(x=new) for _, new in pairs]
    (path,) = compare(before, now)
    ratios = sorted(new / old for old, new in pairs)
    assert path.low == ratios[0]
    assert path.high == ratios[-1]
    assert path.ratio is not None
    assert path.before_s is not None
    assert path.now_s is not None
    assert path.ratio == path.now_s / path.before_s
    (back,) = compare(now, before)
    assert back.ratio == pytest.approx(1 / path.ratio)
    assert not (path.slower_than(1) and back.slower_than(1))
    assert path.slower_than(1.25) == (path.ratio > 1.25 and ratios[0] > 1)


def test_what_is_on_one_side_only_is_said() -> None:
    before = [timed(a=1, gone=1), timed(a=2, gone=1)]
    now = [timed(a=2, new=1), timed(a=2, new=1)]
    before[0].skipped["new"] = "there is no module x"
    before[1].skipped["new"] = "there is no module x"
    now[1].failed["a"] = "KeyError: 1"
    del now[1].timed["a"]
    found = {path.name: path for path in compare(before, now)}
    assert found["new"].note == "skipped before: there is no module x"
    assert found["gone"].note == "not there now"
    assert found["a"].note == "failed now: KeyError: 1"
    assert [name for name, path in found.items() if path.failed] == ["a"]
    assert {path.ratio for path in found.values()} == {None}
    assert "skipped before: there is no module x" in comparison_table(list(found.values()))


def test_table_is_aligned_and_marks_what_is_slower() -> None:
    paths = compare([timed(a=1e-3, bcd=2)] * 2, [timed(a=1.5e-3, bcd=1)] * 2)
    assert comparison_table(paths, 1.25).splitlines() == [
        "path  before     now  ratio          spread",
        "a       1 ms  1.5 ms  1.50x  1.50x to 1.50x  SLOWER",
        "bcd      2 s     1 s  0.50x  0.50x to 0.50x",
    ]
    assert "SLOWER" not in comparison_table(paths)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(None, "-"), (0.0, "0 ns"), (2.5e-8, "25 ns"), (1.234e-4, "123 µs"), (5e3, "5000 s")],
)
def test_durations(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text


# --- the command ------------------------------------------------------------------------


def slow(name: str = "a") -> command.Comparison:
    return command.Comparison("HEAD", "0" * 40, [HotPath(name, 1.0, 2.0, 2.0, 1.5, 2.5)])


@pytest.mark.parametrize(
    ("options", "code"),
    [((), 0), (("--fail-above", "1.25"), 1), (("--fail-above", "3"), 0)],
)
def test_fail_above(
    options: tuple[str, ...],
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(command, "measure_against", lambda *_: slow())
    assert command.main(["--against", *options]) == code
    shown = capsys.readouterr()
    assert "2.00x" in shown.out
    assert ("slower than 1.25 times: a" in shown.err) is (code == 1)
    assert command.main(["--against", "--json", *options]) == code
    header, line = map(json.loads, capsys.readouterr().out.splitlines())
    assert (header["kind"], header["against"]) == ("run", "HEAD")
    assert (line["name"], line["ratio"]) == ("a", 2.0)


def test_a_path_that_broke_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = command.Comparison("HEAD", "0" * 40, [HotPath("a", 1.0, note="why", failed=True)])
    monkeypatch.setattr(command, "measure_against", lambda *_: broken)
    assert command.main(["--against"]) == 1
    assert "does not run now: a" in capsys.readouterr().err
    run_of_one = Run({"a": Timed(1, 1, 1)}, {"b": "no b"}, {"c": "ValueError"})
    monkeypatch.setattr(command, "measure", lambda *_: run_of_one)
    assert command.main([]) == 1
    assert "failed: ValueError" in capsys.readouterr().out
    assert command.main(["--json"]) == 1
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["kind"] for line in lines] == ["run", "path", "skipped", "failed"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("--fail-above", "1.25"),
        ("--against", "HEAD", "--fail-above", "0"),
        ("--rounds", "0"),
        ("--seconds", "nan"),
    ],
)
def test_wrong_arguments(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        command.main(list(arguments))
    assert refused.value.code == 2
    assert "error:" in capsys.readouterr().err


def test_ordinary_tests_do_not_collect_the_benchmarks() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    options = settings["tool"]["pytest"]["ini_options"]
    assert options["testpaths"] == ["tests"]
    assert "python_files" not in options
    names = [path.name for path in (ROOT / "benchmarks" / "micro").glob("*.py")]
    assert [n for n in names if fnmatch(n, "test_*.py") or fnmatch(n, "*_test.py")] == []


# --- revisions --------------------------------------------------------------------------


def git(root: Path, *arguments: str) -> str:
    settings = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    return subprocess.run(
        ["git", "-C", str(root), *settings, *arguments],
        env={key: value for key, value in os.environ.items() if not key.startswith("GIT_")},
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()


def commit_all(root: Path, message: str) -> str:
    git(root, "add", "-A")
    git(root, "commit", "-q", "-m", message)
    return git(root, "rev-parse", "HEAD")


@pytest.fixture
def repository(tmp_path: Path) -> tuple[Path, list[str]]:
    """A checkout with two commits, and their names."""
    root = tmp_path / "repository"
    (root / "hybridlog").mkdir(parents=True)
    git(tmp_path, "init", "-q", str(root))
    commits = []
    for number in range(2):
        (root / "hybridlog" / "__init__.py").write_text(f"NUMBER = {number}\n")
        commits.append(commit_all(root, str(number)))
    return root, commits


def worktrees(root: Path) -> int:
    return len(git(root, "worktree", "list").splitlines())


def test_default_revision(repository: tuple[Path, list[str]]) -> None:
    root, commits = repository
    (root / "README.md").write_text("not the source")
    assert revisions.last_commit(root) == "HEAD~1"
    assert revisions.commit_of(root, "HEAD~1") == commits[0]
    new = root / "hybridlog" / "new.py"
    new.touch()
    assert revisions.last_commit(root) == "HEAD"
    new.unlink()
    (root / "hybridlog" / "__init__.py").write_text("NUMBER = 2\n")
    assert revisions.last_commit(root) == "HEAD"
    assert revisions.commit_of(root, "HEAD") == commits[1]


@pytest.mark.parametrize("revision", ["nosuch", "HEAD~5", "--help", "-n1", "a b", "HEAD:hybridlog"])
def test_revisions_that_are_not_there(
    revision: str,
    repository: tuple[Path, list[str]],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(command, "ROOT", repository[0])
    assert command.main([f"--against={revision}"]) == 2
    assert f"There is no commit {revision}" in capsys.readouterr().err


def test_no_checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GIT_CEILING_DIRECTORIES", str(tmp_path.parent))
    with pytest.raises(RevisionError, match="git checkout only"):
        revisions.last_commit(tmp_path)
    with pytest.raises(RevisionError, match="git checkout only"):
        revisions.commit_of(tmp_path, "HEAD")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(RevisionError, match="git cannot be run"):
        revisions.last_commit(tmp_path)


def test_worktree_has_the_commit_and_goes_away(
    repository: tuple[Path, list[str]], tmp_path: Path
) -> None:
    root, commits = repository
    hook = root / ".git" / "hooks" / "post-checkout"
    hook.parent.mkdir(exist_ok=True)
    hook.write_text(f"#!/bin/sh\ntouch {tmp_path}/hooked\n")
    hook.chmod(0o755)
    place = tmp_path / "place"
    for error in (None, KeyboardInterrupt):
        try:
            with revisions.worktree(root, commits[0], place) as made:
                assert (made / "hybridlog" / "__init__.py").read_text() == "NUMBER = 0\n"
                assert worktrees(root) == 2
                (made / "left.pyc").touch()
                if error is not None:
                    raise error
        except KeyboardInterrupt:
            assert error is not None
        assert not place.exists()
        assert worktrees(root) == 1
    place.mkdir()
    (place / "file").touch()
    with pytest.raises(RevisionError, match="already exists"):
        with revisions.worktree(root, commits[0], place):
            pass
    assert (place / "file").exists()
    assert worktrees(root) == 1
    assert not (tmp_path / "hooked").exists()


# --- both together ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkout of the project, whose last commit is slower to put documents together."""
    root = tmp_path_factory.mktemp("checkout")
    running.copy_source(ROOT, root)
    shutil.copytree(
        ROOT / "benchmarks", root / "benchmarks", ignore=shutil.ignore_patterns("__pycache__")
    )
    git(root, "init", "-q")
    (root / ".gitignore").write_text("__pycache__/\n")
    commit_all(root, "fast")
    file = root / "storage" / "hybridlog_storage" / "index_documents.py"
    lines = file.read_text(encoding="utf-8").splitlines()
    at = next(n for n, line in enumerate(lines) if "tail = self._tails.get(error)" in line)
    lines[at:at] = ["        import time", "        time.sleep(0.005)"]
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    commit_all(root, "slow")
    return root


def test_a_slower_commit_is_found(
    checkout: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "ROOT", checkout)
    options = ["--seconds", "0.01", "--only", "(transcode and pose) or (decode and imu)"]
    assert command.main(["--against", "--json", "--fail-above", "2", *options]) == 1
    shown = capsys.readouterr()
    header, *lines = map(json.loads, shown.out.splitlines())
    assert (header["against"], header["commit"]) == ("HEAD~1", git(checkout, "rev-parse", "HEAD~1"))
    ratios = {line["name"]: line["ratio"] for line in lines}
    assert ratios.keys() == {"transcode[pose]", "decode[imu]"}
    assert ratios["transcode[pose]"] > 2
    assert "slower than 2 times: transcode[pose]" in shown.err
    assert worktrees(checkout) == 1


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_nothing(
    number: signal.Signals, checkout: Path, tmp_path: Path
) -> None:
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    code = (
        "import sys; from pathlib import Path; from benchmarks.micro import command; "
        f"command.ROOT = Path({str(checkout)!r}); "
        "sys.exit(command.main(['--against', 'HEAD~1', '--only', 'fetch']))"
    )
    with (tmp_path / "out").open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            cwd=ROOT,
            env={**os.environ, "TMPDIR": str(scratch)},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            wait_for(lambda: process.poll() is not None or mongods(scratch) > 0)
            assert process.poll() is None, (tmp_path / "out").read_text()
            assert worktrees(checkout) == 2
            process.send_signal(number)
            assert process.wait(60) == 128 + number
        finally:
            process.kill()
            process.wait()
    assert "interrupted" in (tmp_path / "out").read_text()
    assert list(scratch.iterdir()) == []
    assert worktrees(checkout) == 1
    assert mentioned(str(scratch)) == []


def mentioned(text: str) -> list[str]:
    """Command lines of processes that have a text in them."""
    lines = []
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has just ended
            lines.append((process / "cmdline").read_bytes().decode(errors="replace"))
    return [line for line in lines if text in line]


def mongods(directory: Path) -> int:
    """How many have their data below a directory."""
    return sum("--dbpath" in line for line in mentioned(str(directory)))


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)
