"""A database server of a benchmark's own: started, watched, and ended with it.

The server listens on a unix socket in a private directory. The kernel ends it when the
benchmark's process ends, however that ends. A lock on a file of its directory is inherited
by the server: while one of an earlier benchmark comes to its end, the next one waits.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from hashlib import sha256
from pathlib import Path

from benchmarks import usage
from benchmarks.backends.base import BackendMissingError

START_LIMIT_S = 120.0
"""Seconds a server has to answer: it may have to recover from a crash first."""
LONGEST_SOCKET = 100
"""Bytes of a socket's path; the kernel takes 107, other systems 103."""
OPEN_FILES = 64_000
"""As MongoDB's documentation advises."""
_END_LIMIT_S = 90.0
_PR_SET_PDEATHSIG = 1


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
        self._process: subprocess.Popen[bytes] | None = None
        self._stop = signal.SIGTERM

    def prepare(self, data: Path, owner: int | None = None) -> None:
        """Wait until no earlier server has the data; make directories for it and the socket.

        Args:
            data: Directory of the data; its parent exists.
            owner: User id that the server will run as, when it is another one.
        """
        try:
            self._lock = self._locked()
            base = tempfile.gettempdir()
            base = base if len(os.fsencode(base)) <= LONGEST_SOCKET - 40 else "/tmp"
            digest = sha256(os.fsencode(self._lock_path.resolve())).hexdigest()[:16]
            place = Path(base, f"hybridlog-bench-{digest}")
            # What a benchmark that was killed has left: nobody else has the lock.
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(mode=0o700)
            self.sockets = place
            data.mkdir(mode=0o700, exist_ok=True)
            if owner is not None:
                os.chown(self.sockets, owner, -1)
                os.chown(data, owner, -1)
        except OSError as error:
            self.stop()
            raise BackendMissingError(
                f"{data.parent} cannot be used for {self.name}: {error.strerror} "
                f"({error.filename}). Give a directory on a local disk that can be written."
            ) from error

    def start(
        self, command: Sequence[str], stop: signal.Signals, answers: Callable[[], bool]
    ) -> None:
        """Start it and wait until it answers. Needs `prepare`; `stop` is needed after.

        Args:
            command: The program and its arguments.
            stop: The signal that ends it in good order.
            answers: Whether it answers now; returns soon.
        """
        assert self._lock is not None
        begin = self.log.stat().st_size if self.log.exists() else 0
        self._stop = stop
        try:
            with self.log.open("ab") as log:
                self._process = subprocess.Popen(
                    list(command),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd="/",
                    env={**os.environ, "LC_ALL": "C"},
                    pass_fds=(self._lock,),
                    start_new_session=True,  # Ctrl-C is for the benchmark, which then ends it
                    preexec_fn=_ready(os.getpid(), stop),  # noqa: PLW1509 - no threads yet
                )
        except OSError as error:
            self.stop()
            raise BackendMissingError(f"{self.name} cannot be started: {error}.") from error
        deadline = time.monotonic() + START_LIMIT_S
        while not answers():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.stop()
                text = self.log.read_bytes()[begin:][-2000:].decode(errors="replace")
                raise BackendMissingError(
                    f"{self.name} does not start: {' '.join(text.split()) or 'it logged nothing'}. "
                    f"The whole log is {self.log}."
                )
            time.sleep(0.02)

    def processes(self) -> Sequence[int]:
        """Process ids of the server and its children."""
        process = self._process
        if process is None or process.poll() is not None:
            return ()
        return [process.pid, *(usage.with_children([process.pid]) - {process.pid})]

    def stop(self) -> None:
        """End it, and wait for the end. May be called at any time, and again."""
        process, self._process = self._process, None
        if process is not None:
            process.send_signal(self._stop)
            try:
                process.wait(_END_LIMIT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None
            if process is not None:
                # Children of a killed server have the lock until they have ended, too.
                os.close(self._locked())
        if self.sockets != Path():
            shutil.rmtree(self.sockets, ignore_errors=True)

    def _locked(self) -> int:
        """A descriptor with the lock."""
        descriptor = os.open(self._lock_path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        deadline = time.monotonic() + _END_LIMIT_S
        while True:
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                return descriptor
            if time.monotonic() > deadline:
                os.close(descriptor)
                raise BackendMissingError(
                    f"Another {self.name} runs in {self.log.parent}: end that benchmark first, "
                    "or give another directory."
                )
            time.sleep(0.02)


def _ready(parent: int, stop: int) -> Callable[[], None]:
    """The child's steps before it becomes the server."""
    is_linux = sys.platform.startswith("linux")
    prctl = ctypes.CDLL(None, use_errno=True).prctl if is_linux else None

    def prepare() -> None:
        if prctl is not None:
            prctl(_PR_SET_PDEATHSIG, stop, 0, 0, 0)
            if os.getppid() != parent:  # it died before the line above
                os._exit(1)
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        wanted = OPEN_FILES if hard == resource.RLIM_INFINITY else min(OPEN_FILES, hard)
        if soft != resource.RLIM_INFINITY and soft < wanted:
            with contextlib.suppress(OSError, ValueError):
                resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))

    return prepare
