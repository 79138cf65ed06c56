"""Commands in processes of their own, forked from one that has imported what they need.

`python -m tests.cli.fork_server` serves a socket at its standard input. Each request passes the
two ends of the pipes that become the streams of a command, then arguments, directory and
environment as a line of JSON. Answers are the number of the process, and how it has ended.
"""

from __future__ import annotations

import atexit
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

PACKAGES = ("hybridlog.cli", "hybridlog.query", "hybridlog_storage")
OTHERS = ("numpy", "pyarrow.compute", "pyarrow.parquet", "pymongo", "rich.progress")
AT_START = ("PYTHON", "LC_", "LANG", "LD_", "TZ")
"""Beginnings of variables that a program reads when it starts."""
ROOT = Path(__file__).parents[2]


class ForkServer:
    """The process that forks. It ends with this one.

    Args:
        environment: Of the process; commands may have others.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._at_start = _at_start(environment)
        self._lock = threading.Lock()
        self._socket, other = socket.socketpair()
        with other:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__],
                cwd=ROOT,
                stdin=other,
                stdout=subprocess.DEVNULL,
                env=environment,
            )
        self._replies = self._socket.makefile("rb")

    def run(
        self, arguments: Sequence[str], environment: Mapping[str, str], limit_s: float
    ) -> subprocess.CompletedProcess[bytes] | None:
        """Run a command to its end; None if it needs a start, or another one is running."""
        if _at_start(environment) != self._at_start or not self._lock.acquire(blocking=False):
            return None
        try:
            return self._run(arguments, environment, limit_s)
        finally:
            self._lock.release()

    def _run(
        self, arguments: Sequence[str], environment: Mapping[str, str], limit_s: float
    ) -> subprocess.CompletedProcess[bytes]:
        (out, to_out), (err, to_err) = os.pipe(), os.pipe()
        asked = {"arguments": arguments, "directory": os.getcwd(), "environment": {**environment}}  # noqa: PTH109
        socket.send_fds(self._socket, [b"\n"], [to_out, to_err])
        os.close(to_out)
        os.close(to_err)
        self._socket.sendall(json.dumps(asked).encode() + b"\n")
        process = int(self._replies.readline())
        timer = threading.Timer(limit_s, functools.partial(os.kill, process, signal.SIGKILL))
        timer.start()
        try:
            with (
                os.fdopen(out, "rb") as told,
                os.fdopen(err, "rb") as said,
                ThreadPoolExecutor(1) as beside,
            ):
                errors = beside.submit(said.read)
                found = told.read(), errors.result()
            code = int(self._replies.readline())
        finally:
            timer.cancel()
        return subprocess.CompletedProcess(arguments, code, *found)

    def close(self) -> None:
        """End the process."""
        self._replies.close()
        self._socket.close()
        self._process.wait()


@functools.cache
def fork_server() -> ForkServer:
    """The one of this process."""
    kept = {k: v for k, v in os.environ.items() if k not in {"HYBRIDLOG_STORE", "COLUMNS"}}
    server = ForkServer({**kept, "LC_ALL": "C.UTF-8"})
    atexit.register(server.close)
    return server


def _at_start(environment: Mapping[str, str]) -> dict[str, str]:
    return {k: v for k, v in environment.items() if k.startswith(AT_START)}


def serve() -> None:
    """Fork for each request, until there are no more; returns in the processes for commands."""
    for name in PACKAGES:
        package = importlib.import_module(name)
        for found in pkgutil.walk_packages(package.__path__, f"{name}."):
            importlib.import_module(found.name)
    for name in OTHERS:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()
    # The number is free for the standard input of commands.
    requests = socket.socket(fileno=os.dup(0))
    lines = open(requests.fileno(), "rb", closefd=False)  # noqa: SIM115
    while True:
        mark, streams, *_ = socket.recv_fds(requests, 1, 2)
        if not mark:
            os._exit(0)
        asked = json.loads(lines.readline())
        process = os.fork()
        if not process:
            break
        for stream in streams:
            os.close(stream)
        requests.sendall(b"%d\n" % process)
        _, status = os.waitpid(process, 0)
        requests.sendall(b"%d\n" % os.waitstatus_to_exitcode(status))
    gc.unfreeze()
    for number, stream in enumerate([os.open(os.devnull, os.O_RDONLY), *streams]):
        os.dup2(stream, number)
        os.close(stream)
    requests.close()
    # Those of before believe that they are files of other kinds.
    sys.stdin = open(0, encoding=sys.stdin.encoding, closefd=False)  # noqa: SIM115
    sys.stdout, sys.stderr = (
        open(number, "w", int(number == 2) or -1, one.encoding, one.errors, closefd=False)  # noqa: SIM115
        for number, one in ((1, sys.stdout), (2, sys.stderr))
    )
    sys.__stdin__, sys.__stdout__, sys.__stderr__ = sys.stdin, sys.stdout, sys.stderr
    os.environ.clear()
    os.environ.update(asked["environment"])
    os.chdir(asked["directory"])
    sys.argv = ["hybridlog", *asked["arguments"]]
    sys.path[0] = asked["directory"]


if __name__ == "__main__":
    serve()
    runpy.run_module("hybridlog", run_name="__main__", alter_sys=True)
