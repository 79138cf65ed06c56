"""The command line of the benchmarks, on studies that take no time."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import pytest

from benchmarks import campaign, command
from benchmarks.__main__ import main
from benchmarks.backends.base import Backend, BackendMissingError
from benchmarks.backends.registry import BACKENDS
from benchmarks.campaign import PARTS
from benchmarks.progress import Steps, short
from benchmarks.samples import Journal, Sample
from benchmarks.studies.runs import Context
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

    def expected_seconds(self, context: Context, settings: FewSettings) -> float:
        return 1.0 * sum(context.to_do(sample) for sample in self._plan(context, settings))

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
            with context.steps.step(sample.backend, 1.0):
                self.during(sample)
            self.ran.append(sample.key)
            context.journal.add(Sample(*about, self.status, VALUES, ""))  # type: ignore[arg-type]


@pytest.fixture
def study(monkeypatch: pytest.MonkeyPatch) -> Study:
    found = Study()
    monkeypatch.setattr(campaign, "import_module", lambda name: found)
    monkeypatch.setattr("hybridlog.cli.signals.install", lambda: None)
    return found


def journal_of(out: Path) -> Journal:
    return Journal(out)


def throughput(out: Path, *more: str) -> int:
    return main(["throughput", "--no-ceilings", "-b", "mcap,nothing", "--out", str(out), *more])


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
    assert set(header["backends"]) == {"mcap", "nothing"}
    assert {"cpu", "packages", "revision"} <= set(header)
    assert (tmp_path / "out" / "report.html").is_file()
    said = capsys.readouterr()
    assert "* " in said.out
    assert re.search(r"^ *25% \w+ \(0\.0 s\), \d+ s left$", said.err, re.MULTILINE)


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
    assert "2 runs are there and not done again" in capsys.readouterr().err
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
        (["--quick"], "quick off, now it is on"),
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
    assert main(["throughput", "--no-ceilings", "-b", "absent,mcap", "--out", out]) == 0
    said = capsys.readouterr()
    assert "absent is left out: absent is not installed: install it" in said.err
    assert "install it" in said.out
    assert "install it" in (tmp_path / "report.md").read_text("utf-8")
    assert len(study.ran) == 2
    assert main(["--list-backends"]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("absent")]
    assert "absent is not installed: install it" in row


def test_json_is_all_that_is_printed(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert throughput(tmp_path, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert found["samples"] == {"ok": 4, "missing": 0, "failed": 0}
    assert [Path(name).name for name in found["report"]] == ["report.html", "report.md"]
    assert throughput(tmp_path, "--list-backends", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in listed] == list(BACKENDS)


def test_no_report_when_none_is_wanted(study: Study, tmp_path: Path) -> None:
    assert throughput(tmp_path, "--no-report") == 0
    assert {path.name for path in tmp_path.iterdir()} == {"samples.jsonl"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["-b", "nosuch"], "no backend 'nosuch'"),
        (["-b", "mongo_jsno"], "did you mean mongo_json"),
        (["-b", "mongo"], "mongo_json, mongo_json_indexed, mongo_json_batched"),
        (["-b", ","], "names none"),
        (["--sizes", "big"], "'big' is no size"),
        (["--sizes", "0"], "not above 0"),
        (["--sizes", "5kB,127"], "has 128 bytes at least"),
        (["--sizes", ","], "--sizes is empty"),
        (["--rates", "x"], "'x' is no rate"),
        (["--rates", "-4"], "no rate that a topic can have"),
        (["--rates", "nan"], "no rate that a topic can have"),
        (["--rates", "1e-9"], "no rate that a topic can have"),
        (["--sizes", "99999999TB"], "has 1024 MiB at most"),
        (["--messages", "99999999999"], "less than or equal to 10000000"),
        (["--seconds", "inf"], "less than or equal to 86400"),
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
    assert main(["throughput", "--out", str(out), *arguments]) == 2
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
    assert "is a file" in capsys.readouterr().err
    (tmp_path / "samples.jsonl").write_text('{"kind": "sample", "nonsense": 1}\n')
    assert throughput(tmp_path) == 2
    assert "no journal of these studies (line 1: " in capsys.readouterr().err
    assert main(["report", "--out", str(file)]) == 2
    assert "is a file" in capsys.readouterr().err
    assert main(["report", "--out", str(tmp_path / "nowhere")]) == 2
    assert "holds no results" in capsys.readouterr().err
    assert not (tmp_path / "nowhere").exists()
    assert main(["persistence", "--out", str(tmp_path / "o"), "-l", str(tmp_path / "no.bag")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_a_line_that_is_being_written_is_left_to_its_writer(tmp_path: Path) -> None:
    writing, path = journal_of(tmp_path), tmp_path / "samples.jsonl"
    writing.begin({"seed": 1})
    with path.open("ab") as file:
        file.write(b'{"kind": "run", "seed"')
    half = path.read_bytes()
    going_on = journal_of(tmp_path)
    assert going_on.headers == [{"seed": 1}]
    assert path.read_bytes() == half
    # Only who writes next takes away what nobody has ended.
    going_on.begin({"seed": 2})
    going_on.begin({"seed": 3})
    assert [header["seed"] for header in journal_of(tmp_path).headers] == [1, 2, 3]
    assert path.read_bytes().count(b"\n") == 3


def test_nothing_is_left_where_nothing_was_run(
    study: Study, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*_: object) -> float:
        raise SourceError("a.bag cannot be read")

    monkeypatch.setattr(study, "expected_seconds", unreadable)
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


def test_the_beginning_of_a_name_will_do(study: Study, tmp_path: Path) -> None:
    arguments = ["throughput", "--no-ceilings", "--out", str(tmp_path)]
    assert main([*arguments, "-b", "bagf", "-b", "mongo_json, sqlite_u"]) == 0
    names = {sample.backend for sample in journal_of(tmp_path).samples.values()}
    assert names == {"bagfile", "mongo_json", "sqlite_udf"}


def test_parts_and_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[campaign.Choices] = []

    def take(choices: campaign.Choices, words: Sequence[str]) -> int:
        asked.append(choices)
        return 0

    monkeypatch.setattr(campaign, "run", take)
    for arguments in (
        ["all"],
        ["all", "--no-ceilings", "--no-reading"],
        ["all", "--only", "reading", "--only", "ceilings"],
        ["throughput"],
        ["persistence", "--no-speed-up"],
        ["queries"],
    ):
        assert main(arguments) == 0
    assert [list(choices.parts) for choices in asked] == [
        list(PARTS),
        ["throughput", "persistence", "speed-up", "queries"],
        ["ceilings", "reading"],
        ["throughput", "ceilings"],
        ["persistence"],
        ["queries", "reading"],
    ]
    assert asked[0].out == Path("benchmark-results")


def test_every_part_has_what_a_campaign_needs() -> None:
    from importlib import import_module

    for name, part in PARTS.items():
        module = import_module(part.module)
        for quick in (True, False):
            settings = module.Settings.usual(quick=quick)
            plain = campaign._plain(settings)
            assert json.loads(json.dumps(plain)) == plain, name
            assert plain.keys() == module.Settings.__dataclass_fields__.keys(), name
        assert set(part.options) <= module.Settings.__dataclass_fields__.keys(), name
        assert isinstance(module.STUDY, str)
        assert callable(module.run)
        assert callable(module.expected_seconds)


def test_only_and_no_together_leave_nothing(
    study: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["all", "--only", "ceilings", "--no-ceilings", "--out", str(tmp_path / "o")]) == 2
    assert "Nothing is left" in capsys.readouterr().err


def test_speed_is_for_whole_logs_only(study: Study, tmp_path: Path) -> None:
    arguments = ["all", "--only", "throughput", "--only", "persistence", "--speed", "4"]
    assert main([*arguments, "-b", "mcap", "--out", str(tmp_path)]) == 0
    assert [context.speed for context in study.contexts] == [1.0, 4.0]


def test_help_and_speed(capfd: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    listed = capfd.readouterr().out
    assert listed.startswith("Usage: python -m benchmarks ")
    for name in ("throughput", "persistence", "queries", "all", "report", "speed"):
        assert re.search(rf"^  {name} ", listed, re.MULTILINE)
    assert "..." not in listed.split("Commands:")[1]
    assert main(["all", "--help"], "hybridlog bench") == 0
    assert capfd.readouterr().out.startswith("Usage: hybridlog bench all ")
    with pytest.raises(SystemExit) as leaving:
        main(["speed", "--help"])
    assert leaving.value.code == 0
    assert "speed targets" in capfd.readouterr().out
    assert main(["nosuch"]) == 2
    assert "nosuch" in capfd.readouterr().err


def test_help_loads_nothing_heavy() -> None:
    script = (
        "import sys\nfrom benchmarks.__main__ import main\nmain(['all', '--help'])\n"
        "heavy = {'numpy', 'pandas', 'pyarrow', 'pymongo', 'matplotlib', 'rosbags', 'psycopg'}\n"
        "sys.exit(' '.join(sorted(heavy & set(sys.modules))) or 0)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_every_option_is_handed_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[campaign.Choices] = []

    def take(choices: campaign.Choices, words: Sequence[str]) -> int:
        asked.append(choices)
        return 0

    monkeypatch.setattr(campaign, "run", take)
    log = tmp_path / "a.bag"
    given = (
        f"--quick -b mcap -o {tmp_path} --sizes 5kB --rates 4 --messages 3 --topics 2 "
        f"--seconds 0.5 -l {log} --no-made --log-seconds 7 --speed 2 -n 4 --seed 9 "
        f"--work {tmp_path} --restart --no-report --json"
    )
    assert main(["all", *given.split()]) == 0
    choices = asked[0]
    assert choices == campaign.Choices(
        list(PARTS),
        tmp_path,
        quick=True,
        backends=["mcap"],
        sizes="5kB",
        rates="4",
        messages=3,
        topics=2,
        seconds=0.5,
        logs=[log],
        made=False,
        log_seconds=7.0,
        speed=2.0,
        repetitions=4,
        seed=9,
        work=tmp_path,
        restart=True,
        report=False,
        as_json=True,
    )


def test_ctrl_c_ends_a_real_run(tmp_path: Path) -> None:
    """Signals, processes and the journal of the harness itself."""
    log = tmp_path / "log"
    arguments = (
        "throughput --no-ceilings -b nothing --sizes 5kB --rates 4 --messages 200 --topics 2"
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


# --- progress -------------------------------------------------------------------------


def test_the_time_left_follows_the_pace() -> None:
    now = [0.0]
    steps = Steps(100.0, None, None, clock=lambda: now[0])
    assert steps.left_s == 100.0
    for _ in range(50):
        with steps.step("", 1.0):
            now[0] += 2.0
    # Half is done, in twice the time: what was expected still counts a little.
    assert 50.0 < steps.left_s < 100.0
    with steps.step("", 10.0):
        before = steps.left_s
        now[0] += 3.0
        assert steps.left_s == pytest.approx(before - 3.0)
        now[0] += 1000.0
        assert steps.left_s > 50.0
    assert steps.left_s >= 0.0


def test_a_part_with_fewer_steps_than_expected_is_over_all_the_same() -> None:
    now = [0.0]
    steps = Steps(100.0, None, None, clock=lambda: now[0])
    with steps.step("", 1.0):
        now[0] += 1.0
    steps.reach(60.0)
    # The pace is that of the steps that were done, not of those that were left out.
    assert steps.left_s == pytest.approx(40.0)


def test_a_step_that_fails_does_not_count(capsys: pytest.CaptureFixture[str]) -> None:
    steps = Steps(10.0, None, None)
    with pytest.raises(ZeroDivisionError), steps.step("x", 10.0):
        raise ZeroDivisionError
    assert capsys.readouterr().err == ""
    assert steps.left_s == 10.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0.2, "0 s"), (99.4, "99 s"), (100, "2 min"), (5900, "98 min"), (6000, "1 h 40 min")],
)
def test_lengths_of_time(seconds: float, text: str) -> None:
    assert short(seconds) == text


def test_the_bar_on_a_terminal_shows_the_time_left() -> None:
    import pty

    script = (
        "import time\nfrom benchmarks.progress import steps\n"
        "with steps(4.0) as progress:\n"
        "    for name in ('[red]one', 'two'):\n"
        "        with progress.step(name, 2.0):\n"
        "            time.sleep(0.3)\n"
    )
    ours, theirs = pty.openpty()
    heard = bytearray()

    def listen() -> None:
        try:
            while data := os.read(ours, 1 << 16):
                heard.extend(data)
        except OSError:
            return

    process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stderr=theirs)
    os.close(theirs)
    listener = threading.Thread(target=listen)
    listener.start()
    assert process.wait(60) == 0
    listener.join(10)
    os.close(ours)
    said = heard.decode("utf-8", "replace")
    assert "[red]one" in said
    assert re.search(r"\d s left", said)
    assert "100 %" in said


def test_the_parts_of_all_are_those_of_a_campaign() -> None:
    assert [part.value for part in command.Part] == list(PARTS)
