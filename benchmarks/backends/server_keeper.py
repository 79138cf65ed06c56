"""The process that stands between a benchmark and a server it has started.

Run as a script by `benchmarks.backends.server`, with nothing but the standard library:

    python -I -S server_keeper.py '{"command": [...], ...}'

It starts the server, says its process id on standard output, and ends it as soon as its
standard input is closed or speaks: that is when the benchmark asks for it, and also when
the benchmark has been killed. Ends by itself when the server has ended.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import select
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypedDict

OPEN_FILES = 64_000
"""As MongoDB's documentation advises."""
END_LIMIT_S = 30.0
_PR_SET_PDEATHSIG = 1


class Job(TypedDict):
    """What is asked of a keeper. All paths are absolute.

    Attributes:
        command: The server and its arguments.
        log: Where its output goes.
        stop: Number of the signal that ends it in good order.
        sockets: Directory of its socket, removed at the end.
        lock: Descriptor that the server inherits; its lock says that the server lives.
    """

    command: list[str]
    log: str
    stop: int
    sockets: str
    lock: int


def main(job: Job) -> int:
    """Run a server until it ends or is not wanted any more; return its exit status."""
    asked, telling = os.pipe()
    os.set_blocking(telling, False)
    signal.set_wakeup_fd(telling)
    for number in (signal.SIGCHLD, signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: None)
    ending = False
    try:
        with Path(job["log"]).open("ab") as log:
            server = subprocess.Popen(
                job["command"],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd="/",
                env={**os.environ, "LC_ALL": "C"},
                pass_fds=(job["lock"],),
                preexec_fn=_ready(os.getpid(), job["stop"]),  # noqa: PLW1509 - one thread
            )
    except OSError as error:
        with contextlib.suppress(OSError), Path(job["log"]).open("a") as log_text:
            log_text.write(f"{job['command'][0]} cannot be run: {error}\n")
        shutil.rmtree(job["sockets"], ignore_errors=True)
        return 1
    try:
        os.write(1, b"%d\n" % server.pid)
        while server.poll() is None and not ending:
            heard, _, _ = select.select([0, asked], [], [])
            signals = os.read(asked, 64) if asked in heard else b""
            ending = 0 in heard or any(number != signal.SIGCHLD for number in signals)
        if ending:
            _end(server, job["stop"])
        return server.returncode
    finally:
        shutil.rmtree(job["sockets"], ignore_errors=True)


def _ready(keeper: int, stop: int) -> Callable[[], None]:
    """What the child does before it becomes the server."""
    prctl = None
    if sys.platform.startswith("linux"):
        prctl = ctypes.CDLL(None, use_errno=True).prctl

    def prepare() -> None:
        if prctl is not None:
            prctl(_PR_SET_PDEATHSIG, stop, 0, 0, 0)
            if os.getppid() != keeper:  # it died before the line above
                os._exit(1)
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
        if soft != resource.RLIM_INFINITY and soft < wanted:
            with contextlib.suppress(OSError, ValueError):
                resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))

    return prepare


def _end(server: subprocess.Popen[bytes], stop: int) -> None:
    server.send_signal(stop)
    try:
        server.wait(END_LIMIT_S)
    except subprocess.TimeoutExpired:
        server.kill()
        server.wait()


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])) != 0)
