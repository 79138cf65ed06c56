"""A database server of a benchmark's own: started, watched, and ended with it.

The server listens on a unix socket in a private directory. What is left of it when the
benchmark's process ends is ended by `benchmarks.side`.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from benchmarks.backends.base import BackendMissingError

START_LIMIT_S = 120.0
"""Seconds a server has to answer: it may have to recover from a crash first."""
LONGEST_SOCKET = 100
"""Bytes of a socket's path; the kernel takes 107, other systems 103."""
OPEN_FILES = 64_000
"""As MongoDB's documentation advises."""
_END_LIMIT_S = 90.0


class Server:
    """One server process."""

    def __init__(self, name: str, directory: Path) -> None:
        self.name = name
        self.log = directory / f"{name}.log"
        self.sockets = Path()
        """Private directory of the socket; made by `prepare`."""
        self._process: subprocess.Popen[bytes] | None = None
        self._stop = signal.SIGTERM

    def prepare(self, data: Path, owner: int | None = None) -> None:
        """Make directories for the data and the socket."""
        base = tempfile.gettempdir()
        base = base if len(os.fsencode(base)) <= LONGEST_SOCKET - 40 else "/tmp"
        self.sockets = Path(tempfile.mkdtemp(prefix="hybridlog-bench-", dir=base))
        data.mkdir(mode=0o700, exist_ok=True)
        if owner is not None:
            os.chown(self.sockets, owner, -1)
            os.chown(data, owner, -1)

    def start(
        self, command: Sequence[str], stop: signal.Signals, answers: Callable[[], bool]
    ) -> None:
        """Start it and wait until it answers. Needs `prepare`; `stop` is needed after."""
        begin = self.log.stat().st_size if self.log.exists() else 0
        self._stop = stop
        hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(OPEN_FILES, hard), hard))
        try:
            with self.log.open("ab") as log:
                self._process = subprocess.Popen(
                    list(command),
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd="/",
                    env={**os.environ, "LC_ALL": "C"},
                    start_new_session=True,  # Ctrl-C is for the benchmark, which then ends it
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
        """Process id of the server, while it runs."""
        process = self._process
        return () if process is None or process.poll() is not None else (process.pid,)

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
        if self.sockets != Path():
            shutil.rmtree(self.sockets, ignore_errors=True)
