"""What the backends that write recording files have in common.

A file of a recording cannot be added to once it has come to its end. A backend that is
opened on a directory with files from before, perhaps only to read them, therefore begins
a new one, with the next number, when the first message comes; otherwise at once.
"""

from __future__ import annotations

import os
import threading
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

from benchmarks.backends.base import Backend, BackendFailedError

if TYPE_CHECKING:
    from hybridlog_storage.messages import Channel


class Recorder(Protocol):
    """What writes one file."""

    def write(self, channel: int, log_time: int, payload: bytes) -> None:
        """Append a message."""

    def close(self) -> None:
        """Write what belongs at the end, and close the file."""


class FileBackend(Backend):
    """Recorders under one lock: files are written by one thread at a time."""

    kind = "file"

    suffix: ClassVar[str]
    """Of the files' names."""

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._channels: Sequence[Channel] = ()
        self._recorder: Recorder | None = None
        self._started: Path | None = None
        self._lock = threading.Lock()

    @property
    def paths(self) -> list[Path]:
        """All files, oldest first."""
        return sorted(self.directory.glob(f"recording-*{self.suffix}"))

    @property
    def path(self) -> Path:
        """The newest file."""
        return self.paths[-1]

    def open(self, channels: Sequence[Channel]) -> None:
        self.check()
        self._channels = channels
        if not self.paths:
            with self._lock, self._failures():
                self._begin()

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        with self._lock, self._failures():
            recorder = self._recorder or self._begin()
            recorder.write(channel, log_time, payload)

    def _begin(self) -> Recorder:
        self._started = self.directory / f"recording-{len(self.paths) + 1:04d}{self.suffix}"
        self._recorder = self._record(self._started)
        return self._recorder

    def finish(self) -> None:
        with self._lock:
            recorder, self._recorder = self._recorder, None
            if recorder is None or self._started is None:
                return
            with self._failures():
                recorder.close()
                _sync(self._started)
                _sync(self.directory)

    def counts(self) -> Mapping[str, int]:
        found = dict.fromkeys((channel.topic for channel in self._channels), 0)
        with self._failures():
            for path in self.paths:
                for topic, count in self._count(path).items():
                    found[topic] = found.get(topic, 0) + count
        return found

    def close(self) -> None:
        with self._lock:
            recorder, self._recorder = self._recorder, None
            if recorder is not None:
                with suppress(Exception):  # on a full disk there is no good end
                    recorder.close()

    @abstractmethod
    def _record(self, path: Path) -> Recorder:
        """Begin a file."""

    @abstractmethod
    def _count(self, path: Path) -> Mapping[str, int]:
        """Read all messages of a file and count them by topic."""

    @contextmanager
    def _failures(self) -> Iterator[None]:
        """Whatever a package raises is a failure of the backend."""
        try:
            yield
        except Exception as error:
            of_system = isinstance(error, OSError) and error.strerror
            reason = of_system or str(error)
            raise BackendFailedError(f"{self.name}: {type(error).__name__}: {reason}") from error


def _sync(path: Path) -> None:
    """See a file, or everything in a directory, on the disk."""
    for place in (path, *path.iterdir()) if path.is_dir() else (path,):
        descriptor = os.open(place, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
