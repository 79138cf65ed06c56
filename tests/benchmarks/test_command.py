"""The command line of the benchmarks, on studies that take no time."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest

from benchmarks import __main__ as command
from benchmarks.__main__ import PARTS, STUDIES, main
from benchmarks.backends.base import Backend, BackendMissingError
from benchmarks.backends.registry import BACKENDS
from benchmarks.samples import Journal, Sample
from benchmarks.studies.runs import Context, step
from hybridlog.cli.signals import Stopped
from hybridlog_storage.errors import SourceError
from tests.imports import ROOT

VALUES = {
    "published": 10,
    "persisted": 10,
    "published_bytes": 10**6,
    "persisted_bytes": 10**6,
    "publish_s": 1.0,
    "wall_s": 1.0,
}


class Absent(Backend):
    """A backend that cannot run here."""

    name = "absent"
    about = "nowhere to be had"
    kind = "database"

    @classmethod
    def check(cls) -> None:
        raise BackendMissingError("absent is not installed: install it")

    def open(self, channels: Sequence[Any]) -> None:
        raise AssertionError

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        raise AssertionError

    def finish(self) -> None:
        raise AssertionError

    def counts(self) -> Mapping[str, int]:
        raise AssertionError

    def close(self) -> None:
        raise AssertionError


@dataclass(frozen=True)
class FewSettings:
    """Of a study that does nothing."""

    sizes: Sequence[int] = (5000,)
    rates: Sequence[float] = (64.0,)
    messages: int = 500
    repetitions: int = 2

    @classmethod
    def usual(cls, *, quick: bool) -> FewSettings:
        return cls(messages=5) if quick else cls()


class Study:
    """Stands in for a module of `benchmarks.studies`; `during` is called in every run."""

    STUDY = "throughput"
    Settings = FewSettings

    def __init__(self) -> None:
        self.ran: list[str] = []
        self.contexts: list[Context] = []
        self.status = "ok"
        self.during: Callable[[Sample], None] = lambda sample: None

    def _plan(self, context: Context, settings: FewSettings) -> list[Sample]:
        return [
            Sample(
                "throughput",
                {"size": size, "rate": rate, "messages": settings.messages, "topics": 20},
                name,
                repetition,
            )
            for size in settings.sizes
            for rate in settings.rates
            for name in context.backends
            for repetition in range(settings.repetitions)
        ]

    def run(self, context: Context, settings: FewSettings) -> None:
        self.contexts.append(context)
        for sample in self._plan(context, settings):
            if not context.to_do(sample):
                continue
            about = (sample.study, sample.case, sample.backend, sample.repetition)
            if sample.backend in context.missing:
                reason = context.missing[sample.backend]
                context.journal.add(Sample(*about, "missing", {}, reason))
                continue
            with step(sample.backend):
                self.during(sample)
            self.ran.append(sample.key)
            context.journal.add(Sample(*about, self.status, VALUES, ""))  # type: ignore[arg-type]


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> Study:
    found = Study()
    monkeypatch.setattr(command, "import_module", lambda name: found)
    monkeypatch.setattr("hybridlog.cli.signals.install", lambda: None)
    return found


def journal_of(out: Path) -> Journal:
    return Journal(out)


def code_of(*arguments: str) -> int:
    """The exit code; wrong usage leaves by itself."""
    try:
        return main(arguments)
    except SystemExit as leaving:
        return int(str(leaving.code))


def throughput(out: Path, *more: str) -> int:
    only = ["throughput", "--only", "throughput", "-b", "mcap,nothing"]
    return main([*only, "--out", str(out), *more])


def test_a_run_leaves_a_journal_and_a_report(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert throughput(tmp_path / "out") == 0
    found = journal_of(tmp_path / "out")
    assert len(found.samples) == 4
    (header,) = found.headers
    assert header["seed"] == 1
    assert header["settings"]["throughput"]["messages"] == 500
    assert header["command"][:4] == ["python", "-m", "benchmarks", "throughput"]
    assert {"cpu", "packages", "revision"} <= set(header)
    assert (tmp_path / "out" / "report.md").is_file()
    said = capsys.readouterr()
    assert "* " in said.out
    assert re.search(r"^\w+ \(0\.0 s\)$", said.err, re.MULTILINE)


def test_the_same_command_goes_on(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop_at_the_third(sample: Sample) -> None:
        if len(study.ran) == 2:
            raise Stopped(signal.SIGINT)

    study.during = stop_at_the_third
    assert throughput(tmp_path) == 130
    said = capsys.readouterr().err
    assert "interrupted" in said
    assert "2 runs so far" in said
    (again,) = re.findall(r"To go on: python -m benchmarks (.+)$", said, re.MULTILINE)
    (draw,) = re.findall(r"To draw what is there: python -m benchmarks (.+)$", said, re.MULTILINE)
    assert main(draw.split()) == 0
    assert (tmp_path / "report.md").is_file()
    capsys.readouterr()
    study.during = lambda sample: None
    assert main(again.split()) == 0
    assert "2 runs are not done again" in capsys.readouterr().err
    assert len(study.ran) == len(set(study.ran)) == 4
    # Nothing is left: nothing is run, and no further header is written.
    assert main(again.split()) == 0
    assert len(study.ran) == 4
    assert len(journal_of(tmp_path).headers) == 2


def test_restart_sets_the_journal_aside(study: Study, tmp_path: Path) -> None:
    for _ in range(3):
        assert throughput(tmp_path, "--restart") == 0
    assert len(study.ran) == 12
    assert {path.name for path in tmp_path.glob("samples*")} == {
        "samples.jsonl",
        "samples.1.jsonl",
        "samples.2.jsonl",
    }
    assert (tmp_path / "samples.1.jsonl").read_bytes()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--quick"], "quick False, now it is True"),
        (["--seed", "2"], "seed 1, now it is 2"),
        (["--messages", "7"], "throughput messages 500, now it is 7"),
    ],
)
def test_what_does_not_fit_into_one_report_is_refused(
    study: Study,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    more: list[str],
    words: str,
) -> None:
    assert throughput(tmp_path) == 0
    before = (tmp_path / "samples.jsonl").read_bytes()
    assert throughput(tmp_path, *more) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "--restart" in said
    assert (tmp_path / "samples.jsonl").read_bytes() == before


def test_more_of_the_same_fits(study: Study, tmp_path: Path) -> None:
    assert throughput(tmp_path) == 0
    assert throughput(tmp_path, "--sizes", "5kB,1MiB", "--rates", "64", "-n", "3") == 0
    assert len(study.ran) == 12
    cases = {(s.case["size"], s.repetition) for s in journal_of(tmp_path).samples.values()}
    assert cases == {(size, n) for size in (5000, 1 << 20) for n in range(3)}


def test_a_run_that_failed_is_told_by_the_exit_code(study: Study, tmp_path: Path) -> None:
    study.status = "failed"
    assert throughput(tmp_path) == 1
    assert main(["report", "--out", str(tmp_path)]) == 1
    study.status = "ok"
    assert throughput(tmp_path) == 0
    assert main(["report", "--out", str(tmp_path)]) == 0


def test_a_missing_backend_is_left_out_and_told(
    study: Study,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(BACKENDS, "absent", Absent)
    out = str(tmp_path)
    only = ["throughput", "--only", "throughput"]
    assert main([*only, "-b", "absent,mcap", "--out", out]) == 0
    said = capsys.readouterr()
    assert "absent is left out: absent is not installed: install it" in said.err
    assert "install it" in (tmp_path / "report.md").read_text("utf-8")
    assert len(study.ran) == 2
    assert main(["--list-backends"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("absent")]
    assert "absent is not installed: install it" in row


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-b", "nosuch"], "no backend 'nosuch'"),
        (["-b", ","], "no backend ''"),
        (["--sizes", "big"], "'big' is no size"),
        (["--sizes", "0"], "a message has 128 to"),
        (["--sizes", "5kB,127"], "a message has 128 to"),
        (["--sizes", ","], "is no size"),
        (["--sizes", "99999999TB"], "to 1073741824 bytes"),
        (["--rates", "x"], "invalid _rates value: 'x'"),
        (["--rates", "-4"], "not between"),
        (["--rates", "nan"], "not between"),
        (["--rates", "1e-9"], "not between"),
        (["--messages", "99999999999"], "1 to 10000000"),
        (["--repetitions", "0"], "1 to 10000000"),
        (["--seconds", "inf"], "not between"),
        (["--only", "queries"], "leaves nothing"),
    ],
)
def test_wrong_options_have_a_cure(
    study: Study,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: str,
) -> None:
    out = tmp_path / "out"
    assert code_of("throughput", "--out", str(out), *arguments) == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_a_full_disk_is_told_with_the_file(
    study: Study,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def full(_: int) -> NoReturn:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    assert throughput(tmp_path) == 7
    told = capsys.readouterr().err
    assert f"No space left on device: '{tmp_path / 'samples.jsonl'}'" in told
    assert "Traceback" not in told


def test_a_report_that_cannot_be_written_is_told_with_the_file(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "report.md").mkdir()
    assert throughput(tmp_path) == 1
    assert f"{tmp_path / 'report.md'}" in capsys.readouterr().err
    assert not list(tmp_path.glob("*.new"))
    assert Journal(tmp_path).samples


def test_directories_that_will_not_do(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "file"
    file.write_text("x")
    assert throughput(file) == 2
    assert "cannot be used: File exists" in capsys.readouterr().err
    (tmp_path / "samples.jsonl").write_text('{"kind": "sample", "nonsense": 1}\n')
    assert throughput(tmp_path) == 2
    assert "no journal of these studies (line 1: " in capsys.readouterr().err
    assert main(["report", "--out", str(tmp_path / "nowhere")]) == 2
    assert "holds no results" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()
    assert main(["persistence", "--out", str(tmp_path / "o"), "-l", str(tmp_path / "no.bag")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_a_line_that_is_being_written_is_left_to_its_writer(tmp_path: Path) -> None:
    path, sample = tmp_path / "samples.jsonl", Sample("throughput", {}, "mcap", 0)
    writing = journal_of(tmp_path)
    writing.begin({"seed": 1})
    assert not path.exists()
    writing.add(sample)
    with path.open("ab") as file:
        file.write(b'{"kind": "run", "seed"')
    half = path.read_bytes()
    going_on = journal_of(tmp_path)
    assert going_on.headers == [{"seed": 1}]
    assert path.read_bytes() == half
    # Only who writes next takes away what nobody has ended.
    for seed in (2, 3):
        going_on.begin({"seed": seed})
        going_on.add(sample)
    assert [header["seed"] for header in journal_of(tmp_path).headers] == [1, 2, 3]
    assert path.read_bytes().count(b"\n") == 6


def test_nothing_is_left_where_nothing_was_run(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*_: object) -> float:
        raise SourceError("a.bag cannot be read")

    monkeypatch.setattr(study, "run", unreadable)
    assert throughput(tmp_path / "new") == 3
    assert not (tmp_path / "new").exists()
    (tmp_path / "old").mkdir()
    assert throughput(tmp_path / "old") == 3
    assert (tmp_path / "old").is_dir()


def test_two_runs_do_not_write_into_one_directory(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    codes: list[int] = []
    study.during = lambda sample: codes.append(throughput(tmp_path)) if not codes else None
    assert throughput(tmp_path) == 0
    assert codes == [2]
    assert "Another run is writing" in capsys.readouterr().err


def test_parts_and_their_order(study: Study, tmp_path: Path) -> None:
    for number, (arguments, parts) in enumerate(
        (
            (["all"], len(PARTS)),
            ([], len(PARTS)),
            (["all", "--only", "reading", "--only", "ceilings"], 2),
            (["throughput"], 2),
            (["persistence", "--only", "persistence"], 1),
            (["queries"], 2),
        )
    ):
        study.contexts.clear()
        assert main([*arguments, "-b", "mcap", "--out", str(tmp_path / str(number))]) == 0
        assert len(study.contexts) == parts
    assert [name for names in list(STUDIES.values())[:3] for name in names] == list(PARTS)


def test_every_part_has_what_a_campaign_needs() -> None:
    from importlib import import_module

    for name, place in PARTS.items():
        module = import_module(place)
        for quick in (True, False):
            settings = module.Settings.usual(quick=quick)
            plain = json.loads(json.dumps(asdict(settings), default=str))
            assert plain.keys() == module.Settings.__dataclass_fields__.keys(), name
        assert isinstance(module.STUDY, str)
        assert callable(module.run)


def test_speed_is_for_whole_logs_only(study: Study, tmp_path: Path) -> None:
    arguments = ["all", "--only", "throughput", "--only", "persistence", "--speed", "4"]
    assert main([*arguments, "-b", "mcap", "--out", str(tmp_path)]) == 0
    assert [context.speed for context in study.contexts] == [1.0, 4.0]


def test_help(capfd: pytest.CaptureFixture[str]) -> None:
    assert code_of("--help") == 0
    listed = capfd.readouterr().out
    assert listed.startswith("usage: python -m benchmarks ")
    for name in (*STUDIES, "report", "live"):
        assert re.search(rf"^  {name} ", listed, re.MULTILINE)
    assert code_of("nosuch") == 2
    assert "nosuch" in capfd.readouterr().err


def test_help_loads_nothing_heavy() -> None:
    script = (
        "import sys\nfrom benchmarks.__main__ import main\n"
        "try:\n    main(['all', '--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'pandas', 'pyarrow', 'pymongo', 'matplotlib', 'rosbags', 'psycopg'}\n"
        "sys.exit(' '.join(sorted(heavy & set(sys.modules))) or 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_every_option_is_handed_over(study: Study, tmp_path: Path) -> None:
    given = (
        f"--quick -b mcap -o {tmp_path} --sizes 5kB,10kB --rates 4 --messages 3 "
        f"-n 4 --seed 9 --work {tmp_path / 'work'}"
    )
    assert main(["throughput", "--only", "throughput", *given.split()]) == 0
    (header,) = journal_of(tmp_path).headers
    assert (header["quick"], header["seed"]) == (True, 9)
    assert header["settings"]["throughput"] == {
        "sizes": [5000, 10_000],
        "rates": [4.0],
        "messages": 3,
        "repetitions": 4,
    }
    (context,) = study.contexts
    assert (context.quick, context.seed, context.work) == (True, 9, tmp_path / "work")


@pytest.mark.parametrize("name", PARTS)
def test_options_change_the_settings_of_their_part(name: str, tmp_path: Path) -> None:
    (tmp_path / "a.bag").touch()
    given = f"--topics 2 --seconds 0.5 -l {tmp_path / 'a.bag'} --no-made --log-seconds 7 -n 4"
    chosen = command._parser().parse_args(given.split())
    settings = asdict(command._part(name, chosen).settings)
    assert settings["repetitions"] == 4
    expected: dict[str, dict[str, Any]] = {
        "throughput": {"topics": 2},
        "ceilings": {"topics": 2, "seconds": 0.5},
        "persistence": {"logs": (tmp_path / "a.bag",), "made": (), "log_seconds": 7.0},
        "speed-up": {"logs": (tmp_path / "a.bag",), "made": (), "log_seconds": 7.0},
        "queries": {"sessions": 8},
        "reading": {"seconds": 30.0},
    }
    assert {key: settings[key] for key in expected[name]} == expected[name]


def test_ctrl_c_ends_a_real_run(tmp_path: Path) -> None:
    """Signals, processes and the journal of the harness itself."""
    log = tmp_path / "log"
    arguments = (
        "throughput --only throughput -b nothing --sizes 5kB --rates 4 --messages 200 --topics 2"
    )
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "benchmarks",
                *arguments.split(),
                "--out",
                str(tmp_path / "out"),
            ],
            cwd=ROOT,
            stdout=stream,
            stderr=subprocess.STDOUT,
            env={**os.environ, "HYBRIDLOG_TEST_MARK": str(tmp_path)},
        )
        try:
            deadline = time.monotonic() + 60
            while len(_marked(tmp_path)) < 3:  # the campaign, the logger, the publisher
                assert process.poll() is None, log.read_text()
                assert time.monotonic() < deadline
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        finally:
            process.kill()
            process.wait()
    said = log.read_text("utf-8")
    assert "interrupted" in said
    assert "To go on: python -m benchmarks throughput" in said
    assert "Traceback" not in said
    assert _marked(tmp_path) == []


def _marked(mark: Path) -> list[int]:
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            environment = (entry / "environ").read_bytes()
        except OSError:
            continue
        if b"HYBRIDLOG_TEST_MARK=" + str(mark).encode() in environment.split(b"\0"):
            found.append(int(entry.name))
    return found
