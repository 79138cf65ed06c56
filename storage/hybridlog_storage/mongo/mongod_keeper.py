"""The process that starts one embedded mongod, waits, and ends it.

`hybridlog_storage.mongo.mongod` runs it as a script. It uses only the standard library, so it
starts fast and stays small. It outlives its starter: mongod belongs to all processes on a store.

    python -I -S mongod_keeper.py LOCK_FD LINGER_S SOCKET MONGOD ARGUMENT...

It runs in the directory of mongod, with the log as standard output, and inherits an open,
locked file, which mongod inherits in turn: its lock means that one of both has not ended.
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
from collections.abc import Callable
from pathlib import Path

LOG_LIMIT = 10 << 20
"""Bytes of log after which it is emptied."""
END_LIMIT_S = 30.0
"""Seconds for an orderly end of mongod."""
PUBLISHED_S = 86_400.0
"""Most seconds for which mongod waits for clients."""
_PR_SET_PDEATHSIG = 1


def main(lock: int, linger_s: float, socket: str, command: list[str]) -> int:
    """Run mongod until it is unused for `linger_s`; the exit status of this process.

    mongod shares the lock of the descriptor `lock`.
    """
    os.umask(0o077)
    fcntl.lockf(lock, fcntl.LOCK_EX)  # which mongod does not share
    end_signals: list[int] = []
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda got, _frame: end_signals.append(got))
    try:
        mongod = _start(lock, command)
    except OSError as error:
        _say(f"cannot run {command[0]}: {error}")
        return 1
    is_removed = False
    try:
        users = os.open("users.lock", os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        is_removed = _wait(mongod, users, socket, linger_s, end_signals)
    except OSError as error:
        _say(f"the keeper of mongod failed: {error}")
    finally:
        status = mongod.poll()
        if status is None:
            _end(mongod, at_once=is_removed)
        else:
            how = f"killed by signal {-status}" if status < 0 else f"with exit status {status}"
            _say(f"mongod ended by itself, {how}")
        with contextlib.suppress(OSError):
            Path(socket).unlink()  # one that was killed has left it
    return 0


def _start(lock: int, command: list[str]) -> subprocess.Popen[bytes]:
    _raise_limits()
    _empty_long_log()
    # C, since mongod does not start under a locale that is not installed, and ssh passes
    # on the locale of the other side.
    environment = {**os.environ, "LC_ALL": "C"}
    _say("starts mongod")
    return subprocess.Popen(  # noqa: S603 - the starter's own command
        command,
        stdin=subprocess.DEVNULL,
        env=environment,
        pass_fds=(lock,),
        preexec_fn=_die_with(os.getpid()),  # noqa: PLW1509 - there are no threads
    )


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
    """Undo the starter's limits of memory and of open files: each collection takes about two."""
    for limit in (resource.RLIMIT_DATA, resource.RLIMIT_NOFILE):
        hard = resource.getrlimit(limit)[1]
        with contextlib.suppress(OSError, ValueError):
            resource.setrlimit(limit, (hard, hard))


def _wait(
    mongod: subprocess.Popen[bytes],
    users: int,
    socket: str,
    linger_s: float,
    end_signals: list[int],
) -> bool:
    """Wait until mongod has ended, a signal asks to end, or it is idle (`users` is then locked).

    True if the store was removed, and mongod's data with it.
    """
    born = used = time.monotonic()
    while mongod.poll() is None and not end_signals:
        now, about = time.monotonic(), os.fstat(users)
        if about.st_nlink == 0:
            return True
        try:
            fcntl.flock(users, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            used = now
        else:
            # Clients are waited for until the time that the file is set to.
            is_published = 0 < about.st_mtime - time.time() < PUBLISHED_S
            if is_published or _has_clients(socket):
                used = now
            elif now - used >= linger_s:
                # It stays locked: new users wait until mongod and this process have ended,
                # and then start a new one.
                return False
            fcntl.flock(users, fcntl.LOCK_UN)
        _empty_long_log()
        time.sleep(0.05 if now - born < 3 else 0.25)
    return False


def _has_clients(socket: str) -> bool:
    """True if any program is connected to a socket; other systems than Linux do not tell."""
    with contextlib.suppress(OSError):
        lines = Path("/proc/net/unix").read_bytes().splitlines()
        # Num, RefCount, Protocol, Flags, Type, St (3: connected), Inode, Path
        connected = [line.split(None, 5)[5].split(None, 2) for line in lines[1:]]
        return any(one[0] == b"03" and one[2:] == [os.fsencode(socket)] for one in connected)
    return False


def _end(mongod: subprocess.Popen[bytes], *, at_once: bool) -> None:
    if at_once:
        mongod.kill()
    mongod.terminate()
    try:
        mongod.wait(END_LIMIT_S)
    except subprocess.TimeoutExpired:
        mongod.kill()  # its journal restores everything
        mongod.wait()


def _empty_long_log() -> None:
    """Empty a long log. mongod appends, so its descriptor stays valid."""
    with contextlib.suppress(OSError):
        if os.fstat(1).st_size > LOG_LIMIT:
            os.ftruncate(1, 0)


def _say(text: str) -> None:
    with contextlib.suppress(OSError):
        os.write(1, f"hybridlog: {text}\n".encode())


if __name__ == "__main__":
    # The starter waits for this first process only. init adopts the child, so no starter
    # has to reap it.
    if os.fork():
        os._exit(0)
    given_lock, given_linger, given_socket, *given = sys.argv[1:]
    sys.exit(main(int(given_lock), float(given_linger), given_socket, given))
