"""A database server of a benchmark's own: started, watched, and ended with it.

The server listens on a unix socket in a private directory. A keeper, `server_keeper.py`,
ends it when the benchmark does, however that ends. A lock on a file of its directory is
inherited by the server: while one of an earlier benchmark is still coming to its end, the
next one waits.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.backends.base import BackendMissingError
from benchmarks.backends.processes import family

START_LIMIT_S = 120.0
"""Seconds a server has to answer: it may have to recover from a crash first."""
LONGEST_SOCKET = 100
"""Bytes of a socket's path; the kernel takes 107, other systems 103."""
_END_LIMIT_S = 90.0
_TAIL = 2000


class Server:
    """One server process.

    Args:
        name: For messages and file names: `mongod`.
        directory: Exists; gets the log and the lock.
    """

    def __init__(self, name: str, directory: Path) -> None:
        self.name = name
        self.log = directory / f"{name}.log"
        self.sockets = Path()
        """Private directory of the socket; made by `prepare`."""
        self._lock_path = directory / f"{name}.lock"
        self._lock: int | None = None
        self._keeper: subprocess.Popen[str] | None = None
        self._pid = 0

    def prepare(self, data: Path, owner: int | None = None) -> None:
        """Wait until no earlier server has the data; make directories for it and the socket.

        Args:
            data: Directory of the data; its parent exists.
            owner: User id that the server will run as, when it is another one.

        Raises:
            BackendMissingError: Another benchmark uses it, or it cannot be written.
        """
        try:
            self._prepare(data, owner)
        except OSError as error:
            self._unlock()
            raise BackendMissingError(
                f"{data.parent} cannot be used for {self.name}: {error.strerror} "
                f"({error.filename}). Give a directory on a local disk that can be written."
            ) from error

    def _prepare(self, data: Path, owner: int | None) -> None:
        self._lock = os.open(self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        deadline = time.monotonic() + _END_LIMIT_S
        while not _locked(self._lock):
            if time.monotonic() > deadline:
                self._unlock()
                raise BackendMissingError(
                    f"Another {self.name} runs in {self.log.parent}: end that benchmark first, "
                    "or give another directory."
                )
            time.sleep(0.02)
        self.sockets = _socket_directory()
        data.mkdir(mode=0o700, exist_ok=True)
        if owner is not None:
            os.chown(self.sockets, owner, -1)
            os.chown(data, owner, -1)

    def start(
        self, command: Sequence[str], stop: signal.Signals, answers: Callable[[], bool]
    ) -> None:
        """Start it and wait until it answers. Needs `prepare`; `stop` is needed after.

        Args:
            command: The program and its arguments.
            stop: The signal that ends it in good order.
            answers: Whether it answers now; returns soon.

        Raises:
            BackendMissingError: It ends, or does not answer; with what it logged.
        """
        assert self._lock is not None
        begin = self.log.stat().st_size if self.log.exists() else 0
        job = {
            "command": list(command),
            "log": str(self.log.absolute()),
            "stop": int(stop),
            "sockets": str(self.sockets),
            "lock": self._lock,
        }
        script = Path(__file__).with_name("server_keeper.py")
        try:
            self._keeper = subprocess.Popen(
                [sys.executable, "-I", "-S", str(script), json.dumps(job)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
                cwd="/",
                pass_fds=(self._lock,),
                start_new_session=True,  # Ctrl-C is for the benchmark, which then ends it
            )
        except OSError as error:
            self.stop()
            raise BackendMissingError(f"{self.name} cannot be started: {error}.") from error
        assert self._keeper.stdout is not None
        self._pid = int(self._keeper.stdout.readline() or 0)
        deadline = time.monotonic() + START_LIMIT_S
        while not answers():
            if not self.is_running() or time.monotonic() > deadline:
                self.stop()
                raise BackendMissingError(
                    f"{self.name} does not start: {self._said(begin) or 'it logged nothing'}. "
                    f"The whole log is {self.log}."
                )
            time.sleep(0.02)

    def is_running(self) -> bool:
        """Whether it has not ended yet."""
        return self._keeper is not None and self._keeper.poll() is None

    def processes(self) -> Sequence[int]:
        """Process ids of the server and its children; the keeper is not one of them."""
        return family(self._pid) if self._pid and self.is_running() else ()

    def stop(self) -> None:
        """End it, and wait for the end. May be called at any time, and again."""
        keeper, self._keeper = self._keeper, None
        if keeper is not None:
            assert keeper.stdin is not None
            assert keeper.stdout is not None
            with contextlib.suppress(OSError):
                keeper.stdin.write("end\n")
                keeper.stdin.close()
            try:
                keeper.wait(_END_LIMIT_S)
            except subprocess.TimeoutExpired:
                keeper.kill()  # its server goes with it
                keeper.wait()
            keeper.stdout.close()
            self._wait_for_children()
        self._pid = 0
        self._unlock()

    def _wait_for_children(self) -> None:
        """Wait until what a killed server has left behind has ended, too."""
        self._unlock()
        descriptor = os.open(self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        deadline = time.monotonic() + _END_LIMIT_S
        while not _locked(descriptor) and time.monotonic() < deadline:
            time.sleep(0.02)
        os.close(descriptor)

    def _unlock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
            # The keeper removes it, too; there may have been none.
            if self.sockets != Path():
                shutil.rmtree(self.sockets, ignore_errors=True)

    def _said(self, begin: int) -> str:
        with contextlib.suppress(OSError), self.log.open("rb") as log:
            log.seek(max(begin, self.log.stat().st_size - _TAIL))
            return " ".join(log.read().decode(errors="replace").split())
        return ""


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _socket_directory() -> Path:
    """A new private directory whose path is short enough for a socket."""
    base = tempfile.gettempdir()
    if len(os.fsencode(base)) > LONGEST_SOCKET - 40:
        base = "/tmp"
    return Path(tempfile.mkdtemp(prefix="hybridlog-bench-", dir=base))
