"""Processes of this machine, as `/proc` shows them."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path


def family(pid: int) -> tuple[int, ...]:
    """A process and all its descendants; just itself where there is no `/proc`."""
    children: dict[int, list[int]] = defaultdict(list)
    for process in Path("/proc").glob("[0-9]*"):
        try:
            status = (process / "stat").read_bytes()
        except OSError:
            continue  # it has just ended
        # The second field is a name in parentheses, which may hold anything.
        children[int(status.rpartition(b")")[2].split()[1])].append(int(process.name))
    found = [pid]
    for parent in found:
        found.extend(children.get(parent, ()))
    return tuple(found)


def working_below(directory: Path, program: str) -> tuple[int, ...]:
    """Processes whose command line names a program and a directory, or what lies below it."""
    name = str(directory.resolve()).encode()
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes()
        except OSError:
            continue
        if name in command and program.encode() in command:
            found.append(int(process.name))
    return tuple(found)
