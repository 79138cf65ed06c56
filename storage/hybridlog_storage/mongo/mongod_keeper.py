"""The process that starts one embedded mongod, waits, and ends it.

`hybridlog_storage.mongo.mongod` runs it as a script and never imports it. It uses only the
standard library, so it starts fast and stays small. It outlives the process that started
it: mongod belongs to all processes on a store, not to the first one.

    python -I -S mongod_keeper.py '{"command": [...], ...}'

It inherits two open, locked files. The lock on the first means that a keeper is running;
it ends with this process. mongod inherits the second, so its lock means that mongod has
not ended, even after its keeper was killed. The keeper also inherits the open folder of
these files, and the open log. It opens files only relative to that folder, and follows no
symlink there.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypedDict

LOG_LIMIT = 10 << 20
"""Bytes of log after which it is rotated; one older log is kept."""
OPEN_FILES = 64_000
"""Limit of mongod's open files: about two for each collection."""
END_LIMIT_S = 30.0
"""Seconds for an orderly end of mongod."""
POLL_S = 0.25
POLL_AT_START_S = 0.05
YOUNG_S = 3.0
LOG_CHECK_S = 10.0
RECORD_LIMIT = 64 << 10
PUBLISHED_S = 86_400.0
"""Most seconds for which mongod waits for clients."""
CONNECTED = b"03"
"""State of a connection in /proc/net/unix."""
_PR_SET_PDEATHSIG = 1


class Job(TypedDict):
    """The starter's request. Files are names in the folder.

    Attributes:
        command: mongod and its arguments.
        socket: Path of mongod's unix socket, the only file in its directory.
        record: File that names the socket while this keeper runs.
        users_lock: File on which every process that uses mongod holds a shared lock.
        log: Name of the log.
        linger_s: Seconds for which mongod runs after its last use.
        folder_fd: Descriptor of the folder.
        log_fd: Descriptor of the log for mongod's output, for reading and appending.
        alive_fd: Descriptor whose lock mongod shares.
    """

    command: list[str]
    socket: str
    record: str
    users_lock: str
    log: str
    linger_s: float
    folder_fd: int
    log_fd: int
    alive_fd: int


def main(job: Job) -> int:
    """Run mongod until it is unused; return the exit status of this process."""
    os.umask(0o077)
    end_signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, _frame: end_signals.append(got))
    try:
        mongod = _start(job)
    except OSError as error:
        _say(job, f"cannot run {job['command'][0]}: {error}")
        _clean(job)
        return 1
    is_removed = False
    try:
        users = _open(job, job["users_lock"], os.O_RDWR)
        _write_record(job, mongod.pid)
        is_removed = _wait(job, mongod, users, end_signals)
    except OSError as error:  # the record cannot be written on a full disk
        _say(job, f"the keeper of mongod failed: {error}")
    finally:
        status = mongod.poll()
        if status is None:
            _end(mongod, at_once=is_removed)
        else:
            _say(job, f"mongod ended by itself, {describe_status(status)}")
        _clean(job)
    return 0


def describe_status(status: int) -> str:
    """Describe a process's return code."""
    return f"killed by signal {-status}" if status < 0 else f"with exit status {status}"


def _start(job: Job) -> subprocess.Popen[bytes]:
    _raise_limits()
    _put_log_aside(job)
    # C, since mongod does not start under a locale that is not installed, and ssh passes
    # on the locale of the other side.
    environment = {**os.environ, "LC_ALL": "C"}
    _say(job, "starts mongod")
    return subprocess.Popen(  # noqa: S603 - the starter's own command
        job["command"],
        stdin=subprocess.DEVNULL,
        stdout=job["log_fd"],
        stderr=job["log_fd"],
        env=environment,
        pass_fds=(job["alive_fd"],),
        preexec_fn=_die_with(os.getpid()),  # noqa: PLW1509 - there are no threads
    )


def _open(job: Job, name: str, flags: int) -> int:
    """Open a file in the folder; a symlink in its place is an error."""
    safe = flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    return os.open(name, safe, 0o600, dir_fd=job["folder_fd"])


def _new_file(job: Job, name: str) -> int:
    """Create a file in the folder for writing; replace a file or symlink of its name."""
    with contextlib.suppress(FileNotFoundError):
        os.unlink(name, dir_fd=job["folder_fd"])
    return _open(job, name, os.O_WRONLY | os.O_CREAT | os.O_EXCL)


def _write(fd: int, content: bytes) -> None:
    while content:
        content = content[os.write(fd, content) :]


def _die_with(keeper: int) -> Callable[[], None] | None:
    """Runs in mongod's process before exec: ends it when the keeper ends."""
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def tie() -> None:
        prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM), 0, 0, 0)
        if os.getppid() != keeper:  # the keeper died before the line above
            os._exit(1)

    return tie


def _raise_limits() -> None:
    """Undo the starter's limit of memory, and allow many open files."""
    hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
    resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    unlimited = resource.RLIM_INFINITY
    wanted = OPEN_FILES if hard == unlimited else min(OPEN_FILES, hard)
    if soft not in {unlimited, wanted} and soft < wanted:
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _wait(job: Job, mongod: subprocess.Popen[bytes], users: int, end_signals: list[int]) -> bool:
    """Wait until mongod has ended, a signal asks to end, or it is idle (`users` is then locked).

    Returns:
        Whether the store was removed, and mongod's data with it.
    """
    born = time.monotonic()
    checked_log = born
    idle_since: float | None = None
    while mongod.poll() is None and not end_signals:
        now = time.monotonic()
        if os.fstat(users).st_nlink == 0:
            return True
        if _lock(users):
            if _is_published(users) or _has_clients(job["socket"]):
                idle_since = None
            elif idle_since is None:
                idle_since = now
            if idle_since is not None and now - idle_since >= job["linger_s"]:
                # It stays locked: new users wait until mongod and this process have ended,
                # and then start a new one.
                return False
            fcntl.flock(users, fcntl.LOCK_UN)
        else:
            idle_since = None
        if now - checked_log > LOG_CHECK_S:
            checked_log = now
            _put_log_aside(job)
        time.sleep(POLL_AT_START_S if now - born < YOUNG_S else POLL_S)
    return False


def _is_published(users: int) -> bool:
    """True while clients are waited for: the time of the file is set to the end of it."""
    return 0 < os.fstat(users).st_mtime - time.time() < PUBLISHED_S


def _has_clients(socket: str) -> bool:
    """True if any program is connected to a socket; other systems than Linux do not tell."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/net/unix").read_bytes().splitlines()
        # Num, RefCount, Protocol, Flags, Type, St, Inode, Path
        connected = [line.split(None, 5)[5].split(None, 2) for line in lines[1:]]
        return any(one[0] == CONNECTED and one[2:] == [os.fsencode(socket)] for one in connected)
    return False


def _lock(users: int) -> bool:
    try:
        fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _end(mongod: subprocess.Popen[bytes], *, at_once: bool) -> None:
    if at_once:
        mongod.kill()
    mongod.terminate()
    try:
        mongod.wait(END_LIMIT_S)
    except subprocess.TimeoutExpired:
        mongod.kill()  # its journal restores everything
        mongod.wait()


def _write_record(job: Job, pid: int) -> None:
    fresh = job["record"] + ".new"
    content = json.dumps({"socket": job["socket"], "mongod": pid, "keeper": os.getpid()})
    fd = _new_file(job, fresh)
    try:
        _write(fd, content.encode())
    finally:
        os.close(fd)
    folder = job["folder_fd"]
    os.rename(fresh, job["record"], src_dir_fd=folder, dst_dir_fd=folder)


def _clean(job: Job) -> None:
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        # Another keeper may have written a record since.
        fd = _open(job, job["record"], os.O_RDONLY)
        try:
            keeper = json.loads(os.read(fd, RECORD_LIMIT))["keeper"]
        finally:
            os.close(fd)
        if keeper == os.getpid():
            os.unlink(job["record"], dir_fd=job["folder_fd"])
    socket = Path(job["socket"])
    with contextlib.suppress(OSError):
        socket.unlink()
    with contextlib.suppress(OSError):
        socket.parent.rmdir()


def _put_log_aside(job: Job) -> None:
    """Rotate a long log. mongod appends, so its descriptor stays valid."""
    log = job["log_fd"]
    with contextlib.suppress(OSError):
        if os.fstat(log).st_size <= LOG_LIMIT:
            return
        aside = _new_file(job, job["log"] + ".1")
        try:
            at = 0
            while part := os.pread(log, 1 << 20, at):
                _write(aside, part)
                at += len(part)
        finally:
            os.close(aside)
        os.ftruncate(log, 0)


def _say(job: Job, text: str) -> None:
    with contextlib.suppress(OSError):
        _write(job["log_fd"], f"hybridlog: {text}\n".encode())


if __name__ == "__main__":
    # The starter waits for this first process only. init adopts the child, so no starter
    # has to reap it.
    if os.fork():
        os._exit(0)
    sys.exit(main(json.loads(sys.argv[1])))
