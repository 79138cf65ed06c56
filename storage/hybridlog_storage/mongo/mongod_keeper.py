"""The process that starts one embedded mongod, waits, and ends it.

`hybridlog_storage.mongo.mongod` runs it as a script. It uses only the standard library, so it
starts fast and stays small. It outlives its starter: mongod belongs to all processes on a store.

    python -I -S mongod_keeper.py LINGER_S SOCKET LOCK_FD MONGOD ARGUMENT...

It runs in the directory of mongod, with the log as standard output. mongod inherits the open and
locked file LOCK_FD, as this process does: its lock means that one of both has not ended.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import resource
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

END_LIMIT_S = 30.0
"""Seconds for an orderly end of mongod."""
_LOOK_S = 0.1
_PR_SET_PDEATHSIG = 1


def main(linger_s: float, socket: str, lock: int, command: list[str]) -> None:
    """Run mongod, which shares `lock`, until it is unused for `linger_s`."""
    os.umask(0o077)
    # The starter's limits of memory and open files: each collection takes about two.
    for limit in (resource.RLIMIT_DATA, resource.RLIMIT_NOFILE):
        hard = resource.getrlimit(limit)[1]
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(limit, (hard, hard))
    mongod = subprocess.Popen(  # noqa: S603 - the starter's own command
        command,
        stdin=subprocess.DEVNULL,
        # C, since mongod does not start under a locale that is not installed, and ssh passes
        # on the locale of the other side.
        env={**os.environ, "LC_ALL": "C"},
        pass_fds=(lock,),
        preexec_fn=partial(_tie, os.getpid()),  # noqa: PLW1509 - there are no threads
    )
    _wait(mongod, os.open("users.lock", os.O_RDWR | os.O_NOFOLLOW), socket, linger_s)
    if mongod.poll() is not None:
        said = f"hybridlog: mongod ended by itself, with status {mongod.returncode}\n"
        os.write(1, said.encode())
        return
    mongod.terminate()
    try:
        mongod.wait(END_LIMIT_S)
    except subprocess.TimeoutExpired:
        mongod.kill()  # its journal restores everything


def _tie(keeper: int) -> None:
    """Runs in mongod's process before exec: ends it when the keeper ends."""
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
    if os.getppid() != keeper:  # which died before the line above
        os._exit(1)


def _wait(mongod: subprocess.Popen[bytes], users: int, socket: str, linger_s: float) -> None:
    """Wait until mongod has ended, its store was removed, or nobody has used it for `linger_s`."""
    used = time.monotonic()
    while mongod.poll() is None and os.fstat(users).st_nlink:
        try:
            fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            used = time.monotonic()
        else:
            # Clients are waited for until the time that the file is set to.
            if os.fstat(users).st_mtime > time.time() or _has_clients(socket):
                used = time.monotonic()
            elif time.monotonic() - used >= linger_s:
                return  # `users` stays locked: new ones wait, and then start another mongod
            fcntl.flock(users, fcntl.LOCK_UN)
        time.sleep(_LOOK_S)


def _has_clients(socket: str) -> bool:
    """True if any program is connected to a socket."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/net/unix").read_bytes().splitlines()
        # Num, RefCount, Protocol, Flags, Type, St (3: connected), Inode, Path
        connected = [line.split(None, 5)[5].split(None, 2) for line in lines[1:]]
        return any(one[0] == b"03" and one[2:] == [os.fsencode(socket)] for one in connected)
    return False


if __name__ == "__main__":
    # The starter waits for this first process only. init adopts the child, so no starter
    # has to reap it.
    if os.fork():
        os._exit(0)
    given_linger, given_socket, given_lock, *given = sys.argv[1:]
    main(float(given_linger), given_socket, int(given_lock), given)
