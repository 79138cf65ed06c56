"""What a benchmark ran on: a figure without its machine means nothing."""

from __future__ import annotations

import os
import platform
import re
import sqlite3
import subprocess
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from hybridlog_storage.mongo.mongod import find_mongod
from hybridlog_storage.threads import processors

_PACKAGES = ("hybridlog", "mcap", "numpy", "pandas", "psycopg", "pyarrow", "pymongo", "rosbags")
_ROOT = Path(__file__).parents[1]


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
