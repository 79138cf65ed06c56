"""Commands in processes of their own, forked from one that has imported what they need.

`python -m tests.cli.fork_server FOLDER` serves the socket `FOLDER/socket`, a connection for each
command: the three streams and a line of JSON with arguments, directory, environment and ignored
signals. Each line after that is a signal to the command; when the connection ends, it is killed.
The answer is how it has ended. The script `FOLDER/hybridlog` asks there, for shells.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

PACKAGES = ("hybridlog.cli", "hybridlog.query", "hybridlog_storage")
OTHERS = ("numpy", "pyarrow.compute", "pyarrow.parquet", "pymongo", "rich.progress")
AT_START = ("PYTHON", "LC_", "LANG", "LD_", "TZ")
"""Beginnings of variables that a program reads when it starts."""
ROOT = Path(__file__).parents[2]
SCRIPT = """#!{python} -IS
import array, json, os, signal, socket, sys
words = sys.argv[1:]
at_start = {{k: v for k, v in os.environ.items() if k.startswith({at_start})}}
if at_start != {variables} or any(word.startswith("/dev/") for word in words):
    os.execv({python!r}, [{python!r}, "-m", "hybridlog", *words])
ignored = [n for n in (1, 2, 15) if signal.getsignal(n) is signal.SIG_IGN]
asked = dict(
    arguments=words, directory=os.getcwd(), environment=dict(os.environ), ignored=ignored
)
server = socket.socket(socket.AF_UNIX)
server.connect({address!r})
streams = array.array("i", [0, 1, 2])
server.sendmsg([b"\\n"], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, streams)])
server.sendall(json.dumps(asked).encode() + b"\\n")
for number in 1, 2, 15:  # a command may listen to those that it ignores at first
    signal.signal(number, lambda number, _: server.sendall(b"%d\\n" % number))
code = int(server.makefile().readline())
if code < 0:
    signal.signal(-code, signal.SIG_DFL)
    os.kill(os.getpid(), -code)
os._exit(code)
"""


class ForkServer:
    """The process that forks. It ends with this one.

    Args:
        environment: Of the process; commands may have others.
        modules: That it imports beside those that each command needs.
    """

    def __init__(self, environment: Mapping[str, str], *modules: str) -> None:
        self._at_start = _at_start(environment)
        self._folder = tempfile.TemporaryDirectory(prefix="hl-fork-")
        self.path = Path(self._folder.name)
        """A folder with the command, for PATH."""
        self._address = str(self.path / "socket")
        script = self.path / "hybridlog"
        script.write_text(
            SCRIPT.format(
                python=sys.executable,
                at_start=AT_START,
                variables=self._at_start,
                address=self._address,
            )
        )
        script.chmod(0o755)
        alive, self._alive = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, self._address, *modules],
            cwd=ROOT,
            stdin=alive,
            stdout=subprocess.PIPE,
            env=environment,
        )
        os.close(alive)
        assert self._process.stdout is not None
        with self._process.stdout as told:
            assert told.read() == b"ready\n"

    def run(
        self, arguments: Sequence[str], environment: Mapping[str, str], limit_s: float
    ) -> subprocess.CompletedProcess[bytes] | None:
        """Run a command to its end; None if it needs a start."""
        if _at_start(environment) != self._at_start:
            return None
        (out, to_out), (err, to_err) = os.pipe(), os.pipe()
        asked = {
            "arguments": arguments,
            "directory": os.getcwd(),  # noqa: PTH109
            "environment": {**environment},
            "ignored": [],
        }
        with socket.socket(socket.AF_UNIX) as server, Path(os.devnull).open("rb") as nothing:
            server.connect(self._address)
            socket.send_fds(server, [b"\n"], [nothing.fileno(), to_out, to_err])
            os.close(to_out)
            os.close(to_err)
            server.sendall(json.dumps(asked).encode() + b"\n")
            server.settimeout(limit_s)
            with (
                os.fdopen(out, "rb") as told,
                os.fdopen(err, "rb") as said,
                ThreadPoolExecutor(2) as beside,
            ):
                outputs = beside.submit(told.read), beside.submit(said.read)
                try:
                    code = int(server.makefile().readline())
                except TimeoutError:
                    server.shutdown(socket.SHUT_RDWR)  # kills the command
                    code = -signal.SIGKILL
                output, errors = (output.result() for output in outputs)
        return subprocess.CompletedProcess(arguments, code, output, errors)

    def close(self) -> None:
        """End the process."""
        os.close(self._alive)
        self._process.wait()
        self._folder.cleanup()


@functools.cache
def fork_server() -> ForkServer:
    """The one of this process."""
    kept = {k: v for k, v in os.environ.items() if k not in {"HYBRIDLOG_STORE", "COLUMNS"}}
    server = ForkServer({**kept, "LC_ALL": "C.UTF-8"})
    atexit.register(server.close)
    return server


def _at_start(environment: Mapping[str, str]) -> dict[str, str]:
    return {k: v for k, v in environment.items() if k.startswith(AT_START)}


def serve(address: str, *modules: str) -> None:
    """Fork for each connection until standard input ends; returns in the processes for commands."""
    for name in PACKAGES:
        package = importlib.import_module(name)
        for found in pkgutil.walk_packages(package.__path__, f"{name}."):
            importlib.import_module(found.name)
    for name in (*OTHERS, *modules):
        importlib.import_module(name)
    gc.collect()
    gc.freeze()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(address)
    listener.listen(64)
    selector = selectors.DefaultSelector()
    # The numbers of the streams are free for commands.
    alive = os.dup(0)
    selector.register(alive, selectors.EVENT_READ)
    selector.register(listener, selectors.EVENT_READ)
    os.write(1, b"ready\n")
    with Path(os.devnull).open("r+b") as nothing:
        os.dup2(nothing.fileno(), 0)
        os.dup2(nothing.fileno(), 1)
    commands: dict[int, tuple[int, socket.socket]] = {}
    while True:
        for key, _ in selector.select():
            if key.fd == alive:
                for process, _ in commands.values():
                    os.kill(process, signal.SIGKILL)
                os._exit(0)
            elif key.fileobj is listener:
                connection, _ = listener.accept()
                streams, asked, signals = _request(connection)
                process = os.fork()
                if not process:
                    for one in list(selector.get_map().values()):
                        os.close(one.fd) if one.data is None else one.data.close()
                    listener.detach()
                    connection.close()
                    selector.close()
                    _become(streams, asked)
                    return
                for stream in streams:
                    os.close(stream)
                _pass_on(process, signals)
                ended = os.pidfd_open(process)
                commands[ended] = process, connection
                selector.register(ended, selectors.EVENT_READ)
                selector.register(connection, selectors.EVENT_READ, connection)
            elif key.data is None:
                process, connection = commands.pop(key.fd)
                _, status = os.waitpid(process, 0)
                selector.unregister(key.fd)
                os.close(key.fd)
                if connection.fileno() in selector.get_map():
                    selector.unregister(connection)
                with contextlib.suppress(OSError), connection:
                    connection.sendall(b"%d\n" % os.waitstatus_to_exitcode(status))
            elif key.data.fileno() >= 0:
                (process,) = [p for p, connection in commands.values() if connection is key.data]
                signals = key.data.recv(1024)
                if not signals:
                    selector.unregister(key.data)
                _pass_on(process, signals or b"9")


def _pass_on(process: int, signals: bytes) -> None:
    for number in signals.split():
        os.kill(process, int(number))


def _request(connection: socket.socket) -> tuple[list[int], dict[str, Any], bytes]:
    """Streams of a command, what it is, and signals that have come already."""
    _, streams, *_ = socket.recv_fds(connection, 1, 3)
    text = b""
    while b"\n" not in text:
        text += connection.recv(1 << 16)
    line, _, signals = text.partition(b"\n")
    return streams, json.loads(line), signals


def _become(streams: Sequence[int], asked: Mapping[str, Any]) -> None:
    """Be the process of a command."""
    gc.unfreeze()
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)
    for number in asked["ignored"]:
        signal.signal(number, signal.SIG_IGN)
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
    serve(*sys.argv[1:])
    runpy.run_module("hybridlog", run_name="__main__", alter_sys=True)
