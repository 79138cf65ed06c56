"""The command of the benchmarks: its pieces, what stops it, and a tiny run."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from benchmarks import __main__ as command
from benchmarks.__main__ import PARTS, Piece, main
from benchmarks.backends.base import BackendMissingError
from benchmarks.backends.nothing import Nothing
from benchmarks.backends.registry import BACKENDS
from benchmarks.samples import Journal, Sample
from benchmarks.side import SideError
from benchmarks.studies import tasks
from benchmarks.studies.runs import Context
from hybridlog.cli.signals import Stopped
from tests.imports import ROOT
from tests.waiting import wait_for

pytestmark = pytest.mark.mongo("embedded")

MINUTES = {"full": 1.0, "quick": 1.0, "tiny": 1.0}


class Absent(Nothing):
    @classmethod
    def check(cls) -> None:
        raise BackendMissingError("absent is not installed: install it")


class Pieces:
    """Stand in for those of a run; `during` is called in each."""

    def __init__(self, *names: str) -> None:
        self.names = names
        self.ran: list[str] = []
        self.during: Callable[[str], None] = lambda name: None
        self.status = "ok"
        self.extra: tuple[str, ...] = ()

    def __call__(self) -> list[Piece]:
        return [self._piece(name) for name in self.names]

    def _piece(self, name: str) -> Piece:
        def run(context: Context) -> None:
            wanted = Sample("live", {"case": name}, "hybridlog", 0)
            if context.to_do(wanted):
                self.during(name)
                self.ran.append(name)
                about = (wanted.study, wanted.case, wanted.backend, 0)
                context.journal.add(Sample(*about, self.status, {"rows": []}, "why"))  # type: ignore[arg-type]

        return Piece("live", name, MINUTES, run, is_extra=name in self.extra)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Pieces:
    found = Pieces("one", "two", "three")
    monkeypatch.setattr(command, "pieces", found)
    monkeypatch.setattr("hybridlog.cli.signals.install", lambda: None)
    return found


def test_a_run_leaves_a_journal_and_a_page(
    made: Pieces, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["--out", str(tmp_path)]) == 0
    found = Journal(tmp_path)
    assert made.ran == ["one", "two", "three"]
    assert len(found.samples) == 3
    (header,) = found.headers
    assert (header["scale"], header["seed"]) == ("full", 1)
    assert {"cpu", "packages", "revision", "started"} <= set(header)
    assert (tmp_path / "benchmarks.md").read_text("utf-8").startswith("<!-- made by")
    assert "<!-- measured -->" in (tmp_path / "readme.md").read_text("utf-8")
    assert "wrote" in capsys.readouterr().err


def test_a_piece_that_breaks_off_leaves_the_others_and_is_done_again(
    made: Pieces, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def break_off(name: str) -> None:
        if name == "two":
            raise SideError("it crashed")

    made.during = break_off
    assert main(["--out", str(tmp_path)]) == 1
    assert made.ran == ["one", "three"]
    assert re.search(
        r"^\[0:0\d, about \d min left\] two FAILED: it", capsys.readouterr().err, re.MULTILINE
    )
    made.during = lambda name: None
    assert main(["--out", str(tmp_path)]) == 0
    assert made.ran == ["one", "three", "two"]


def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on(
    made: Pieces, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(name: str) -> None:
        if name == "two":
            raise Stopped(signal.SIGINT)

    made.during = stop
    assert main(["--out", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert "interrupted" in said
    (again,) = re.findall(r"To go on: python -m benchmarks (.+)$", said, re.MULTILINE)
    made.during = lambda name: None
    assert main(again.split()) == 0
    assert made.ran == ["one", "two", "three"]
    assert "1 samples are there" in capsys.readouterr().err
    # Nothing is left: nothing is run, and no further header is written.
    assert main(again.split()) == 0
    assert len(made.ran) == 3
    assert len(Journal(tmp_path).headers) == 2


@pytest.mark.parametrize(
    ("more", "words"), [(["--quick"], "scale full, now it is quick"), (["--seed", "2"], "seed 1")]
)
def test_what_does_not_fit_on_one_page_is_refused(
    made: Pieces, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], words: str
) -> None:
    assert main(["--out", str(tmp_path)]) == 0
    assert main(["--out", str(tmp_path), *more]) == 2
    assert words in capsys.readouterr().err
    assert main(["--out", str(tmp_path), *more, "--restart"]) == 0
    assert len(list(tmp_path.glob("samples*.jsonl"))) == 2
    assert len(made.ran) == 6


def test_what_will_not_do_has_a_cure(
    made: Pieces,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "samples.jsonl").write_text('{"kind": "sample", "nonsense": 1}\n')
    for arguments, words in (
        (["--out", str(file)], "cannot be used: File exists"),
        (["--out", str(tmp_path / "odd")], "no journal of these benchmarks (line 1: "),
        (["--out", str(tmp_path / "new"), "-b", "nosuch"], "no backend 'nosuch'"),
        (["--out", str(tmp_path / "new"), "--render"], "holds no results"),
    ):
        assert main(arguments) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
    monkeypatch.setitem(BACKENDS, "absent", Absent)
    assert main(["-b", "absent", "--out", str(tmp_path / "out")]) == 0
    assert "absent is left out: absent is not installed: install it" in capsys.readouterr().err


def test_the_page_goes_into_the_checkout(
    made: Pieces, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "checkout"
    (root / "docs").mkdir(parents=True)
    (root / "README.md").write_text("# it\n<!-- measured -->\nold\n<!-- /measured -->\nend\n")
    monkeypatch.setattr(command, "ROOT", root)
    assert main(["--docs", "--out", str(tmp_path / "out")]) == 0
    text = (root / "README.md").read_text("utf-8")
    assert text.startswith("# it\n<!-- measured -->\n| | hybridlog |")
    assert text.endswith("<!-- /measured -->\nend\n")
    page = (root / "docs" / "benchmarks.md").read_text("utf-8")
    assert page == (tmp_path / "out" / "benchmarks.md").read_text("utf-8")
    assert Journal(root / "docs" / "benchmarks-results").samples.keys() == (
        Journal(tmp_path / "out").samples.keys()
    )


def run(out: Path, *arguments: str) -> subprocess.Popen[bytes]:
    """Start a tiny run; what it says goes into a file."""
    out.mkdir()
    with (out / "said").open("wb") as stream:
        return subprocess.Popen(
            [sys.executable, "-m", "benchmarks", "--tiny", "--out", str(out), *arguments],
            cwd=ROOT,
            stdout=stream,
            stderr=subprocess.STDOUT,
        )


def test_a_tiny_run(tmp_path: Path) -> None:
    """Real processes: streams, the log of a robot, questions, reading."""
    parts = ("record", "logs", "queries", "reading")
    only = [word for part in parts for word in ("--only", part)]
    with run(tmp_path / "out", *only, "-b", "sqlite,sqlite_indexed") as process:
        assert process.wait(120) == 0, (tmp_path / "out" / "said").read_text()
    samples = Journal(tmp_path / "out").samples.values()
    assert {sample.study for sample in samples} == set(parts)
    assert {sample.status for sample in samples} == {"ok"}
    assert {s.case["size"] for s in samples if s.study == "record"} == {5000, 40_000, 640_000}
    text = (tmp_path / "out" / "benchmarks.md").read_text("utf-8")
    for heading in ("Recording", "Questions", "Reading"):
        assert f"\n## {heading}\n" in text


@pytest.mark.exhaustive
def test_a_tiny_run_of_the_tasks_and_of_every_backend(tmp_path: Path) -> None:
    only = [word for part in PARTS if part != "live" for word in ("--only", part)]
    with run(tmp_path / "out", *only) as process:
        assert process.wait(600) == 0, (tmp_path / "out" / "said").read_text()
    samples = Journal(tmp_path / "out").samples.values()
    assert {sample.backend for sample in samples} == set(BACKENDS)


def test_the_tasks_on_our_stores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """SQL, many recordings, the page, buckets."""
    monkeypatch.setitem(tasks.SETTINGS, "tiny", tasks.Settings(5, 2, 1))
    context = Context(tmp_path / "work", {}, Journal(tmp_path / "out"), "tiny")
    for group in ("sql", "many", "page", "remote"):
        tasks.run(context, group)
    found = list(context.journal.samples.values())
    assert [(s.status, s.reason) for s in found] == [("ok", "")] * 4
    *timed, bucket = found
    assert all(row["ms"] > 0 for s in timed for row in s.values["rows"].values())
    requests = {row["step"]: row["requests"] for row in bucket.values["rows"]}
    assert 0 < requests["open"] <= 3
    assert requests["a second of scan"] > requests["the same again"] == 0


def test_ctrl_c_ends_a_real_run(tmp_path: Path) -> None:
    """Signals, processes and the journal of the harness itself."""
    with run(tmp_path / "out", "--only", "record", "-b", "nothing,bagfile") as process:
        here = psutil.Process(process.pid)
        # The logger, and the publisher.
        wait_for(lambda: len(here.children(recursive=True)) == 2 or process.poll() is not None)
        started = here.children(recursive=True)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    said = (tmp_path / "out" / "said").read_text("utf-8")
    assert "To go on: python -m benchmarks --tiny" in said
    assert "Traceback" not in said
    assert not any(child.is_running() for child in started)
