"""The documentation, kept true: what it shows is run, what exists is in it."""

from __future__ import annotations

import contextlib
import hashlib
import inspect
import io
import json
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import termios
import threading
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import pytest
import zstandard

import hybridlog as hl
from hybridlog.cli.app import app
from hybridlog.cli.main import EXIT_CODES
from hybridlog.query import times, topics, where
from hybridlog_storage import errors
from hybridlog_storage.errors import HybridlogError

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md")])
SHOWN = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
# A terminal of this many columns.
COLUMNS = 160
START_NS = 1_748_937_600_000_000_000


# --- reading Markdown -----------------------------------------------------------------


class Fence(NamedTuple):
    """A fenced block."""

    language: str
    lines: list[str]
    line: int


def fences(path: Path) -> list[Fence]:
    """The fenced blocks of a page, in order."""
    found: list[Fence] = []
    open_fence: Fence | None = None
    for number, text in enumerate(path.read_text("utf-8").splitlines(), 1):
        if text.startswith("```"):
            if open_fence is None:
                open_fence = Fence(text[3:].strip(), [], number)
            else:
                found.append(open_fence)
                open_fence = None
        elif open_fence is not None:
            open_fence.lines.append(text)
    assert open_fence is None, f"{path}: a fence is not closed"
    return found


def prose(path: Path) -> str:
    """A page without its fenced blocks."""
    return re.sub(r"^```.*?^```$", "", path.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)


def sections(path: Path, level: int) -> dict[str, str]:
    """The text under each heading of one level, by the heading without its markup."""
    pieces = re.split(rf"^{'#' * level} (.+)$", path.read_text("utf-8"), flags=re.MULTILINE)
    return {
        name.replace("`", "").strip(): re.split(rf"^#{{1,{level}}} ", text, flags=re.MULTILINE)[0]
        for name, text in zip(pieces[1::2], pieces[2::2], strict=True)
    }


@dataclass
class Step:
    """A command or a piece of Python that a page shows, and what it says comes of it."""

    kind: str
    text: str
    line: int
    shown: list[str] = field(default_factory=list)
    code: int = 0


def steps(path: Path) -> list[Step]:
    """What a page runs, in order."""
    found: list[Step] = []
    for fence in fences(path):
        if fence.language == "python":
            found.append(Step("python", "\n".join(fence.lines) + "\n", fence.line + 1))
        elif fence.language == "text" and found and found[-1].kind == "python":
            found[-1].shown = fence.lines
        elif fence.language == "console":
            is_open = False
            for number, text in enumerate(fence.lines, fence.line + 1):
                if is_open:
                    found[-1].text += "\n" + text
                elif text.startswith("$ "):
                    found.append(Step("shell", text[2:], number))
                elif found:
                    found[-1].shown.append(text)
                is_open = (is_open or text.startswith("$ ")) and text.endswith("\\")
    for step in found:
        if step.kind == "shell" and (match := re.search(r"\s# exit (\d+)$", step.text)):
            step.code = int(match[1])
    return found


_NUMBER = re.compile(
    r"(?<![\w.])-?(?:\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?\s?(?:[kMGT]?B|d|h|ms|us|ns|m|s)?\b)+"
)
_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d[\d.]*(?:Z|\+00:00)?")
_URI = re.compile(r"mongodb://\S+")


def skeleton(line: str) -> str:
    """A line of output without what differs from run to run: numbers, times, widths."""
    for pattern, name in ((_URI, "URI"), (_TIME, "TIME"), (_NUMBER, "N")):
        line = pattern.sub(name, line)
    return " ".join(line.split())


def missing_lines(shown: list[str], output: str) -> list[str]:
    """Shown lines that the output does not have. A count is compared to the digit."""
    exact = {line.strip() for line in output.splitlines()}
    bones = {skeleton(line) for line in output.splitlines()}
    missing = []
    for line in shown:
        if not line.strip() or line.strip() in {"...", "…"}:
            continue
        if line.strip().isdigit():
            if line.strip() not in exact:
                missing.append(line)
        elif skeleton(line) not in bones:
            missing.append(line)
    return missing


# --- running it -----------------------------------------------------------------------


class Shell:
    """Runs commands one by one; what they export and where they go is kept.

    Standard output is a terminal, because that is where people read it.
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        self._state = directory / ".state"
        python = str(Path(sys.executable).parent)
        hidden = ("HYBRIDLOG_", "COLUMNS", "LINES")
        self._env = {
            **{k: v for k, v in os.environ.items() if not k.startswith(hidden)},
            "PATH": f"{python}{os.pathsep}{os.environ['PATH']}",
            "TERM": "dumb",
            "NO_COLOR": "1",
        }

    def run(self, command: str) -> tuple[int, str]:
        """Exit code, and standard output followed by standard error."""
        script = (
            "set -o pipefail\n"
            f"if [ -e {self._state} ]; then . {self._state}; cd \"$PWD\"; fi\n"
            f"{command}\n"
            f"code=$?; {{ export -p; printf 'PWD=%q\\n' \"$PWD\"; }} > {self._state}; exit $code"
        )
        ours, theirs = pty.openpty()
        termios.tcsetwinsize(theirs, (50, COLUMNS))
        heard = bytearray()
        process = subprocess.Popen(
            ["bash", "-c", script],
            cwd=self.directory,
            env=self._env,
            stdin=subprocess.DEVNULL,
            stdout=theirs,
            stderr=subprocess.PIPE,
        )
        os.close(theirs)
        listener = threading.Thread(target=_listen, args=(ours, heard))
        listener.start()
        assert process.stderr is not None
        complaints = process.stderr.read()
        process.stderr.close()
        code = process.wait(120)
        listener.join(10)
        os.close(ours)
        return code, (bytes(heard) + complaints).decode("utf-8", "replace").replace("\r\n", "\n")

    @property
    def place(self) -> Path:
        """Where the shell stands."""
        if not self._state.exists():
            return self.directory
        return Path(self._state.read_text().rstrip("\n").rsplit("PWD=", 1)[1].replace("\\", ""))


def _listen(descriptor: int, heard: bytearray) -> None:
    # The end of a terminal is an error on Linux.
    with contextlib.suppress(OSError):
        while data := os.read(descriptor, 1 << 16):
            heard += data


class Page:
    """Runs a page's steps."""

    def __init__(self, directory: Path) -> None:
        self.shell = Shell(directory)
        self._names: dict[str, Any] = {"__name__": "docs"}

    def run(self, step: Step, source: str) -> tuple[int, str]:
        """Exit code and output of a step; Python raises what it raises."""
        if step.kind == "shell":
            return self.shell.run(step.text)
        printed = io.StringIO()
        code = compile("\n" * (step.line - 1) + step.text, source, "exec")
        with contextlib.chdir(self.shell.place), contextlib.redirect_stdout(printed):
            exec(code, self._names)
        return 0, printed.getvalue()


@pytest.fixture(scope="session")
def demo_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bag of the demo, but for the size of its pictures: the same answers, faster."""
    from hybridlog.demo.config import RobotConfig
    from hybridlog.demo.write import write_bag

    path = tmp_path_factory.mktemp("demo") / "robot.bag"
    small = RobotConfig(image_size=(32, 24), cloud_columns=64)
    truth = write_bag(path, config=small).truth
    path.with_name("truth.json").write_text(json.dumps(dict(truth)))
    return path


@pytest.fixture
def page(tmp_path: Path, demo_bag: Path, monkeypatch: pytest.MonkeyPatch) -> Page:
    """A directory as `hybridlog demo` leaves it, less its store."""
    monkeypatch.delenv("HYBRIDLOG_MONGOD_LINGER_S", raising=False)
    directory = tmp_path / "hybridlog-demo"
    directory.mkdir()
    for name in ("robot.bag", "truth.json"):
        os.link(demo_bag.with_name(name), directory / name)
    return Page(tmp_path)


@pytest.mark.parametrize("path", [p for p in SHOWN if steps(p)], ids=lambda p: p.name)
def test_what_is_shown_runs(path: Path, page: Page) -> None:
    for step in steps(path):
        code, output = page.run(step, str(path))
        place = f"{path.name}:{step.line}: {step.text}"
        assert code == step.code, f"{place}\nexit {code}\n{output}"
        missing = missing_lines(step.shown, output)
        assert not missing, f"{place}\nis not said: {missing}\n{output}"


def test_the_skeleton_keeps_words_and_drops_numbers() -> None:
    line = "20 messages, 116.5 kB of payload, 5 chunks, 0.858 s"
    assert skeleton(line) == "N messages, N of payload, N chunks, N"
    assert skeleton("start   2025-06-03T08:00:00.001075172Z  59.9s") == "start TIME N"
    assert missing_lines(["3", "N  rows", "…"], "4\nN rows") == ["3"]
    assert missing_lines(["gone"], "here") == ["gone"]


def test_a_failing_command_is_noticed(tmp_path: Path) -> None:
    shell = Shell(tmp_path)
    assert shell.run("mkdir a; cd a; export X='1 2'") == (0, "")
    assert shell.run('echo "$X"; basename "$PWD"; false') == (1, "1 2\na\n")
    assert shell.place == tmp_path / "a"


# --- links ----------------------------------------------------------------------------


def anchors(path: Path) -> set[str]:
    """The fragments that headings of a page give, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} (.+)$", prose(path), flags=re.MULTILINE):
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\- ]", "", text).replace(" ", "-")
        number = 0
        while (name := slug if not number else f"{slug}-{number}") in found:
            number += 1
        found.add(name)
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_resolve(path: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", prose(path))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, fragment = target.partition("#")
        other = (path.parent / name).resolve() if name else path
        assert other.exists(), f"{path.name}: {target} leads nowhere"
        if fragment:
            assert fragment in anchors(other), f"{path.name}: {target}: no such heading"


def test_the_pages_are_reached() -> None:
    index = (DOCS / "index.md").read_text("utf-8")
    for path in sorted(DOCS.glob("*.md")):
        assert path.name == "index.md" or f"({path.name})" in index
    notes = (DOCS / "design" / "README.md").read_text("utf-8")
    for path in (DOCS / "design").glob("[0-9]*.md"):
        assert f"({path.name})" in notes


def test_the_map_of_the_source_tree() -> None:
    tree = sections(DOCS / "index.md", 2)["The source tree"]
    named = set(re.findall(r"^\| `([\w./]+)`", tree, flags=re.MULTILINE))
    for name in named:
        assert (ROOT / name).exists(), name
    packages = [p.parent for p in (ROOT / "hybridlog").rglob("__init__.py")]
    for package in [*packages, ROOT / "storage" / "hybridlog_storage"]:
        assert f"{package.relative_to(ROOT)}/" in named, package


# --- the README and the changelog -----------------------------------------------------


def test_the_two_commands_stand_where_the_machine_reads_them() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    (block,) = re.findall(r"<!-- commands -->\n(.*?)<!-- end -->", text, flags=re.DOTALL)
    lines = [line for line in block.splitlines() if line.strip()]
    assert len(lines) == 2
    assert all(line.startswith("    python3 -m venv .venv && ") for line in lines)
    assert lines[0].endswith(".venv/bin/hybridlog demo")
    assert lines[1].endswith(".venv/bin/pytest -q")


def test_the_changelog_has_this_version() -> None:
    assert re.search(
        rf"^## \[{re.escape(hl.__version__)}\]", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.M
    )


# --- the command line -----------------------------------------------------------------


def commands() -> dict[str, Any]:
    import typer.main

    return dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]


@pytest.mark.parametrize("name", sorted(commands()))
def test_every_option_is_described(name: str) -> None:
    text = sections(DOCS / "cli.md", 2)[name]
    described = set(re.findall(r"(?<![\w-])--?[a-zA-Z][\w-]*", "".join(re.findall("`[^`]+`", text))))
    real: set[str] = set()
    for parameter in commands()[name].params:
        spellings = [*parameter.opts, *parameter.secondary_opts]
        if parameter.param_type_name == "argument":
            shown = (parameter.metavar or parameter.name).strip("[]").upper()
            assert shown in text, f"{name}: the argument {shown}"
            continue
        real.update(spellings)
        if parameter.envvar:
            assert str(parameter.envvar) in text, f"{name}: {parameter.envvar}"
        row = next((r for r in text.splitlines() if r.startswith(f"| `{spellings[0]}")), "")
        assert row, f"{name}: {spellings[0]} has no row"
        for choice in getattr(parameter.type, "choices", ()):
            word = str(getattr(choice, "value", choice))
            assert f"`{word}`" in row, f"{name} {spellings[0]}: {word}"
    assert real <= described, f"{name} lacks {sorted(real - described)}"
    own = set(re.findall(r"^\| `(--?[\w-]+)", text, flags=re.MULTILINE))
    assert own <= real, f"{name} has no {sorted(own - real)}"


def test_every_command_has_its_section() -> None:
    assert [n for n in sections(DOCS / "cli.md", 2) if n in commands()] == list(commands())


def test_every_exit_code_and_variable_is_described() -> None:
    text = sections(DOCS / "cli.md", 2)["Exit codes"]
    assert {int(n) for n in re.findall(r"^\| (\d+) \|", text, flags=re.MULTILINE)} == set(
        EXIT_CODES
    )
    variables = sections(DOCS / "cli.md", 2)["Environment"]
    used: set[str] = set()
    for path in [*(ROOT / "hybridlog").rglob("*.py"), *(ROOT / "storage").rglob("*.py")]:
        used.update(re.findall(r"HYBRIDLOG_[A-Z_]*[A-Z]", path.read_text("utf-8")))
    assert set(re.findall(r"`(HYBRIDLOG_\w+)`", variables)) == used


# --- the Python interface -------------------------------------------------------------


def public(thing: type) -> dict[str, Any]:
    """Public attributes of a class, fields of dataclasses included."""
    found = {n: v for n, v in vars(thing).items() if not n.startswith("_")}
    found.update(
        {n: None for n in getattr(thing, "__dataclass_fields__", {}) if not n.startswith("_")}
    )
    return found


def documented_classes() -> list[type]:
    from hybridlog.maintenance import Finding, Tended, Verification
    from hybridlog.query.plan import Counters
    from hybridlog.recorder import RecordReport
    from hybridlog_storage.catalog import ChannelEntry, ChannelStats, RecordingEntry
    from hybridlog_storage.segment_writer import SegmentSettings

    results = [Counters, RecordReport, RecordingEntry, ChannelEntry, ChannelStats]
    checks = [Verification, Finding, Tended]
    return [hl.Store, hl.Query, hl.Message, hl.RecordOptions, SegmentSettings, *results, *checks]


@pytest.mark.parametrize("thing", documented_classes(), ids=lambda c: c.__name__)
def test_every_public_name_is_described(thing: type) -> None:
    text = sections(DOCS / "api.md", 2)[thing.__name__]
    rows = dict(re.findall(r"^\| `(\w+)(\([^`]*\))?`", text, flags=re.MULTILINE))
    members = public(thing)
    if thing is hl.Store:
        members |= dict.fromkeys(("directory", "database", "without_database", "tended"))
    assert set(rows) == set(members), set(rows) ^ set(members)
    for name, value in members.items():
        if inspect.isfunction(value):
            assert rows[name] == spelled(value), f"{thing.__name__}.{name}{spelled(value)}"


def spelled(function: Callable[..., object]) -> str:
    """A signature as the tables write it: names and defaults, without `self` and types."""
    signature = inspect.signature(function)
    plain = [
        p.replace(annotation=inspect.Parameter.empty)
        for n, p in signature.parameters.items()
        if n != "self"
    ]
    return str(signature.replace(parameters=plain, return_annotation=inspect.Signature.empty))


def test_every_exported_name_is_described() -> None:
    text = (DOCS / "api.md").read_text("utf-8")
    for name in hl.__all__:
        assert f"`{name}" in text or f"hl.{name}" in text, name
    assert f"`open{spelled(hl.open)}`" in text


def test_every_error_is_described() -> None:
    text = sections(DOCS / "api.md", 2)["Errors"]
    rows = dict(re.findall(r"^\| `(\w+)` \| (\d+) \|", text, flags=re.MULTILINE))
    real = {
        n: str(c.exit_code)
        for n, c in vars(errors).items()
        if inspect.isclass(c) and issubclass(c, HybridlogError)
    }
    assert rows == real


# --- the language ---------------------------------------------------------------------


def examples(language: str) -> list[str]:
    """The lines of the fences of one language in `language.md`, without comments."""
    lines = [text for f in fences(DOCS / "language.md") if f.language == language for text in f.lines]
    return [re.split(r"\s{2,}# ", line)[0].strip() for line in lines if line.strip()]


def test_the_predicates_are_accepted() -> None:
    shown = examples("where")
    assert len(shown) > 20
    for text in shown:
        where.compile_filter(text)


def test_the_wrong_predicates_are_refused() -> None:
    shown = examples("where-refused")
    assert shown
    for text in shown:
        with pytest.raises(HybridlogError):
            where.compile_filter(text, field_types={"x": "float64", "name": "string"})


def test_the_times_are_understood() -> None:
    shown = examples("times")
    assert len(shown) > 10
    for line in shown:
        text, _, means = line.partition("->")
        start, end = START_NS, START_NS + 60_000_000_000
        got = times.parse_time(text.strip(), start=start, end=end)
        assert times.format_time(got) == means.strip() or means.strip() == "…", line


def test_the_patterns_find_what_is_said() -> None:
    from hybridlog.demo.config import RobotConfig
    from hybridlog.demo.robot import Robot
    from hybridlog.demo.streams import Speech
    from hybridlog.demo.wire import Types

    spoken = Speech(Robot(10.0, 1), RobotConfig(), Types(1)).streams()
    names = [stream.topic for stream in spoken]
    shown = examples("topics")
    assert len(shown) > 5
    for line in shown:
        pattern, _, found = line.partition("->")
        if found.strip() == "refused":
            with pytest.raises(HybridlogError):
                topics.resolve([pattern.strip()], names)
        else:
            assert topics.resolve([pattern.strip()], names) == found.split(), line
