"""What the studies share: one run of one case, kept in the journal."""

from __future__ import annotations

import os
import platform
import re
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.harness.run import run as run_load
from benchmarks.loads.base import Load
from benchmarks.samples import Journal, Sample, Scale
from hybridlog_storage.mongo.mongod import find_mongod
from hybridlog_storage.threads import processors

if TYPE_CHECKING:
    from benchmarks.backends.base import Backend

_DIGESTED_S = 500e6  # bytes a second of what a run has kept that the machine is done with,
_DIGESTING_S = 12.0  # and seconds after which it is done with all


@dataclass
class Context:
    """Where and how studies run.

    Attributes:
        work: Directory for loads (kept) and the data of runs (removed after each).
        backends: Those that take part, by name, in the order in which they take turns.
        missing: Why backends are missing that were found so: they are not tried again.
        quiet_at: When the machine will be done with what the last run left, seconds of
            `time.monotonic`.
    """

    work: Path
    backends: Mapping[str, type[Backend]]
    journal: Journal
    scale: Scale = "full"
    seed: int = 1
    missing: dict[str, str] = field(default_factory=dict)
    quiet_at: float = 0.0
    _begun: float = field(default_factory=time.monotonic)

    @property
    def minutes(self) -> float:
        """Since the run was started."""
        return (time.monotonic() - self._begun) / 60

    @contextmanager
    def step(self, text: str) -> Iterator[None]:
        """Write a line to standard error when the block has ended well."""
        started = time.monotonic()
        yield
        self.say(f"{text} ({time.monotonic() - started:.1f} s)")

    def say(self, text: str) -> None:
        """Write a line, with the time so far."""
        minutes, seconds = divmod(round(self.minutes * 60), 60)
        print(f"[{minutes}:{seconds:02}] {text}", file=sys.stderr, flush=True)

    def load(self, name: str, settings: Mapping[str, Any], make: Callable[[Path], Load]) -> Load:
        """A load that is made once."""
        place = self.work / "loads" / "-".join(map(str, [name, *settings.values()]))
        if not place.exists():
            place.mkdir(parents=True)
            make(place)
        return Load.open(place)

    def run(self, wanted: Sample, load: Callable[[], Load], *, speed: float = 1.0) -> Sample:
        """Run one case with one backend."""
        reason = self.missing.get(wanted.backend)
        if reason is not None:
            sample = replace(wanted, status="missing", reason=reason)
        else:
            case = ", ".join(f"{name} {value}" for name, value in wanted.case.items())
            text = f"{wanted.study}: {wanted.backend}, {case}, round {wanted.repetition + 1}"
            with self.step(text):
                sample = self._run(wanted, load(), speed)
        if sample.status == "missing":
            self.missing[wanted.backend] = sample.reason
        self.journal.add(sample)
        return sample

    def _run(self, wanted: Sample, load: Load, speed: float) -> Sample:
        if self.scale == "full":
            time.sleep(max(self.quiet_at - time.monotonic(), 0))
        with run_directory(self.work) as directory:
            outcome = run_load(load, self.backends[wanted.backend], directory, speed)
        # A virtual machine returns freed memory to its host bit by bit, every two seconds. The
        # host then loses sight of the pages that are in use, too, and who touches them next pays
        # for it: 100 to 300 ms of a run's first seconds, when the one before had kept gigabytes.
        kept: float = outcome.values.get("persisted_bytes", 0)
        self.quiet_at = time.monotonic() + min(kept / _DIGESTED_S, _DIGESTING_S)
        values = {name: v for name, v in outcome.values.items() if name != "topics"}
        return replace(wanted, status=outcome.status, values=values, reason=outcome.reason)


@contextmanager
def run_directory(work: Path) -> Iterator[Path]:
    """An empty directory for one run, removed with all that is in it, however the run ends."""
    work.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=work, ignore_cleanup_errors=True) as directory:
        yield Path(directory)


_PACKAGES = ("hybridlog", "mcap", "numpy", "pandas", "psycopg", "pyarrow", "pymongo", "rosbags")
_ROOT = Path(__file__).parents[2]


def describe(work: Path | None = None) -> dict[str, object]:
    """Machine, system, versions, revision and load, as values that JSON can hold."""
    cpu = re.search(r"^model name\s*:\s*(.+)$", _text("/proc/cpuinfo"), re.MULTILINE)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": cpu[1] if cpu else platform.processor() or "unknown",
        "cores": processors(),
        "memory_gib": round(memory / 2**30, 1),
        "disk": _disk(work or Path(tempfile.gettempdir())),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "mongod": _said([str(find_mongod()), "--version"], r"db version v(\S+)"),
        "postgres": _postgres_version(),
        "sqlite": sqlite3.sqlite_version,
        # With a plus sign when files differ from the commit.
        "revision": _said(
            ["git", "-C", str(_ROOT), "describe", "--always", "--abbrev=12", "--dirty=+"], r"(\S+)"
        ),
        "load_1min": round(os.getloadavg()[0], 2),
    }


def _text(path: str) -> str:
    try:
        return Path(path).read_text()
    except OSError:
        return ""


def _disk(directory: Path) -> str:
    """File system and disk of a directory: `ext4 on vda`."""
    number = directory.resolve().stat().st_dev
    for fields in map(str.split, _text("/proc/self/mountinfo").splitlines()):
        if fields[2] == f"{os.major(number)}:{os.minor(number)}":
            kind, source = fields[fields.index("-") + 1 :][:2]
            return f"{kind} on {Path(source).name}"
    return "unknown"


def _postgres_version() -> str:
    from benchmarks.backends.base import BackendMissingError
    from benchmarks.backends.postgres import find_programs

    try:
        program = find_programs().directory / "postgres"
    except BackendMissingError:
        return "absent"
    return _said([str(program), "--version"], r"\(PostgreSQL\) (\S+)")


def _said(command: Sequence[str], pattern: str) -> str:
    """What a program says that matches a pattern."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    found = re.search(pattern, done.stdout)
    return found[1] if found else "unknown"
