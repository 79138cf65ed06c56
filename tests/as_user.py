"""Becomes another user of the system, and then a command. Run as a script, by root.

    python as_user.py '{"uid": 65534, "gid": 65534, "groups": [], "umask": 18, "trees": [...]}' CMD

The interpreter, the environment and the source tree may lie where only root gets to, such as
in root's home. Then this process, in a mount namespace of its own, puts an empty folder over
the one that is closed, and the trees back into that. Nobody else sees it.
"""

from __future__ import annotations

import ctypes
import json
import os
import sys
from pathlib import Path
from typing import Any

_NEW_NAMESPACE = 0x00020000
_BIND, _RECURSIVE, _PRIVATE = 0x1000, 0x4000, 1 << 18


def main() -> None:
    job, command = json.loads(sys.argv[1]), sys.argv[2:]
    open_up([Path(tree) for tree in job["trees"]])
    os.setgroups(job["groups"])
    os.setgid(job["gid"])
    os.setuid(job["uid"])
    os.umask(job["umask"])
    os.execvp(command[0], command)


def open_up(trees: list[Path]) -> None:
    """Let everybody get to some folders, for this process and its children."""
    closed = {shut for tree in trees if (shut := closed_above(tree))}
    closed = {place for place in closed if not any(p in closed for p in place.parents)}
    if not closed:
        return
    libc = ctypes.CDLL(None, use_errno=True)
    check(libc.unshare(_NEW_NAMESPACE))
    check(libc.mount(b"none", b"/", None, _RECURSIVE | _PRIVATE, None))
    # Not before: what is held open belongs to the namespace that it was opened in.
    held = [
        (tree, os.open(tree, os.O_PATH))
        for tree in trees
        if any(place in tree.parents for place in closed)
    ]
    for place in closed:
        check(libc.mount(b"none", os.fsencode(place), b"tmpfs", 0, b"mode=755"))
    for tree, fd in held:
        tree.mkdir(parents=True, exist_ok=True)
        source = f"/proc/self/fd/{fd}".encode()
        check(libc.mount(source, os.fsencode(tree), None, _BIND | _RECURSIVE, None))
        os.close(fd)


def closed_above(tree: Path) -> Path | None:
    """The first folder on the way that others cannot pass."""
    return next((p for p in reversed(tree.parents) if not p.stat().st_mode & 0o001), None)


def check(result: Any) -> None:
    if result:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


if __name__ == "__main__":
    main()
