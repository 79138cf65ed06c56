"""What processes and the machine have used, as `/proc` tells; nothing where there is none."""

from __future__ import annotations

import os
import re
import resource
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

_PROC = Path("/proc")
_MONGOD_END_S = 60.0
_SPIN = 250_000


class Machine(NamedTuple):
    """CPU time of all processors since the machine was started, seconds.

    Attributes:
        busy: In which something ran.
        stolen: In which the host of a virtual machine let it wait.
    """

    busy: float
    stolen: float


def machine() -> Machine | None:
    """What the machine has used; None when the system does not tell."""
    try:
        first = (_PROC / "stat").read_text().split("\n", 1)[0].split()
    except OSError:
        return None
    user, nice, system, _idle, _wait, irq, softirq, stolen = map(int, first[1:9])
    tick = _tick()
    return Machine((user + nice + system + irq + softirq) / tick, stolen / tick)


def with_children(pids: Iterable[int]) -> set[int]:
    """Processes that are there, and all that descend from them."""
    children: dict[int, list[int]] = {}
    for pid in _pids():
        fields = _stat(pid)
        if fields is not None:
            children.setdefault(int(fields[1]), []).append(pid)
    found: set[int] = set()
    waiting = [pid for pid in pids if _stat(pid) is not None]
    while waiting:
        pid = waiting.pop()
        if pid not in found:
            found.add(pid)
            waiting += children.get(pid, ())
    return found


def cpu_s(pids: Iterable[int]) -> float:
    """Seconds of CPU, user and system, of processes and of their children that have ended."""
    ticks = 0
    for pid in pids:
        fields = _stat(pid)
        if fields is not None:
            ticks += sum(map(int, fields[11:15]))
    return ticks / _tick()


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
    kilobytes = _kilobytes(os.getpid()).get("VmHWM")
    if kilobytes is None:
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        kilobytes = used // 1024 if sys.platform == "darwin" else used
    return kilobytes * 1024


def working_below(directory: Path, program: str) -> tuple[int, ...]:
    """Processes whose command line names a program and a directory, or what lies below it."""
    name = str(directory.resolve()).encode()
    found = []
    for pid in _pids():
        try:
            command = (_PROC / str(pid) / "cmdline").read_bytes()
        except OSError:
            continue  # it has just ended
        if name in command and program.encode() in command:
            found.append(pid)
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
    try:
        text = (_PROC / "self" / "smaps").read_text()
    except OSError:
        return 0
    name = re.escape(str(path))
    return 1024 * sum(
        int(found[1]) for found in re.finditer(rf" {name}\n(?:.*\n)*?Rss:\s+(\d+) kB", text)
    )


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
    entry = f"{variable}={value}".encode()
    found = []
    for pid in _pids():
        try:
            given = (_PROC / str(pid) / "environ").read_bytes()
        except OSError:
            continue  # it has ended, or belongs to somebody else
        if pid != os.getpid() and entry in given.split(b"\0") and not _is_dead(pid):
            found.append(pid)
    return found


def _is_dead(pid: int) -> bool:
    """Whether a process has ended and only waits for its parent to notice."""
    fields = _stat(pid)
    return fields is None or fields[0] == "Z"


def _pids() -> Iterator[int]:
    if _PROC.is_dir():
        for entry in os.listdir(_PROC):  # noqa: PTH208 - thousands of names, no paths
            if entry.isdigit():
                yield int(entry)


def _kilobytes(pid: int) -> dict[str, int]:
    """What a process's status gives in kB, by name; nothing when there is no such process."""
    try:
        text = (_PROC / str(pid) / "status").read_text()
    except OSError:
        return {}
    return {n: int(v) for n, v in re.findall(r"^(\w+):\s+(\d+) kB", text, re.MULTILINE)}


def _stat(pid: int) -> list[str] | None:
    """Fields of a process from its state on; None when there is no such process."""
    try:
        text = (_PROC / str(pid) / "stat").read_text(errors="replace")
    except OSError:
        return None
    # The name stands in brackets and may hold anything, brackets too.
    return text[text.rindex(")") + 2 :].split()


def _tick() -> int:
    return os.sysconf("SC_CLK_TCK")
