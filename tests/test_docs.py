"""The documentation, kept true: what it shows is run, what exists is in it."""

from __future__ import annotations

import contextlib
import inspect
import json
import os
import pty
import re
import shutil
import subprocess
import sys
import termios
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import pytest
from msgspec.structs import asdict

import hybridlog as hl
from benchmarks import page
from benchmarks.samples import Journal
from hybridlog.cli.app import EXIT_CODES, app
from hybridlog.query import times, topics
from hybridlog.query.predicate.parser import parse
from hybridlog.query.predicate.tree import check
from hybridlog_storage import errors
from hybridlog_storage.errors import HybridlogError
from hybridlog_storage.messages import Channel, Schema
from tests import places
from tests.format_reader import FormatReader, collection_name, index_key
from tests.independent import write_mcap

if TYPE_CHECKING:
    from hybridlog_storage.catalog import RecordingEntry

pytestmark = pytest.mark.mongo("embedded")

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md")])
SHOWN = [ROOT / "README.md", *sorted([*DOCS.glob("*.md"), *DOCS.glob("*.ipynb")])]
TUTORIAL = DOCS / "tutorial.md"
"""It goes on where the README ends."""
# A terminal of this many columns.
COLUMNS = 150
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


def steps_of_notebook(path: Path) -> list[Step]:
    """The cells with code of a notebook, and what they print."""
    cells = json.loads(path.read_text("utf-8"))["cells"]
    return [
        Step(
            "python",
            "".join(cell["source"]) + "\n",
            number,
            [line.rstrip("\n") for output in cell["outputs"] for line in output["text"]],
        )
        for number, cell in enumerate(cells, 1)
        if cell["cell_type"] == "code"
    ]


def steps(path: Path) -> list[Step]:
    """What a page runs, in order."""
    if path.suffix == ".ipynb":
        return steps_of_notebook(path)
    found: list[Step] = []
    for fence in fences(path):
        if fence.language == "python":
            found.append(Step("python", "\n".join(fence.lines) + "\n", fence.line + 1))
        elif fence.language == "text" and found and found[-1].kind == "python":
            found[-1].shown = fence.lines
        elif fence.language.startswith("yaml "):  # a file, by its name
            text = "\n".join([f"cat > {fence.language[5:]} <<'END'", *fence.lines, "END"])
            found.append(Step("shell", text, fence.line + 1))
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
    r"(?<![\w.])-?(?:(?:\d+(?:\.\d+)?(?:d|h|ms|us|ns|m|s))+\b"
    r"|\d[\d,]*(?:\.\d+)?(?:e[+-]?\d+)?(?:\s[kMGT]?B\b)?)"
)
_COUNT = r"(?<![\w.])-?\d{1,5}(?![\w.]*[\w])(?!\s[kMGT]?B\b)"
_TIME = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d:\d\d[\d.]*(?:Z|\+00:00)?")
_URI = re.compile(r"mongodb://\S+")


_MEASURED = re.compile(f"(?!{_COUNT}){_NUMBER.pattern}")


def skeleton(line: str, *, counts: bool = False) -> str:
    """A line of output without what differs from run to run: numbers, times, widths.

    Args:
        line: The line.
        counts: Whole numbers without a unit are kept.
    """
    number = _MEASURED if counts else _NUMBER
    for pattern, name in ((_URI, "URI"), (_TIME, "TIME"), (number, "N")):
        line = pattern.sub(name, line)
    return " ".join(line.split())


def missing_lines(shown: list[str], output: str, *, counts: bool = False) -> list[str]:
    """Shown lines that the output does not have. A count is compared to the digit.

    Args:
        shown: The lines.
        output: What was printed.
        counts: Whole numbers in a line are counts.
    """
    exact = {line.strip() for line in output.splitlines()}
    bones = {skeleton(line, counts=counts) for line in output.splitlines()}
    missing = []
    for line in shown:
        if not line.strip() or line.strip() in {"...", "…"}:
            continue
        if line.strip().isdigit():
            if line.strip() not in exact:
                missing.append(line)
        elif skeleton(line, counts=counts) not in bones:
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
            "PATH": os.pathsep.join([python, os.environ["PATH"]]),
            "LC_ALL": "C.UTF-8",
            "TERM": "xterm",
            "NO_COLOR": "1",
        }

    def setenv(self, name: str, value: str) -> None:
        """Set a variable, before the first command."""
        self._env[name] = value

    def run(self, command: str) -> tuple[int, str]:
        """Exit code, and standard output followed by standard error."""
        script = (
            "set -o pipefail\n"
            f'if [ -e {self._state} ]; then . {self._state}; cd "$PWD"; fi\n'
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
        code = process.wait()
        listener.join()
        os.close(ours)
        said = (bytes(heard) + complaints).decode("utf-8", "replace")
        return code, re.sub(r"\x1b\[[0-9;]*m", "", said.replace("\r\n", "\n"))

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


WORKER = """
import contextlib, io, json, os, sys, traceback
names = {"__name__": "docs"}
for line in sys.stdin:
    job = json.loads(line)
    os.chdir(job["place"])
    said, code = io.StringIO(), 0
    with contextlib.redirect_stdout(said):
        try:
            exec(compile(job["text"], job["source"], "exec"), names)
        except BaseException:
            traceback.print_exc(file=said)
            code = 1
    print(json.dumps([code, said.getvalue()]), flush=True)
"""


class Python:
    """A Python in which the pieces of a page run one after the other."""

    def __init__(self) -> None:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("HYBRIDLOG_")}
        self._process = subprocess.Popen(
            [sys.executable, "-W", "error", "-c", WORKER],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=environment,
            text=True,
        )

    def run(self, step: Step, source: str, place: Path) -> tuple[int, str]:
        """1 for an exception, and what was printed."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        text = "\n" * (step.line - 1) + step.text
        job = {"text": text, "source": source, "place": str(place)}
        self._process.stdin.write(json.dumps(job) + "\n")
        self._process.stdin.flush()
        code, said = json.loads(self._process.stdout.readline())
        return code, said

    def close(self) -> None:
        """End it."""
        self._process.communicate()


@contextlib.contextmanager
def elsewhere(directory: Path, page: Path) -> Iterator[str]:
    """The URI of a MongoDB that is not the store's own, for a page that needs one."""
    from hybridlog_storage.mongo.mongod import EmbeddedMongod

    if "$MONGO_URI" not in page.read_text("utf-8"):
        yield ""
        return
    with EmbeddedMongod(directory / "server", linger_s=0.2) as server:
        yield server.start().replace("/?", "/robots?")


def take(page: Path, directory: Path, bag: Path) -> Iterator[tuple[Step, int, str]]:
    """Run a page's steps where `hybridlog demo` was run, less its store; to be exhausted."""
    place = directory / "hybridlog-demo"
    place.mkdir()
    shutil.copyfile(bag, place / "robot.bag")
    shell, python = Shell(directory), Python()
    try:
        with elsewhere(directory, page) as uri:
            shell.setenv("MONGO_URI", uri)
            before = steps(ROOT / "README.md") if page == TUTORIAL else []
            for step in [*before, *steps(page)]:
                if step.kind == "shell":
                    yield step, *shell.run(step.text)
                else:
                    yield step, *python.run(step, str(page), shell.place)
    finally:
        python.close()


def trouble(page: Path, directory: Path, bag: Path) -> str:
    """Run a page; what is not as it says, empty when all is."""
    for step, code, output in take(page, directory, bag):
        place = f"{page.name}:{step.line}: {step.text}"
        if code != step.code:
            return f"{place}\nexit {code}, not {step.code}\n{output}"
        if missing := missing_lines(step.shown, output, counts=step.kind == "python"):
            return f"{place}\nis not said: {missing}\n{output}"
    return ""


@pytest.fixture(scope="session")
def demo_bag() -> Path:
    """The bag of the demo."""
    return ROOT / "hybridlog" / "demo" / "robot.bag"


RUN = [page for page in SHOWN if steps(page)]


@pytest.fixture(scope="session")
def troubles(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, demo_bag: Path
) -> dict[Path, Future[str]]:
    """The pages that are asked for, running side by side: most of the time is waiting."""
    asked = [page for page in RUN if any(page.name in item.name for item in request.session.items)]
    pool = ThreadPoolExecutor(3)
    # The longest first.
    asked.sort(key=lambda page: -len(steps(page)))
    places = {page: tmp_path_factory.mktemp(page.stem) for page in asked}
    found = {page: pool.submit(trouble, page, places[page], demo_bag) for page in asked}
    pool.shutdown(wait=False)
    return found


@pytest.mark.timeout(1800)  # for all pages, also on a machine that has other things to do
@pytest.mark.parametrize("page", RUN, ids=lambda page: page.name)
def test_what_is_shown_runs(page: Path, troubles: dict[Path, Future[str]]) -> None:
    found = troubles[page].result()
    assert not found, found


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
    packages = [
        p.parent for root in ("hybridlog", "storage") for p in (ROOT / root).rglob("__init__.py")
    ]
    for package in packages:
        assert f"{package.relative_to(ROOT)}/" in named, package


# --- the README and the changelog -----------------------------------------------------


def test_the_figures_shown_are_those_of_the_results() -> None:
    """The page and the README's table are what `python -m benchmarks` makes of the samples."""
    journal = Journal(DOCS / "benchmarks-results")
    table = page.readme(journal)
    assert table in (ROOT / "README.md").read_text("utf-8")
    assert table.count("\n|") == 12
    text = (DOCS / "benchmarks.md").read_text("utf-8")
    assert text == page.page(journal)
    assert len(text.splitlines()) < 150


# --- the command line -----------------------------------------------------------------


def commands() -> dict[str, Any]:
    context = click.Context(app)
    return {name: app.get_command(context, name) for name in app.list_commands(context)}


def params_of(command: click.Command) -> list[click.Parameter]:
    """The parameters of a command, or of all commands of a group."""
    if not isinstance(command, click.Group):
        return command.params
    return [param for each in command.commands.values() for param in each.params]


def option_rows(text: str) -> dict[str, str]:
    """The rows of tables of options, by the first spelling of the option."""
    return {
        re.findall(r"`(-[^` ]+)", row)[0]: row
        for row in text.splitlines()
        if row.startswith(("| `-", "| `TOPIC`, `-"))
        and "[which recordings]" not in row
        and "[common" not in row
    }


@pytest.mark.parametrize("name", sorted(commands()))
def test_every_option_is_described(name: str) -> None:
    """In the section of its command, or once for all that have it."""
    pages = sections(DOCS / "cli.md", 2)
    own = option_rows(pages[name])
    shared = option_rows(pages["Common options"]) | option_rows(pages["Choosing recordings"])
    common = re.findall(r"^\| (.*) \| \[common options\]", pages[name], flags=re.MULTILINE)
    named = set(re.findall(r"`([^`]+)`", "".join(common)))
    params = params_of(commands()[name])
    for parameter in params:
        spellings = [*parameter.opts, *parameter.secondary_opts]
        if parameter.param_type_name == "argument":
            shown = (parameter.metavar or parameter.name).strip("[].").upper()
            assert shown in pages[name], f"{name}: the argument {shown}"
            continue
        row = own.get(spellings[0]) or shared.get(spellings[0], "")
        assert row, f"{name}: {spellings[0]} has no row"
        assert set(spellings) <= set(re.findall(r"--?[a-zA-Z][\w-]*", row)), (name, spellings)
        if parameter.envvar:
            assert str(parameter.envvar) in row, f"{name}: {parameter.envvar}"
        for choice in getattr(parameter.type, "choices", ()):
            assert f"`{choice}`" in row, f"{name} {spellings[0]}: {choice}"
    real = {each for parameter in params for each in parameter.opts}
    assert real >= named, f"{name} has no {sorted(named - real)}"
    assert real >= {*own}, f"{name} has no {sorted({*own} - real)}"


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
        used.update(re.findall(r"\bHYBRIDLOG_[A-Z0-9_]*[A-Z]", path.read_text("utf-8")))
    assert set(re.findall(r"`(HYBRIDLOG_\w+)`", variables)) == used


# --- the Python interface -------------------------------------------------------------


def public(thing: type) -> dict[str, Any]:
    """Public attributes of a class, fields of dataclasses included."""
    classes = [c for c in reversed(thing.__mro__) if c.__module__.startswith("hybridlog")]
    found = {n: v for c in classes for n, v in vars(c).items() if not n.startswith("_")}
    found.update(
        {n: None for n in getattr(thing, "__struct_fields__", ()) if not n.startswith("_")}
    )
    return found


def documented_classes() -> list[type]:
    from hybridlog.across.align import Aligned
    from hybridlog.across.sync import Synced
    from hybridlog.attachments import StoredAttachment
    from hybridlog.index.of_store import Index
    from hybridlog.live import LiveOptions, LiveRecording
    from hybridlog.maintenance.copying import CopyOptions, CopyReport
    from hybridlog.maintenance.report import Repaired
    from hybridlog.maintenance.verify import Finding, Verification
    from hybridlog.query.answers.completeness import Completeness
    from hybridlog.query.answers.statistics import FieldStatistics
    from hybridlog.query.intervals import Interval, Intervals
    from hybridlog.query.question import Counters
    from hybridlog.record.recorder import RecordReport
    from hybridlog.recordings import Recordings
    from hybridlog.training.lerobot import LerobotReport
    from hybridlog_storage.catalog import ChannelEntry, ChannelStats, RecordingEntry
    from hybridlog_storage.segments.segment_writer import SegmentSettings

    results = [Counters, RecordReport, RecordingEntry, ChannelEntry, ChannelStats]
    checks = [Index, Verification, Finding, Repaired, CopyReport, LerobotReport]
    answers = [Completeness, FieldStatistics, Aligned, Synced, Intervals, Interval]
    asking = [Recordings, hl.Query, hl.Message, StoredAttachment, *answers]
    recording = [hl.RecordOptions, CopyOptions, LiveOptions, LiveRecording, SegmentSettings]
    return [hl.Store, *asking, *recording, *results, *checks]


@pytest.mark.parametrize("thing", documented_classes(), ids=lambda c: c.__name__)
def test_every_public_name_is_described(thing: type) -> None:
    text = sections(DOCS / "api.md", 3)[thing.__name__]
    listed = re.findall(r"^\| `(\w+)(\([^`]*\))?`", text, flags=re.MULTILINE)
    rows = dict(listed)
    assert len(rows) == len(listed), "a name is listed twice"
    members = public(thing)
    if thing.__name__ == "LiveRecording":
        members |= dict.fromkeys(("id", "ledger", "failure"))
    if thing is hl.Store:
        members |= {"directory": None}
    if thing is hl.Query:
        members |= dict.fromkeys(("question", "counters", "conditions"))
    if thing.__name__ == "Aligned":
        members |= {"rows": None, "empty": None}
    if thing.__name__ == "Synced":
        members |= dict.fromkeys(("topics", "recordings", "times", "counters", "left_out"))
    if thing.__name__ == "Recordings":
        conditions = inspect.signature(hl.Store.recordings).parameters
        members |= dict.fromkeys(("summaries", *(name for name in conditions if name != "self")))
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
    for family, shown in sections(DOCS / "api.md", 2).items():
        assert "```python" in shown, f"{family} has no example"


def test_every_error_is_described() -> None:
    text = sections(DOCS / "api.md", 2)["Errors"]
    listed = re.findall(r"^\| `(\w+)` \| (\d+) \|", text, flags=re.MULTILINE)
    rows = dict(listed)
    assert len(rows) == len(listed), "an error is listed twice"
    real = {
        n: str(c.exit_code)
        for n, c in vars(errors).items()
        if inspect.isclass(c) and issubclass(c, HybridlogError)
    }
    assert rows == real


# --- the language ---------------------------------------------------------------------


def examples(language: str) -> list[str]:
    """The lines of the fences of one language in `language.md`, without comments."""
    lines = [
        text for f in fences(DOCS / "language.md") if f.language == language for text in f.lines
    ]
    return [re.split(r"\s{2,}# ", line)[0].strip() for line in lines if line.strip()]


def test_the_predicates_are_accepted() -> None:
    shown = examples("where")
    assert len(shown) > 20
    for text in shown:
        check(parse(text), None)


def test_the_wrong_predicates_are_refused() -> None:
    shown = examples("where-refused")
    assert shown
    for text in shown:
        with pytest.raises(HybridlogError):
            check(parse(text), {"x": "float64", "name": "string"})


def test_the_times_are_understood() -> None:
    shown = examples("times")
    assert len(shown) > 10
    for line in shown:
        text, _, means = line.partition("->")
        start, end = START_NS, START_NS + 60_000_000_000
        got = times.parse_time(text.strip(), start=start, end=end)
        assert times.format_time(got) == means.strip() or means.strip() == "…", line


def test_the_patterns_find_what_is_said() -> None:
    from benchmarks.simulator.topics import DEMO, topics_of

    names = [topic.name for topic in topics_of(DEMO)]
    shown = examples("topics")
    assert len(shown) > 5
    for line in shown:
        pattern, _, found = line.partition("->")
        if found.strip() == "refused":
            with pytest.raises(HybridlogError):
                topics.resolve([pattern.strip()], names)
        else:
            assert topics.resolve([pattern.strip()], names) == found.split(), line


# --- the specification ----------------------------------------------------------------


def json_log(path: Path) -> None:
    """An MCAP with publish times, odd topics, and more than one channel on one of them."""
    schema = Schema("Weather", "jsonschema", b"{}")
    names = ["/weather", "/weather_", "weather", "/Wetter in Köln", "/weather"]
    channels = [
        Channel(name, "json", schema if n < 4 else None, {"n": str(n)})
        for n, name in enumerate(names)
    ]
    rows = []
    for number in range(500):
        now = START_NS + (number * 7919 % 500) * 10**8
        value = {"t": number, "list": list(range(number % 40)), "_id": None}
        rows.append((channels[number % 5], now, json.dumps(value).encode(), now - number, number))
    write_mcap(path, rows)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, demo_bag: Path) -> Iterator[hl.Store]:
    directory = tmp_path_factory.mktemp("second")
    json_log(directory / "weather.mcap")
    shutil.copyfile(demo_bag, directory / "cut.bag")
    os.truncate(directory / "cut.bag", demo_bag.stat().st_size // 8)
    from hybridlog_storage.segments.segment_writer import SegmentSettings

    with hl.open(directory / "store", create=True) as store:
        several = SegmentSettings(segment_size=2 << 20, chunk_size=64 << 10)
        store.record(demo_bag, name="robot", settings=several)
        store.record(directory / "weather.mcap")
        store.record(directory / "cut.bag")
        yield store


def entry_of(store: Path, name: str) -> RecordingEntry:
    """What hybridlog says of a recording that was read, and what a crash has left is finished."""
    with hl.open(store) as opened:
        opened.shared.recover()
        assert [one.raw for one in opened.all_topics().in_recording(name)]
        opened.refresh()
        return next(entry for entry in opened.recordings() if entry.name == name)


def bare(rows: Iterable[Mapping[str, Any]], *, of_files: bool) -> list[dict[str, Any]]:
    """Rows of a loss ledger, those that follow from files without the reason, in one order."""
    kept = [dict(row) for row in rows if (row["cause"] == "segment") == of_files]
    for row in kept if of_files else ():
        row.pop("reason", None)
    return sorted(kept, key=lambda row: json.dumps(row, sort_keys=True))


def test_a_second_reader_gets_the_same_messages(recorded: hl.Store) -> None:
    second = FormatReader(recorded.directory.path)
    assert second.store_id == recorded.directory.settings.store_id
    assert second.names() == ["cut", "robot", "weather"]
    assert len(second.recording("robot").segments) > 2
    for name in second.names():
        recording = second.recording(name)
        entry = recorded.entry(name)
        assert (recording.id, recording.status) == (entry.id, entry.status)
        assert (recording.manifest.name, recording.manifest.tags) == (entry.name, entry.tags)
        for of_files in (False, True):
            losses = bare(entry.losses, of_files=of_files)
            assert bare(recording.losses, of_files=of_files) == losses
        told = sorted(message for _, message in recording.messages())
        schemas = {
            (lane.channel.topic, lane.channel.schema.name): lane.channel
            for lane in recorded.session.channels_of(entry, {c.topic for c in entry.channels})
            if lane.channel.schema is not None
        }
        ours = sorted(
            (m.seq, m.topic, m.type, m.log_time_ns, m.publish_time_ns, m.sequence, m.raw)
            for m in recorded.all_topics().in_recording(name)
        )
        theirs = [(t.seq, t.topic, t.schema[0] if t.schema else "", *t[4:]) for t in told]
        assert theirs == ours
        assert [t.seq for t in told] == list(range(len(told)))
        for message in told:
            if message.schema is not None:
                channel = schemas[message.topic, message.schema[0]]
                assert channel.schema is not None
                assert message.schema[1:] == (channel.schema.encoding, channel.schema.data)
                assert message.encoding == channel.message_encoding
    statuses = [second.recording(name).status for name in second.names()]
    assert statuses == ["damaged", "complete", "complete"]


@pytest.fixture(scope="module")
def older(recorded: hl.Store, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Segment 1 of `robot` as a crash would have left it: whole, and with fewer messages."""
    store = tmp_path_factory.mktemp("older") / "store"
    robot = places.folder(copied(recorded, store), "robot")
    (robot / "000001.mcap").rename(robot / "000001.mcap.open")
    os.truncate(robot / "000001.mcap.open", (robot / "000001.mcap.open").stat().st_size // 2)
    before, after = FormatReader(store).recording("robot"), entry_of(store, "robot")
    assert (before.status, after.status) == ("unfinished", "damaged")
    again = FormatReader(store).recording("robot")
    assert again.status == "damaged"
    assert bare(again.losses, of_files=True) == bare(after.losses, of_files=True) != []
    return robot / "000001.mcap"


def copied(recorded: hl.Store, store: Path) -> Path:
    """A copy of the files that are the truth."""
    hidden = shutil.ignore_patterns("mongod*", "catalog*")
    shutil.copytree(recorded.directory.path, store, ignore=hidden)
    return store


ONE = "000001.mcap"


def swap(one: Path, other: Path) -> None:
    one.rename(one.with_name("aside"))
    other.rename(one)
    one.with_name("aside").rename(other)


def foreign(robot: Path) -> Path:
    return places.segment(robot.parents[1], "weather")


# What is done to a recording.
FAULTS: dict[str, Callable[[Path, Path], object]] = {
    "lost": lambda robot, _: (robot / ONE).unlink(),
    "swapped": lambda robot, _: swap(robot / "000000.mcap", robot / ONE),
    "an older one": lambda robot, older: shutil.copyfile(older, robot / ONE),
    "a foreign one more": lambda robot, _: shutil.copyfile(foreign(robot), robot / "000999.mcap"),
    "cut": lambda robot, _: os.truncate(robot / ONE, (robot / ONE).stat().st_size - 1),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_the_status_follows_from_the_page_alone(
    fault: str, recorded: hl.Store, older: Path, tmp_path: Path
) -> None:
    robot = places.folder(copied(recorded, tmp_path / "store"), "robot")
    FAULTS[fault](robot, older)
    status = "complete" if fault == "a foreign one more" else "damaged"
    second = FormatReader(tmp_path / "store")
    before = second.recording("robot")
    entry = entry_of(tmp_path / "store", "robot")
    after = second.recording("robot")  # hybridlog may have changed the manifest
    for recording in (before, after):
        assert (recording.status, recording.id) == (status, entry.id)
        assert entry.status == recording.status
        lost = bare(recording.losses, of_files=True)
        assert lost == bare(entry.losses, of_files=True)
        assert bool(lost) == (recording.status == "damaged")
        assert entry.segments == len(recording.segments)
        counted = sum(p.messages for s in recording.segments.values() for p in s.parts)
        assert entry.messages == counted
        assert (recording.end or {})["status"] == entry.manifest.status == "complete"
    with hl.open(tmp_path / "store") as store:
        whole = recorded.entry("robot")
        missing = sum(row["count"] for row in lost)
        assert entry.messages + missing == whole.messages
        seqs = [m.seq for m in store.all_topics().in_recording("robot")]
        assert sorted(seqs) == sorted(m.seq for _, m in after.messages())


def test_a_damaged_chunk_is_the_same_loss_for_both(recorded: hl.Store, tmp_path: Path) -> None:
    from hybridlog.maintenance.verify import verify

    robot = places.folder(copied(recorded, tmp_path / "store"), "robot")
    whole = FormatReader(tmp_path / "store").recording("robot").segments[1]
    # In a chunk, in an arrival record, and in a message index.
    flips = (
        (0, 60),
        (2, whole.chunks[2].length + whole.chunks[2].trailer - 3),
        (3, whole.chunks[3].length + 20),
    )
    for number, behind in flips:
        with (robot / "000001.mcap").open("r+b") as file:
            file.seek(whole.chunks[number].offset + behind)
            (byte,) = file.read(1)
            file.seek(-1, os.SEEK_CUR)
            file.write(bytes([byte ^ 4]))
    second = FormatReader(tmp_path / "store").recording("robot")
    assert sorted(second.damage) == [(1, 0), (1, 2), (1, 3)]
    assert second.status == "damaged"
    with hl.open(tmp_path / "store") as store:
        found = verify(store.shared, {store.entry("robot").id: "robot"})
    assert {f.place.split(" byte ")[0] for f in found.findings} == {"000001.mcap"}
    assert len(found.findings) == 3
    with hl.open(tmp_path / "store", require_database=True) as store:
        entry = store.entry("robot")
        lost = bare(entry.losses, of_files=True)
    assert entry.status == "damaged"
    assert lost == bare(second.losses, of_files=True)


def test_what_people_wrote_is_read_from_the_manifest(recorded: hl.Store, tmp_path: Path) -> None:
    copied(recorded, tmp_path / "store")
    with hl.open(tmp_path / "store") as store:
        store.edit("robot", name="Tuesday")
        store.edit("Tuesday", tag={"place": "lab", "weather": "rain"})
        store.edit("Tuesday", untag=["weather"])
        store.edit("Tuesday", note="the left wheel squeaks")
        entry = store.mark("Tuesday", "+2s", "bump", {"how": "hard"})
    second = FormatReader(tmp_path / "store")
    recording = second.recording(entry.name)
    assert (entry.name, entry.status) == ("Tuesday", recording.status)
    assert recording.manifest.name == "Tuesday"
    assert recording.manifest.tags == entry.tags == {"place": "lab"}
    assert recording.manifest.notes == [(n.at, n.text) for n in entry.manifest.notes]
    (mark,) = recording.manifest.marks
    assert mark == {k: v for k, v in asdict(entry.manifest.marks[0]).items() if v is not None}
    assert (mark["text"], mark["tags"]) == ("bump", {"how": "hard"})
    seqs = sorted(m.seq for _, m in recording.messages())
    assert seqs == list(range(len(seqs)))


def test_the_index_is_as_specified(recorded: hl.Store) -> None:
    """What documents say of their messages; `tests/indexed.py` compares the fields."""
    from pymongo import MongoClient

    second = FormatReader(recorded.directory.path)
    wanted: dict[bytes, tuple[str, dict[str, Any]]] = {}
    for recording in map(second.recording, second.names()):
        key = recording.id[-16:]
        for (segment, chunk, offset), told in recording.messages():
            ref = {"seg": segment, "chunk": chunk, "off": offset, "len": len(told.payload)}
            since = timedelta(milliseconds=told.log_time // 1_000_000)
            meta = {"rec": key, "seq": told.seq, "topic": told.topic, "t": told.log_time}
            meta |= {"ref": ref, "inserted_at": datetime(1970, 1, 1) + since}
            meta |= {} if told.publish_time is None else {"pub": told.publish_time}
            wanted[index_key(told.log_time, key, told.seq)] = collection_name(told.topic), meta
    with MongoClient[dict[str, Any]](recorded.index.address().uri) as client:
        database = client["hybridlog"]
        for name in database.list_collection_names():
            for document in database[name].find() if not name.startswith("hybridlog.") else ():
                collection, meta = wanted.pop(document["_id"])
                assert (collection, {**document["_meta"], **meta}) == (name, document["_meta"])
                assert "pub" in meta or "pub" not in document["_meta"]
        assert not wanted
        owner = database["hybridlog.store"].find_one({"_id": "store"})
        assert owner is not None
        assert (owner["store"], owner["place"]) == (second.store_id, "embedded")


def test_the_specification_names_what_there_is() -> None:
    from hybridlog.schema.document import ARRAY_LIMIT
    from hybridlog_storage import manifest
    from hybridlog_storage.cells import CATALOG
    from hybridlog_storage.disk import directory
    from hybridlog_storage.mongo import index_documents
    from hybridlog_storage.segments import chunk_table, segment_format
    from hybridlog_storage.settings import FORMAT, StoreSettings

    text = (DOCS / "format.md").read_text("utf-8")
    assert len(text.split()) <= 3000
    for name in ("RECORDING", "LOSSES"):
        assert f"`{getattr(segment_format, f'{name}_METADATA')}`" in text
    for name in (segment_format.NO_PUBLISH_TIME, segment_format.PROFILE):
        assert f"`{name}`" in text
    for name in ("ARRIVAL_OPCODE", "CHUNK_TABLE_OPCODE", "DAMAGED_OPCODE"):
        assert re.search(f"opcode,? {getattr(segment_format, name):#x}", text)
    assert FORMAT == segment_format.FORMAT_VERSION
    assert f"Format {FORMAT}. No version of hybridlog has been released yet" in text
    text += (DOCS / "derived.md").read_text("utf-8")
    assert f"up to {ARRAY_LIMIT} elements" in text
    for name in StoreSettings.__struct_fields__:
        assert f"`{name}`" in text, name
    for kind in (chunk_table.CHUNK, chunk_table.PART):
        assert all(f"`{name}`" in text for name in kind.names or ())
    rows = sections(DOCS / "format.md", 2)["Manifest"]
    m = manifest
    for part in (m.Manifest, m.File, m.Mark, m.Pin, m.Loss, m.LetGo):
        for name in part.__struct_fields__:
            assert f"`{name}`" in rows, name
    for name in (index_documents.RECORDINGS, index_documents.STORE):
        assert f"`{name}`" in text
    for name in (
        CATALOG,
        directory.LOCK,
        "manifests/",
        "<id>.json",
        "manifest.lock",
        "manifest.old",
    ):
        assert name in sections(DOCS / "format.md", 2)["Directory"]


# --- the robot ------------------------------------------------------------------------


def test_the_unit_for_systemd_starts_a_recorder() -> None:
    from hybridlog.cli.commands.record import record_command
    from hybridlog.cli.record_choices import RecordChoices
    from hybridlog.cli.record_live import recorder_options

    (unit,) = (fence for fence in fences(DOCS / "robot.md") if fence.language == "ini")
    settings = dict(line.split("=", 1) for line in unit.lines if "=" in line)
    program, command, *arguments = settings["ExecStart"].split()
    assert (Path(program).name, command) == ("hybridlog", "record")
    with record_command.make_context("record", arguments) as context:
        choices = RecordChoices(**context.params)
    choices.check()
    assert recorder_options(choices).settings.segment_span_s == 60
    # It says that it is ready, and can be stopped while its own MongoDB still runs.
    assert (settings["Type"], settings["KillMode"]) == ("notify", "mixed")
    assert int(settings["WatchdogSec"]) > 10


WITHOUT_NETWORK = """
import sys
from importlib import import_module

def audit(event, arguments):
    if event in {"socket.connect", "socket.getaddrinfo", "socket.gethostbyname"}:
        if event != "socket.connect" or isinstance(arguments[1], tuple):
            print("network:", event, arguments, file=sys.stderr)

sys.addaudithook(audit)
import_module("hybridlog.cli.app").main()
"""


@pytest.mark.parametrize("mongo", ["none", "embedded"])
def test_a_recorder_needs_no_network(mongo: str, tmp_path: Path, demo_bag: Path) -> None:
    arguments = ["--replay", demo_bag, "--speed", 60, "--reserve", 0, "--mongo", mongo]
    program = [sys.executable, "-c", WITHOUT_NETWORK, "record", "--store", tmp_path / "store"]
    done = subprocess.run(
        [str(word) for word in (*program, *arguments)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert "network" not in done.stderr
    assert re.search(r"(?ms): (\d+) messages, .*^\1 received; ", done.stdout)
