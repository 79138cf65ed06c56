"""What processes and the machine have used."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import psutil

_MONGOD_END_S = 60.0
_SPIN = 250_000


def with_children(pids: Iterable[int]) -> set[int]:
    """Processes that are there, and all that descend from them."""
    found: set[int] = set()
    for pid in pids:
        with suppress(psutil.NoSuchProcess):
            process = psutil.Process(pid)
            found |= {pid, *(child.pid for child in process.children(recursive=True))}
    return found


def cpu_s(pids: Iterable[int]) -> float:
    """Seconds of CPU, user and system, of processes and of their children that have ended."""
    total = 0.0
    for pid in pids:
        with suppress(psutil.NoSuchProcess):
            total += sum(psutil.Process(pid).cpu_times()[:4])
    return total


def peak_rss(pids: Iterable[int]) -> int:
    """Most bytes of memory that processes have had, one by one; what they share counts once."""
    own = shared = 0
    for pid in pids:
        kilobytes = _kilobytes(pid)
        both = kilobytes.get("RssShmem", 0) + kilobytes.get("RssFile", 0)
        own += max(kilobytes.get("VmHWM", 0) - both, 0)
        shared = max(shared, both)
    return (own + shared) * 1024


def rss(pids: Iterable[int]) -> int:
    """Bytes of memory that processes have now; what they share counts for each."""
    return 1024 * sum(_kilobytes(pid).get("VmRSS", 0) for pid in pids)


def own_peak() -> int:
    """Most bytes of memory that this process has had resident since it was started."""
    # getrusage would include the parent's memory, which a fork shares for a moment.
    return 1024 * _kilobytes(os.getpid())["VmHWM"]


def working_below(directory: Path, program: str) -> tuple[int, ...]:
    """Processes whose command line names a program and a directory, or what lies below it."""
    name = str(directory.resolve())
    found = []
    for process in psutil.process_iter(["cmdline"]):
        command = "\0".join(process.info["cmdline"] or ())
        if name in command and program in command:
            found.append(process.pid)
    return tuple(found)


def wait_for_mongods(directory: Path) -> None:
    """Wait until no mongod with its data below a directory is left."""
    deadline = time.monotonic() + _MONGOD_END_S
    while working_below(directory, "mongod"):
        if time.monotonic() > deadline:
            raise TimeoutError(f"The mongod below {directory} does not end.")
        time.sleep(0.05)


def mapped_rss(path: Path) -> int:
    """Bytes of a file that this process has mapped and resident."""
    return sum(each.rss for each in psutil.Process().memory_maps() if each.path == str(path))


def disk_bytes(directory: Path) -> int:
    """Bytes that the files below a directory take on the disk, holes not counted."""
    total = 0
    for place, _, names in os.walk(directory):
        for name in names:
            try:
                status = Path(place, name).lstat()
            except OSError:
                continue  # it has just gone
            total += status.st_blocks * 512
    return total


def spin_ms() -> float:
    """How long a fixed piece of work takes: it is the same on a machine that is as quiet."""
    started = time.perf_counter()
    value = 0
    for number in range(_SPIN):
        value = (value * 31 + number) & 0xFFFF
    return (time.perf_counter() - started) * 1000


def marked(variable: str, value: str) -> list[int]:
    """Processes that were given an environment variable of a value, ourselves left out."""
    found = []
    for process in psutil.process_iter():
        with suppress(psutil.Error):  # it has ended, or belongs to somebody else
            is_given = process.pid != os.getpid() and process.environ().get(variable) == value
            if is_given and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


def _kilobytes(pid: int) -> dict[str, int]:
    """What a process's status gives in kB, by name; nothing when there is no such process."""
    try:
        text = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return {}
    return {n: int(v) for n, v in re.findall(r"^(\w+):\s+(\d+) kB", text, re.MULTILINE)}
